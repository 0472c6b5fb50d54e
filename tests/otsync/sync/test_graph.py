"""Robust synchronisation over a graph against closed forms, and its laws."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync import Graph
from otsync.sync.graph import (
    CurveSum,
    Edge,
    agreeing,
    components,
    cycle_errors,
    judged_by_cycles,
    solve,
    spanning_trees,
)


def edges_of(x, pairs, sigma=0.01, noise=None):
    noise = np.zeros(len(pairs)) if noise is None else noise
    return [Edge(a, b, float(x[b] - x[a] + e), sigma, True) for (a, b), e in zip(pairs, noise, strict=True)]


def all_pairs(n):
    return list(itertools.combinations(range(n), 2))


@given(st.integers(2, 40), st.integers(0, 6), st.integers(0, 39))
@settings(max_examples=60, deadline=None)
def test_the_chosen_pairs_hang_together(n, extra, centre):
    centre %= n
    pairs = Graph(extra=extra).pairs(n, centre)
    assert pairs == sorted(set(pairs)) and all(a < b for a, b in pairs)
    assert (components(n, pairs) == 0).all()
    assert all(any({centre, v} == {a, b} for a, b in pairs) for v in range(n) if v != centre)


def test_star_complete_and_about_ninety_pairs():
    assert Graph(extra=0).pairs(5, 2) == [(0, 2), (1, 2), (2, 3), (2, 4)]
    assert Graph().pairs(8, 0) == all_pairs(8)
    pairs = Graph().pairs(30, 0)
    degree = np.bincount(np.array(pairs).ravel(), minlength=30)
    assert 80 <= len(pairs) <= 95 and degree.min() >= 5
    with pytest.raises(ValueError, match="extra"):
        Graph(extra=-1)


@given(st.integers(0, 10**6), st.integers(3, 9))
@settings(max_examples=30, deadline=None)
def test_consistent_edges_are_solved_exactly(seed, n):
    x = np.random.default_rng(seed).normal(size=n)
    found = solve(n, edges_of(x, all_pairs(n)), anchor=1)
    np.testing.assert_allclose(found.x, x - x[1], atol=1e-9)
    np.testing.assert_allclose(found.residual, 0, atol=1e-9)


def test_small_errors_are_weighed_as_least_squares_weighs_them():
    """Far within the robust losses' quadratic range: weighted least squares, and its covariance."""
    rng = np.random.default_rng(0)
    x, pairs = rng.normal(size=5), all_pairs(5)
    sigma = rng.uniform(0.5, 2.0, len(pairs))
    noise = 1e-3 * rng.normal(size=len(pairs))
    edges = [Edge(a, b, float(x[b] - x[a] + e), s, True) for (a, b), e, s in zip(pairs, noise, sigma, strict=True)]
    A = np.zeros((len(pairs), 5))
    for k, (a, b) in enumerate(pairs):
        A[k, a], A[k, b] = -1, 1
    A, d = A[:, 1:] / sigma[:, None], np.array([e.offset for e in edges]) / sigma
    found = solve(5, edges, anchor=0)
    np.testing.assert_allclose(found.x[1:], np.linalg.lstsq(A, d, rcond=None)[0], atol=1e-7)
    np.testing.assert_allclose(found.sigma[1:], np.sqrt(np.diag(np.linalg.inv(A.T @ A))), rtol=1e-4)


def test_wrong_edges_do_not_pull():
    rng = np.random.default_rng(1)
    x, pairs = rng.normal(size=8), all_pairs(8)
    noise = 0.01 * rng.normal(size=len(pairs))
    wrong = rng.choice(len(pairs), 8, replace=False)
    noise[wrong] += rng.choice([-1, 1], 8) * rng.uniform(1, 3, 8)
    found = solve(8, edges_of(x, pairs, 0.01, noise), anchor=0)
    np.testing.assert_allclose(found.x, x - x[0], atol=0.02)
    edges = edges_of(x, pairs, 0.01, noise)
    np.testing.assert_array_equal(np.flatnonzero(~agreeing(edges, found.residual, 0.05)), np.sort(wrong))


def test_the_anchor_only_moves_the_origin():
    rng = np.random.default_rng(2)
    x, pairs = rng.normal(size=6), all_pairs(6)
    edges = edges_of(x, pairs, 0.01, 0.01 * rng.normal(size=len(pairs)))
    one, two = solve(6, edges, 0), solve(6, edges, 4)
    np.testing.assert_allclose(one.x - one.x[4], two.x, atol=1e-6)


def test_what_no_edge_reaches_has_no_offset():
    found = solve(5, edges_of(np.arange(5.0), [(0, 1), (3, 4)]), anchor=0)
    np.testing.assert_array_equal(np.isnan(found.x), [False, False, True, True, True])
    np.testing.assert_array_equal(components(5, [(0, 1), (3, 4)]), [0, 0, 2, 3, 3])


def curve(peaks, width=0.05, reach=3.0):
    t = np.arange(-reach, reach + 1e-9, 1 / 30)
    return np.stack([t, sum(h * np.exp(-0.5 * ((t - p) / width) ** 2) for p, h in peaks)], 1)


