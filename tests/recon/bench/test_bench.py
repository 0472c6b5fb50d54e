"""The benchmark of configurations: its figures, its rows, and that rows which took hours are never lost or mixed."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import recon.cli
from otsync.bench import record
from otsync.files.cache import Cache
from otsync.io import open_scene
from otsync.plugins import forget, register
from otsync.progress import Progress
from otsync.types import Clock, Offsets, TrackSet
from recon.bench import fits as bench
from recon.bench import gate
from recon.bench.configurations import OWN, check_heeded, configurations, per_frame
from recon.bench.plot import curve, held, plot
from recon.bench.rows import find, measured_before, paper_tables, row_table, summary
from recon.fit.optimize import RATES
from recon.fit.options import FitOptions
from recon.losses import ImageLoss, Mask
from recon.motion import HermiteSpline, PerGaussian, ScaffoldOptions
from recon.observe.effects import Effect, Gain, RollingShutter
from recon.pipeline.plan import Plan
from recon.pipeline.prepare import prepare
from recon.scene.gaussians4d import Gaussians4D
from recon.scene.seed import Seeding
from tests.recon.worlds import FRAMES, SIZE, capture, votes_at_once, write_world

STEP = 1 / 30


@pytest.fixture(scope="module")
def truth() -> Gaussians4D:
    """The simulated world itself, its motion splined through every frame."""
    c = capture()
    path = HermiteSpline.of(-0.1, 2.1, STEP, 0.1)
    rest = c.world.moving(0.2)
    knots = torch.as_tensor(c.world.positions(np.asarray(path.times)), dtype=torch.float32).transpose(0, 1)
    return Gaussians4D(
        rest,
        PerGaussian(path, knots - rest.means),
        footprint=0.02,
        frame_step=STEP,
        span=(0.0, 2.0),
        static=c.world.static,
        near=c.near,
    )


@pytest.mark.parametrize("clock", ["fps", "timestamps", "rate", "cut"])
def test_held_out_tracks_are_compared_at_their_own_times(truth, clock):
    """The Gaussians' own tracks are followed as on the reference's clock, whatever clock they are given on."""
    offset, rate, fps = 0.013, 1.0, 30.0
    own = np.arange(60) * STEP
    if clock == "fps":
        fps = 25.0
        own = np.arange(50) / fps
    elif clock == "timestamps":
        own = own + 0.3 * STEP * np.sin(np.arange(60))
    elif clock == "rate":
        rate = 1.2
    else:
        own = own[7:]
    tracks = TrackSet(truth.tracks(rate * own + offset)[::40], timestamps=own, name="b")
    offsets = replace(Offsets.known(("a", "b"), np.array([0.0, offset]), fps), rates=np.array([1.0, rate]))
    figures = bench.motion_figures(truth, SimpleNamespace(offsets=offsets), [tracks], 0.02)  # type: ignore[arg-type]
    plain = TrackSet(truth.tracks(np.arange(60) * STEP)[::40], fps=30.0, name="a")
    wanted = bench.motion_figures(truth, SimpleNamespace(offsets=offsets), [plain], 0.02)  # type: ignore[arg-type]
    assert figures["follow_20"] == pytest.approx(wanted["follow_20"], abs=0.1)  # footprints


def test_positions_between_frames_lie_on_the_line_and_not_where_nothing_was_seen():
    xyz = np.arange(6.0)[None, :, None] * np.ones((1, 1, 3))
    xyz[0, 3] = np.nan
    tracks = TrackSet(xyz, timestamps=np.array([0.0, 1, 2, 3, 4, 9]), name="a")
    found = bench.positions_at(tracks, np.array([-0.5, 0.0, 0.5, 2.0, 2.5, 3.0, 4.0, 6.0, 9.0, 9.5]))[0, :, 0]
    nan = np.nan
    np.testing.assert_allclose(found, [nan, 0, 0.5, 2, nan, nan, 4, nan, 5, nan])
    assert np.isnan(bench.positions_at(TrackSet(xyz[:, :1], fps=1.0, name="a"), np.zeros(2))).all()


@pytest.mark.parametrize("layered", [True, False])
def test_held_out_views_are_drawn_as_the_fit_drew_them(truth, monkeypatch, layered):
    seen = []
    real = bench.view

    def looking(*args, **options):
        seen.append(options.get("layered", True))
        return real(*args, **options)

    monkeypatch.setattr(bench, "view", looking)
    ready = SimpleNamespace(held_out=capture().held_out, clocks={"held0": Clock(0.0)}, layered=layered)
    fitted = SimpleNamespace(scene=replace(truth, span=(0.0, (FRAMES - 1) * STEP)), parameters={})
    figures = bench.held_out_figures(fitted, (), ready, 16)  # type: ignore[arg-type]
    assert seen == [layered] and figures["psnr"] > 20 and np.isnan(figures["lpips"])


TINY = bench.Protocol(Plan(width=SIZE[0], backdrop_steps=5), held_out=("held0",))


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A recording, its truth, and a cache that the stages of every protocol share."""
    folder = write_world(tmp_path_factory.mktemp("world"))
    return open_scene(folder), Offsets.load(folder / "truth.json"), Cache(folder / "stages")


