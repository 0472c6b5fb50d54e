"""Matchers: laws, oracles, refusals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import ot
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync import (
    Cosine,
    EntropicFGW,
    FusedGromovWasserstein,
    GromovWasserstein,
    Matches,
    NearestNeighbor,
    OptimalTransport,
    PartialFGW,
    Refused,
    Status,
    TrackSet,
    match,
)
from otsync.match.problem import Problem, normalised_structure
from otsync.match.sinkhorn import round_to_marginals, sinkhorn
from otsync.match.vouch import geometry, moves_mirrored
from otsync.types import Clock
from tests.conftest import wiggle

STRUCTURED = [FusedGromovWasserstein(), EntropicFGW(), PartialFGW()]
ALL = [*STRUCTURED, GromovWasserstein(), OptimalTransport(), OptimalTransport(reg=0.02), NearestNeighbor()]


def name(matcher) -> str:
    return f"{type(matcher).__name__}{getattr(matcher, 'reg', '')}"


def as_set(m: Matches) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in m.pairs}


@pytest.mark.parametrize("matcher", STRUCTURED, ids=name)
def test_structure_and_features_together_find_every_track(pair, matcher):
    a, b, where = pair
    found = match(a, b, matcher)
    assert (where[found.pairs[:, 0]] == found.pairs[:, 1]).mean() == 1
    assert len(found) == (round(0.65 * len(a)) if isinstance(matcher, PartialFGW) else len(a))


@pytest.mark.parametrize("matcher", ALL, ids=name)
def test_swapping_the_videos_mirrors_the_matches(pair, matcher):
    a, b, _ = pair
    forward, backward = match(a, b, matcher), match(b, a, matcher)
    assert as_set(forward) == as_set(backward.swapped())
    scores = dict(zip(map(tuple, backward.swapped().pairs.tolist()), backward.score, strict=True))
    # an iterative solver mirrors its scores to its own tolerance, an exact one to rounding
    close = 2e-5 if isinstance(matcher, EntropicFGW) else 1e-9
    np.testing.assert_allclose([scores[tuple(p)] for p in forward.pairs.tolist()], forward.score, atol=close)


@pytest.mark.parametrize("matcher", ALL, ids=name)
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_neither_unit_nor_rigid_motion_changes_a_match(pair, matcher, unit):
    a, b, _ = pair
    rotation = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1.0]])
    moved = replace(a, xyz=(a.xyz @ rotation.T + [3, -1, 2]) * unit)
    assert as_set(match(moved, replace(b, xyz=b.xyz * unit), matcher)) == as_set(match(a, b, matcher))


@pytest.mark.parametrize("matcher", ALL, ids=name)
def test_permuting_tracks_permutes_matches(pair, matcher):
    a, b, _ = pair
    order = np.random.default_rng(0).permutation(len(a))
    permuted = match(a.take(order), b, matcher)
    assert {(int(order[i]), j) for i, j in as_set(permuted)} == as_set(match(a, b, matcher))


@pytest.mark.parametrize("matcher", ALL, ids=name)
def test_videos_may_have_different_numbers_of_tracks_and_frames(pair, matcher):
    a, b, where = pair
    fewer = b.take(np.sort(where[:40]))
    fewer = replace(fewer, xyz=fewer.xyz[:, :30], visible=fewer.visible[:, :30])
    found = match(a, fewer, matcher, throw=False)
    assert 0 < len(found) <= 40
    found.check("found", 60, 40)
    # the structure of a part differs from that of the whole: without features it misleads, and that is said
    right = (np.searchsorted(np.sort(where[:40]), where[found.pairs[:, 0]]) == found.pairs[:, 1]).mean()
    assert found.status.ok or (isinstance(matcher, GromovWasserstein) and right < 0.5)


@pytest.mark.parametrize("matcher", [m for m in ALL if not isinstance(m, NearestNeighbor)], ids=name)
def test_plans_meet_their_marginals(pair, matcher):
    a, b, _ = pair
    found = match(a, b.take(slice(0, 45)), matcher, throw=False)
    mass = getattr(matcher, "mass", 1.0)
    assert abs(found.plan.sum() - mass) < 1e-6 and found.stats["marginal_error"] < 1e-6
    rows, columns = found.plan.sum(1) - 1 / 60, found.plan.sum(0) - 1 / 45
    if mass < 1:
        assert rows.max() < 1e-9 and columns.max() < 1e-9
    else:
        assert np.abs(rows).max() < 1e-6 and np.abs(columns).max() < 1e-6


@given(st.integers(0, 10**6), st.sampled_from([0.0, 0.05, 0.222, 1.0, 20.0]))
@settings(max_examples=20, deadline=None)
def test_objective_and_gradient_equal_a_brute_force_sum(seed, alpha):
    rng = np.random.default_rng(seed)
    n, m = 5, 4
    Ca, Cb, M = rng.random((n, n)), rng.random((m, m)), rng.random((n, m))
    Ca, Cb = Ca + Ca.T, Cb + Cb.T
    p, q = np.full(n, 1 / n), np.full(m, 1 / m)
    plan = ot.emd(p, q, rng.random((n, m))) * 0.7 + 0.3 * np.outer(p, q)
    problem = Problem(M, Ca, Cb, p, q, alpha)

    def paper(g):
        structure = sum(
            (Ca[i, k] - Cb[j, l]) ** 2 * g[i, j] * g[k, l]
            for i in range(n)
            for j in range(m)
            for k in range(n)
            for l in range(m)
        )
        return structure + alpha / 2 * (M * g).sum()

    np.testing.assert_allclose(problem.objective(plan), paper(plan), rtol=1e-12)
    pot = (1 - problem.pot_weight) * (M * plan).sum() + problem.pot_weight * (
        problem.objective(plan) - alpha / 2 * (M * plan).sum()
    )
    np.testing.assert_allclose(problem.objective(plan), (1 + alpha / 2) * pot, rtol=1e-12)
    i, j, h = 2, 1, 1e-6
    step = np.zeros((n, m))
    step[i, j] = h
    slope = (paper(plan + step) - paper(plan - step)) / (2 * h)
    np.testing.assert_allclose(problem.gradient(plan)[i, j], slope, rtol=1e-6)


def test_stats_carry_both_units_and_agree_with_pot(pair):
    a, b, _ = pair
    found = match(a, b, FusedGromovWasserstein())
    problem = Problem.of(a, b, (Cosine(),), 0.222)
    loss = ot.gromov.fused_gromov_wasserstein2(problem.M, problem.Ca, problem.Cb, alpha=problem.pot_weight)
    np.testing.assert_allclose(found.stats["objective_pot"], loss, rtol=1e-9)
    np.testing.assert_allclose(found.stats["objective"], 1.111 * loss, rtol=1e-9)
    assert found.stats["iterations"] >= 1 and found.stats["seconds"] > 0


def test_matches_are_one_to_one_best_first_and_scored_by_the_linearised_cost(pair):
    a, b, _ = pair
    found = match(a, b, FusedGromovWasserstein())
    assert len(set(found.pairs[:, 0])) == len(set(found.pairs[:, 1])) == len(found)
    assert (np.diff(found.score) <= 0).all()
    gradient = Problem.of(a, b, (Cosine(),), 0.222).gradient(found.plan)
    np.testing.assert_allclose(found.score, -gradient[found.pairs[:, 0], found.pairs[:, 1]], rtol=1e-9)


def test_one_far_track_does_not_wipe_out_the_structure(pair):
    """C is divided by the median, not by the maximum."""
    a, b, where = pair
    far = a.xyz.copy()
    far[0] += 1000
    found = match(replace(a, xyz=far), b, PartialFGW(mass=0.9))
    assert (where[found.pairs[:, 0]] == found.pairs[:, 1]).mean() > 0.9
    assert abs(found.stats["mass"] - 0.9) < 1e-9


def test_any_number_of_tracks_may_keep_all_its_mass():
    rng = np.random.default_rng(0)
    for n in (3, 10, 49):
        t = TrackSet(rng.normal(size=(n, 5, 3)), features=rng.normal(size=(n, 8)), fps=30)
        assert abs(PartialFGW(mass=1.0)(t, t).stats["mass"] - 1) < 1e-9


def test_structure_of_one_side_alone_is_no_information():
    rng = np.random.default_rng(0)
    flat = TrackSet(np.ones((5, 4, 3)), features=np.ones((5, 3)), fps=30)
    b = TrackSet(rng.normal(size=(5, 4, 3)), features=np.ones((5, 3)), fps=30)
    assert match(flat, b, FusedGromovWasserstein(), throw=False).status is Status.NO_INFORMATION


def test_a_solver_that_stopped_at_its_limit_says_so(pair):
    a, b, _ = pair
    assert FusedGromovWasserstein()(a, b).stats["converged"] == 1
    assert FusedGromovWasserstein(max_iter=1)(a, b).stats["converged"] == 0


@pytest.mark.parametrize("matcher", STRUCTURED, ids=name)
def test_gaps_are_no_positions(pair, matcher):
    a, b, where = pair
    seen = np.random.default_rng(1).random(a.visible.shape) < 0.7
    holes = replace(a, xyz=np.where(seen[..., None], a.xyz, 1e9), visible=seen)
    found = match(holes, b, matcher)
    assert (where[found.pairs[:, 0]] == found.pairs[:, 1]).mean() > 0.95


def test_costs_add_up_with_weights(pair):
    a, b, _ = pair
    once = match(a, b, OptimalTransport(costs=(Cosine(weight=3.0),)))
    thrice = match(a, b, OptimalTransport(costs=(Cosine(), Cosine(), Cosine())))
    np.testing.assert_allclose(once.stats["objective"], thrice.stats["objective"])


def test_integer_features_and_positions_are_no_different(pair):
    a, b, _ = pair
    as_int = [replace(t, features=np.round(t.features * 1000).astype(int)) for t in (a, b)]
    as_float = [replace(t, features=t.features.astype(float)) for t in as_int]
    assert as_set(match(*as_int)) == as_set(match(*as_float))


@pytest.mark.parametrize("matcher", [m for m in ALL if not isinstance(m, GromovWasserstein)], ids=name)
def test_no_information_is_said_not_guessed(matcher):
    same = TrackSet(np.ones((6, 4, 3)), features=np.ones((6, 3)), fps=30)
    with pytest.raises(Refused, match="no_information") as caught:
        match(same, same, matcher)
    assert caught.value.result.status is Status.NO_INFORMATION and len(caught.value.result) == 0
    assert match(same, same, matcher, throw=False).flags == (Status.NO_INFORMATION,)


@pytest.mark.parametrize("matcher", ALL, ids=name)
def test_bad_contents_are_refused_by_name(pair, matcher):
    a, b, _ = pair
    broken = b.xyz.copy()
    broken[3, 2] = np.nan
    if not isinstance(matcher, OptimalTransport | NearestNeighbor):
        with pytest.raises(ValueError, match=r"a\.xyz: expected 3D positions"):
            match(TrackSet(None, uv=np.zeros((4, 5, 2)), features=np.ones((4, 16)), fps=30), b, matcher)
    with pytest.raises(ValueError, match=r"b\.xyz: expected finite"):
        match(a, replace(b, xyz=broken), matcher)
    with pytest.raises(ValueError, match="a: expected at least one track"):
        match(a.take(slice(0, 0)), b, matcher)
    if isinstance(matcher, GromovWasserstein):
        return
    zero = a.features.copy()
    zero[[5, 9]] = 0
    with pytest.raises(ValueError, match=r"a\.features: expected non-zero descriptors; tracks 5, 9"):
        match(replace(a, features=zero), b, matcher)
    with pytest.raises(ValueError, match=r"b\.features: expected \(N,D\) descriptors; found none"):
        match(a, replace(b, features=None), matcher)


@pytest.mark.parametrize(
    "make",
    [
        lambda: PartialFGW(mass=0),
        lambda: PartialFGW(mass=1.1),
        lambda: EntropicFGW(reg=0),
        lambda: OptimalTransport(reg=-1),
        lambda: FusedGromovWasserstein(alpha=float("nan")),
    ],
)
def test_matchers_refuse_nonsense(make):
    with pytest.raises(ValueError, match=r"(mass|reg|alpha): expected"):
        make()


def test_any_callable_is_a_matcher_and_its_indices_are_checked(pair):
    a, b, _ = pair
    one = match(a, b, lambda a, b: Matches(np.array([[1, 2]])), throw=False)
    assert one.pairs.tolist() == [[1, 2]] and one.flags == (Status.FEW_MATCHES,)
    with pytest.raises(ValueError, match=r"matcher\.pairs: expected indices of b below 60; found 60"):
        match(a, b, lambda a, b: Matches(np.array([[1, 60]])))


@pytest.mark.parametrize("eps", [1e-4, 1e-2, 1.0])
def test_sinkhorn_stays_a_plan_at_any_regularisation(eps):
    rng = np.random.default_rng(0)
    cost, p, q = rng.random((30, 20)), np.full(30, 1 / 30), np.full(20, 1 / 20)
    plan, _, _ = sinkhorn(p, q, cost, eps)
    assert np.isfinite(plan).all() and (plan >= 0).all()
    np.testing.assert_allclose(plan.sum(1), p, atol=1e-12)
    np.testing.assert_allclose(plan.sum(0), q, atol=1e-12)
    if eps == 1e-4:
        np.testing.assert_allclose((cost * plan).sum(), ot.emd2(p, q, cost), rtol=0.05)


def test_rounding_keeps_a_plan_and_moves_little():
    rng = np.random.default_rng(1)
    p, q = rng.dirichlet(np.ones(8)), rng.dirichlet(np.ones(5))
    plan = ot.emd(p, q, rng.random((8, 5)))
    np.testing.assert_allclose(round_to_marginals(plan, p, q), plan, atol=1e-15)
    crooked = plan * rng.uniform(0.9, 1.1, plan.shape)
    rounded = round_to_marginals(crooked, p, q)
    np.testing.assert_allclose(rounded.sum(1), p)
    assert np.abs(rounded - crooked).sum() < 0.3


def test_partial_fgw_leaves_outliers_out():
    rng = np.random.default_rng(2)
    xyz, f = wiggle(rng, 50, 30), rng.normal(size=(50, 16))
    junk = [wiggle(rng, 20, 30, 3.0) for _ in range(2)]
    a, b = (
        TrackSet(
            np.concatenate([xyz, j]),
            features=np.concatenate([f + 0.4 * rng.normal(size=f.shape), rng.normal(size=(20, 16))]),
            fps=30,
        )
        for j in junk
    )
    found = match(a, b, PartialFGW(mass=0.65))
    right = found.pairs[:, 0] == found.pairs[:, 1]
    assert right.mean() > 0.9 and (found.pairs[:, 0] < 50).mean() > 0.95


def test_structures_are_compared_in_one_unit(pair):
    """A scene of twice the size stays twice as large: it is another scene."""
    a, _, _ = pair
    small, large = normalised_structure(a, replace(a, xyz=2 * a.xyz))
    np.testing.assert_allclose(large, 2 * small)


def test_disagreement_of_distances_grows_with_their_square():
    """Four points a metre apart, and four that are 2 % further: 1.98 % of the mean distance, where 5 % count as 1."""
    x = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])[:, None] / np.sqrt(8)
    a, b = TrackSet(x, fps=30), TrackSet(1.02 * x, fps=30)
    every = np.arange(4)
    assert geometry(a, b, every, every) == pytest.approx((0.02 / 1.01 / 0.05) ** 2)
    assert geometry(a, a, every, every) == pytest.approx(0, abs=1e-12)


def test_motion_tells_a_mirror_image_at_a_known_clock(pair):
    a, _, _ = pair
    every, mirrored = np.arange(len(a)), replace(a, xyz=a.xyz * [1, -1, 1])
    assert moves_mirrored(a, mirrored, every, every, Clock())
    assert not moves_mirrored(a, a, every, every, Clock())
    assert not moves_mirrored(a, mirrored, every, every, None)


@dataclass(frozen=True)
class Shifted:
    """Feature distance plus a constant."""

    by: float
    weight: float = 1.0

    def matrix(self, a, b):
        return Cosine().matrix(a, b) + self.by


def test_a_constant_on_all_costs_changes_no_partial_plan(pair):
    """Costs below zero are costs, too: they must not draw more mass than there is."""
    a, b, _ = pair
    plain, below = (PartialFGW(costs=(Shifted(by),))(a, b) for by in (0.0, -3.0))
    assert below.status.ok and below.stats["mass"] == pytest.approx(0.65)
    assert as_set(below) == as_set(plain)