def test_summed_curves_find_what_single_peaks_miss():
    """In half of the pairs a false peak is the highest; only the true ones close cycles."""
    rng = np.random.default_rng(3)
    x = np.round(rng.uniform(-0.8, 0.8, 6) * 30) / 30
    x -= x[0]
    edges = []
    for n, (a, b) in enumerate(all_pairs(6)):
        true = x[b] - x[a]
        peaks = [(true, 10.0), (true + rng.choice([-1, 1]) * rng.uniform(0.5, 1.0), 12.0 if n % 2 else 6.0)]
        top = max(peaks, key=lambda p: p[1])[0]
        edges.append(Edge(a, b, top, 0.02, False, curve(peaks)))
    total = CurveSum(6, edges, 1 / 30)
    starts = spanning_trees(6, edges, [1.0] * len(edges), 0, 5, seed=0)
    found = total.search(starts, 0)
    np.testing.assert_allclose(found, x, atol=1.01 / 30)
    assert total.total(found) >= max(map(total.total, starts))
    here, rival = total.standing(3, found)
    assert here > 1.2 * rival


def test_ascent_never_goes_down():
    rng = np.random.default_rng(4)
    edges = [
        Edge(a, b, 0.0, 1.0, False, curve([(rng.uniform(-1, 1), 5), (rng.uniform(-1, 1), 4)])) for a, b in all_pairs(5)
    ]
    total = CurveSum(5, edges, 1 / 30)
    for _ in range(10):
        x = np.r_[0.0, rng.uniform(-1, 1, 4)]
        assert total.total(total.ascend(x, 0)) >= total.total(x) - 1e-9


def test_trees_use_the_heaviest_edges_first():
    edges = [Edge(0, 1, 1.0, 1, True), Edge(1, 2, 1.0, 1, True), Edge(0, 2, 5.0, 1, True)]
    np.testing.assert_array_equal(spanning_trees(3, edges, [3, 2, 1], 0, 1, 0)[0], [0, 1, 2])
    np.testing.assert_array_equal(spanning_trees(3, edges, [1, 2, 3], 0, 1, 0)[0], [0, 4, 5])


def test_cycles_close_or_do_not():
    x = np.array([0.0, 0.3, -0.2])
    assert cycle_errors(edges_of(x, all_pairs(3))) == pytest.approx([0.0])
    assert cycle_errors(edges_of(x, all_pairs(3), noise=[0.1, 0, 0])) == pytest.approx([0.1])
    assert len(cycle_errors(edges_of(np.zeros(4), all_pairs(4)))) == 4


@pytest.mark.parametrize("shared", [0.0, 0.5, 1.0])
def test_sigma_is_that_of_errors_which_pairs_of_a_video_share(shared):
    """Drawn from the model: half of the shared variance from either video, the rest from the pair."""
    rng, n, sigma = np.random.default_rng(3), 6, 0.01
    pairs, z = all_pairs(n), []
    for _ in range(300):
        own = rng.normal(size=n) * sigma * np.sqrt(shared / 2)
        each = rng.normal(size=len(pairs)) * sigma * np.sqrt(1 - shared)
        noise = [own[b] - own[a] + e for (a, b), e in zip(pairs, each, strict=True)]
        solved = solve(n, edges_of(np.zeros(n), pairs, sigma, noise), 0, shared=shared)
        z += (solved.x[1:] / solved.sigma[1:]).tolist()
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_sigma_is_that_of_errors_which_edges_tell_of(share):
    """The same, where every edge knows how much of its sigma is its videos' own."""
    rng, n, sigma = np.random.default_rng(4), 6, 0.01
    pairs, z = all_pairs(n), []
    for _ in range(300):
        own = rng.normal(size=n) * sigma * np.sqrt(share / 2)
        each = rng.normal(size=len(pairs)) * sigma * np.sqrt(1 - share)
        noise = [own[b] - own[a] + e for (a, b), e in zip(pairs, each, strict=True)]
        edges = [replace(e, common=sigma * np.sqrt(share)) for e in edges_of(np.zeros(n), pairs, sigma, noise)]
        solved = solve(n, edges, 0)
        z += (solved.x[1:] / solved.sigma[1:]).tolist()
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.12)


def test_shared_errors_change_sigma_and_nothing_else_and_nothing_of_a_single_pair():
    rng = np.random.default_rng(3)
    edges = edges_of(rng.normal(size=5), all_pairs(5), 0.01, 0.01 * rng.normal(size=10))
    plain, wide = solve(5, edges, 0), solve(5, edges, 0, shared=0.5)
    np.testing.assert_array_equal(wide.x, plain.x)
    assert (wide.sigma[1:] > plain.sigma[1:]).all() and wide.sigma[0] == 0
    one = edges_of(np.array([0.0, 0.3]), [(0, 1)], 0.02)
    assert solve(2, one, 0, shared=0.5).sigma[1] == pytest.approx(0.02)
    hanging = [*edges_of(np.zeros(4), all_pairs(3), 0.01), Edge(0, 3, 0.0, 0.2, True)]
    assert solve(4, hanging, 0, shared=0.5).sigma[3] == pytest.approx(0.2)  # no less than its only edge says