def material(world, *cameras: str, **changed) -> bench.Material:
    scene, truth, cache = world
    return bench.material_of(scene, truth, replace(TINY, cameras=cameras or None, **changed), cache, map, Progress())


def test_few_cameras_in_another_order_keep_what_the_rig_gave_each(world):
    """Their images alone are fewer: depth, tracks and the static part are those of all, each camera with its own."""
    whole, few = material(world, "cam0", "cam1", "cam2"), material(world, "cam2", "cam0")
    assert material(world).backdrop is None and whole.train == ("cam0", "cam1", "cam2")
    assert few.scene.names == ("cam2", "cam0", "held0") == few.truth.names and few.train == ("cam2", "cam0")
    assert few.truth.seconds.tolist() == [whole.truth.seconds[2], whole.truth.seconds[0], whole.truth.seconds[3]]
    assert few.truth.names[few.truth.reference] == "cam0"
    counts = [{t.name: len(t) + len(k) for t, k in zip(m.tracks, m.kept, strict=True)} for m in (few, whole)]
    assert counts[0] == {n: counts[1][n] for n in ("cam0", "cam2")} and min(counts[0].values()) > 0
    for name in few.train:
        mine, theirs = (m.scene.videos[m.scene.names.index(name)] for m in (few, whole))
        assert all(np.array_equal(a, b) for a, b in zip(mine.depth, theirs.depth, strict=True))
    gains, psnr = whole.backdrop.gains, whole.backdrop.psnr
    assert np.ptp(gains, axis=0).min() > 1e-4 and len(set(psnr)) == 3  # so that another camera's would be noticed
    assert np.array_equal(few.backdrop.gains, gains[[2, 0]]) and np.array_equal(few.backdrop.psnr, psnr[[2, 0]])
    assert torch.equal(few.backdrop.gaussians.means, whole.backdrop.gaussians.means)


def test_a_backdrop_with_the_gains_of_other_videos_is_refused(world):
    scene, truth, cache = world
    whole = material(world, "cam0", "cam1", "cam2").backdrop
    with pytest.raises(ValueError, match=r"backdrop: expected gains of shape \(2,3\).*\(cam0, cam1\); found \(3, 3\)"):
        prepare(
            scene,
            truth,
            capture().tracks,
            plan=Plan(width=SIZE[0]),
            held_out=("held0", "cam2"),
            backdrop=whole,
            cache=cache,
        )


def test_a_rig_without_a_static_part_is_said(world):
    scene, truth, cache = world
    everywhere = [np.ones((len(v.frames), SIZE[1], SIZE[0]), bool) for v in scene.videos]
    progress = Progress()
    protocol = replace(TINY, cameras=("cam0", "cam1"))
    found = bench.material_of(replace(scene, masks=tuple(everywhere)), truth, protocol, cache, map, progress)
    assert found.backdrop is None
    assert any("the whole rig gave no static part" in note for note in progress.notes)


