"""Transport with relaxed marginals, and weights of matches: laws and oracles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from otsync import Cosine, Matches, Status, TrackSet, match
from otsync.align import LikelihoodScan, align
from otsync.epipolar.scan import mixture
from otsync.files.cache import Cache
from otsync.match import Candidates, SemirelaxedFGW, UnbalancedFGW, UnbalancedOT
from otsync.match.problem import Problem
from otsync.match.unbalanced import partners_of, relaxed_plan, unrelated
from otsync.recordings.kept_pairs import KeptPairs, pack, unpack
from otsync.refine import SplineRefine, refine
from otsync.sync.pairs import Job, run
from otsync.types import Alignment

MATCHERS = [UnbalancedOT(), UnbalancedFGW(), SemirelaxedFGW()]
ALL = pytest.mark.parametrize("matcher", MATCHERS, ids=lambda m: type(m).__name__)


def kl(x: np.ndarray, y: np.ndarray) -> float:
    """Σ x log(x/y) - x + y, with 0 log 0 = 0."""
    return float(np.sum(np.where(x > 0, x * np.log(np.maximum(x, 1e-300) / y), 0.0) - x + y))


def problem(seed: int, n: int = 5, m: int = 4):
    rng = np.random.default_rng(seed)
    return np.full(n, 1 / n), np.full(m, 1 / m), rng.uniform(0, 1.5, (n, m))


def objective(plan: np.ndarray, p: np.ndarray, q: np.ndarray, M: np.ndarray, reg: float, marginal: float) -> float:
    relaxed = marginal * (kl(plan.sum(1), p) + kl(plan.sum(0), q))
    return float((M * plan).sum()) + reg * kl(plan, np.outer(p, q)) + relaxed


def videos(n: int = 40, frames: int = 60, seed: int = 0, noise: float = 0.3, n_b: int | None = None):
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / 30
    xyz = rng.normal(size=(n, 1, 3)) + 0.2 * np.sin(
        2 * np.pi * rng.uniform(0.3, 1.5, (n, 1, 3)) * t[None, :, None] + rng.uniform(0, 6, (n, 1, 3))
    )
    features = rng.normal(size=(n, 16))

    def seen(k: int) -> TrackSet:
        looks = features[:k] + noise * rng.normal(size=(k, 16))
        return TrackSet(xyz[:k] + 0.003 * rng.normal(size=(k, frames, 3)), features=looks, fps=30)

    return seen(n), seen(n if n_b is None else n_b)


def as_set(m: Matches) -> set[tuple[int, int]]:
    return set(map(tuple, m.pairs.tolist()))


# --- the plan ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("reg, marginal", [(0.05, 0.03), (0.2, 0.5), (0.02, 1.0)])
def test_the_plan_minimises_the_objective_that_is_documented(seed, reg, marginal):
    """Against scipy's minimiser over log-plans, which knows no Sinkhorn."""
    p, q, M = problem(seed)
    plan, _, failed = relaxed_plan(p, q, M, reg, marginal)
    assert not failed

    def f(x: np.ndarray) -> float:
        return objective(np.exp(x).reshape(M.shape), p, q, M, reg, marginal)

    def slope(x: np.ndarray) -> np.ndarray:
        g = np.exp(x).reshape(M.shape)
        per_entry = M + reg * np.log(g / np.outer(p, q))
        per_entry = per_entry + marginal * (np.log(g.sum(1) / p)[:, None] + np.log(g.sum(0) / q)[None])
        return (per_entry * g).ravel()

    best = minimize(
        f,
        np.log(np.outer(p, q)).ravel(),
        jac=slope,
        method="L-BFGS-B",
        options={"maxiter": 5000, "ftol": 1e-15, "gtol": 1e-10},
    )
    ours = objective(plan, p, q, M, reg, marginal)
    assert ours <= best.fun + 1e-6
    np.testing.assert_allclose(plan, np.exp(best.x).reshape(M.shape), atol=2e-4)


