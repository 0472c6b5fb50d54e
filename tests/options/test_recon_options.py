"""No option of reconstruction is silently ignored: as tests/options/test_otsync_options.py, for ``recon`` and
``otsync run``.

``fit``, ``run`` and ``bench`` share one plan. Every option of it is tried in a real fit; of ``run`` and ``bench`` it is
then enough to see that the same plan reaches the same functions.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import json
import logging
import shutil
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import otsync.cli
import recon.cli
import recon.simulate.phones
from otsync import DTW, PAPER, Graph, Method, UnbalancedOT, Unrefined
from otsync.cli.commands import OWN as SYNC
from otsync.costs import CurveDistance
from otsync.files.arrays import read_npz
from otsync.files.cache import Cache
from otsync.files.digest import content_key
from otsync.io import open_scene
from otsync.plugins import available, entries, made
from otsync.types import Offsets, TrackSet
from recon.cli.commands import OWN
from recon.features.maps import LabMaps
from recon.fit.optimize import every_group, rates_on
from recon.fit.options import FitOptions
from recon.fit.verb import fit
from recon.losses import LOSSES, Photometric
from recon.losses.window import Window
from recon.observe import EFFECTS, Gain
from recon.observe.recorded import with_declared
from recon.pipeline.intake import only
from recon.pipeline.plan import Plan
from recon.pipeline.prepare import Prepared, prepare
from recon.result import EXPORTERS
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture
from tests.options.walk import options_of
from tests.recon.worlds import votes_at_once

COMMANDS = OWN | {name: p.value for name, p in entries("commands").items() if p.value.startswith("recon.")}
"""Where the dataclass of every command is: those of ``recon``, and what recon adds to ``otsync``."""

SIZE, FRAMES, STEPS = (64, 40), 12, 4

REASONS = {
    "fit workers": "results do not depend on it (tests/recon/pipeline/test_pipeline.py); -1 is refused below",
    "run recording.workers": "as of fit",
    "lifting lifting.repeats": "how often the cost is timed; the count is seen below, the time is the machine's",
}
"""Options that change nothing that can be compared, and why that is right."""

PLAN = {
    "width": "--width 48",
    "frames": "--frames 1 10",
    "fit.losses": "--losses photometric mask",
    "fit.effects": "--effects motion-blur:exposure=0.01",
    "fit.rates": "--rates offsets=0.1",
    "fit.freeze": "--freeze offsets",
    "fit.steps": "--steps 3",
    "fit.batch": "--batch 1",
    "fit.densify:Densify": "densify:densify",
    "fit.densify:Densify.at": "densify:densify --densify.at 0.9",
    "fit.densify:Densify.share": "densify:densify --densify.share 0.5",
    "fit.densify:Densify.min_opacity": "densify:densify --densify.min-opacity 0.8",
    "fit.densify:Densify.nodes": "densify:densify --densify.nodes 5",
    "fit.seed": "--seed 3",
    "exposure": "--exposure 0.01",
    "features": "--features lab --losses photometric mask feature",
    "bend": "--bend 0.05",
    "scaffold.unit": "--scaffold.unit 20",
    "scaffold.second_pick": "--scaffold.second-pick 1",
    "scaffold.fewest": "--scaffold.fewest 9",
    "scaffold.most": "--scaffold.fewest 9 --scaffold.most 15",
    "scaffold.spacing": "--scaffold.spacing 0.05",
    "scaffold.margin": "--scaffold.margin 0.5",
    "scaffold.per_video": "--scaffold.per-video",
    "scaffold.neighbours": "--scaffold.neighbours 3",
    "scaffold.reach": "--scaffold.reach 0.5",
    "scaffold.robust": "--scaffold.robust 0.2",
    "scaffold.shortest": "--scaffold.shortest 0.01",
    "scaffold.smooth.velocity": "--scaffold.smooth.velocity 3",
    "scaffold.smooth.acceleration": "--scaffold.smooth.acceleration 1",
    "scaffold.smooth.still": "--scaffold.smooth.still 0.1",
    "scaffold.blend": "--scaffold.blend dual-quaternion",
    "scaffold.spline": "--scaffold.spline hermite",
    "seeding.voxel": "--voxel 4",
    "seeding.support": "--seeding.support 3",
    "seeding.share": "--seeding.share 0.9",
    "seeding.reach": "--seeding.reach 0.5",
    "seeding.scale": "--seeding.scale 0.8",
    "seeding.opacity": "--seeding.opacity 0.5",
    "seeding.sh_degree": "--sh-degree 1",
    "backdrop_steps": "--backdrop-steps 9",
    "views": "--views 1",
}
"""What sets each option of a plan to another value than the base's."""

BESIDE = {"scaffold.most": "--scaffold.fewest 9", "fit.densify:Densify.": "densify:densify"}
"""What options, by the beginnings of their names, are compared beside, where they say nothing alone."""

OF_A_FIT = ("fit.save_every", "fit.budget", "device")
"""Options of a plan with tests of their own."""

TOGETHER = [o for o in PLAN if o not in ("exposure", "scaffold.unit", "fit.freeze", "fit.densify:Densify")]
APART = ["exposure", "scaffold.unit", "fit.freeze"]
"""Options of a plan that can be given at once."""


def flags(options: list[str]) -> list[str]:
    """The words that set all of these options; subcommands last, as the shell takes them."""
    texts = [PLAN[option] for option in options]
    words = [word for text in texts if not text.startswith("densify:") for word in text.split()]
    return [*words, *dict.fromkeys(word for text in texts if text.startswith("densify:") for word in text.split())]


def leaf(plan: Any, option: str) -> Any:
    """The value of an option in a plan; None where a part is off."""
    for name in option.split("."):
        plan = None if plan is None else getattr(plan, name.partition(":")[0])
    return plan


class Reached(BaseException):
    """Ends a command where it begins to work, with what had reached that place."""


