"""No option is silently ignored: each changes what comes out, is refused, or is on a short list with the reason.

The table below is held against the commands' own fields, so that a new option without a row fails.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from otsync import PAPER, TrackSet, synchronize
from otsync.cli import main
from otsync.cli.commands import OWN
from otsync.plugins import short_name
from otsync.simulate import matching_world, simulate
from otsync.types import Offsets
from tests.options.walk import options_of
from tests.recording_world import write_recording

REFUSED = "refused"

REASONS = {
    "sync workers": "results do not depend on it (tests/otsync/sync/test_sync.py); 0 is refused",
    "sync recording.workers": "results do not depend on it (tests/otsync/recordings/test_recordings.py)",
    "sync graph.starts": "more starts of a search: they matter where the obvious ones fail (test_graph.py)",
    "match matcher:FusedGromovWasserstein.device": "where products are computed; an unknown one is refused below",
    "match matcher:GromovWasserstein.device": "as of FusedGromovWasserstein",
}
"""Options that change nothing that can be compared, and why that is right."""

COSTS = (
    "AnchoredFGW",
    "FusedGromovWasserstein",
    "PartialFGW",
    "EntropicFGW",
    "UnbalancedFGW",
    "SemirelaxedFGW",
    "OptimalTransport",
    "UnbalancedOT",
    "NearestNeighbor",
    "Candidates",
)


def slot(kind: str, name: str, **values: object) -> dict[str, list[str]]:
    """Rows of an algorithm's options: each set alone beside the algorithm at its defaults."""
    return {
        f"{kind}:{name}.{field}": [f"--{kind}.{field.replace('_', '-')}", *str(value).split()]
        for field, value in values.items()
    }


MATCHER_OPTIONS = (
    slot(
        "matcher",
        "AnchoredFGW",
        anchors=40,
        cells=60,
        mass=0.4,
        alpha=2.0,
        tau=0.2,
        beta=0.2,
        landmarks=20,
        rounds=1,
        partners=2,
        seed=3,
    )
    | slot("matcher", "FusedGromovWasserstein", alpha=3.0, max_iter=2, tol=0.5)
    | slot("matcher", "PartialFGW", mass=0.3, alpha=3.0, tol=10.0)
    | slot("matcher", "EntropicFGW", reg=0.09, alpha=3.0, max_iter=2, tol=1.0)
    | slot("matcher", "GromovWasserstein", max_iter=2, tol=0.5)
    | slot("matcher", "OptimalTransport", reg=0.3)
    | slot("matcher", "UnbalancedOT", reg=0.3, marginal=1.0, partners=1, top=10, every=10**6)
    | {"matcher:UnbalancedOT.weighted": ["--matcher.weighted"]}
    | slot("matcher", "UnbalancedFGW", marginal=1.0, reg=0.05, alpha=0.5, partners=2, top=10, max_iter=1)
    | slot("matcher", "SemirelaxedFGW", alpha=3.0, partners=2, top=10, max_iter=1, tol=0.5)
    | slot("matcher", "Candidates", k=1, top=10)
)

SCAN, FIT = "aligner:LikelihoodScan", "refiner:SplineRefine"
ALIGNER_OPTIONS = (
    slot("aligner", "LikelihoodScan", max_lag=0.1, min_overlap=2.5, peaks=1, limit=10)
    | slot("aligner", "DTW", cost="velocity")
    | {"aligner:DTW.open_ends": ["--aligner.open-ends"]}
    | slot("aligner", "ConstantShift", cost="velocity", min_overlap=3.25, max_lag=0.1)
    | {
        f"{SCAN}.trust.{name}": [f"--aligner.trust.{name.replace('_', '-')}", value]
        for name, value in {
            "evidence": "1e9",
            "margin": "10",
            "returning": "-1",
            "disagreement": "-1",
            "alias": "-1",
            "overlap": "1e9",
            "matches": "1e9",
            "motion": "1e9",
            "rate_gain": "-1",
        }.items()
    }
)
REFINER_OPTIONS = slot("refiner", "SplineRefine", windows="0.3 0.2", smoothing=3.0, limit=10) | {
    f"{FIT}.trust.{name}": [f"--refiner.trust.{name.replace('_', '-')}", value]
    for name, value in {
        "moved": "-1",
        "spread": "-1",
        "correlation": "2",
        "blur": "-1",
        "common": "2",
        "wander": "-9",
        "unsteady": "-1",
        "astray": "-1",
        "untold": "-1",
        "lag": "-1",
        "parted": "-1",
        "overlap": "1e9",
        "matches": "1e9",
    }.items()
}
EPIPOLAR, EPIPOLAR_FIT = "aligner:EpipolarScan", "refiner:EpipolarRefine"
EPIPOLAR_OPTIONS = slot(
    "aligner",
    "EpipolarScan",
    window=0.5,
    motion_scale=9.0,
    position_scale=30.0,
    min_overlap=2.5,
    min_seen=2.0,
    max_lag=0.05,
    weak=1e9,
    ambiguous=9.0,
) | slot("refiner", "EpipolarRefine", windows="0.3 0.2", reach=1e-6, iterations=1)
EPIPOLAR_OPTIONS |= {f"{EPIPOLAR_FIT}.trust.lag": ["--refiner.trust.lag", "-1"]}
EPIPOLAR_OPTIONS |= {
    f"{EPIPOLAR_FIT}.scan.{name}": [f"--refiner.scan.{name.replace('_', '-')}", value]
    for name, value in {"window": "0.5", "motion_scale": "9", "position_scale": "30", "min_seen": "4"}.items()
}
NOT_READ = {
    **{f"{EPIPOLAR_FIT}.scan.{name}": "refiner" for name in ("min_overlap", "max_lag", "weak", "ambiguous")},
    **{
        f"{EPIPOLAR_FIT}.trust.{name}": "refiner"
        for name in (
            "moved",
            "spread",
            "correlation",
            "blur",
            "common",
            "wander",
            "unsteady",
            "astray",
            "untold",
            "parted",
            "overlap",
            "matches",
            "returning",
            "disagreement",
            "alias",
            "motion",
            "rate_gain",
        )
    },
    **{
        f"{SCAN}.trust.{name}": "aligner"
        for name in (
            *(
                "moved",
                "spread",
                "correlation",
                "blur",
                "common",
                "wander",
                "unsteady",
                "astray",
                "untold",
                "rate_sigmas",
            ),
            "lag",
            "parted",
        )
    },
    **{f"{FIT}.trust.{name}": "refiner" for name in ("returning", "disagreement", "alias", "motion", "rate_gain")},
}