def test_hard_marginals_are_the_limit_of_a_large_rho():
    import ot

    p, q, M = problem(7)
    plan, _, _ = relaxed_plan(p, q, M, 0.1, 200.0)
    np.testing.assert_allclose(plan, ot.sinkhorn(p, q, M, 0.1, numItermax=10_000, stopThr=1e-12), atol=1e-3)
    np.testing.assert_allclose(plan.sum(1), p, atol=2e-3)
    loose, _, _ = relaxed_plan(p, q, M, 0.1, 0.5)
    assert np.abs(loose.sum(1) - p).max() > 0.01


def test_less_mass_moves_where_it_costs_less_to_give_it_up():
    p, q, M = problem(3)
    masses = [relaxed_plan(p, q, M, 0.05, rho)[0].sum() for rho in (0.01, 0.03, 0.1, 1.0)]
    assert masses == sorted(masses) and masses[0] < 0.7 * masses[-1]


def test_a_constant_on_all_costs_changes_the_mass_and_not_the_shares():
    p, q, M = problem(4)
    plan, more = (relaxed_plan(p, q, M + c, 0.05, 0.03)[0] for c in (0.0, 0.3))
    assert more.sum() < plan.sum()
    np.testing.assert_allclose(more / more.sum(), plan / plan.sum(), rtol=1e-4)


