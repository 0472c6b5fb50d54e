"""Costs at known times against brute force, with gaps."""

from __future__ import annotations

import numpy as np
import pytest

from otsync import TrackSet
from otsync.costs.kernels import paired_epipolar_residuals
from otsync.costs.positions import SynchronousDistance, scene_scale
from otsync.geometry import fundamentals, sampson
from tests.recording_world import ring


@pytest.mark.parametrize("late", [6, -4])
def test_the_distance_at_equal_times_is_the_mean_over_the_frames_that_both_see(late):
    """b started ``late`` frames later: its frame k shows what a's frame k + late shows."""
    rng = np.random.default_rng(late + 10)
    xa, xb = rng.normal(size=(4, 40, 3)), rng.normal(size=(5, 30, 3))
    seen_a, seen_b = rng.random((4, 40)) < 0.8, rng.random((5, 30)) < 0.8
    seen_b[3, 5:] = False  # shares less than is asked for
    a, b = (TrackSet(x, seen, fps=30, frame="w") for x, seen in ((xa, seen_a), (xb, seen_b)))
    found = SynchronousDistance(late / 30, scale=1.0, cap=1e9, min_overlap=10 / 30).matrix(a, b)
    unit = scene_scale(a, b)
    k = np.arange(max(0, -late), min(30, 40 - late))
    for i in range(4):
        for j in range(5):
            both = k[seen_a[i, k + late] & seen_b[j, k]]
            apart = np.linalg.norm(xa[i, both + late] - xb[j, both], axis=1).mean() / unit
            assert found[i, j] == pytest.approx(apart if len(both) >= 10 else 1e9)
    assert (found[:, 3] == 1e9).all() and (found[:, :3] < 1e9).all()


@pytest.mark.parametrize("moves", [False, True])
def test_epipolar_residuals_are_sampsons_and_vary_within_windows(moves):
    rng = np.random.default_rng(0)
    first, second, third = ring(4, width=640, height=360)[:3]
    F = np.repeat(fundamentals(first, second)[0], 25 if moves else 1, 0)
    if moves:
        F[::2] = fundamentals(first, third)[0, 0]
    A, B = rng.uniform(0, 300, (3, 25, 2)), rng.uniform(0, 300, (2, 25, 2))
    A[0, 4:9], B[1, ::3] = np.nan, np.nan
    i, j = np.divmod(np.arange(6), 2)
    motion, place = paired_epipolar_residuals(A, B, F, i, j, 10, 4)
    for p in range(6):
        known = np.isfinite(A[i[p], :, 0]) & np.isfinite(B[j[p], :, 0])
        each = [sampson(F[t % len(F)], A[i[p], [t]], B[j[p], [t]])[0] for t in range(25)]
        e = np.where(known, each, np.nan)
        parts = [e[s : s + 10] for s in (0, 10, 20)]
        spread = sum(np.nansum((part - np.nanmean(part)) ** 2) for part in parts)
        assert motion[p] == pytest.approx(spread / known.sum())
        assert place[p] == pytest.approx(np.nanmean(e**2))