def run(args: list[str]) -> tuple[int, str, str]:
    """(exit code, standard output, standard error) of ``otsync`` in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(args)
        except SystemExit as stop:
            code = int(stop.code or 0)
    return code, out.getvalue(), err.getvalue()


ANSWERS: dict[tuple[str, ...], str] = {}


def answer(args: list[str]) -> str:
    """What a command prints as JSON, without wall times; asked once, wherever its files go."""
    places = {n + 1 for n, arg in enumerate(args) if arg == "--out"}
    key = tuple("OUT" if n in places else arg for n, arg in enumerate(args))
    if key not in ANSWERS:
        ANSWERS[key] = _answer(args)
    return ANSWERS[key]


def _answer(args: list[str]) -> str:
    code, out, err = run(args)
    assert code in (0, 1), err

    def plain(x):
        if isinstance(x, dict):
            return {k: plain(v) for k, v in x.items() if k not in ("seconds", "refine_seconds")}
        return [plain(v) for v in x] if isinstance(x, list) else x

    return json.dumps(plain(json.loads(out)))


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> list[str]:
    """Two videos of 260 tracks, as files."""
    folder = tmp_path_factory.mktemp("pair")
    a, b, _ = matching_world(260, seed=3, frames=16)
    a.save(folder / "a.npz")
    b.save(folder / "b.npz")
    return [str(folder / "a.npz"), str(folder / "b.npz")]


@pytest.fixture(scope="module")
def films(tmp_path_factory) -> list[str]:
    """Five videos of 100 frames and 64 tracks, as files."""
    folder = tmp_path_factory.mktemp("films")
    tracks, _ = simulate("softball", preset="clean", videos=5, frames=100, seed=3, max_offset=10)
    for n, t in enumerate(tracks):
        last, some = 100 if n < 4 else 60, slice(0, len(t), 3)  # the last one is short
        film = TrackSet(
            t.xyz[some, :last], t.seen[some, :last], t.features[some], fps=t.fps, name=t.name, frame=t.frame
        )
        film.save(folder / f"{t.name}.npz")
    return [str(p) for p in sorted(folder.glob("*.npz"))]


@pytest.fixture(scope="module")
def flat(tmp_path_factory) -> list[str]:
    """Two videos of 100 frames in pixels alone, as files."""
    folder = tmp_path_factory.mktemp("flat")
    tracks, _ = simulate("softball", preset="clean", videos=2, frames=100, seed=4, max_offset=10)
    for t in tracks:
        film = replace(t, xyz=None, sigma=None, visible=t.seen).take(np.arange(0, len(t), 3))
        film.save(folder / f"{t.name}.npz")
    return [str(p) for p in sorted(folder.glob("*.npz"))]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    write_recording(folder, [0.0, 3.0, -2.0], frames=45)
    return folder


def test_every_option_has_a_row():
    walked = {f"{command} {option}" for command, place in OWN.items() for option in options_of(place)}
    missing, gone = walked - set(ROWS), set(ROWS) - walked
    assert not missing and not gone, f"without a row: {sorted(missing)}; no option any more: {sorted(gone)}"


def matching(option: str) -> list[str]:
    name = option.partition(".")[0]
    return [f"{name.partition(':')[0]}:{short_name(type(name.partition(':')[2], (), {}))}"]


@pytest.mark.parametrize("option", sorted(MATCHER_OPTIONS))
def test_options_of_matchers_change_the_matches(option, pair):
    base = ["match", *pair, "--json", *matching(option)]
    assert answer(base) != answer([*base, *MATCHER_OPTIONS[option]])


def test_restarts_of_the_anchored_matcher(tmp_path):
    """They matter where the first start looks mirrored: features that say nothing of the side."""
    a, b, _ = matching_world(260, seed=3, frames=16)
    rng = np.random.default_rng(0)
    for name, t in (("a", a), ("b", b)):
        vague = type(t)(t.xyz, t.seen, rng.normal(size=(len(t), 4)), fps=30, name=name)
        vague.save(tmp_path / f"{name}.npz")
    base = ["match", str(tmp_path / "a.npz"), str(tmp_path / "b.npz"), "--json", "matcher:anchored-fgw"]
    assert answer(base) != answer([*base, "--matcher.restarts", "1"])


def test_algorithms_in_the_slot_of_matchers_differ(pair):
    names = sorted({matching(option)[0] for option in MATCHER_OPTIONS} | {"matcher:nearest-neighbor"})
    answers = [answer(["match", *pair, "--json", name]) for name in names]
    assert len(set(answers)) == len(names) == 11


def test_costs_for_the_named_matcher(pair, films, tmp_path):
    base = ["match", *pair, "--json"]
    first = answer([*base, "matcher:optimal-transport"])
    assert first != answer([*base, "--costs", "cosine:center=False", "matcher:optimal-transport"])
    sync = ["sync", *films[:2], "--json", "--out", str(tmp_path)]
    assert answer([*sync, "matcher:candidates"]) != answer([*sync, "--costs", "curve-distance", "matcher:candidates"])
    for refused in ([*base, "--costs", "cosine"], [*sync, "--costs", "cosine"]):
        code, _, err = run(refused)
        assert code == 2 and "costs" in err
    code, _, err = run([*base, "--costs", "nothing", "matcher:optimal-transport"])
    assert code == 2 and "--costs" in err


def test_a_method_by_name(films, tmp_path):
    base = ["sync", *films[1:4], "--json", "--out", str(tmp_path)]
    paper = answer([*base, "--method", "paper"])
    slots = ["--rematch", "0", "--graph.extra", "0", "--costs", "cosine:center=False"]
    algorithms = ["matcher:fused-gromov-wasserstein", "aligner:dtw", "refiner:unrefined"]
    assert paper == answer([*base, *slots, *algorithms]) != answer(base)
    tracks = [TrackSet.load(f) for f in films[1:4]]
    python = synchronize(tracks, method=PAPER)
    assert [v["offset_seconds"] for v in json.loads(paper)["videos"]] == python.seconds.tolist()
    assert paper != answer([*base, "--method", "paper", "aligner:likelihood-scan"])
    assert paper != answer([*base, "--method", "paper", "--graph.extra", "4"])


@pytest.mark.parametrize("name", COSTS)
def test_costs_are_not_for_the_shell_and_are_refused(name, pair):
    code, _, err = run(["match", *pair, f"matcher:{short_name(type(name, (), {}))}", "--matcher.costs", "x"])
    assert code == 2 and "costs" in err


@pytest.mark.parametrize("name", ["fused-gromov-wasserstein", "gromov-wasserstein"])
def test_an_unknown_device_is_refused(name, pair):
    code, _, err = run(["match", *pair, f"matcher:{name}", "--matcher.device", "abacus"])
    assert code == 2 and "device" in err


def test_the_other_options_of_match(pair, tmp_path):
    base = ["match", *pair, "--json"]
    assert answer(base) != answer([*base, "--budget", "0.15"])
    assert answer(base) != answer(["match", *pair[::-1], "--json"])
    run([*base, "--out", str(tmp_path / "m.csv")])
    assert (tmp_path / "m.csv").read_text().startswith("a,b,score\n")
    assert run(["match", *pair])[1] != run(base)[1]


@pytest.mark.parametrize("option", sorted(ALIGNER_OPTIONS))
def test_options_of_aligners_change_the_offsets(option, films, tmp_path):
    base = ["sync", *films[:2], "--json", "--rematch", "0", "--out", str(tmp_path), *matching(option)]
    end = [] if "LikelihoodScan" in option else ["refiner:unrefined"]
    assert answer([*base, *end]) != answer([*base, *ALIGNER_OPTIONS[option], *end])


@pytest.mark.parametrize("option", sorted(EPIPOLAR_OPTIONS))
def test_options_of_what_reads_pixels_change_the_offsets(option, flat, tmp_path):
    base = ["sync", *flat, "--json", "--rematch", "0", "--out", str(tmp_path)]
    slots = {"aligner": ["aligner:epipolar-scan"], "refiner": ["refiner:epipolar-refine"]}
    matcher = ["matcher:candidates", "--matcher.k", "8", "--matcher.top", "None"]
    first = answer([*base, *matcher, *slots["aligner"], *slots["refiner"]])
    slots[option.partition(":")[0]] += EPIPOLAR_OPTIONS[option]
    assert first != answer([*base, *matcher, *slots["aligner"], *slots["refiner"]])


@pytest.mark.parametrize("option", sorted(REFINER_OPTIONS))
def test_options_of_refiners_change_the_offsets(option, films, tmp_path):
    base = ["sync", *films[:2], "--json", "--rematch", "0", "--out", str(tmp_path), *matching(option)]
    assert answer(base) != answer([*base, *REFINER_OPTIONS[option]])


@pytest.mark.parametrize(
    "option",
    [["--refiner.trust.evidence", "1e9"], ["--refiner.trust.margin", "1e9"], ["--graph.curves", "False"]],
)
def test_what_decides_where_some_pairs_do_not_vouch_for_themselves(option, films, tmp_path):
    """The pairs of a short video say less; then the summed curves tell, by the refiner's limits."""
    base = ["sync", *films, "--json", "--rematch", "0", "--out", str(tmp_path)]
    weak, sure = [], []
    for pair in json.loads(answer(base))["pairs"]:
        (weak if "video4" in (pair["a"], pair["b"]) else sure).append(pair["stats"]["evidence"])
    assert max(weak) < min(sure)
    scan = ["aligner:likelihood-scan", "--aligner.trust.evidence", f"{(max(weak) + min(sure)) / 2:.9g}"]
    graph, end = (option, []) if "graph" in option[0] else ([], option)
    trusted = answer([*base, *scan, "refiner:spline-refine"])
    doubted = answer([*base, *graph, *scan, "refiner:spline-refine", *end])
    # how far pairs that do not vouch scatter, which makes it coarse or not, is no matter of these options
    found, left = (set(json.loads(text)["videos"][4]["flags"]) - {"coarse"} for text in (trusted, doubted))
    assert not found and left