def test_declared_readouts_reach_the_fit_by_video(world, monkeypatch):
    readouts, seen, fit = {"cam0": 0.01, "cam1": None, "cam2": 0.03}, [], bench.fit

    def spied(*args, **options):
        seen.append(([f.name for f in args[1]], args[3].effects))
        return fit(*args, **options)

    monkeypatch.setattr(bench, "fit", spied)
    scene, truth, cache = world
    videos = tuple(replace(v, camera=replace(v.camera, readout=readouts.get(v.name))) for v in scene.videos)
    rolled = material((replace(scene, videos=videos), truth, cache), "cam2", "cam0", "cam1")
    row = bench.measure("ours", OWN["ours"], rolled, TINY, 1.0, 0, 1, cache, map)
    ((names, (shutter, gain)),) = seen
    assert names == ["cam2", "cam0", "cam1"] and shutter == RollingShutter((0.03, 0.01, 0.0))
    assert isinstance(gain, Gain) and np.array_equal(gain.start, rolled.backdrop.gains)
    assert row["images"] == TINY.plan.fit.batch


@dataclass(frozen=True)
class Dimming(Effect):
    """A plugin's effect."""

    strength: float = 0.5

    def wrap(self, observe, params):
        return observe


@dataclass(frozen=True)
class Colourless(ImageLoss):
    """A plugin's loss."""

    weight: float = 0.5

    def __call__(self, seen):
        return (seen.rendered.mean(-1) - seen.image.mean(-1)).square().mean()


def test_every_loss_and_every_plugin_is_a_row():
    register("losses")(Colourless)
    register("effects")(Dimming)
    try:
        rows = configurations()
    finally:
        forget(Colourless, Dimming)
    plan = Plan()
    assert rows.keys() >= OWN.keys() | {"without mask", "with depth", "with track", "with colourless", "with dimming"}
    assert "with photometric" not in rows and "with feature" not in rows and "with gain" not in rows
    assert rows["with colourless"].change(plan).fit.losses == (*plan.fit.losses, Colourless())
    assert rows["with dimming"].change(plan).effects == (Dimming(),)
    kept = rows["without mask"].change(plan).fit.losses
    assert Mask() in plan.fit.losses and set(kept) == set(plan.fit.losses) - {Mask()}
    bare = replace(plan, fit=replace(plan.fit, losses=kept))
    for name, given in (("without mask", bare), ("with depth", rows["with depth"].change(plan))):
        with pytest.raises(ValueError, match="rows: expected a loss"):
            rows[name].change(given)
    assert (
        rows["fixed"].change(plan).fit.freeze == ("offsets",)
        and "offsets" in OWN["ours"].change(plan).fit.active_rates()
    )


def test_rows_that_are_compared_learn_offsets_alike():
    compared = (
        ("ours", "Hermite spline", "w/o scaffold", "scaffold per video", "Sync-NeRF style"),
        ("true time", "w/o scaffold, true time", "w/o spline, true time", "Dynamic3DGaussians"),
        ("fixed", "w/o spline"),
    )
    for plan in (Plan(), Plan(fit=FitOptions(rates={**RATES, "offsets": 0.5})), Plan(fit=FitOptions(freeze=("sh",)))):
        for rows in compared:
            rates = [OWN[row].plan(plan).fit.active_rates().get("offsets") for row in rows]
            usual = plan.fit.active_rates()["offsets"] if rows[0] == "ours" else None
            assert rates == [usual] * len(rows)
            assert len({OWN[row].clocks for row in rows}) == 1
    assert {row for rows in compared for row in rows} == OWN.keys()


def test_no_row_leaves_an_option_out_in_silence():
    unit, steps = Plan(scaffold=ScaffoldOptions(unit=20.0)), Plan(fit=FitOptions(losses=(Mask(),)))
    for plan, option, row in (
        (unit, "scaffold.unit", "w/o scaffold"),
        (unit, "scaffold.unit", "Dynamic3DGaussians"),
        (Plan(seeding=Seeding(support=3)), "seeding.support", "Sync-NeRF style"),
        (steps, "losses", "Sync-NeRF style"),
        (steps, "losses", "Dynamic3DGaussians"),
    ):
        with pytest.raises(ValueError, match=f"{option}: expected an option that a row heeds; found .*Leave it out"):
            check_heeded([OWN[row]], plan)
        check_heeded([OWN[row], OWN["ours"]], plan)
    check_heeded([OWN["w/o scaffold"]], Plan(width=160, views=3, scaffold=ScaffoldOptions(spacing=0.2, margin=1.0)))


