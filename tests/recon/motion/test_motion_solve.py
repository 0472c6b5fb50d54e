"""The parts of building a scaffold: tracks on a grid, the pick, the solver of curves, rotations; laws and oracles."""

from __future__ import annotations

import numpy as np
import pytest

from otsync.types import TrackSet
from recon.motion import HermiteSpline
from recon.motion.nodes import TOP, Grid, neighbours, pick
from recon.motion.solve import (
    FRAME,
    RIDGE,
    Coupling,
    Observations,
    Smoothness,
    angular_velocities,
    neighbourhood_rotations,
    solve_curves,
)


def test_tracks_on_the_grid():
    """Interpolated between samples that were seen, never over a long gap."""
    t = np.arange(10) / 10
    xyz = np.stack([t, t**2, 0 * t], 1)[None].repeat(2, 0)
    xyz[0, 4] = np.nan
    xyz[1, :6] = np.nan
    grid = Grid.of([TrackSet(xyz, np.isfinite(xyz[..., 0]), fps=10)], np.array([0.05]), 0.05)
    assert grid.times[0] == pytest.approx(0.05) and len(grid.times) == 19
    place = grid.xyz + grid.centre
    assert np.allclose(place[0, grid.seen[0], 0], (grid.times - 0.05)[grid.seen[0]], atol=1e-6)
    assert grid.seen[0].tolist() == [not 6 < k < 10 for k in range(19)]
    assert grid.seen[1].tolist() == [k >= 12 for k in range(19)]


def d_track(xyz, seen, i, j):
    """The definition: the third largest distance over the frames that both are seen; the largest of fewer."""
    both = seen[i] & seen[j]
    if not both.any():
        return np.inf
    d = np.sort(np.linalg.norm(xyz[i, both] - xyz[j, both], axis=1))
    return d[-TOP] if len(d) >= TOP else d[-1]


@pytest.fixture(scope="module")
def few():
    """Forty tracks, each seen by halves."""
    rng = np.random.default_rng(3)
    xyz = (rng.normal(size=(40, 1, 3)) + 0.3 * rng.normal(size=(40, 20, 3)).cumsum(1)).astype(np.float32)
    seen = rng.random((40, 20)) < 0.4
    seen[0], seen[1, :10], seen[2] = False, False, True
    seen[3, 2:] = False
    return np.where(seen[..., None], xyz, 0), seen


def test_track_distances_are_their_definition(few):
    xyz, seen = few
    index, distance = neighbours(xyz, seen, 6)
    D = np.array([[np.inf if i == j else d_track(xyz, seen, i, j) for j in range(40)] for i in range(40)])
    assert np.allclose(distance, np.sort(D, axis=1)[:, :6], rtol=1e-5)
    finite = np.isfinite(distance)
    assert np.allclose(np.take_along_axis(D, index, 1)[finite], distance[finite], rtol=1e-5)
    assert (index[~finite] == np.nonzero(~finite)[0]).all()  # no neighbour: the node itself
    alone = neighbours(xyz[:1], seen[:1], 4)
    assert alone[0].tolist() == [[0] * 4] and np.isinf(alone[1]).all()


@pytest.mark.parametrize("unit", [0.5, 1.5, 4.0])
def test_the_pick_covers_and_keeps_apart(few, unit):
    xyz, seen = few
    order = np.random.default_rng(0).permutation(40)
    picked = pick(xyz, seen, order, unit, 40)
    assert picked[0] == order[0]
    D = np.array([[d_track(xyz, seen, i, j) for j in picked] for i in range(40)])
    mine = D[picked]
    assert mine[~np.eye(len(picked), dtype=bool)].min(initial=np.inf) > unit
    left_out = np.setdiff1d(np.arange(40), picked)
    assert len(left_out) == 0 or (D[left_out].min(1) <= unit).all()
    assert pick(xyz, seen, order, unit, 5).tolist() == picked[:5].tolist()