def test_what_a_bad_pair_has_in_common_reaches_no_video_that_its_other_pairs_tell():
    """It counts by the pair's weight in the answer: four films of 3 s, one pair of which knew nothing, had sigmas of a
    frame with errors of .07."""
    edges = edges_of(np.zeros(4), all_pairs(4), 0.2)
    common = [replace(e, common=0.15) for e in edges]
    sound = solve(4, common, 0).sigma[1:]
    with_bad = solve(4, [replace(common[0], sigma=4.0, common=4.0), *common[1:]], 0).sigma[1:]
    assert (sound > solve(4, edges, 0).sigma[1:]).all()
    assert (with_bad >= sound).all() and (with_bad < 1.5 * sound).all()


def test_what_a_doubt_makes_of_a_sigma_is_no_error_of_a_video():
    """Of a reference with one good pair of three, the answers were said to be off by a frame and more."""
    edges = edges_of(np.zeros(4), all_pairs(4), 0.2)
    doubtful = [replace(e, sigma=0.6, doubt=3.0, trusted=False) if e.a == 0 and e.b > 1 else e for e in edges]
    sound, beside = (solve(4, e, 0, shared=0.35).sigma[1:] for e in (edges, doubtful))
    assert (beside >= sound).all() and (beside < 1.7 * sound).all()


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_tentative_sigmas_are_judged_by_how_cycles_close(scale):
    """Half of each edge's variance is its videos' own, the cycles show the other half: sigma becomes what is true, but
    for what was taken before they were seen; as far as edges say that theirs is a guess.
    """
    rng, n = np.random.default_rng(3), 12
    pairs = list(itertools.combinations(range(n), 2))
    ratios = []
    for _ in range(40):
        own, edge = rng.normal(0, 0.5, n), rng.normal(0, 0.5**0.5, len(pairs))
        edges = [
            Edge(a, b, 0.01 * scale * (own[b] - own[a] + e), 0.01, True) for (a, b), e in zip(pairs, edge, strict=True)
        ]
        said = solve(n, edges, 0, shared=0.5)
        judged = solve(n, [replace(e, tentative=1.0) for e in edges], 0, shared=0.5)
        np.testing.assert_array_equal(judged.x, said.x)
        ratios.append(judged.sigma[1:] / said.sigma[1:])
        half = solve(n, [replace(e, tentative=k % 2) for k, e in enumerate(edges)], 0, shared=0.5)
        np.testing.assert_allclose(2 * half.sigma**2, said.sigma**2 + judged.sigma**2, rtol=1e-9)
    assert np.mean(ratios) == pytest.approx(np.sqrt((4 + 55 * scale**2) / 59), rel=0.06)


def test_without_cycles_a_tentative_sigma_stands_and_one_wrong_edge_is_not_all():
    edge = Edge(0, 1, 0.3, 0.01, True, tentative=1.0)
    assert solve(2, [edge], 0).sigma[1] == pytest.approx(0.01)
    edges = [replace(edge, offset=0.0), replace(edge, b=2), replace(edge, a=1, b=2, offset=9.0)]
    assert judged_by_cycles(np.array([0.0, 0.0, 900.0]), 2) == pytest.approx(((4 + 2 * 2.5) / 5) ** 0.5)
    assert np.isfinite(solve(3, edges, 0).sigma).all()


def test_lags_without_overlap_say_nothing():
    """They score what an offset beyond the curve scores: 0, the level of its median."""
    seen = curve([(0.5, 10.0)])
    blind = seen.copy()
    blind[seen[:, 0] < -1, 1] = -np.inf
    total = CurveSum(2, [Edge(0, 1, 0.5, 0.01, True, blind + np.array([0.0, 3.0]))], 1 / 30)
    at = [total.total(np.array([0.0, x])) for x in (-2.0, 50.0, 0.5)]
    assert at == pytest.approx([0.0, 0.0, 10.0])


def test_a_video_is_searched_for_wherever_its_curves_reach():
    """Whether it comes first or second in a pair: candidates span all of every curve, about the other's place."""
    lopsided = curve([(0.5, 10.0)])
    lopsided = lopsided[lopsided[:, 0] >= -0.4]
    total, x = CurveSum(2, [Edge(0, 1, 0.5, 0.01, True, lopsided)], 1 / 30), np.array([1.0, 1.2])
    for v, low, high in ((1, 1.0 - 0.4, 1.0 + 3.0), (0, 1.2 - 3.0, 1.2 + 0.4)):
        candidates, score = total.of_video(v, x)
        assert candidates.min() == pytest.approx(low, abs=1.01 / 30)
        assert candidates.max() == pytest.approx(high, abs=1.01 / 30)
        assert abs(candidates[score.argmax()] - (1.5 if v == 1 else 0.7)) < 1 / 30