def test_frames_of_their_own(tmp_path):
    """--frames own finds transforms, heeds matcher and graph, and refuses what needs a common frame."""
    tracks, _ = simulate(
        "softball", preset="clean", videos=3, own_frames=True, frames=60, tracks=40, seed=5, max_offset=8
    )
    for t in tracks:
        t.save(tmp_path / f"{t.name}.npz")
    files = [str(p) for p in sorted(tmp_path.glob("*.npz"))]
    base = ["sync", *files, "--frames", "own", "--json", "--out", str(tmp_path / "o")]
    code, _, err = run(["sync", *files, "--out", str(tmp_path / "o")])
    assert code == 2 and "--frames own" in err
    first = answer(base)
    assert "transform" in json.loads(first)["videos"][1]
    assert first != answer([*base, "--graph.extra", "0"])
    assert first != answer([*base, "matcher:partial-fgw"])
    for option in (["aligner:dtw"], ["refiner:unrefined"], ["--rate", "fit"], ["--rematch", "0"]):
        code, _, err = run([*base, *option])
        name = option[0].lstrip("-").partition(":")[0]
        assert code == 2 and f"{name}: expected none" in err and "own" in err, err


def test_rates_of_long_clips(tmp_path):
    tracks, _ = simulate("softball", preset="clean", videos=2, frames=660, rates=[1, 1.002], offsets=[0, 0.3], seed=9)
    for t in tracks:
        t.take(np.arange(0, len(t), 4)).save(tmp_path / f"{t.name}.npz")
    base = ["sync", *map(str, sorted(tmp_path.glob("*.npz"))), "--json", "--rematch", "0", "--out", str(tmp_path)]
    fitted = answer(base)
    fixed = answer([*base, "--rate", "fixed"])
    assert fitted != fixed == answer([*base, "refiner:spline-refine", "--refiner.rate", "fixed"])
    assert fitted == answer([*base, "--rate", "fit"])
    assert fitted != answer([*base, "refiner:spline-refine", "--refiner.trust.rate-sigmas", "1e9"])
    code, _, err = run([*base, "--rate", "fit", "refiner:unrefined"])
    assert code == 2 and "rate" in err and "Unrefined" in err


