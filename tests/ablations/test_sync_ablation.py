"""Where the world makes it true: likelihood over DTW, refined over frames, graph over star."""

from __future__ import annotations

import numpy as np
import pytest

from otsync import DTW, ConstantShift, LikelihoodScan, align, refine
from otsync.bench.sync_shutter import shutter_rows
from otsync.bench.sync_worlds import FPS, MOVING, pair_case

SEEDS = (5100, 5101)


def errors(band: int, preset: str, aligner, refined: bool = False) -> np.ndarray:
    found = []
    for motion in MOVING:
        for seed in SEEDS:
            case = pair_case(motion, preset, band, seed)
            answer = align(case.a, case.b, case.matches, aligner, throw=False)
            if refined:
                answer = refine(case.a, case.b, case.matches, answer, throw=False)
            found.append(abs(answer.offset * FPS - case.offset))
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["mid", "hard"])
def test_the_papers_dtw_is_three_times_worse_in_the_widest_band(preset):
    ours = errors(2, preset, LikelihoodScan(), refined=True)
    assert errors(2, preset, DTW()).mean() >= 3 * ours.mean()
    assert errors(2, preset, ConstantShift()).mean() >= 3 * ours.mean()


def test_refinement_goes_below_the_frame():
    scanned, refined = (errors(1, "mid", LikelihoodScan(), r) for r in (False, True))
    assert refined.mean() < 0.6 * scanned.mean()
    assert refined.mean() < 0.06


@pytest.mark.parametrize(
    ("preset", "videos", "share"),
    [
        ("clean", 2, 0.25),
        pytest.param("mid", 2, 0.5, marks=pytest.mark.slow),
        pytest.param("mid", 8, 0.5, marks=pytest.mark.slow),
    ],
)
def test_a_declared_readout_makes_a_rolling_shutter_global(preset, videos, share):
    rows = {r["shutter"]: r["mean"] for r in shutter_rows(SEEDS[:1], (preset,), (videos,), MOVING)}
    assert rows["rolling, declared"] < share * rows["rolling, not declared"]
    assert rows["rolling, declared"] < 1.1 * rows["global"] + 0.002
