"""Matching at known times: near neighbours of each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otsync import TrackSet
from otsync.match.synchronous import SynchronousMatching, mutual
from otsync.simulate import simulate


def costs(seed: int, rows: int, columns: int, unseen: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    cost = rng.uniform(size=(rows, columns))
    return np.where(rng.uniform(size=cost.shape) < unseen, np.inf, cost)


@given(
    seed=st.integers(0, 999),
    rows=st.integers(0, 12),
    columns=st.integers(0, 12),
    unseen=st.sampled_from([0.0, 0.4, 1.0]),
    neighbours=st.integers(1, 4),
)
def test_each_is_among_the_nearest_of_the_other(seed, rows, columns, unseen, neighbours):
    cost = costs(seed, rows, columns, unseen)
    nearer_b = (cost[:, None, :] < cost[:, :, None]).sum(2)  # of how many columns a row is nearer
    nearer_a = (cost[None, :, :] < cost[:, None, :]).sum(1)
    wanted = (nearer_b < neighbours) & (nearer_a < neighbours) & np.isfinite(cost)
    i, j = mutual(cost, neighbours)
    assert set(zip(i.tolist(), j.tolist(), strict=True)) == set(map(tuple, np.argwhere(wanted).tolist()))
    assert max(np.bincount(i, minlength=1).max(), np.bincount(j, minlength=1).max()) <= neighbours
    back = mutual(cost.T, neighbours)
    assert sorted(zip(*back[::-1], strict=True)) == sorted(zip(i, j, strict=True))


def test_ties_leave_each_track_its_share():
    i, j = mutual(np.zeros((5, 5)), 2)
    assert np.bincount(i).max() <= 2 and np.bincount(j).max() <= 2 and len(i)


def test_second_neighbours_are_near_as_well():
    """They stand on the same limb, and lose little of what the nearest ones have."""
    tracks, truth = simulate("football", preset="mid", videos=2, seed=8)
    nearest, two = (SynchronousMatching(truth.offset(0, 1), neighbours=n)(*tracks) for n in (1, 2))
    assert set(map(tuple, nearest.pairs)) <= set(map(tuple, two.pairs)) and len(two) > 1.8 * len(nearest)

    def apart(found):
        return float(np.median(truth.match_errors(found, 0, 1)[0])) / truth.size

    assert apart(two) < apart(nearest) + 0.03


@pytest.mark.parametrize("told", [0.0, 1.0], ids=["features alike", "features of noise"])
def test_things_that_move_by_themselves_have_one_track_each(told):
    """Their second neighbours are other things."""
    rng = np.random.default_rng(3)
    steps = rng.normal(size=(40, 90, 3)).cumsum(1) / 9
    sets = [TrackSet(steps + rng.normal(size=steps.shape) * 0.01, fps=30, frame="w") for _ in range(2)]
    found = SynchronousMatching(0.0, neighbours=2)(*sets)
    assert len(found) >= 38 and (found.pairs[:, 0] == found.pairs[:, 1]).all()


@pytest.mark.parametrize("wrong", [0, -1, 1.5])
def test_neighbours_are_counted(wrong):
    with pytest.raises(ValueError, match="neighbours"):
        SynchronousMatching(0.0, neighbours=wrong)