@pytest.mark.parametrize("option", sorted(NOT_READ))
def test_limits_that_nobody_reads_are_refused(option, films, tmp_path):
    part = option.split(".")[1]
    flag = f"--{NOT_READ[option]}.{part}.{option.rpartition('.')[2].replace('_', '-')}"
    code, _, err = run(["sync", *films[:2], "--out", str(tmp_path / "o"), *matching(option), flag, "0.777"])
    assert code == 2 and option.rpartition(".")[2] in err and not (tmp_path / "o").exists()


def test_the_graph(films, tmp_path):
    base = ["sync", *films, "--json", "--rematch", "0", "--out", str(tmp_path)]
    ring = [*base, "--graph.complete", "3", "--graph.extra", "1"]
    assert answer(base) != answer([*base, "--graph.extra", "0"])
    assert answer([*base, "--graph.extra", "1"]) != answer(ring)
    assert answer(ring) != answer([*ring, "--graph.seed", "4"])
    for options in (
        ["--graph.extra", "0", "--graph.complete", "3"],
        ["--graph.curves", "False", "--graph.starts", "9"],
    ):
        code, _, err = run([*base, *options])
        assert code == 2 and "Graph." in err


def test_the_other_options_of_sync(films, tmp_path):
    out = ["--out", str(tmp_path / "o")]
    base = ["sync", *films[:3], "--json", *out]
    first = answer(base)
    assert (tmp_path / "o" / "offsets.json").is_file() and first != run(base[:-3] + base[-2:])[1]
    assert first != answer([*base, "--rematch", "0"])
    assert first != answer([*base, "--reference", "video1"])
    assert run([*base, "--workers", "0"])[0] == 2  # what two of them change, nothing, is in tests/otsync/cli
    truth = tmp_path / "o" / "offsets.json"
    assert "error_frames" in answer([*base, "--truth", str(truth)])
    assert first != answer(["sync", *films[:2], *base[4:]])
    for option in (["--recording.route", "stereo"], ["--recording.workers", "1"], ["--recording.cameras", "a"]):
        code, _, err = run([*base, *option])
        assert code == 2 and "--recording" in err and "track sets" in err