def test_samples_of_every_frame_lie_on_the_frames():
    """Whatever the margin: half-way between two samples a frame might take either."""
    start = PerGaussian.at_rest(HermiteSpline.of(0.2, 0.5, 4 * STEP, 4.5 * STEP), 3)
    scene = SimpleNamespace(motion=start, span=(0.2, 0.5), frame_step=STEP)
    times = per_frame(scene).times  # type: ignore[arg-type]
    frames = (times - 0.2) / STEP
    np.testing.assert_allclose(frames, np.rint(frames), atol=1e-9)
    assert times[0] <= 0.2 - 4.5 * STEP + 1e-9 and times[-1] >= 0.5 + 4.5 * STEP - STEP


SOME = ("w/o scaffold", "Sync-NeRF style", "Dynamic3DGaussians", "true time")


@pytest.mark.parametrize("names", [SOME, pytest.param(tuple(OWN), marks=pytest.mark.slow)], ids=["some", "all"])
def test_every_row_can_be_measured_and_a_seed_is_the_fits_too(world, monkeypatch, names):
    """Two steps each; rows at true time differ from seed to seed as well."""
    whole, seeds, fit = material(world), [], bench.fit

    def spied(scene, footage, offsets, options):
        seeds.append(options.seed)
        return fit(scene, footage, offsets, options)

    monkeypatch.setattr(bench, "fit", spied)
    monkeypatch.setattr("recon.fit.run.Run.votes", votes_at_once)
    cache = world[2]
    for name in names:
        row = OWN[name]
        for seed in (0, 3) if name == "true time" else (0,):
            found = bench.measure(name, row, whole, TINY, 1.0, seed, 2, cache, map)
            assert found["psnr"] > 10 and found["gaussians"] > 100
            assert (found["start"] == 0) == (row.clocks == "true")
            held = "offsets" not in row.plan(TINY.plan).fit.active_rates()
            assert (found["mean"] == found["start"]) == held, name
    assert sorted(set(seeds)) == [0, 3]


def test_the_gate_compares_with_the_baseline_and_takes_no_other_options(tmp_path, monkeypatch, capsys):
    rows = [row(name) for name in gate.ROWS]
    whole = {"offset error of the motion, frames": 0.2, "offset error, frames": 0.1, "PSNR": 25.0, "speed": 0.01}
    monkeypatch.setattr(gate, "measured", lambda: rows)
    monkeypatch.setattr(gate, "whole_run", lambda: whole)
    monkeypatch.setattr("otsync.bench.record.baseline_path", lambda name: tmp_path / f"{name}.json")
    out = ["--out", str(tmp_path / "out")]
    assert recon.cli.main(["bench", "--rebase", *out]) == 0 == recon.cli.main(["bench", "--gate", *out])
    assert (tmp_path / "out" / "recon_gate.csv").exists() and "no worse" in capsys.readouterr().out
    for key, change in (("psnr", -0.4), ("mask_psnr", -0.4), ("mean", 0.05), ("neighbour_change", 0.2)):
        rows[0] = row("ours", **{key: row("ours")[key] + change})
        assert recon.cli.main(["bench", "--gate", *out]) == 1
        assert "ours" in capsys.readouterr().err
    rows[0] = row("ours", psnr=24.8, mean=0.13, neighbour_change=0.2)
    assert recon.cli.main(["bench", "--gate", *out]) == 0
    for key, change in (*((name, 0.1) for name in list(whole)[:2]), ("PSNR", -0.4), ("speed", -0.005)):
        kept = whole[key]
        whole[key] += change
        assert recon.cli.main(["bench", "--gate", *out]) == 1
        assert f"whole run: {key}" in capsys.readouterr().err
        whole[key] = kept
    for more, named in ((["world"], "scene"), (["--steps", "3"], "protocol"), (["--json"], "json")):
        assert recon.cli.main(["bench", "--gate", *out, *more]) == 2
        assert f"found {named}" in capsys.readouterr().err
    assert recon.cli.main(["bench", *out]) == 2 and "scene: expected a recording" in capsys.readouterr().err


def test_lengths_and_steps_exclude_each_other():
    assert bench.Protocol().steps == (bench.STEPS,) and bench.Protocol(lengths=(3, 9)).steps == (3, 9)
    assert bench.Protocol(Plan(fit=FitOptions(budget=3))).steps == (0,)
    for fit in (FitOptions(steps=3), FitOptions(budget=3)):
        with pytest.raises(ValueError, match="lengths: expected without steps and budget"):
            bench.Protocol(Plan(fit=fit), lengths=(3,))
    with pytest.raises(ValueError, match="save_every"):
        bench.Protocol(Plan(fit=FitOptions(save_every=5)))