def test_the_solver_is_least_squares():
    """Without reweighting, against numpy's least squares on the stacked residuals; two clocks, gaps, an outlier."""
    rng = np.random.default_rng(0)
    path = HermiteSpline(-0.1, 0.15, 6)
    grid = np.arange(0, 0.55, FRAME)
    times = grid, grid[3:] + 0.011
    xyz = [rng.normal(size=(3, len(t), 3)) for t in times]
    xyz[0][0, 4:] = np.nan
    xyz[1][2, ::2] = np.nan
    observed = [
        Observations(times[0], xyz[0], np.array([0, 2, 4])),
        Observations(times[1], xyz[1], np.array([1, 3, 5])),
    ]
    edges, ties = np.array([[0, 1], [1, 0], [2, 3], [4, 5], [0, 5]]), np.array([1.0, 1.0, 0.4, 0.2, 0.7])
    smooth = Smoothness(0.3, 0.02, 1e-3)
    coupling = Coupling(edges, ties, grid, np.ones((6, len(grid)), bool), 1.0)
    found = solve_curves(path, observed, coupling, smooth, robust=1e6, rounds=1)

    rows, right = [], []

    def row(weight, node, basis, value):
        r = np.zeros((6, path.count))
        for n, b in zip(np.atleast_1d(node), np.atleast_2d(basis), strict=True):
            r[n] += b
        rows.append(np.sqrt(weight) * r.ravel())
        right.append(np.sqrt(weight) * np.asarray(value))

    def design(t):
        return path.design(t).toarray()

    for o in observed:
        for n, samples in zip(o.node, o.xyz, strict=True):
            mean = np.nanmean(samples, 0)
            for t, x in zip(o.times, samples, strict=True):
                if np.isfinite(x[0]):
                    row(1, n, design(np.array([t]))[0], x)
            for k in range(path.count):
                row(RIDGE, n, np.eye(path.count)[k], mean)
    for t in grid:
        v = (design(np.array([t + FRAME / 2])) - design(np.array([t - FRAME / 2])))[0]
        for (i, j), tie in zip(edges, ties, strict=True):
            row(smooth.velocity * tie, [i, j], [v, -v], np.zeros(3))
    for n in range(6):
        for d in np.diff(np.eye(path.count), 2, axis=0):
            row(smooth.acceleration, n, d, np.zeros(3))
        for d in np.diff(np.eye(path.count), axis=0):
            row(smooth.still, n, d, np.zeros(3))
    oracle = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0].reshape(6, path.count, 3)
    assert np.abs(found.transpose(1, 0, 2) - oracle).max() < 1e-5


def test_the_solver_shrugs_off_a_lost_track():
    """A sample far off counts next to nothing, and the curve runs through the others."""
    path, grid = HermiteSpline(0.0, 0.2, 5), np.arange(0, 0.8, FRAME)
    truth = np.stack([np.sin(3 * grid), grid, 0 * grid], 1)
    lost = truth.copy()
    lost[10:13] += 5.0
    coupling = Coupling(np.zeros((0, 2), int), np.zeros(0), grid, np.ones((1, len(grid)), bool), 1.0)
    observed = [Observations(grid, lost[None], np.zeros(1, int))]
    errors = []
    for rounds in (1, 8):
        knots = solve_curves(path, observed, coupling, Smoothness(), robust=0.03, rounds=rounds)
        errors.append(np.abs(path.design(grid).toarray() @ knots[:, 0] - truth).max())
    assert errors[1] < 0.03 < 0.5 < errors[0]