def test_slots_on_a_recording(recording, tmp_path):
    """Without depth: what reads pixels changes the answer, what reads positions is refused with the route's name."""
    base = ["sync", str(recording), "--json", "--out", str(tmp_path / "o"), "--recording.route", "epipolar"]
    first = answer(base)
    for options in (
        ["matcher:nearest-neighbor"],
        ["aligner:epipolar-scan", "--aligner.window", "0.5"],
        ["refiner:epipolar-refine", "--refiner.iterations", "1"],
        ["--graph.extra", "0"],
        ["--rematch", "1"],
        ["--reference", "auto"],
        ["--costs", "cosine:center=True", "matcher:unbalanced-ot"],
    ):
        assert first != answer([*base, *options]), options
    for options, word in (
        (["aligner:dtw"], "aligner, route"),
        (["matcher:partial-fgw"], "matcher, route"),
        (["refiner:spline-refine"], "refiner, route"),
        (["--method", "paper"], "matcher, route"),
        (["--rate", "fit"], "rate"),
        (["--workers", "2"], "--workers"),
    ):
        code, _, err = run([*base[:4], str(tmp_path / "new"), *base[5:], *options])
        assert code == 2 and word in err, (options, err)


def test_options_of_recordings(recording, tmp_path):
    base = ["sync", str(recording), "--json", "--out", str(tmp_path / "o")]
    first = answer(base)
    assert first != answer([*base, "--recording.route", "epipolar"])
    names = [video["name"] for video in json.loads(first)["videos"]]
    base += ["--recording.cameras", *names[:2]]
    all_of_them, first = first, answer(base)
    assert first != all_of_them
    flow = ["flow", "dis-flow:preset=fast"]
    for priors in (["masks", "flow-residual"], ["points", "chained-flow:every=3"], flow, ["features", "daisy"]):
        assert first != answer([*base, f"--recording.{priors[0]}", priors[1]]), priors
        code, _, err = run([*base, f"--recording.{priors[0]}", "nothing"])
        assert code == 2 and f"--{priors[0]}" in err
    for depth, more, says in (
        ("nothing", [], "--depth: expected some of"),
        ("depth-anything2", ["--recording.route", "epipolar"], "--recording.depth: expected a route that reads it"),
        ("depth-anything2:model=nowhere", [], "expected weights at"),
    ):  # what it does: tests/otsync/recordings/test_learned_depth.py
        code, _, err = run([*base, "--recording.depth", depth, *more])
        assert code == 2 and says in " ".join(err.split())
    for option, other, wrong in (("selection", "count=20", "pace=3"), ("width", "200", "8")):
        assert first != answer([*base, f"--recording.{option}", other]), option
        code, _, err = run([*base, f"--recording.{option}", wrong])
        assert code == 2 and f"--recording.{option}" in err
    assert first == answer([*base, "--recording.workers", "1"])
    assert run([*base, "--recording.workers", "-1"])[0] == 2
    answer([*base, "--recording.cache", str(tmp_path / "kept")])
    assert any((tmp_path / "kept").iterdir())
    moved = tmp_path / "moved"
    moved.mkdir()
    document = json.loads((recording / "scene.json").read_text())
    for video in document["videos"]:
        video["frames"] = [
            f"../{recording.name}/{p.parent.name}/{p.name}" for p in sorted(recording.glob(video["frames"]))
        ]
    shutil.copytree(recording, tmp_path / recording.name)
    (moved / "scene.json").write_text(json.dumps(document))
    outside = ["sync", str(moved), "--json", "--out", str(tmp_path / "m")]
    assert run(outside)[0] == 2 and run([*outside, "--recording.allow-outside"])[0] in (0, 1)
    assert run(["check", str(moved)])[1] != run(["check", str(moved), "--allow-outside"])[1]
    broken = tmp_path / recording.name
    frame = sorted(p for p in broken.rglob("*") if p.suffix in (".png", ".jpg"))[3]
    frame.write_bytes(b"no image")
    assert run(["check", str(broken)])[1] != run(["check", str(broken), "--no-every-frame"])[1]