def row(name: str, amplitude: float = 1.0, seed: int = 0, **figures: float | None) -> dict:
    base = {
        "steps": 2500,
        "images": 5000,
        "cpu_seconds": 100.0,
        "start": 0.5,
        "mean": 0.1,
        "max": 0.2,
        "psnr": 25.0,
        "ssim": 0.9,
        "lpips": None,
        "mask_psnr": 20.0,
        "mask_ssim": 0.8,
        "neighbour_change": 0.3,
        "follow_20": 2.0,
    }
    return {"configuration": name, "amplitude": amplitude, "seed": seed, **base, **figures}


def test_rows_are_continued_only_where_they_were_measured_alike(tmp_path):
    about = {"protocol": {"width": 320, "seeds": (0,), "amplitudes": (1.0,), "frames": (2, 9)}, "figures": 2}
    assert measured_before(tmp_path, about) == []
    rows = [row("ours"), row("fixed", seed=1)]
    (tmp_path / "recon.json").write_text(json.dumps({**about, "rows": rows}))
    more = {**about, "protocol": {**about["protocol"], "seeds": (0, 1), "amplitudes": (3.0,)}}
    assert measured_before(tmp_path, more) == rows
    for other in ({"figures": 3}, {"protocol": {**about["protocol"], "width": 160}}):
        with pytest.raises(ValueError, match=r"differs: .*now (3|160)"):
            measured_before(tmp_path, {**about, **other})
    for text in ("[]", '{"rows": 3}', '{"rows": [{"seed": 1}]}', "{"):
        (tmp_path / "recon.json").write_text(text)
        with pytest.raises(ValueError, match=r"recon\.json: expected"):
            measured_before(tmp_path, about)


def test_a_row_without_lpips_is_measured_again_once_there_are_weights():
    rows = [row("ours"), row("fixed", lpips=0.1)]
    assert find(rows, ("ours", 1.0, 0, 2500), lpips=False) is rows[0]
    assert find(rows, ("ours", 1.0, 0, 2500), lpips=True) is None
    assert find(rows, ("fixed", 1.0, 0, 2500), lpips=True) is rows[1]
    assert find(rows, ("ours", 1.0, 1, 2500), lpips=False) is None
    assert find(rows, ("ours", 1.0, 0, 300), lpips=False) is None


def test_tables_in_the_papers_layout_average_seeds_and_say_why_lpips_lacks():
    rows = [
        row("ours", psnr=24.0, max=0.2),
        row("ours", seed=1, psnr=25.0, max=0.7),
        row("true time", psnr=27.5),
        row("w/o spline", psnr=26.5),
        row("w/o spline, true time", psnr=27.25),
        row("ours", amplitude=30.0, psnr=None, mean=None),
    ]
    small, large = paper_tables(rows, "tennis", "no weights given").split("errors of up to 30 frames")
    views = next(line.split() for line in small.splitlines() if line.split()[:2] == ["tennis", "PSNR"])
    assert views[2:] == ["26.41", "27.30", "27.50", "23.14", "26.32", "24.50", "±", "0.71"]
    lpips = next(line.split() for line in small.splitlines() if "LPIPS   " in line)
    assert lpips[-1] == "–" == lpips[4] and "LPIPS: no weights given." in small
    offsets = next(line.split() for line in small.splitlines() if line.split()[:2] == ["tennis", "13.355"])
    assert offsets[-8:] == ["0.500", "±", "0.000", "–", "0.100", "±", "0.000", "0.700"]
    ablations = [line.split() for line in small.splitlines() if line.startswith(("full", "w/o spline"))]
    assert ablations[-2][:5] == ["full", "27.30", "0.880", "0.142", "27.50"]  # the paper's, and ours, at true time
    assert ablations[-1][:6] == ["w/o", "spline", "27.57", "0.889", "0.139", "27.25"]
    assert "26.50" in small and "2 seeds" in small and "27.50" not in large and "w/o spline" not in large
    assert paper_tables([row("ours", lpips=0.123)], "kitchen").count("0.123") == 1


