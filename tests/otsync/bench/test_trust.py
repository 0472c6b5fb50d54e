"""``otsync bench trust``: errors are measured against what frames show, and the tables say what they say."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from otsync.bench.trust import thresholds
from otsync.bench.trust.diagram import reliability
from otsync.bench.trust.run import acceptance, interval, one, run, summarise, wrong
from otsync.bench.trust.worlds import CLASSES, FPS, WITHOUT_DEPTH, World, levelled, plain, steady
from otsync.simulate import simulate
from otsync.simulate.effects import Drop, In, Repeats
from otsync.types import Break, Offsets


def test_an_error_is_the_distance_from_what_a_frame_shows():
    tracks, truth = simulate("tennis", preset="mid", videos=2, offsets=[0.0, 0.5], seed=1)
    world = World(tuple(tracks), truth.shown)
    for off in (0.0, 0.1, -0.2):
        ends, worst = world.errors(Offsets.known(("a", "b"), np.array([0.0, 0.5 + off]), FPS))
        assert ends[0] == pytest.approx(abs(off) * FPS, abs=1e-6) and worst[0] == pytest.approx(ends[0], abs=1e-6)


def test_the_beginning_and_the_end_are_told_apart():
    """A clock that is right where both begin, and 1 % fast, is off by a hundredth of what lies between."""
    tracks, truth = simulate("tennis", preset="mid", videos=2, offsets=[0.0, 0.0], frames=90, tracks=20, seed=1)
    world = World(tuple(tracks), truth.shown)
    fast = replace(Offsets.known(("a", "b"), np.zeros(2), FPS), rates=np.array([1.0, 0.99]))
    (begin, end), *_ = world.at_ends(fast)
    assert begin < 0.1 and end == pytest.approx(0.82, abs=0.02)  # means of the first and the last fifteen of 90 frames
    ends, worst = world.errors(fast)
    assert ends[0] == worst[0] == end


def test_a_break_that_is_not_told_is_an_error_behind_it():
    world = next(w for w in map(CLASSES["freeze of 30"], range(20)) if w.shown[1][0] < 0)  # most of it is common
    assert world.shown is not None
    late = float(world.shown[1][0] - world.shown[0][0])
    plain = Offsets.known(("a", "b"), np.array([0.0, late]), FPS)
    assert world.errors(plain)[0][0] == pytest.approx(30, abs=0.01)
    step = np.flatnonzero(np.diff(world.shown[1]) < 1e-9)
    at = float(world.tracks[1].times[step[-1] + 2])
    told = replace(plain, breaks=((), (Break(at, -1.0, 1.0),)))
    assert world.errors(told)[0][0] < 0.01


def test_a_steep_staircase_is_asked_for_its_middle():
    """Fifteen pictures a second shown at twenty in a file of thirty: no frame is steady, but the clock has a middle."""
    fast = (In(0, Repeats(15.0)), In(0, Repeats(20.0)))
    tracks, truth = simulate("boxes", preset="clean", videos=2, frames=60, tracks=20, effects=fast, seed=0)
    world = World(tuple(tracks), truth.shown)
    late = float(np.mean(truth.shown[0] - truth.shown[0][0] - tracks[0].times)) + truth.shown[0][0]
    true = truth.shown[1][0] - late
    for off in (0.0, 0.1, -0.8):
        ends, _ = world.errors(Offsets.known(("a", "b"), np.array([0.0, true + off]), FPS))
        assert ends[0] == pytest.approx(abs(off) * FPS, abs=0.7), off


@pytest.mark.parametrize("pictures", [24.0, 12.0])
@pytest.mark.parametrize("frames", [40, 41, 42, 43, 44])
def test_the_middle_of_a_file_that_repeats_frames_is_right_at_both_ends_and_anywhere(frames, pictures):
    """Of 24 pictures a second in 30 each is late by 0, 1, 3/4, 1/2 and 1/4 of a frame in turns: by a half, whichever
    of them the clip begins and ends with. Of 12 by 0, 1, 2, 1/2 and 3/2: too steep for any frame to be steady.
    """
    repeats = (In(1, Repeats(pictures)),)
    tracks, truth = simulate("tennis", preset="clean", videos=2, frames=frames, tracks=20, effects=repeats, seed=0)
    world = World(tuple(tracks), truth.shown)
    middle = float(np.mean((truth.shown[1] - tracks[1].times)[:40]))
    for off in (0.0, 0.1):
        found = Offsets.known(("a", "b"), np.array([0.0, middle - truth.shown[0][0] + off]), FPS)
        errors, worst = world.errors(found)
        assert worst[0] == pytest.approx(off * FPS, abs=1e-6) and errors[0] == pytest.approx(off * FPS, abs=1e-6)
        np.testing.assert_allclose(world.at_ends(found), off * FPS, atol=1e-6)


def test_a_few_frames_that_seem_even_do_not_answer_for_a_steep_staircase():
    """Twelve pictures a second in 30, of which ten frames are lost: only the six behind the last picture seem steady;
    they say nothing of the beginning.
    """
    lost = (In(1, Repeats(12.0)), In(1, Drop(10 / 30)))
    world = plain(66100, first=lost)
    assert world.shown is not None
    own, times = world.shown[1], world.tracks[1].times
    assert 0 < steady(own, times).sum() < 15
    middle = float(np.mean((own - times)[:60])) - float(world.shown[0][0])
    found = Offsets.known(("a", "b"), np.array([0.0, middle]), FPS)
    told = replace(found, breaks=((), (Break(float(times[np.argmax(np.diff(own)) + 1]), 10 / 30),)))
    assert world.at_ends(told)[0, 0] < 0.01


def test_a_gap_parts_what_an_error_is_averaged_over():
    times = np.concatenate([np.arange(20), np.arange(40, 60)]) / FPS
    late = np.repeat([0.0, 1.0], 20)
    np.testing.assert_array_equal(levelled(late, times), late)


def test_where_there_is_no_truth_every_answer_is_wrong():
    world = CLASSES["two scenes"](3)
    ends, _ = world.errors(Offsets.known(("a", "b"), np.zeros(2), FPS))
    assert np.isinf(ends).all()
    assert wrong({"trusted": True, "error": float("inf")}) and not wrong({"trusted": False, "error": float("inf")})


def test_tables_of_made_up_answers():
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.02, 0.2, 400)
    base = {"method": "default", "trusted": True, "flags": ""}

    def row(begin: float, end: float, s: float) -> dict[str, object]:
        ends = {"begin": begin, "end": end, "sigma_begin": s, "sigma_end": s}
        return base | {"class": "mid", "error": max(begin, end), "heard": max(begin, end), "sigma": s} | ends

    both = np.abs(sigma[:, None] * rng.normal(size=(400, 2)))
    rows = [row(float(b), float(e), float(s)) for (b, e), s in zip(both, sigma, strict=True)]
    told = reliability(rows)
    assert len(told) == 8 and all(abs(r["claimed rms"] / r["found rms"] - 1) < 0.35 for r in told)
    assert summarise(rows)[0]["trusted"] == 1.0
    # each end by itself: of two that are told apart the larger error is within one sigma in 47 of 100 only
    assert summarise(rows)[0]["1 sigma"] == pytest.approx(0.68, abs=0.04)
    assert np.mean([r["error"] <= r["sigma"] for r in rows]) < 0.55
    known = [r | {"sigma_begin": r["begin"] / 0.9, "sigma_end": r["end"] / 1.1} for r in rows]
    assert summarise(known)[0]["1 sigma"] == 0.5 and summarise(known)[0]["2 sigma"] == 1.0
    checks = {c.name: c for c in acceptance([*rows, row(9.0, 9.0, 0.1)])}
    assert checks["confident and wrong, in 500 trusted"].measured == pytest.approx(500 / 401)


def test_what_is_mended_must_be_named_and_exact():
    base = {"method": "default", "class": "freeze of 15", "rate": 1.0, "sigma": 0.1, "flags": ""}
    named = base | {"trusted": True, "breaks": "video 1: stands still", "error": 0.1, "heard": 0.1}
    flagged = base | {"trusted": False, "breaks": "", "error": 15.0, "heard": 15.0}
    checks = {c.name: c for c in acceptance([*[named] * 9, flagged])}
    assert checks["freeze of 15: found and named"].measured == 0.9 and checks["freeze of 15: found and named"].met
    worse = {c.name: c for c in acceptance([*[named] * 8, named | {"error": 0.2}, flagged])}
    assert not worse["freeze of 15: largest error of trusted, frames"].met
    unnamed = {c.name: c for c in acceptance([named | {"breaks": ""}])}
    assert unnamed["freeze of 15: found and named"].measured == 0
    low, high = interval(0, 300)
    assert low == 0 and high == pytest.approx(0.0122, abs=1e-3)


def test_steps_that_noise_hides_are_counted_where_they_would_be_heard_and_the_others_everywhere():
    ends = {"begin": 0.1, "end": 0.1, "sigma_begin": 0.1, "sigma_end": 0.1}
    base = {"method": "default", "rate": 1.0, "sigma": 0.1, "flags": "", "trusted": True, "breaks": ""} | ends
    at_the_end = base | {"class": "frames lost at an end, hard", "error": 4.0, "heard": 0.1}
    right = base | {"class": "freeze of 30", "error": 0.1, "heard": 0.1}
    everywhere, where_heard = (
        "confident and wrong, in 500 trusted",
        "confident and wrong where a step would be heard, in 500",
    )
    checks = {c.name: c for c in acceptance([at_the_end, at_the_end, *[right] * 500])}
    assert checks[everywhere].measured == 0 and checks[where_heard].measured == 0
    (row, _) = summarise([at_the_end, at_the_end, right])
    assert row["wrong"] == 2 and row["where heard"] == 0
    checks = {c.name: c for c in acceptance([right | {"error": 4.0}] * 2 + [right] * 498)}
    assert checks[everywhere].measured == 2 and not checks["most in one class"].met
    checks = {c.name: c for c in acceptance([at_the_end | {"heard": 4.0}] * 2 + [right] * 498)}
    assert checks[everywhere].measured == 0 and not checks[where_heard].met and not checks["  most in one class"].met


@pytest.mark.slow
def test_a_small_run_writes_tables_and_a_diagram(tmp_path):
    assert run(tmp_path, seeds=2, first_seed=50, only=("mid", "two scenes")) == 0
    rows = json.loads((tmp_path / "trust.json").read_text())["rows"]
    assert [(r["class"], r["seed"]) for r in rows] == [(c, s) for s in (50, 51) for c in ("mid", "two scenes")]
    assert (tmp_path / "trust.png").stat().st_size > 5000
    with pytest.raises(ValueError, match="expected classes among"):
        run(tmp_path, only=("nothing",))


def test_a_limit_is_set_where_it_is_read_and_set_back():
    from otsync.sync import parts

    with thresholds.limit_set("blur", 0.1) as method:
        assert method is not None and method.aligner is None and method.refiner.trust.blur == 0.1
    now = parts.SUITS_BETTER
    with thresholds.limit_set("sync.parts.SUITS_BETTER", 0.4) as method:
        assert method is None and parts.SUITS_BETTER == 0.4
    assert now == parts.SUITS_BETTER


@pytest.mark.parametrize("name", ["blurr", "sync.parts.NOTHING", "sync.nowhere.X", "sync.parts.LENGTHS", "os.path.sep"])
def test_a_limit_that_there_is_not_is_refused(name, tmp_path):
    with pytest.raises(ValueError, match=f"--only: .*found {name}"):
        thresholds.run(tmp_path, only=(name,))


def test_a_number_is_changed_where_it_is_imported_and_not_where_another_has_its_name():
    """GAP of breaks and GAP of another module are two limits, even where they are equal."""
    from types import ModuleType

    from otsync.sync.mend import breaks

    for name, source in (
        ("otsync.importer", "from otsync.sync.mend.breaks import LIMIT"),
        ("otsync.namesake", "LIMIT = 200"),
    ):
        module = ModuleType(name)
        exec(source, vars(module))
        sys.modules[name] = module
    try:
        with pytest.MonkeyPatch.context() as patch:
            sources = {
                "otsync.importer": "from otsync.sync.mend.breaks import LIMIT",
                "otsync.namesake": "LIMIT = 200\n",
            }
            real = thresholds.inspect.getsource
            patch.setattr(thresholds.inspect, "getsource", lambda m: sources.get(m.__name__) or real(m))
            with thresholds.limit_set("sync.mend.breaks.LIMIT", 100):
                assert breaks.LIMIT == 100 and sys.modules["otsync.importer"].LIMIT == 100
                assert sys.modules["otsync.namesake"].LIMIT == 200
        assert breaks.LIMIT == sys.modules["otsync.importer"].LIMIT == 200
    finally:
        for name in ("otsync.importer", "otsync.namesake"):
            del sys.modules[name]


def test_limits_are_not_chosen_on_seeds_that_measure(tmp_path):
    with pytest.raises(ValueError, match="--first-seed"):
        thresholds.run(tmp_path, first_seed=19_999, seeds=2)


def test_the_limit_chosen_trusts_most_while_hardly_any_is_wrong():
    rows = [
        {"limit": "blur", "now": 2.0, "value": v, "right": right, "wrong": wrong}
        for v, right, wrong in ((1.0, 900, 0), (2.0, 1100, 1), (2.4, 1100, 1), (4.0, 1300, 9))
    ]
    told = thresholds.chosen(rows)
    assert told["chosen"] == 2.0 and told["right now"] == 1100
    assert thresholds.chosen([r | {"wrong": r["wrong"] + 20} for r in rows])["chosen"] == 2.0


@pytest.mark.slow
def test_a_sweep_writes_what_each_value_trusts(tmp_path, monkeypatch):
    monkeypatch.setattr(thresholds, "CLASSES", {"hard": CLASSES["hard"]})
    monkeypatch.setattr(thresholds, "FACTORS", (0.01, 1.0))
    assert thresholds.run(tmp_path, seeds=2, only=("blur",)) == 0
    strict, now = json.loads((tmp_path / "thresholds.json").read_text())["rows"]
    assert strict["right"] == 0 and strict["wrong"] == 0 and strict["answers"] == now["answers"] == 2
    assert len(json.loads((tmp_path / "thresholds_answers.json").read_text())["rows"]) == 4
    assert json.loads((tmp_path / "thresholds_chosen.json").read_text())["rows"][0]["chosen"] == now["value"]


def test_tracks_without_depth_take_no_other_method_and_no_limit_of_one():
    assert len(WITHOUT_DEPTH) == 8
    for name in WITHOUT_DEPTH:
        with pytest.raises(ValueError, match=f"{name}: expected no other method, .*; found 'paper'"):
            one((name, "paper", 500))
        assert not thresholds.reads("blur", name) and thresholds.reads("sync.parts.SUITS_BETTER", name)
    assert thresholds.reads("blur", "mid") and thresholds.reads(None, "phones in hands")


def test_phones_in_hands_repeat_a_frozen_picture_and_know_where_they_were():
    world = CLASSES["phones in hands, one frozen"](500)
    uv, still = world.tracks[1].uv, np.flatnonzero(np.diff(world.shown[1]) == 0)
    assert len(still) == 8 and all(np.array_equal(uv[:, k], uv[:, k + 1], equal_nan=True) for k in still)
    off, true = (CLASSES[f"phones in hands, {name}ten lost"](500).tracks[0] for name in ("poses off, ", ""))
    assert np.allclose(off.uv, true.uv, atol=10, equal_nan=True) and not np.allclose(off.camera.w2c, true.camera.w2c)
    assert np.abs(off.camera.center - true.camera.center).max() < 0.05