def run(main: Callable[[list[str]], int], args: list[str]) -> tuple[int, str, str]:
    """(exit code, standard output, standard error) of a command in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(args)
        except SystemExit as stop:
            code = int(stop.code or 0)
    return code, out.getvalue(), err.getvalue()


def done(main: Callable[[list[str]], int], args: list[str]) -> str:
    """What a command prints that does its work."""
    code, out, err = run(main, args)
    assert code in (0, 1), err
    return out


def refused(main: Callable[[list[str]], int], args: list[str], *words: str) -> None:
    """The command ends in 2 and says what it does not take."""
    code, _, err = run(main, args)
    told = " ".join(err.replace("│", " ").split())
    assert code == 2 and all(word in told for word in words), (code, err)


def plain(x: Any) -> Any:
    """Without wall times and places, which no two runs share."""
    if isinstance(x, dict):
        return {k: plain(v) for k, v in x.items() if "seconds" not in k.split("_") and not k.endswith(("_ms", "out"))}
    return [plain(v) for v in x] if isinstance(x, list) else x


@contextlib.contextmanager
def lighter() -> Iterator[pytest.MonkeyPatch]:
    """Fits that do not ask how sure the clocks are, which takes longer than a few steps and is no option."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("recon.fit.run.Run.votes", votes_at_once)
        yield patch