def test_figures_have_a_spread_where_they_were_measured_several_times():
    several = summary([row("ours", psnr=p, max=m) for p, m in ((24.0, 0.2), (25.0, 0.7), (29.0, 0.1))])
    assert several["psnr"] == 26.0 and several["psnr_spread"] == pytest.approx(np.std([24.0, 25, 29], ddof=1))
    assert several["max"] == 0.7 and several["seeds"] == 3 and several["lpips"] is None is several["lpips_spread"]
    once = summary([row("fixed")])
    assert once["psnr"] == 25.0 and once["psnr_spread"] is None
    lines = row_table({"ours": several, "fixed": once}).splitlines()
    assert "26.00 ± 2.65" in lines[1] and "0.100 ± 0.000" in lines[1] and "±" not in lines[2]
    assert lines[1].split()[:4] == ["ours", "3", "5000", "100"]
    one_without = summary([row("ours", psnr=24.0), row("ours", psnr=None)])
    assert one_without["psnr"] == 24.0 and one_without["psnr_spread"] is None


def test_the_plot_has_a_line_a_configuration_and_a_point_a_length(tmp_path):
    rows = [row("ours", steps=n, cpu_seconds=n / 25, mean=30 / n, seed=s) for n in (300, 1000, 3000) for s in (0, 1)]
    rows += [row("fixed", mean=0.5), row("true time", mask_psnr=None, mean=0.0, start=0.0), row("ours", amplitude=9.0)]
    np.testing.assert_allclose(curve(rows[:6], "mean"), [[12, 0.1], [40, 0.03], [120, 0.01]])
    assert curve([rows[7]], "mask_psnr").shape == (0, 2)
    assert held(rows[6]) and held(rows[7]) and not held(rows[0])
    plot(rows, tmp_path / "recon.svg")
    drawn = (tmp_path / "recon.svg").read_text()
    assert all(name in drawn for name in ("ours", "fixed", "true time", "errors of up to 1 frames"))
    assert ">CPU seconds of the fit<" in drawn and "GPU" not in drawn
    again = tmp_path / "again.svg"
    plot(rows, again)
    assert again.read_text() == drawn


def test_the_plot_of_fits_on_a_gpu_is_against_wall_seconds(tmp_path):
    rows = [row("ours", steps=n, seconds=n / 100, gpu_gb=0.5, mean=30 / n) for n in (300, 3000)]
    np.testing.assert_allclose(curve(rows, "mean", "seconds"), [[3, 0.1], [30, 0.01]])
    plot(rows, tmp_path / "recon.svg")
    drawn = (tmp_path / "recon.svg").read_text()
    assert ">wall seconds of the fit, on a GPU<" in drawn and "CPU seconds" not in drawn
    cpu = [{k: v for k, v in r.items() if k != "gpu_gb"} | {"cpu_seconds": r["seconds"]} for r in rows]
    plot(cpu, tmp_path / "cpu.svg")
    lines = [
        re.findall(r'<path d="M[^"]*L[^"]*" clip-path', text) for text in (drawn, (tmp_path / "cpu.svg").read_text())
    ]
    assert lines[0] == lines[1] != []  # drawn at the seconds, not at the CPU's


def test_tables_hold_the_longest_fits():
    rows = [
        row("ours", steps=300, psnr=11.11),
        row("ours", steps=900, psnr=22.22),
        row("w/o scaffold", psnr=33.33, steps=300),
    ]
    told = paper_tables(rows, "tennis")
    assert "22.22" in told and "33.33" in told and "11.11" not in told


@pytest.mark.slow
def test_the_gate_is_passed_and_repeats_itself_and_its_rows_are_what_the_page_says():
    """On a simulated world: what was measured stands beside each bar."""
    found = gate.measured()
    assert gate.figures_of(gate.measured()) == gate.figures_of(found)
    whole = gate.figures_of_the_whole(gate.whole_run())
    assert record.gate("recon", gate.figures_of(found) | whole, gate.worse) == 0
    rows = {r["configuration"]: r for r in found}
    ours, fixed, without = (rows[name] for name in ("ours", "fixed", "w/o scaffold"))
    assert ours["mean"] < 0.3 * ours["start"]  # .13
    assert ours["mask_psnr"] > fixed["mask_psnr"] + 0.5  # 1.1 dB
    assert without["neighbour_change"] > 3 * ours["neighbour_change"]  # 6.7 times