def test_options_of_init(recording, tmp_path):
    folder = tmp_path / "images"
    for images in sorted(p for p in recording.iterdir() if p.is_dir()):
        shutil.copytree(images, folder / images.name)

    def document(*args: str) -> str:
        run(["init", str(folder), "--force", *args])
        return (folder / "scene.json").read_text()

    plain = document()
    assert plain != document("--fps", "25")
    assert run(["init", str(folder), "--force", "--order", "cam0"])[0] == 2  # a reader that knows no order refuses it
    frames = len(list((folder / "cam0").iterdir()))
    (tmp_path / "times.csv").write_text("video,seconds\n" + "".join(f"cam0,{0.1 * k}\n" for k in range(frames)))
    assert plain != document("--timestamps", str(tmp_path / "times.csv"))
    assert run(["init", str(folder)])[0] == 2  # it is there already
    run(["init", str(folder), "--out", str(folder / "other.json")])
    assert (folder / "other.json").is_file()
    assert run(["init", str(folder), "--force", "--reader", "panoptic"])[0] == 2
    assert run(["init", str(tmp_path / "nowhere")])[0] == 2


def test_options_of_export(recording, tmp_path):
    names = [video["name"] for video in json.loads((recording / "scene.json").read_text())["videos"]]
    Offsets.known(names, np.linspace(0, 0.1, len(names)), 30).save(tmp_path / "o.json")
    Offsets.known(names, np.linspace(0, 0.2, len(names)), 30).save(tmp_path / "other.json")

    def export(*more: str, of: Path = recording, offsets: str = "o.json") -> dict[str, bytes]:
        out = tmp_path / "out"
        shutil.rmtree(out, ignore_errors=True)
        args = ["export", str(of), "--offsets", str(tmp_path / offsets), "--out", str(out), *more]
        assert run(args)[0] == 0
        return {str(p.relative_to(out)): p.read_bytes() for p in out.rglob("*") if p.is_file()}

    base = export("--what", "frames", "timeline")
    assert set(base) == {"frames.csv", "timeline.otio"}
    assert base != export("--what", "frames", "timeline", offsets="other.json")
    assert base != export("--what", "frames", "timeline", "--cameras", *names[:2])
    assert base != export("--what", "frames", "timeline", "--fps", "10")
    mosaic = export("--what", "mosaic", "--width", "40")
    assert set(mosaic) == {"mosaic.mp4"} and mosaic != export("--what", "mosaic", "--width", "60")
    args = ["export", str(recording), "--offsets", str(tmp_path / "o.json"), "--out", str(tmp_path / "out")]
    for option, value in (("--width", "50"), ("--fps", "9")):
        code, _, err = run([*args, "--what", "timeline", option, value])
        assert code == 2 and f"{option}: expected with" in err
    assert run([*args, "--what", "mosaic"])[0] == 2 and run([*args, "--what", "mosaic", "--force"])[0] == 0
    outside = tmp_path / "outside"
    outside.mkdir()
    document = json.loads((recording / "scene.json").read_text())
    for video in document["videos"]:
        for key in ("frames", "masks", "file"):
            if key in video:
                video[key] = f"{recording}/{video[key]}"
        video.pop("depth", None)
    (outside / "scene.json").write_text(json.dumps(document))
    args = ["export", str(outside), "--offsets", str(tmp_path / "o.json"), "--out", str(tmp_path / "out")]
    code, _, err = run([*args, "--what", "frames"])
    assert code == 2 and "outside" in err
    assert export("--what", "frames", "--allow-outside", of=outside)["frames.csv"] == base["frames.csv"]


def test_options_of_simulate(tmp_path):
    def world(*args: str) -> dict[str, bytes]:
        out = tmp_path / "-".join(args or ("plain",)).replace("/", "_")
        assert run(["simulate", str(out), "--frames", "20", "--videos", "2", *args])[0] == 0
        return {p.name: p.read_bytes() for p in sorted(out.iterdir())}

    plain = world()
    for args in (
        ["--motion", "boxes"],
        ["--preset", "hard"],
        ["--videos", "3"],
        ["--frames", "25"],
        ["--fps", "25"],
        ["--max-offset", "5"],
        ["--seed", "8"],
        ["--own-frames"],
    ):
        assert world(*args) != plain, args