def test_hidden_nodes_turn_with_their_body():
    """A body turns at a constant rate; some of its nodes are seen in the first half only, and still go round."""
    path, grid = HermiteSpline(-0.1, 0.1, 18), np.arange(0, 1.4, FRAME)
    cloud = np.random.default_rng(0).normal(size=(8, 3))
    angle = 1.5 * grid
    turn = np.stack([np.stack([np.cos(angle), -np.sin(angle)], 1), np.stack([np.sin(angle), np.cos(angle)], 1)], 1)
    truth = np.tile(cloud[:, None], (1, len(grid), 1))
    truth[..., :2] = np.einsum("tij,mj->mti", turn, cloud[:, :2])
    seen = np.ones((8, len(grid)), bool)
    seen[:3, len(grid) // 2 :] = False
    i, j = np.nonzero(~np.eye(8, dtype=bool))
    coupling = Coupling(np.stack([i, j], 1), np.ones(len(i)), grid, seen, 1.0)
    observed = [Observations(grid, np.where(seen[..., None], truth, np.nan), np.arange(8))]
    errors = []
    for rounds in (1, 6):
        knots = solve_curves(path, observed, coupling, Smoothness(), robust=0.1, rounds=rounds)
        followed = np.einsum("tp,pmk->mtk", path.design(grid).toarray(), knots)
        errors.append(np.linalg.norm(followed - truth, axis=2)[:3, -1].max())
    assert errors[1] < 0.3 * errors[0]


def test_angular_velocities_are_those_of_the_seen():
    """Two bodies that turn about different axes; half of each is not seen, and claims to go elsewhere."""
    rng = np.random.default_rng(0)
    places = rng.normal(size=(30, 4, 3)) + 50.0
    body = np.arange(30) % 2
    omega = np.array([[0.0, 0.0, 0.2], [0.1, -0.3, 0.0]])[body]
    rates = np.cross(omega[:, None], places) + np.array([[1.0, 2.0, 3.0], [0.0, 0.0, -1.0]])[body][:, None]
    seen = rng.random((30, 4)) < 0.7
    rates[~seen] = rng.normal(size=(int((~seen).sum()), 3)) * 10
    i, j = np.nonzero((body[:, None] == body) & (np.arange(30)[:, None] < np.arange(30)))
    coupling = Coupling(np.stack([i, j], 1), np.ones(len(i)), np.arange(4) * FRAME, seen, 1e-4)
    assert np.abs(angular_velocities(coupling, places, rates) - omega[:, None]).max() < 1e-6
    lonely = Coupling(np.zeros((0, 2), int), np.zeros(0), np.arange(4) * FRAME, seen, 1.0)
    assert np.abs(angular_velocities(lonely, places, rates)).max() < 1e-6  # one point does not tell how it turns


def test_rotations_follow_a_neighbourhood_round_and_round():
    """A rigid cloud turns three times: the nodes' rotations are the cloud's, even where neighbours are on a line."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(1)
    turns = Rotation.from_rotvec(np.radians(36) * np.arange(30)[:, None] * np.array([0.0, 0.6, 0.8]))
    cloud = rng.normal(size=(20, 3))
    positions = np.stack([r.apply(cloud) for r in turns]) + np.arange(30)[:, None, None]
    index = np.stack([np.delete(np.arange(20), m)[rng.permutation(19)[:8]] for m in range(20)])
    found = neighbourhood_rotations(positions, index, np.ones((20, 8)), 1.0)
    relative = np.stack([(turns[p] * turns[15].inv()).as_matrix() for p in range(30)])
    # the pull towards the rotation before is weak beside eight neighbours, not nil
    assert np.abs(found - relative[:, None]).max() < 1e-2
    # two neighbours on a line: the turn about it is free; none flips or reflects
    line = np.stack([r.apply(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])) for r in turns])
    free = neighbourhood_rotations(line, np.array([[1, 2], [0, 2], [0, 1]]), np.ones((3, 2)), 1.0)
    assert np.allclose(np.linalg.det(free), 1)
    along = np.einsum("pmij,mj->pmi", free, line[15, 1:2].repeat(3, 0))
    assert np.abs(along - line[:, 1:2]).max() < 2e-3
    step = np.einsum("pmij,pmkj->pmik", free[1:], free[:-1])
    assert np.degrees(np.arccos((np.trace(step, axis1=2, axis2=3) - 1) / 2)).max() < 37
    alone = neighbourhood_rotations(line[:, :1], np.zeros((1, 2), int), np.zeros((1, 2)), 1.0)
    assert np.allclose(alone, np.eye(3))