@given(st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_the_unit_of_costs_is_the_median_so_that_none_enters(seed):
    _, _, M = problem(seed, 6, 7)
    assert unrelated(1e6 * M) == pytest.approx(1e6 * unrelated(M))
    assert unrelated(np.where(np.arange(42).reshape(6, 7) < 30, 0.0, 2.0)) == 2.0


# --- the matchers ------------------------------------------------------------------------------------------------


@ALL
def test_tracks_find_themselves(matcher):
    a, b = videos()
    found = match(a, b, matcher)
    best = found.best(20)
    assert (best.pairs[:, 0] == best.pairs[:, 1]).all() and found.status is Status.OK


@ALL
def test_exchanging_the_videos_exchanges_the_pairs(matcher):
    a, b = videos(n_b=30)
    there, back = match(a, b, matcher, throw=False), match(b, a, matcher, throw=False)
    assert as_set(there) == as_set(back.swapped())
    score = dict(zip(map(tuple, back.swapped().pairs.tolist()), back.score, strict=True))
    np.testing.assert_allclose([score[tuple(p)] for p in there.pairs.tolist()], there.score, rtol=1e-4, atol=1e-4)


@ALL
def test_the_order_of_tracks_does_not_matter(matcher):
    a, b = videos(seed=1)
    rng = np.random.default_rng(0)
    i, j = rng.permutation(len(a)), rng.permutation(len(b))
    plain, shuffled = match(a, b, matcher), match(a.take(i), b.take(j), matcher)
    assert as_set(plain) == {(int(i[x]), int(j[y])) for x, y in shuffled.pairs}


@ALL
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_no_unit_of_length_enters(matcher, unit):
    a, b = videos(seed=2)
    other = [replace(x, xyz=x.xyz * unit) for x in (a, b)]
    assert match(a, b, matcher).pairs.tolist() == match(*other, matcher).pairs.tolist()


def test_no_scale_of_costs_enters():
    a, b = videos(seed=3, noise=0.6)
    one, many = (match(a, b, UnbalancedOT(costs=(Cosine(weight=w),)), throw=False) for w in (1.0, 1e4))
    assert one.pairs.tolist() == many.pairs.tolist()
    np.testing.assert_allclose(one.score, many.score, rtol=1e-6)


def test_strangers_find_no_mass():
    """Half of either set is in no other: they rank behind all that have a partner."""
    a, b = videos(60, seed=5)
    rng = np.random.default_rng(1)
    strange = rng.normal(size=(60, 16))
    b = replace(b, features=np.where((np.arange(60) < 30)[:, None], b.features, strange))
    found = match(a, b, UnbalancedOT(partners=1), throw=False)
    assert found.stats["mass"] < 0.75
    best = found.best(30)
    assert (best.pairs[:, 0] == best.pairs[:, 1]).mean() > 0.95 and (best.pairs[:, 0] < 30).all()


def test_partners_are_the_largest_entries_of_rows_and_columns():
    rng = np.random.default_rng(6)
    plan = rng.uniform(0.1, 1, (6, 5)) / 30
    found = partners_of(plan, np.log(plan), 1, None, {}, False, weighted=True)
    expected = {(i, int(plan[i].argmax())) for i in range(6)} | {(int(plan[:, j].argmax()), j) for j in range(5)}
    assert as_set(found) == expected
    assert (np.diff(found.score) <= 0).all()
    np.testing.assert_allclose(found.weight, plan[tuple(found.pairs.T)] / plan.max())
    assert len(partners_of(plan, np.log(plan), 1, 3, {}, False)) == 3
    assert partners_of(plan, np.log(plan), 1, None, {}, False).weight is None


def test_a_plan_that_is_no_plan_is_a_failure():
    broken = partners_of(np.full((3, 3), np.nan), np.zeros((3, 3)), 1, None, {}, False)
    assert broken.flags == (Status.FAILED,) and len(broken) == 0
    # an outlier whose squared distances overflow POT's kernel
    a, b = videos(20)
    far = replace(b, xyz=np.where((np.arange(20) == 0)[:, None, None], b.xyz + 100.0, b.xyz))
    assert not match(a, far, UnbalancedFGW(), throw=False).status.ok


@pytest.mark.parametrize(
    "make",
    [
        lambda: UnbalancedOT(reg=0),
        lambda: UnbalancedOT(marginal=-1),
        lambda: UnbalancedOT(partners=0),
        lambda: UnbalancedFGW(top=0),
        lambda: SemirelaxedFGW(alpha=-1),
        lambda: SemirelaxedFGW(tol=0),
    ],
)
def test_options_are_checked(make):
    with pytest.raises(ValueError, match=r"(Unbalanced|Semirelaxed)\w+\.\w+: expected"):
        make()


def test_small_costs_do_not_underflow():
    """ε a thousandth of the cost: exp(-M/ε) alone would be zero everywhere."""
    p, q, M = problem(8)
    plan, _, failed = relaxed_plan(p, q, M + 3.0, 2e-3, 1.0)
    assert not failed and plan.sum() > 0 and np.isfinite(plan).all()


def test_the_fused_plan_is_stationary_for_the_paper_s_objective():
    """F of Eq. 1 with relaxed marginals, and ε: at a minimum its slope is the same wherever mass could go."""
    a, b = videos(10, 20, seed=4, noise=0.5)
    alpha, reg, marginal = 2.0, 0.05, 0.1
    found = match(a, b, UnbalancedFGW(marginal, reg, alpha, max_iter=300), throw=False)
    problem, plan = Problem.of(a, b, (Cosine(),), alpha), found.plan
    mass, rows, columns = plan.sum(), plan.sum(1), plan.sum(0)
    slope = problem.gradient(plan) / 2 + mass * reg * np.log(plan / np.outer(problem.p, problem.q))
    slope += mass * marginal * (np.log(rows / problem.p)[:, None] + np.log(columns / problem.q)[None])
    assert np.ptp(slope) < 1e-3 * np.ptp(problem.gradient(plan))


# --- weights -----------------------------------------------------------------------------------------------------


def test_weights_follow_their_pairs():
    m = Matches(np.array([[0, 1], [2, 3], [4, 5]]), np.array([1.0, 3.0, 2.0]), weight=np.array([0.5, 0.0, 1.0]))
    assert m.take([2, 0]).weight.tolist() == [1.0, 0.5]
    assert m.best(2).pairs.tolist() == [[2, 3], [4, 5]] and m.best(2).weight.tolist() == [0.0, 1.0]
    assert m.swapped().weight.tolist() == m.weight.tolist() and m.without_plan().weight is not None
    np.testing.assert_allclose(m.shares, [1.0, 0.0, 2.0])
    assert m.shares.mean() == pytest.approx(1.0)
    assert Matches(m.pairs).shares.tolist() == [1, 1, 1]
    assert replace(m, weight=np.zeros(3)).shares.tolist() == [1, 1, 1]
    for bad in ([1.0, 2.0], [1.0, -1.0, 0.0], [np.nan, 1, 1]):
        with pytest.raises(ValueError, match=r"Matches.weight: expected 3 finite numbers"):
            Matches(m.pairs, weight=np.array(bad))


def matched_videos():
    """b starts 12 frames later; the second half of the matches is wrong."""
    rng = np.random.default_rng(4)
    t = np.arange(162) / 30
    xyz = rng.normal(size=(40, 1, 3)) + 0.3 * sum(
        rng.normal(size=(40, 1, 3))
        * np.sin(2 * np.pi * rng.uniform(0.3, 1.6, (40, 1, 3)) * t[None, :, None] + rng.uniform(0, 6, (40, 1, 3)))
        for _ in range(2)
    )
    a, b = (TrackSet(x + 0.004 * rng.normal(size=x.shape), fps=30) for x in (xyz[:, :150], xyz[:, 12:]))
    j = np.arange(40)
    j[20:] = np.roll(j[20:], 3)
    pairs = np.stack([np.arange(40), j], 1)
    return a, b, Matches(pairs, weight=(np.arange(40) < 20).astype(float)), Matches(pairs[:20])


def test_matches_of_no_weight_are_as_if_they_were_not_there():
    """Up to the noise scale, which is a median over all matches."""
    a, b, weighted, right = matched_videos()
    scans = [align(a, b, m, LikelihoodScan(), throw=False) for m in (weighted, right)]
    assert scans[0].offset == pytest.approx(scans[1].offset, abs=0.2 / 30)
    assert abs(scans[0].offset - 0.4) < 0.5 / 30
    start = Alignment(0.4 + 0.7 / 30, fps=30.0)
    fits = [refine(a, b, m, start, SplineRefine(), throw=False) for m in (weighted, right)]
    assert fits[0].offset == pytest.approx(fits[1].offset, abs=0.02 / 30)
    assert abs(fits[0].offset - 0.4) < 0.05 / 30
    equal = refine(a, b, replace(right, weight=np.full(20, 3.0)), start, SplineRefine(), throw=False)
    assert equal.offset == pytest.approx(fits[1].offset, abs=1e-9)


def test_candidates_of_no_weight_leave_a_tracks_mixture():
    rng = np.random.default_rng(0)
    score = rng.normal(size=(4, 7))
    track = np.array([0, 0, 1, 1])
    alone = mixture(score[[0, 2]], track[[0, 2]])
    np.testing.assert_allclose(mixture(score, track, np.array([1.0, 0, 1, 0])), alone)
    np.testing.assert_allclose(mixture(score, track, np.full(4, 7.0)), mixture(score, track))


def test_weights_survive_files_and_caches(tmp_path):
    a, b = videos(30, 90)
    matcher = UnbalancedOT(weighted=True)
    job = Job((0, 1), a, b, matcher, LikelihoodScan(), SplineRefine(), None)
    fresh = run(job)
    assert fresh.matches.weight is not None and fresh.matches.weight.max() == 1.0
    again = unpack((0, 1), pack(fresh))
    np.testing.assert_array_equal(again.matches.weight, fresh.matches.weight)
    np.testing.assert_array_equal(again.matches.pairs, fresh.matches.pairs)
    np.testing.assert_array_equal(again.matches.score, fresh.matches.score)
    for name in ("scanned", "refined"):
        one, two = getattr(again, name), getattr(fresh, name)
        assert (one.offset, one.rate, one.flags) == (two.offset, two.rate, two.flags)
        np.testing.assert_array_equal(one.curve, two.curve)
        np.testing.assert_array_equal(one.hypotheses, two.hypotheses)
    calls = []

    def counted(item):
        calls.append(item)
        return run(item)

    kept = KeptPairs(Cache(tmp_path))
    first, second = kept(counted, [job])[0], kept(counted, [job])[0]
    assert len(calls) == 1
    np.testing.assert_array_equal(first.matches.weight, second.matches.weight)
    unweighted = run(replace(job, matcher=Candidates()))
    assert unpack((0, 1), pack(unweighted)).matches.weight is None