def test_options_of_film(tmp_path):
    def filmed(*args: str) -> dict[str, bytes]:
        out = tmp_path / "-".join(args or ("plain",))
        tiny = ["--phones", "2", "--frames", "3", "--walk", "3", "--width", "64", "--height", "36"]
        assert run(["film", str(out), *tiny, *args])[0] == 0
        return {p.name: p.read_bytes() for p in sorted(out.iterdir())}

    plain = filmed()
    assert set(plain) >= {"phone0.mp4", "phone1.mp4", "walk.mp4", "truth.json", "cameras.json"}
    for args in (
        ["--phones", "3"],
        ["--gap", "50"],
        ["--handheld"],
        ["--walk", "4"],
        ["--frames", "4"],
        ["--fps", "25"],
        ["--width", "80"],
        ["--height", "40"],
        ["--max-offset", "2"],
        ["--contrast", "0.5"],
        ["--board", "1"],
        ["--seed", "5"],
    ):
        assert filmed(*args) != plain, args
    code, _, err = run(["film", str(tmp_path / "plain")])
    assert code == 2 and "holds some" in err
    code, _, err = run(["film", str(tmp_path / "hands"), "--handheld", "--board", "3"])
    assert code == 2 and "tripods" in err and not list((tmp_path / "hands").glob("*.mp4"))


@pytest.mark.parametrize("stopped", ["by Ctrl-C", "by a kill"])
def test_a_film_that_was_stopped_is_filmed_by_the_same_command(tmp_path, monkeypatch, stopped):
    tiny = ["--phones", "2", "--frames", "3", "--walk", "3", "--width", "64", "--height", "36"]
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert run(["film", str(whole), *tiny])[0] == 0
    if stopped == "by a kill":
        (out / ".film").mkdir(parents=True)
        (out / ".film" / "phone0.mp4").write_bytes(b"half a clip")
    else:
        with monkeypatch.context() as patch:
            patch.setattr("otsync.cli.calibrate.tell", lambda text: signal.raise_signal(signal.SIGINT))
            assert run(["film", str(out), *tiny])[0] == 130
        assert not list(out.rglob("*.mp4"))
    assert run(["film", str(out), *tiny])[0] == 0
    assert {p.name: p.read_bytes() for p in out.iterdir()} == {p.name: p.read_bytes() for p in whole.iterdir()}


def test_a_film_is_whole_or_not_there(tmp_path, monkeypatch):
    """Ctrl-C while clips are moved to their places waits until all are there."""
    move = os.replace

    def replace(a, b):
        if Path(b).name == "phone0.mp4":
            signal.raise_signal(signal.SIGINT)
        move(a, b)

    monkeypatch.setattr("otsync.cli.calibrate.os.replace", replace)
    tiny = ["--phones", "2", "--frames", "3", "--walk", "3", "--width", "64", "--height", "36"]
    assert run(["film", str(tmp_path / "out"), *tiny])[0] == 130
    there = {p.name for p in (tmp_path / "out").iterdir()} - {".otsync.lock"}
    assert there == {"phone0.mp4", "phone1.mp4", "walk.mp4", "truth.json", "cameras.json"}


@pytest.fixture(scope="module")
def phones(tmp_path_factory) -> Path:
    """Three phones and a walk past them, as folders of images: no clock, no cameras."""
    from otsync.simulate.phones import Tripod, Walk
    from otsync.simulate.room import RoomCamera, draw_room

    folder, rng, size = tmp_path_factory.mktemp("phones"), np.random.default_rng(2), (400, 226)
    K = np.array([[340.0, 0, 200], [0, 340, 113], [0, 0, 1]])
    room = draw_room(2, things=1)
    still = Tripod()
    poses = {f"phone{n}": still(float(a), np.zeros(1), rng)[None] for n, a in enumerate((-0.6, 0.0, 0.6))}
    poses["walk"] = Walk(-0.7, 0.7, sway=0.03)(0.0, np.arange(12) / 0.7, rng)
    for name, w2c in poses.items():
        (folder / name).mkdir()
        eye = RoomCamera(room, K, size, rng)
        for k, pose in enumerate(w2c):
            Image.fromarray(eye.film(pose, 0.0)[0]).save(folder / name / f"{k:02d}.png")
    (folder / "given.json").write_text(json.dumps({"*": {"K": (K * [[1.02], [1.02], [1]]).tolist()}}))
    return folder