def contents(folder: Path) -> dict[str, str]:
    """What is in a folder, by name."""
    return {str(p.relative_to(folder)): content_key(p.read_bytes()) for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("options")


@pytest.fixture(scope="module")
def world(home) -> Path:
    """Three cameras and one to hold out, with offsets of up to .8 frames."""
    capture = synthetic(5, cameras=3, held_out=1, frames=FRAMES, size=SIZE, offsets=0.8)
    write_capture(capture, home / "world")
    for path in (home / "world" / "tracks").glob("*.npz"):  # some end after two frames
        tracks = TrackSet.load(path)
        brief = (np.arange(len(tracks))[:, None] % 5 > 0) | (np.arange(FRAMES) < 2)
        replace(tracks, visible=tracks.seen & brief).save(path)
    start = Offsets.load(home / "world" / "start.json")  # clocks with a sigma: those are bent
    loose = np.arange(len(start.names)) != start.reference
    replace(start, sigma=np.where(loose, 0.1 / 30, 0.0)).save(home / "world" / "start.json")
    return home / "world"


@pytest.fixture(scope="module")
def synchronous(home) -> Path:
    """Four cameras that began together."""
    capture = synthetic(5, cameras=4, held_out=0, frames=FRAMES, size=SIZE, offsets=[0, 0, 0, 0])
    write_capture(capture, home / "synchronous")
    return home / "synchronous"


def elsewhere(scene: Path, folder: Path) -> Path:
    """A scene.json in ``folder`` that names the files of another folder."""
    document = json.loads((scene / "scene.json").read_text())
    for video in document["videos"]:
        for part in (video, video.get("depth", {})):
            for key in ("frames", "masks"):
                if key in part:
                    part[key] = [f"../{scene.name}/{p.relative_to(scene)}" for p in sorted(scene.glob(part[key]))]
    folder.mkdir()
    (folder / "scene.json").write_text(json.dumps(document))
    return folder


@pytest.fixture(scope="module")
def outside(world, home) -> Path:
    return elsewhere(world, home / "outside")


def base_of(option: str) -> list[str]:
    """What an option of the plan is compared beside."""
    return next((args.split() for start, args in BESIDE.items() if option.startswith(start)), [])


def fitting(world: Path, out: Path, *more: str, tracks: bool = True) -> list[str]:
    """``recon fit`` of the world; options that come later win."""
    args = ["fit", str(world), "--offsets", str(world / "start.json"), "--out", str(out), "--json"]
    args += ["--cache", str(world.parent / "stages"), "--held-out", "held0", "--width", str(SIZE[0])]
    args += ["--backdrop-steps", "5", "--views", "3", "--save-every", "1e9"]
    if tracks:
        args += ["--tracks", *map(str, sorted((world / "tracks").glob("*.npz")))]
    if not {"--steps", "--budget"} & set(more):
        args += ["--steps", str(STEPS)]
    return [*args, *more]


@pytest.fixture(scope="module")
def fitted(world, home) -> Callable[..., tuple[Any, ...]]:
    """What a fit writes and prints, but for wall times; asked once."""
    answers: dict[Any, tuple[Any, ...]] = {}

    def ask(*more: str, tracks: bool = True) -> tuple[Any, ...]:
        if (more, tracks) not in answers:
            out = home / f"fit{len(answers)}"
            with lighter() as patch:  # a report takes half of the time, and shows nothing but what is compared here
                patch.setattr("recon.pipeline.verb.write_reconstruction_report", lambda *args, **options: None)
                told = json.loads(done(recon.cli.main, fitting(world, out, *more, tracks=tracks)))
            arrays = {k: content_key(v) for k, v in read_npz(out / "scene.npz").items()}
            offsets = Offsets.load(out / "offsets.json")
            answers[more, tracks] = arrays, offsets.seconds.tolist(), str(plain(told["metrics"])), out
        return answers[more, tracks]

    return ask


def test_every_option_has_a_row():
    walked = {f"{command} {option}" for command, place in COMMANDS.items() for option in options_of(place)}
    missing, gone = walked - set(ROWS), set(ROWS) - walked
    assert not missing and not gone, f"without a row: {sorted(missing)}; no option any more: {sorted(gone)}"


@pytest.mark.parametrize("option", sorted(PLAN))
def test_options_of_the_plan_change_what_a_fit_comes_to(option, fitted):
    assert fitted(*base_of(option))[:3] != fitted(*PLAN[option].split())[:3]


def test_a_fit_of_other_things(fitted, world, outside, home):
    base = fitted()[:3]
    assert base != fitted(tracks=False)[:3]
    assert base != fitted("--offsets", str(world / "truth.json"))[:3]
    assert base != fitted("--held-out", "held0", "cam2")[:3]
    told = json.loads(done(recon.cli.main, fitting(world, home / "o", "--steps", "0")))
    allowed = [*fitting(world, home / "o", "--steps", "0"), "--allow-outside"]
    allowed[1] = str(outside)
    files = json.loads(done(recon.cli.main, allowed))
    assert plain(told) == plain(files)
    refused(recon.cli.main, allowed[:-1], "outside")
    allowed[1] = "nowhere"
    refused(recon.cli.main, allowed, "nowhere")
    refused(recon.cli.main, fitting(world, home / "o", "--workers", "-1"), "--workers")


def test_priors_of_a_fit(world, home):
    """On the world without its masks: what is tracked, and where things move."""
    bare = elsewhere(world, home / "bare")
    document = json.loads((bare / "scene.json").read_text())
    for video in document["videos"]:
        video.pop("masks", None)
    (bare / "scene.json").write_text(json.dumps(document))
    shutil.copy(world / "start.json", bare)

    def asked(*more: str) -> tuple[Any, ...]:
        out = home / f"priors{'-'.join(more).replace(':', '-')}"
        done(recon.cli.main, fitting(bare, out, "--allow-outside", *more, tracks=False))
        return {k: content_key(v) for k, v in read_npz(out / "scene.npz").items()}

    base = asked()
    for name, value in (
        ("points", "chained-flow:every=4"),
        ("masks", "flow-residual"),
        ("flow", "dis-flow:preset=fast"),
    ):
        assert base != asked(f"--recording.{name}", value), name
    # these images are no wider than the least that is tracked: that more pixels change tracks is told by otsync sync
    asked("--recording.width", "64")
    assert json.loads((home / "priors--recording.width-64" / "run.json").read_text())["options"]["priors"] == {
        "width": 64
    }
    refused(recon.cli.main, fitting(world, home / "o", "--recording.width", "9"), "--recording.width")
    refused(recon.cli.main, fitting(world, home / "o", "--recording.depth", "a"), "--depth: expected some of")
    for name, value in (("points", "blobs"), ("flow", "dis-flow")):
        refused(recon.cli.main, fitting(world, home / "o", f"--recording.{name}", value), name, "--tracks")


def test_how_long_and_where_a_fit_runs(fitted, world, home, monkeypatch):
    monkeypatch.setattr("recon.fit.verb.GUESSED", (2, 5))
    assert fitted("--budget", "0.01")[:3] not in (fitted()[:3], fitted("--steps", "5")[:3])
    refused(recon.cli.main, fitting(world, home / "o", "--device", "abacus"), "device")
    saved = []
    monkeypatch.setattr("recon.fit.checkpoint.Checkpoint.save", lambda self, snapshot: saved.append(snapshot.step))
    for every, steps in (("1e9", [STEPS]), ("0", [*range(1, STEPS + 1), STEPS])):
        done(recon.cli.main, fitting(world, home / f"every{every}", "--save-every", every))
        assert saved == steps
        saved.clear()


def test_what_a_fit_tells_and_keeps(fitted, world, home):
    args = fitting(world, home / "told", "--steps", "0")
    told = json.loads(done(recon.cli.main, args))
    assert (home / "told" / "report.html").is_file() and not (home / "told" / "stages").exists()
    with_truth = json.loads(done(recon.cli.main, [*args, "--truth", str(world / "truth.json")]))
    assert "error" in with_truth["offsets"][0] and "error" not in told["offsets"][0]
    assert done(recon.cli.main, [a for a in args if a != "--json"]).startswith("video")
    assert any((world.parent / "stages").iterdir())


GROUPS_THERE = (
    "means",
    "quats",
    "log_scales",
    "opacity_logits",
    "sh",
    "knots",
    "knot_quats",
    "gain",
    "offsets",
    "bends",
)
"""Parameter groups of a fit of this world; ``clock_rates`` beside them is fitted where it is given a rate."""


def test_every_group_s_rate_changes_a_fit_or_is_refused(prepared):
    """As the shell spells them: by name, of those that shall differ."""
    begin = content(prepared, with_rates())
    for name in (*GROUPS_THERE, "clock_rates"):
        assert content(prepared, with_rates(f"{name}=0.004")) != begin, name
    absent = set(every_group()) - {*GROUPS_THERE, "clock_rates"}
    assert absent >= {"sh_rest", "own_knots", "own_quats", "features", "static.means"}
    for name in absent:
        with pytest.raises(ValueError, match=f"rates: expected groups of this fit .* found {name}"):
            content(prepared, with_rates(f"{name}=0.004"))


def test_every_group_to_freeze_changes_a_fit_or_is_refused(prepared):
    begin = content(prepared, with_rates())
    for name in GROUPS_THERE:
        assert content(prepared, with_rates(freeze=(name,))) != begin, name
        with pytest.raises(ValueError, match=f"rates, freeze: .* found {name} in both"):
            with_rates(f"{name}=0.004", freeze=(name,))
    for name in ("sh_rest", "own_knots"):
        with pytest.raises(ValueError, match=f"freeze: expected groups of this fit .* found {name}"):
            content(prepared, FitOptions(steps=2, freeze=(name,)))


LOSS_FIELDS = {
    "photometric": {"weight": 0.3, "ssim": 0.6, "window": None},
    "mask": {"weight": 3.0},
    "depth": {"weight": 3.0, "tolerance": 0.5, "scale": "median"},
    "track": {"weight": 3.0, "tolerance": 9.0},
    "feature": {},
    "scale-hinge": {"weight": 3.0, "limit": 0.5},
    "arap": {"weight": 3.0, "begin": 3.0, "every": 1, "shifts": "(0.1,0.2)", "neighbours": 2},
    "length": {"weight": 3.0, "begin": 3.0, "every": 1, "shifts": "(0.1,0.2)", "neighbours": 2},
    "velocity": {"weight": 3.0, "every": 1},
    "acceleration": {"weight": 3.0, "every": 1},
    "rotation-velocity": {"weight": 3.0, "every": 1},
    "rotation-acceleration": {"weight": 3.0, "every": 1},
    "rigidity": {"weight": 3.0, "every": 1, "neighbours": 2, "falloff": 0.5},
    "rotation-similarity": {"weight": 30.0, "every": 1, "neighbours": 2, "falloff": 0.5},
    "isometry": {"weight": 3.0, "every": 1, "neighbours": 2, "falloff": 0.5},
}
"""Another value of every field of every loss, as ``--losses NAME:FIELD=VALUE`` takes it; None: not for the shell."""

EFFECT_FIELDS = {
    "motion-blur": {"exposure": 0.02, "samples": 2},
    "rolling-shutter": {"readout": 0.02, "bands": 2},
    "gain": {"start": None, "weight": 9.0, "white_balance": False},
    "vignetting": {"second": -0.3, "fourth": -0.2},
}
BEGIN = {
    "scale-hinge": {"limit": 1.0},  # the usual one holds nothing back here
    "motion-blur": {"exposure": 0.01},
    "rolling-shutter": {"readout": 0.01, "bands": 3},
    "vignetting": {"second": -0.1},
}
"""What a loss or an effect is compared beside, where its defaults say nothing."""


def content(prepared: Prepared, options: FitOptions) -> str:
    """Everything that a fit of the prepared world comes to, in one word."""
    with lighter():
        found = fit(prepared.initial, prepared.footage, prepared.offsets, options)
    scene = [v.detach() for part in (found.scene.dynamic, found.scene.static) for v in vars(part).values()]
    moved = [v.detach() for v in found.scene.motion.parameters().values()]
    learned = [v.detach() for v in found.parameters.values()]
    numbers = [t.numpy() for t in (*scene, *moved, *learned)]
    return content_key(*numbers, found.offsets.seconds, found.offsets.rates, found.stats["loss"])


@pytest.fixture(scope="module")
def prepared(world, home, fitted) -> Prepared:
    """The world as a fit begins with it, with everything that losses compare with."""
    fitted()  # keeps the stages
    losses = tuple(kind() for name, kind in available("losses", LOSSES).items() if name != "feature")
    plan = Plan(SIZE[0], fit=FitOptions(losses=losses), backdrop_steps=5)
    tracks = [TrackSet.load(p) for p in sorted((world / "tracks").glob("*.npz"))]
    start, cache = Offsets.load(world / "start.json"), Cache(home / "stages")
    ready = prepare(open_scene(world), start, tracks, plan=plan, held_out=("held0",), cache=cache)
    effects = with_declared((), [f.readout for f in ready.footage], ready.gains, ready.falloff)
    assert [type(e).__name__ for e in effects] == ["Gain"]
    return ready


def with_rates(*texts: str, freeze: tuple[str, ...] = ()) -> FitOptions:
    """Options with rates as the shell takes them; four steps see a video again, whose clock has moved since."""
    return FitOptions(
        steps=4, rates=rates_on("--rates").instance_from_str(list(texts)), freeze=freeze, effects=(Gain(),)
    )


def test_every_field_of_losses_and_effects_has_a_row():
    for group, own, rows in (("losses", LOSSES, LOSS_FIELDS), ("effects", EFFECTS, EFFECT_FIELDS)):
        there = {n: [f.name for f in fields(kind)] for n, kind in available(group, own).items() if n != "feature"}
        assert there == {name: list(values) for name, values in rows.items() if name != "feature"}


@pytest.mark.parametrize("name", sorted(LOSS_FIELDS.keys() - {"feature"}))
def test_fields_of_losses_change_a_fit(name, prepared):
    """Beside a photometric loss, so that there is something to balance."""
    choices = available("losses", LOSSES)

    def fitted_with(text: str) -> str:
        losses = (Photometric(window=Window(5)), made(text, choices, "--losses"))
        return content(prepared, FitOptions(losses=losses, steps=2))

    each_field_counts(name, LOSS_FIELDS[name], fitted_with)


@pytest.mark.parametrize("name", sorted(EFFECT_FIELDS))
def test_fields_of_effects_change_a_fit(name, prepared):
    choices = available("effects", EFFECTS)

    def fitted_with(text: str) -> str:
        return content(prepared, FitOptions(effects=(made(text, choices, "--effects"),), steps=2))

    each_field_counts(name, EFFECT_FIELDS[name], fitted_with)


def each_field_counts(name: str, values: dict[str, Any], fitted_with: Callable[[str], str]) -> None:
    """Every other value changes what a fit comes to; what is None here is refused by name, not by a traceback."""

    def spelled(**own: Any) -> str:
        return f"{name}:" + ",".join(f"{field}={value}" for field, value in (BEGIN.get(name, {}) | own).items())

    begin = fitted_with(spelled())
    for field, value in values.items():
        if value is None:
            with pytest.raises(ValueError, match=field):
                fitted_with(spelled(**{field: 9}))
        else:
            assert fitted_with(spelled(**{field: value})) != begin, field


def test_the_feature_loss_asks_for_maps():
    fit = FitOptions(losses=(made("feature", available("losses", LOSSES), "--losses"),))
    with pytest.raises(ValueError, match="losses, features: expected feature maps"):
        Plan(fit=fit)
    assert Plan(fit=fit, features="lab")
    with pytest.raises(ValueError, match="--features: expected some of lab, daisy, dinov3"):
        Plan(features="sift")


def test_scaffolds_of_a_given_unit_choose_none():
    args = ["fit", "nowhere", "--offsets", "nowhere.json", "--scaffold.unit", "9", "--scaffold.fewest", "50"]
    refused(recon.cli.main, args, "unit, fewest")


# otsync run


@pytest.fixture
def arriving(world, monkeypatch) -> Callable[..., dict[str, Any]]:
    """What ``otsync run`` gives to the synchronisation, and ``recon fit`` and it to the reconstruction."""
    seen: dict[str, Any] = {}
    start = Offsets.load(world / "start.json")

    def synchronised(scene, **options):
        seen["sync"] = [(v.name, len(v.frames)) for v in scene.videos], options["route"], options["reference"]
        seen["cache"], seen["method"], seen["stages"] = options["cache"], options["method"], options["stages"]
        return SimpleNamespace(offsets=only(start, scene.names), route="tracks", why=(), seconds={})

    def reconstructed(scene, offsets, out, **options):
        seen["fit"] = {"names": scene.names, "from": offsets.seconds.tolist()} | {
            k: v for k, v in options.items() if k in ("plan", "held_out", "truth", "priors")
        }
        raise Reached

    def by_features(scene, coarse, maps, **options):
        seen["dense"] = maps, options["width"], options["stages"].space
        return coarse

    monkeypatch.setattr("otsync.recordings.routes.synchronize_scene", synchronised)
    monkeypatch.setattr("recon.pipeline.dense_tracks.synchronized_by_features", by_features)
    monkeypatch.setattr("otsync.report.frames.write_recording_report", lambda *args: None)
    monkeypatch.setattr("recon.pipeline.verb.reconstruct", reconstructed)

    def ask(main: Callable[[list[str]], int], args: list[str]) -> dict[str, Any]:
        seen.clear()
        with contextlib.suppress(Reached):
            _, _, err = run(main, args)
            raise AssertionError(err)
        return dict(seen)

    return ask


def running(world: Path, out: Path, *more: str) -> list[str]:
    """``otsync run`` as :func:`fitting`."""
    args = ["run", str(world), "--out", str(out), "--held-out", "held0", "--width", str(SIZE[0])]
    args += ["--backdrop-steps", "5", "--views", "3", "--recording.cache", str(world.parent / "stages")]
    if not {"--steps", "--budget"} & set(more):
        args += ["--steps", str(STEPS)]
    return [*args, *more]


@pytest.mark.parametrize("options", [TOGETHER, APART, ["fit.budget"]], ids=["most", "others", "budget"])
def test_the_plan_of_a_run_is_that_of_a_fit(options, arriving, world, home):
    words = ["--budget", "3"] if options == ["fit.budget"] else flags(options)
    words = ["--save-every", "7", *words]
    base = arriving(otsync.cli.main, running(world, home / "r"))["fit"]["plan"]
    plan = arriving(otsync.cli.main, running(world, home / "r", *words))["fit"]["plan"]
    for option in ("fit.save_every", *options):
        assert leaf(plan, option) != leaf(base, option), option
    assert plan == arriving(recon.cli.main, fitting(world, home / "fit", *words, tracks=False))["fit"]["plan"]
    refused(otsync.cli.main, running(world, home / "r", "--device", "abacus"), "device")


def test_the_other_options_of_a_run(arriving, world, outside, home):
    def asked(*more: str, scene: Path = world) -> dict[str, Any]:
        return arriving(otsync.cli.main, running(scene, home / "r", *more))

    base = asked()
    assert base["method"] == Method()
    assert base["sync"] == ([(f"cam{c}", FRAMES) for c in range(3)], "auto", 0)
    assert base["fit"]["held_out"] == ("held0",) and base["fit"]["truth"] is None
    assert asked("--reference", "cam1")["sync"][2] == 1
    assert asked("--recording.route", "stereo")["sync"][1] == "stereo"
    assert asked("--recording.cameras", "cam0", "cam2")["fit"]["names"] == ("cam0", "cam2", "held0")
    assert asked("--held-out", "held0", "cam2")["sync"][0] == base["sync"][0][:2]
    assert asked("--truth", str(world / "truth.json"))["fit"]["truth"].names == (*("cam0", "cam1", "cam2"), "held0")
    assert asked("--frames", "1", "10")["sync"][0] == [(f"cam{c}", 9) for c in range(3)]
    assert (home / "r" / "offsets_coarse.json").is_file()
    asked("--recording.cache", str(home / "kept"))
    assert any((home / "kept").iterdir())
    for option in ("--allow-outside", "--recording.allow-outside"):
        assert asked(option, scene=outside)["fit"]["names"] == base["fit"]["names"]
    refused(otsync.cli.main, running(outside, home / "r"), "outside")
    refused(otsync.cli.main, running(world, home / "r", "--recording.workers", "-1"), "--recording.workers")
    named = {"masks": "flow-residual", "points": "chained-flow", "flow": "dis-flow", "features": "daisy", "width": "99"}
    for name, value in named.items():  # both stages are told; what they do is tested with otsync sync and recon fit
        told = asked(f"--recording.{name}", value)
        assert told["fit"]["priors"] == {name: int(value) if name == "width" else value}
        assert told["stages"] != base["stages"]
        refused(otsync.cli.main, running(world, home / "r", f"--recording.{name}", "a"), name)
    assert "dense" not in base
    maps, width, method = asked("--features", "lab:bins=3", "--method", "paper")["dense"]
    assert maps == LabMaps(bins=3) and width == SIZE[0] and isinstance(method.aligner, DTW)
    told = asked("--recording.selection", "count=9")  # which tracks a scaffold begins with is its own affair
    assert told["stages"].selection.count == 9 and not told["fit"]["priors"]


def test_a_run_tells_json_only_where_it_is_asked_to(world, home, monkeypatch):
    start = only(Offsets.load(world / "start.json"), ("cam0", "cam1", "cam2"))
    answer = SimpleNamespace(offsets=start, route="tracks", why=(), seconds={})
    monkeypatch.setattr("otsync.recordings.routes.synchronize_scene", lambda *a, **o: answer)
    monkeypatch.setattr("otsync.report.frames.write_recording_report", lambda *args: None)
    monkeypatch.setattr("recon.pipeline.verb.write_reconstruction_report", lambda *args, **options: None)
    args = running(world, home / "json", "--steps", "0")
    document = json.loads(done(otsync.cli.main, [*args, "--json"]))
    assert document["metrics"]["views"] and "camera" in done(otsync.cli.main, args)


# recon bench


def benching(world: Path, out: Path, *more: str) -> list[str]:
    """``recon bench`` of one row; options that come later win."""
    args = ["bench", str(world), "--truth", str(world / "truth.json"), "--out", str(out), "--held-out", "held0"]
    args += ["--width", str(SIZE[0]), "--backdrop-steps", "5", "--views", "3", "--rows", "ours"]
    args += ["--cache", str(world.parent / "stages")]
    if not {"--steps", "--budget", "--lengths"} & set(more):
        args += ["--steps", "2"]
    return [*args, *more]


@pytest.fixture
def measuring(monkeypatch) -> Callable[..., list[Any]]:
    """What ``recon bench`` prepares, and what it fits, one entry a fit."""
    seen: list[Any] = []

    def looked_on(scene, offsets, tracks, *, plan, **rest):
        ready = prepare(scene, offsets, tracks, plan=plan, **rest)
        seen.append({"plan": plan, "offsets": offsets.seconds.tolist(), "names": scene.names, "footage": ready.footage})
        seen[-1] |= {"held_out": rest["held_out"], "tracks": [len(t) for t in tracks]}
        return ready

    def fitted(scene, footage, offsets, options):
        seen[-1]["options"] = replace(options, effects=tuple(e for e in options.effects if not isinstance(e, Gain)))
        raise Reached

    monkeypatch.setattr("recon.bench.fits.prepare", looked_on)
    monkeypatch.setattr("recon.bench.fits.fit", fitted)

    def ask(args: list[str]) -> list[Any]:
        seen.clear()
        with contextlib.suppress(Reached):
            _, _, err = run(recon.cli.main, args)
            raise AssertionError(err)
        return list(seen)

    return ask


@pytest.mark.parametrize("options", [TOGETHER, APART], ids=["most", "others"])
def test_the_plan_of_a_benchmark_reaches_its_fits(options, measuring, world, home):
    base, other = (measuring(benching(world, home / "b", *more))[0] for more in ((), flags(options)))
    for option in options:
        if option == "frames":  # the recording is cut before its stages begin
            assert {len(f) for f in base["footage"]} == {FRAMES} and {len(f) for f in other["footage"]} == {9}
        elif option.startswith("fit."):
            assert leaf(other["options"], option[4:]) != leaf(base["options"], option[4:]), option
        else:
            assert leaf(other["plan"], option) != leaf(base["plan"], option), option


def test_what_a_benchmark_does_not_heed_it_refuses(measuring, world, home):
    refused(recon.cli.main, benching(world, home / "b", "--device", "abacus"), "device")
    refused(recon.cli.main, benching(world, home / "b", "--save-every", "3"), "save_every")
    refused(recon.cli.main, benching(world, home / "b", "--features", "lab"), "features, losses")
    for option, row in (("--scaffold.unit", "w/o scaffold"), ("--seeding.support", "Sync-NeRF style")):
        refused(recon.cli.main, benching(world, home / "b", option, "9", "--rows", row), option.strip("-"))
    for option in ("--gate", "--rebase"):  # what they do: tests/recon/bench/test_bench.py
        refused(recon.cli.main, benching(world, home / "b", option), "gate, rebase")
    held = measuring(benching(world, home / "b", "--rates", "offsets=0.1", "--rows", "fixed"))[0]["options"]
    assert "offsets" not in held.active_rates()
    for option, value in (("--rates", "own_knots=0.1"), ("--freeze", "own_knots")):
        refused(recon.cli.main, benching(world, home / "b", option, value), option.strip("-"), "own_knots")
        for row in ("ours", "w/o scaffold"):
            rows = [row, *{"ours", "w/o scaffold"} - {row}]
            rates = measuring(benching(world, home / "b", option, value, "--rows", *rows))[0]["options"].active_rates()
            own = None if row == "ours" or option == "--freeze" else 0.1
            assert rates.get("own_knots") == own if option == "--rates" else "own_knots" not in rates or row == "ours"


def test_the_other_options_of_a_benchmark(measuring, world, outside, home):
    def asked(*more: str, scene: Path = world) -> list[Any]:
        args = benching(world, home / "b", *more)
        args[1] = str(scene)
        return [{k: v for k, v in row.items() if k != "footage"} for row in measuring(args)]

    base = asked()
    for more in (
        ["--rows", "fixed"],
        ["--amplitudes", "2"],
        ["--seeds", "1"],
        ["--cameras", "cam0", "cam1"],
        ["--held-out", "held0", "cam2"],
        ["--held-out-tracks", "0.5"],
        ["--truth", str(world / "start.json")],
        ["--lengths", "3"],
        ["--budget", "9"],
        ["--steps", "3"],
    ):
        assert asked(*more) != base, more
    asked("--allow-outside", scene=outside)
    args = benching(world, home / "b")
    refused(recon.cli.main, [args[0], str(outside), *args[2:]], "outside")
    asked("--cache", str(home / "of_a_benchmark"))
    assert any((home / "of_a_benchmark").iterdir())


def test_what_a_benchmark_writes(world, home):
    def tables(*more: str, out: str = "bench") -> str:
        return done(recon.cli.main, benching(world, home / out, *more))

    base = tables()
    assert {"recon.csv", "recon.json", "recon.md"} <= {p.name for p in (home / "bench").iterdir()}
    document = json.loads(tables("--json"))  # from here on of the row that is there already
    assert document["recording"] == "world" != json.loads(tables("--json", "--name", "juggle"))["recording"]
    assert base == tables() and "no weights given" in base
    code, told, err = run(recon.cli.main, benching(world, home / "bench", "--lpips-weights", str(home / "none.pth")))
    assert (code == 2 and "none.pth" in err) or (code == 0 and "no torch" in told)
    fewer = json.loads(tables("--json", "--views", "1", out="bench1"))
    assert plain(fewer["rows"]) != plain(document["rows"])


# recon lifting


@pytest.fixture
def lifted(synchronous, home, monkeypatch) -> Callable[..., Any]:
    """What ``recon lifting`` measures; the matching, which has no options, is replaced by what it is given."""
    timed = []

    def compared(sources, cameras):
        return [{"tracks": k, "n": content_key(s.xyz, s.features)} for one in sources for k, s in one.items()]

    def once(work, repeats):
        timed.append(repeats)
        return 1.0

    monkeypatch.setattr("recon.bench.lifting.matched", compared)
    monkeypatch.setattr("recon.bench.lifting._median_ms", once)

    def ask(*more: str, scene: Path = synchronous) -> Any:
        timed.clear()
        args = ["lifting", str(scene), "--out", str(home / "lifting"), "--cache", str(home / "stages"), "--json"]
        args += ["--width", str(SIZE[0]), "--cameras", "2", "--steps", "1"]
        args += [*(() if "--features" in more else ("--features", "lab")), *more]
        return plain(json.loads(done(recon.cli.main, args))), list(timed)

    return ask


def test_options_of_lifting(lifted, synchronous, home):
    base = lifted()
    assert base == lifted()
    for more in (
        ["--cameras", "3"],
        ["--steps", "2"],
        ["--seed", "1"],
        ["--width", "48"],
        ["--frames", "1", "10"],
        ["--held-out", "cam1", "cam2"],
        ["--channels", "9"],
        ["--features", "lab:bins=3"],
        ["--repeats", "2"],
    ):
        assert lifted(*more) != base, more
    assert {"lifting.csv", "lifting.json"} <= {p.name for p in (home / "lifting").iterdir()}
    lifted("--cache", str(home / "of_lifting"))
    assert any((home / "of_lifting").iterdir())
    args = ["lifting", str(synchronous), "--out", str(home / "lifting"), "--width", str(SIZE[0]), "--cameras", "2"]
    assert done(recon.cli.main, [*args, "--steps", "0", "--cache", str(home / "stages")]).startswith("Precision")
    moved = elsewhere(synchronous, home / "synchronous_outside")
    assert lifted("--allow-outside", scene=moved)[0]["cost"] == base[0]["cost"]
    refused(recon.cli.main, ["lifting", str(moved), "--out", str(home / "lifting")], "outside")


# recon render, eval, export, simulate


@pytest.fixture
def result(fitted) -> Path:
    return fitted()[-1]


def test_options_of_render(result, fitted, home):
    def images(*more: str, of: Path = result, out: str = "images") -> dict[str, str]:
        folder = home / out
        shutil.rmtree(folder, ignore_errors=True)
        done(recon.cli.main, ["render", str(of), "--out", str(folder), *more])
        return contents(folder)

    camera, orbit = ["--camera", "cam1"], ["--path", "orbit"]
    base, path = images(*camera), images(*orbit)
    assert len(base) > 5 and base != path
    assert base != images("--camera", "cam0")
    assert base != images(*camera, of=fitted("--seed", "3")[-1])
    assert base != images(*camera, "--times", "0.1")
    assert base != images(*camera, "--fps", "9")
    assert base != images(*camera, "--width", "48")
    assert path != images(*orbit, "--frames", "4")
    assert path != images(*orbit, "--turns", "0.5")
    done(recon.cli.main, ["render", str(result), *camera, "--out", str(home / "seen.mp4"), "--times", "0.1"])
    assert (home / "seen.mp4").stat().st_size > 100
    refused(recon.cli.main, ["render", str(result)], "--camera, --every-camera, --path")
    refused(recon.cli.main, ["render", str(result), "--every-camera"], "{camera}")
    every = ["--every-camera", "--times", "0.1", "--out", str(home / "every {camera}")]
    done(recon.cli.main, ["render", str(result), *every])
    assert len(list(home.glob("every *"))) > 1
    refused(recon.cli.main, ["render", str(result), *camera, "--turns", "2"], "--turns")
    refused(recon.cli.main, ["render", str(result), *camera, "--frames", "2"], "--frames")


def test_options_of_eval(result, fitted, world, outside, home):
    weights = home / "none.pth"

    def figures(*more: str, of: Path = result, scene: Path = world) -> Any:
        return json.loads(done(recon.cli.main, ["eval", str(of), str(scene), "--json", *more]))

    base, trained = figures(), figures("--held-out", "cam1")
    assert base != trained
    assert base != figures(of=fitted("--seed", "3")[-1])
    assert base != figures("--views", "2")
    assert "offset_error" in figures("--truth", str(world / "truth.json")) and "offset_error" not in base
    shifted = Offsets.load(world / "truth.json")
    shifted = replace(shifted, seconds=shifted.seconds + np.array([0.0, 0.03, 0.03, 0.03]))
    shifted.save(home / "shifted.json")
    only(shifted, ("cam0", "cam1")).save(home / "some.json")
    assert base != figures("--offsets", str(home / "shifted.json"))
    assert trained != figures("--held-out", "cam1", "--offsets", str(home / "some.json"))
    args = ["eval", str(result), str(world)]
    refused(recon.cli.main, [*args, "--offsets", str(home / "some.json")], "offsets", "held0")
    code, _, err = run(recon.cli.main, [*args, "--lpips-weights", str(weights)])
    assert (code == 2 and weights.name in err) or figures("--lpips-weights", str(weights))["lpips"] != base["lpips"]
    done(recon.cli.main, [*args, "--out", str(home / "figures.json")])
    assert json.loads((home / "figures.json").read_text()) == base
    assert not done(recon.cli.main, args).startswith("{")
    assert figures("--allow-outside", scene=outside) == base
    refused(recon.cli.main, ["eval", str(result), str(outside)], "outside")


def test_options_of_export(result, fitted, home):
    written = set()
    for kind, exporter in available("exporters", EXPORTERS).items():

        def export(*more: str, of: Path = result, kind: str = kind) -> dict[str, str]:
            folder = home / "export"
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            done(recon.cli.main, ["export", str(of), "--format", kind, "--out", str(folder / "x"), *more])
            return contents(folder)

        if kind == "4dgs" and importlib.util.find_spec("fourdgs") is None:
            refused(recon.cli.main, ["export", str(result), "--format", kind], "pip install 'otsync[4dgs]'")
            written.add(kind)
            continue
        base = export()
        written.add(str(base))
        assert base != export(of=fitted("--seed", "3")[-1])
        for option, holds in (("--at", "moment"), ("--fps", "frames")):
            if exporter.holds == holds:
                assert base != export(option, "0.12" if option == "--at" else "9"), kind
            else:
                refused(recon.cli.main, ["export", str(result), "--format", kind, option, "0.1"], option)
    assert len(written) == len(EXPORTERS)


def test_options_of_simulate(home):
    def world(*more: str) -> dict[str, str]:
        out = home / "_".join(("simulated", *more))
        small = ["--cameras", "2", "--frames", "3", "--width", "40", "--height", "24"]
        assert run(recon.cli.main, ["simulate", str(out), *small, *more])[0] == 0
        return contents(out)

    base = world()
    for more in (
        ["--layout", "sync-nerf"],
        ["--cameras", "3"],
        ["--held-out", "0"],
        ["--frames", "5"],
        ["--width", "48"],
        ["--height", "32"],
        ["--max-offset", "0.2"],
        ["--gain", "0.2"],
        ["--vignetting", "0.3"],
        ["--noise", "0.1"],
        ["--exposure", "0.02"],
        ["--readout", "0.02"],
        ["--sheen", "0.5"],
        ["--pace", "2"],
        ["--seed", "2"],
    ):
        assert world(*more) != base, more


def test_options_of_the_demo(home, monkeypatch):
    """What it films, and what it gives to ``otsync run``."""
    film, seen = recon.simulate.phones.film_phones, {}

    def asked(self):
        seen["steps"], seen["out"], seen["films"] = self.plan.fit.steps, self.out, contents(self.scene)
        raise Reached

    def demo(*more: str) -> dict[str, Any]:
        with contextlib.suppress(Reached):
            run(otsync.cli.main, ["demo", "--out", str(home / "demo"), *more])
            raise AssertionError("otsync run was not reached")
        return dict(seen)

    monkeypatch.setattr("recon.simulate.phones.film_phones", lambda *args: film(*args, seconds=0.1, size=(48, 32)))
    monkeypatch.setattr("recon.cli.run.Run.run", asked)
    base = demo()
    assert base["out"] == home / "demo" / "result" and {"phone0.mp4", "scene.json"} <= set(base["films"])
    assert demo("--steps", "7") == base | {"steps": 7}
    assert demo("--seed", "5")["films"] != base["films"]


def test_quiet_tells_nothing_but_results(result, home, monkeypatch):
    """Not even which back end renders, which is a line of a logger."""
    args = ["render", str(result), "--camera", "cam1", "--times", "0.1", "--out", str(home / "quiet")]
    handler = logging.StreamHandler(io.StringIO())
    logging.getLogger("recon").addHandler(handler)
    try:
        for more, told in (([], True), (["--quiet"], False)):
            monkeypatch.setattr(importlib.import_module("recon.raster.render"), "_announced", set())
            handler.setStream(io.StringIO())
            assert run(recon.cli.main, [*args, *more])[2] == ""
            assert ("backend" in handler.stream.getvalue()) is told
    finally:
        logging.getLogger("recon").removeHandler(handler)
        run(recon.cli.main, ["--version"])


def test_slots_of_a_run_are_those_of_sync(arriving, world, home):
    """The same options make the same method; that each has an effect is tested with ``otsync sync``."""
    own, sync = ({o for o in options_of(place) if slotted(o)} for place in (COMMANDS["run"], SYNC["sync"]))
    assert own == sync

    def asked(*more: str) -> Method:
        return arriving(otsync.cli.main, running(world, home / "r", *more))["method"]

    assert asked("--method", "paper") == PAPER
    assert asked("--rate", "fit", "--rematch", "2", "--graph.extra", "0") == Method(
        rate="fit", rematch=2, graph=Graph(extra=0)
    )
    named = asked("--costs", "curve-distance", "matcher:unbalanced-ot", "aligner:dtw", "refiner:unrefined")
    assert named == Method(matcher=UnbalancedOT(costs=(CurveDistance(),)), aligner=DTW(), refiner=Unrefined())


SLOTS = {"method", "rate", "rematch", "costs", "graph", "matcher", "aligner", "refiner"}


def slotted(option: str) -> bool:
    """Whether an option is one of the method's slots, which ``otsync run`` and ``otsync sync`` share."""
    return option.partition(".")[0].partition(":")[0] in SLOTS


def rows() -> set[str]:
    """Every option that a test above exercises, refuses, or gives a reason for."""
    plan = {*PLAN, *OF_A_FIT}
    others = {
        "fit": "scene offsets out held_out tracks truth view cache json allow_outside recording.masks recording.points "
        "recording.flow recording.depth recording.width",
        "run": "scene out held_out reference truth json allow_outside recording.route recording.cameras "
        "recording.cache recording.allow_outside recording.masks recording.points recording.flow recording.features "
        "recording.depth recording.selection recording.width",
        "bench": "scene truth rows out cache name lpips_weights json allow_outside gate rebase protocol.held_out "
        "protocol.cameras protocol.amplitudes protocol.seeds protocol.lengths protocol.held_out_tracks",
        "lifting": "scene out cache json allow_outside lifting.cameras lifting.steps lifting.seed lifting.width "
        "lifting.frames lifting.held_out lifting.channels lifting.features",
        "render": "result camera every_camera path times frames turns fps width out",
        "eval": "result scene held_out offsets truth views lpips_weights out json allow_outside",
        "export": "result format at fps out",
        "demo": "out seed steps",
        "view": "what port stages allow_outside",
        "simulate": "out layout cameras held_out frames width height max_offset gain vignetting noise exposure readout "
        "sheen pace seed",
    }
    slots = {f"run {o}" for o in options_of(SYNC["sync"]) if slotted(o)}
    shared = (
        slots
        | {f"{command} plan.{o}" for command in ("fit", "run") for o in plan}
        | {f"bench protocol.plan.{o}" for o in plan}
    )
    return shared | set(REASONS) | {f"{command} {o}" for command, names in others.items() for o in names.split()}


ROWS = rows()