@pytest.mark.slow
def test_options_of_calibrate(phones, tmp_path):
    pytest.importorskip("pycolmap")
    out = tmp_path / "out"
    run(["init", str(phones), "--fps", "30"])

    def calibrated(*args: str) -> tuple[str, str]:
        code, told, err = run(["calibrate", str(phones), "--out", str(out), *args])
        assert code in (0, 1), err
        return (phones / "scene.json").read_text(), told

    document, table = calibrated()
    assert (out / "calibration.html").is_file() and "phone1" in table
    for args in (
        ["--key-frames", "9"],
        ["--width", "300"],
        ["--seed", "3"],
        ["--distance", "phone0", "phone1", "12"],
    ):
        assert calibrated(*args)[0] != document, args
    again, told = calibrated("--json")
    assert again == document and json.loads(told) == json.loads(document)["calibration"]
    assert calibrated("--intrinsics", str(phones / "given.json"))[0] != document
    scene = json.loads(document)
    scene.pop("calibration")
    (phones / "scene.json").write_text(json.dumps(scene))  # poses from elsewhere are not thrown away
    code, _, err = run(["calibrate", str(phones), "--out", str(out)])
    assert code == 2 and "--force" in err
    assert "calibration" in json.loads(calibrated("--force")[0])
    code, _, err = run(["calibrate", str(phones), "--board", "9x6"])  # what it does is in test_boards.py
    assert code == 2 and "--board" in err and "board.mp4" in err
    code, _, err = run(["calibrate", str(tmp_path / "nowhere")])
    assert code == 2 and "nowhere" in err


def test_options_of_bench_reach_a_suite_or_are_refused(tmp_path):
    from otsync import plugins

    class Spy:
        name = "spy"

        def run(self, out, **options):
            seen.append((out, options))
            return 0

    class Plain:
        name = "plain"

        def run(self, out):
            return 0

    spy, plain, seen = Spy(), Plain(), []
    plugins.register("benchmarks")(spy)
    plugins.register("benchmarks")(plain)
    try:
        for args, expected in (
            (["somewhere"], {"scene": Path("somewhere")}),
            (["--gate"], {"gate": True}),
            (["--rebase"], {"rebase": True}),
            (["--promises"], {"promises": True}),
            (["--first-seed", "3"], {"first_seed": 3}),
            (["--seeds", "2"], {"seeds": 2}),
            (["--only", "a", "b"], {"only": ("a", "b")}),
            (["--sizes", "20", "50"], {"sizes": (20, 50)}),
            (["--limit", "600"], {"limit": 600.0}),
            (["--features", "daisy"], {"features": "daisy"}),
            (["--json"], {"json": True}),
            (["--cache", "kept"], {"cache": Path("kept")}),
            (["--against", "a.json", "b.json"], {"against": (Path("a.json"), Path("b.json"))}),
        ):
            assert run(["bench", "spy", *args, "--out", str(tmp_path)])[0] == 0
            assert seen.pop() == (tmp_path, expected)
            code, _, err = run(["bench", "plain", *args])
            assert code == 2 and next(iter(expected)).replace("_", "-") in err and "does not take it" in err
    finally:
        plugins.forget(spy, plain)


def test_options_of_plugins():
    assert run(["plugins", "--json"])[1] != run(["plugins"])[1]


def rows() -> set[str]:
    """Every option that a test above exercises, refuses, or gives a reason for."""
    algorithms = {f"match {option}" for option in MATCHER_OPTIONS} | {f"match matcher:{n}.costs" for n in COSTS}
    algorithms |= {f"match {option.partition('.')[0]}" for option in MATCHER_OPTIONS}
    algorithms |= {"match matcher:NearestNeighbor", "match matcher:AnchoredFGW.restarts"}
    algorithms |= {name for name in REASONS if name.startswith("match")}
    slots = (*ALIGNER_OPTIONS, *REFINER_OPTIONS, *EPIPOLAR_OPTIONS)
    pairs = {f"sync {o}" for o in (*slots, *NOT_READ)} | {f"sync {o.partition('.')[0]}" for o in slots}
    pairs |= {f"sync {EPIPOLAR_FIT}.trust.{n}" for n in ("evidence", "margin", "rate_sigmas")}
    pairs |= {f"sync {FIT}.trust.{n}" for n in ("evidence", "margin", "rate_sigmas")} | {f"sync {FIT}.rate"}
    others = {
        "match": "a b out budget json costs",
        "sync": "tracks out reference truth method rate rematch costs frames workers json refiner:Unrefined "
        "graph.extra graph.complete "
        "graph.curves graph.starts graph.seed recording.route recording.cameras recording.cache "
        "recording.allow_outside recording.workers recording.masks recording.points recording.flow recording.features "
        "recording.depth recording.selection recording.width",
        "simulate": "out motion preset videos frames fps max_offset own_frames seed",
        "film": "out phones gap handheld walk board frames fps width height max_offset contrast seed",
        "calibrate": "folder out force way options.intrinsics options.board options.square options.distance "
        "options.key_frames options.width options.seed json",
        "init": "folder out reader fps order timestamps force",
        "audit": "scene out tolerance cameras allow_outside json",
        "import-offsets": "source recording kind sigma offsets out allow_outside",
        "check": "scene every_frame allow_outside",
        "export": "recording offsets out what cameras width fps force allow_outside",
        "bench": "suite scene out gate rebase promises first_seed seeds only sizes limit features json cache against",
        "plugins": "json",
    }
    shared = {row.replace("match matcher", "sync matcher") for row in algorithms if "matcher:" in row}  # the same slot
    return algorithms | shared | pairs | {f"{c} {o}" for c, names in others.items() for o in names.split()}


ROWS = rows()
