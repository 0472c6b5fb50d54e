"""Spline refinement: gradients, laws, honest sigma, rates, timestamps, refusals."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from otsync import Alignment, Matches, Refused, SplineRefine, Status, TrackSet, Trust, Unrefined, align, refine
from otsync.clocks.splines import TrackSplines
from otsync.compute.indices import blocks
from otsync.refine import gauss_newton
from otsync.refine.gauss_newton import Side, System, _linearise, bias_reduced, fit_clock, jackknife, neighbours, wider
from otsync.refine.splines import COMMON_ERRORS, FORGOTTEN, LEAST_SIGMA, SHORT, _of_short, unsettled_rate
from otsync.simulate import simulate
from otsync.types import Clock

ANTISYMMETRY = 1e-3 / 30
"""Seconds: what exchanging the videos may change, the stated tolerance."""


def smooth(rng: np.random.Generator, n: int):
    """xyz(t) of n points, defined at every real t."""
    f, phase = rng.uniform(0.3, 1.5, (n, 4, 3)), rng.uniform(0, 6.3, (n, 4, 3))
    size, base = rng.normal(size=(n, 4, 3)) * 0.2, rng.normal(size=(n, 1, 3))
    return lambda t: base + np.einsum("nfc,nfct->ntc", size, np.sin(2 * np.pi * f[..., None] * t + phase[..., None]))


def films(seed: int = 0, offset: float = 0.3, n: int = 12, noise: float = 0.0, fps_b: float = 30.0, rate: float = 1.0):
    rng = np.random.default_rng(seed)
    move = smooth(rng, n)
    a = move(np.arange(120) / 30)
    b = move(rate * np.arange(int(120 * fps_b / 30)) / fps_b + offset)
    a, b = (x + noise * rng.normal(size=x.shape) for x in (a, b))
    return TrackSet(a, fps=30), TrackSet(b, fps=fps_b), Matches(np.stack([np.arange(n)] * 2, 1))


def near(offset: float) -> Alignment:
    return Alignment(offset, fps=30.0)


@pytest.mark.parametrize("offset", [-0.517, 0.0, 0.013, 0.2891])
@pytest.mark.parametrize("fps_b", [25.0, 30.0, 60.0])
def test_exact_tracks_give_exact_offsets(offset, fps_b):
    a, b, m = films(offset=offset, fps_b=fps_b)
    found = refine(a, b, m, near(offset + 0.04))
    assert found.offset == pytest.approx(offset, abs=0.005 / 30)
    assert found.sigma < 0.05 / 30


def test_the_step_is_the_gradient_of_the_residual():
    """The Jacobian in the normal equations is the finite difference of the detrended residual."""
    a, b, _ = films(noise=0.01)
    curves = TrackSplines(a.times, a.positions()), TrackSplines(b.times, b.positions())
    h, clock = 1e-5, Clock(0.31)
    for forward in (True, False):
        own, other = curves if forward else curves[::-1]
        side = Side.of(own, other, 14 / 30, forward)

        def residual(clock, own=own, other=other, side=side):
            t = side.there(clock)
            ok = own.support(own.times) & other.support(t)
            x = np.where(ok[..., None], own.value(own.times) - other.value(t), 0)
            out = np.zeros_like(x)
            for k in range(x.shape[1]):
                window = slice(side.lo[k], side.hi[k])
                seen = ok[:, window].sum(1)[:, None]
                out[:, k] = x[:, k] - x[:, window].sum(1) / np.maximum(seen, 1)
            return np.where(ok[..., None], out, 0), ok

        (r0, ok0), (r1, ok1) = residual(Clock(clock.offset - h)), residual(Clock(clock.offset + h))
        both = ok0 & ok1
        slope = np.where(both[..., None], (r1 - r0) / (2 * h), 0)
        r = residual(clock)[0]
        system = _linearise((side, side), clock, 0.0, False)
        plain = (slope * r).sum(2)
        # compare where weights are common: the unweighted products from the kernel
        from otsync.refine import kernels

        M, T = both.shape
        first, value, dslope = other.basis(side.there(clock))
        rr, g, hh = np.empty((M, T)), np.empty((1, M, T)), np.empty((1, 1, M, T))
        ok = own.support(own.times) & other.support(side.there(clock))
        sign = 1.0 if forward else -1.0
        kernels.shift_residuals(
            side.at,
            other.by_track,
            other.mean,
            first,
            value,
            sign * dslope,
            np.zeros(T),
            ok,
            side.lo,
            side.hi,
            1.0,
            rr,
            g,
            hh,
        )
        np.testing.assert_allclose(g[0][both], plain[both], atol=1e-4 * np.abs(plain).max())
        np.testing.assert_allclose(hh[0, 0][both], (slope**2).sum(2)[both], rtol=1e-3, atol=1e-4 * (slope**2).max())
        np.testing.assert_allclose(rr[ok], (r**2).sum(2)[ok], rtol=1e-9, atol=1e-12)
        assert system is not None and system.H[0, 0] > 0


@pytest.mark.parametrize("preset", ["mid", "hard", "brutal"])
def test_exchanging_the_videos_flips_the_sign(preset):
    (a, b), truth = simulate("tennis", preset=preset, offsets=[0, 0.37], seed=11)
    m = truth.matches(0, 1)
    there, back = (refine(*x, align(*x, throw=False), throw=False) for x in ((a, b, m), (b, a, m.swapped())))
    assert there.offset == pytest.approx(-back.offset, abs=ANTISYMMETRY)
    assert there.sigma == pytest.approx(back.sigma, rel=0.02)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_unit_order_and_rigid_motion_change_nothing(scale):
    (a, b), truth = simulate("softball", preset="mid", offsets=[0, -0.37], seed=12)
    m = truth.matches(0, 1)
    rng = np.random.default_rng(0)
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    order = rng.permutation(len(a))
    place = np.argsort(order)
    moved = [dataclasses.replace(t, xyz=scale * (t.xyz @ q.T + [5.0, -3.0, 1.0])) for t in (a, b)]
    other = Matches(np.stack([place[m.pairs[:, 0]], m.pairs[:, 1]], 1)[::-1])
    first = refine(a, b, m, align(a, b, m))
    second = refine(moved[0].take(order), moved[1], other, align(moved[0].take(order), moved[1], other))
    assert second.offset == pytest.approx(first.offset, abs=1e-5 / 30)
    assert second.sigma == pytest.approx(first.sigma, rel=1e-3)
    assert second.flags == first.flags


def test_constant_errors_of_tracks_drop_out():
    a, b, m = films(noise=0.003)
    shifted = dataclasses.replace(b, xyz=b.xyz + np.random.default_rng(5).normal(size=(12, 1, 3)))
    first, second = (refine(a, x, m, near(0.3)) for x in (b, shifted))
    assert second.offset == pytest.approx(first.offset, abs=1e-6)


def test_wrong_matches_lose_their_weight():
    a, b, m = films(n=24, noise=0.005)
    wrong = m.pairs.copy()
    wrong[:8, 1] = np.roll(wrong[:8, 1], 1)
    found = refine(a, b, Matches(wrong), near(0.3), throw=False)
    assert found.offset == pytest.approx(0.3, abs=0.06 / 30)
    assert found.stats["effective_matches"] < 20


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_tracks_that_fit_three_times_worse_hardly_count(seed):
    """Their weight falls with the fourth power of what they are off: less than by their variance."""
    a, b, m = films(seed, n=24, noise=0.01)
    worse = b.xyz.copy()
    worse[:8] += 0.04 * np.random.default_rng(seed).normal(size=worse[:8].shape)
    found = refine(a, dataclasses.replace(b, xyz=worse), m, near(0.3), throw=False)
    assert found.offset == pytest.approx(0.3, abs=0.04 / 30)
    assert 15 < found.stats["effective_matches"] < 18.5


def test_gaps_are_never_bridged():
    """Samples inside gaps are garbage; the answer must not see them."""
    a, b, m = films(noise=0.002)
    seen = np.ones((12, 120), bool)
    seen[:, 40:70] = False
    garbage = b.xyz.copy()
    garbage[:, 40:70] += 10.0
    first, second = (refine(a, dataclasses.replace(b, xyz=x, visible=seen), m, near(0.3)) for x in (b.xyz, garbage))
    assert first.offset == second.offset
    assert first.offset == pytest.approx(0.3, abs=0.05 / 30)


def test_dropped_frames_with_timestamps_cost_nothing():
    a, b, m = films(noise=0.002)
    keep = np.sort(np.random.default_rng(3).choice(120, 95, replace=False))
    dropped = TrackSet(b.xyz[:, keep], timestamps=b.times[keep])
    found = refine(a, dropped, m, align(a, dropped, m))
    assert found.offset == pytest.approx(0.3, abs=0.02 / 30)
    ignored = TrackSet(b.xyz[:, keep], fps=30 * 95 / 120)
    assert abs(refine(a, ignored, m, align(a, ignored, m, throw=False), throw=False).offset - 0.3) > 0.2 / 30


def test_sigma_covers_errors_of_independent_noise():
    """Within two sigmas nearly always, within one not nearly always."""
    z = []
    for seed in range(24):
        a, b, m = films(seed, offset=0.1 + seed / 97, noise=0.03)
        found = refine(a, b, m, near(0.1 + seed / 97), throw=False)
        z.append(abs(found.offset - 0.1 - seed / 97) / found.sigma)
    assert np.mean(np.array(z) < 2) >= 0.85
    assert np.mean(z) > 0.15


@pytest.mark.slow
def test_a_fitted_rate_is_kept_only_when_significant():
    for frames, rate, kept in ((900, 1.001, True), (900, 1.0, False), (150, 1.001, False)):
        tracks, truth = simulate("softball", preset="mid", frames=frames, rates=[1, rate], offsets=[0, 0.3], seed=4)
        m = truth.matches(0, 1)
        found = refine(*tracks, m, align(*tracks, m), SplineRefine(rate="fit"))
        assert (found.rate != 1.0) == kept
        if kept:
            assert found.rate == pytest.approx(1.001, abs=2e-4)
            assert found.offset == pytest.approx(0.3, abs=0.1 / 30)
            fixed = refine(*tracks, m, align(*tracks, m), SplineRefine(rate="fixed"), throw=False)
            assert fixed.rate == 1.0 and Status.RATE_MISMATCH in fixed.flags


def test_a_scan_at_a_wrong_rate_is_right_somewhere_in_the_overlap():
    # 1 % over twenty seconds: the scan's peak is 3 frames from where the clocks stand at the first frame
    tracks, truth = simulate("softball", preset="mid", frames=600, rates=[1, 1.01], offsets=[0, 0.3], seed=5)
    m = truth.matches(0, 1)
    scan = align(*tracks, m)
    assert abs(scan.offset - 0.3) > Trust().moved
    found = refine(*tracks, m, scan)
    assert Status.MOVED not in found.flags and found.stats["moved"] < 1 / 30
    assert found.rate == pytest.approx(1.01, abs=3e-4) and found.offset == pytest.approx(0.3, abs=0.2 / 30)
    # a start that is right nowhere in the overlap stays a start that is wrong
    off = dataclasses.replace(scan, offset=0.3 - 3 / 30)
    assert refine(*tracks, m, off, throw=False).stats["moved"] > 2.5 / 30


def test_a_rate_that_is_not_kept_counts_where_it_may_be_real():
    told = {"fitted_rate": 1.001, "rate_sigma": 0.0004}  # 2.5 sigma
    assert unsettled_rate(told, 1.0) == pytest.approx(0.001)
    assert unsettled_rate(told, 1.001) == 0.0  # it is kept
    assert unsettled_rate(told | {"rate_sigma": 0.001}, 1.0) == 0.0  # as much as noise makes
    assert 0 < unsettled_rate(told | {"rate_sigma": 0.0007}, 1.0) < 0.001
    assert unsettled_rate({}, 1.0) == 0.0  # nothing tells it


def test_flags_of_the_alignment_stay():
    a, b, m = films()
    start = dataclasses.replace(near(0.3), flags=(Status.ALIAS,))
    with pytest.raises(Refused, match="alias"):
        refine(a, b, m, start)
    found = refine(a, b, m, start, throw=False)
    assert found.flags == (Status.ALIAS,)


def test_what_raises_which_flag():
    a, b, m = films()
    assert Status.MOVED in refine(a, b, m, near(0.3 + 3 / 30), throw=False).flags
    few = Matches(m.pairs[:3])
    assert Status.FEW_MATCHES in refine(a, b, few, near(0.3), throw=False).flags
    short = TrackSet(b.xyz[:, :36], fps=30)
    assert Status.SHORT_OVERLAP in refine(a, short, m, near(0.3), throw=False).flags
    stranger = films(seed=9)[1]
    assert Status.POOR_FIT in refine(a, stranger, m, near(0.3), throw=False).flags
    assert Status.NO_OVERLAP in refine(a, b, m, near(100.0), throw=False).flags


def test_no_answer_stays_no_answer_and_unrefined_changes_nothing():
    a, b, m = films()
    nothing = Alignment(float("nan"), flags=(Status.NO_OVERLAP,))
    assert np.isnan(refine(a, b, m, nothing, throw=False).offset)
    start = near(0.25)
    assert refine(a, b, m, start, Unrefined()).offset == 0.25


def test_fit_without_common_samples_is_none():
    a, b, _ = films()
    curves = TrackSplines(a.times, a.positions()), TrackSplines(b.times, b.positions())
    assert fit_clock(*curves, Clock(50.0), 14 / 30) is None


def test_neighbourhoods_do_not_depend_on_order():
    x = np.random.default_rng(0).normal(size=(40, 3))
    order = np.random.default_rng(1).permutation(40)
    np.testing.assert_array_equal(neighbours(x, 6)[order], neighbours(x[order], 6))
    assert len(np.unique(neighbours(x, 6))) == 6
    assert len(np.unique(neighbours(x[:3], 6))) == 3


def test_blur_is_the_residual_over_the_speed():
    a, b, _ = films(n=40, noise=0.06)
    curves = TrackSplines(a.times, a.positions()), TrackSplines(b.times, b.positions())
    fit = fit_clock(*curves, Clock(0.3), 14 / 30)
    t = np.arange(20, 90) / 30
    residual = curves[0].value(t) - curves[1].value(t - 0.3)
    residual -= residual.mean(1, keepdims=True)
    speed = curves[1].velocity(t - 0.3)
    assert fit.blur == pytest.approx(np.sqrt((residual**2).sum() / (speed**2).sum()), rel=0.25)


def curves_of(a: TrackSet, b: TrackSet) -> tuple[TrackSplines, TrackSplines]:
    return TrackSplines(a.times, a.positions()), TrackSplines(b.times, b.positions())


def test_the_second_from_which_clocks_count_changes_no_fit():
    """b's clock set forward by s seconds: the offset falls by rate s, and sigma is carried along."""
    a, b, _ = films(offset=0.3, noise=0.01, rate=1.004)
    start, s = Clock(0.31, 1.0), 200.0
    one, other = (
        fit_clock(curves_of(a, x)[0], curves_of(a, x)[1], begin, 14 / 30, fit_rate=True)
        for x, begin in (
            (b, start),
            (dataclasses.replace(b, fps=None, timestamps=b.times + s), Clock(start.offset - start.rate * s, 1.0)),
        )
    )
    assert one is not None and other is not None
    assert one.clock.rate == pytest.approx(1.004, abs=5e-4)
    assert other.clock.rate == pytest.approx(one.clock.rate, abs=1e-6)
    assert other.clock.offset == pytest.approx(one.clock.offset - one.clock.rate * s, abs=1e-4)
    move = np.array([[1.0, -s], [0.0, 1.0]])
    np.testing.assert_allclose(other.covariance, move @ one.covariance @ move.T, rtol=1e-3)
    # the offset is best known in the middle of the overlap, where its error does not go with the rate's
    there = np.array([1.0, 2.0])
    assert there @ one.covariance @ there < 0.5 * one.covariance[0, 0]


def test_detrending_windows_reach_as_far_back_as_ahead():
    a, b, _ = films()
    side = Side.of(*curves_of(a, b), 14 / 30, True)
    inner = np.arange(14, 120 - 14)
    np.testing.assert_array_equal(side.lo[inner], inner - 14)
    np.testing.assert_array_equal(side.hi[inner], inner + 14 + 1)


def test_sigma_never_falls_below_what_blur_predicts():
    """However many matches agree: errors that whole videos share are in no residual."""
    a, b, m = films(n=300, noise=0.8)
    found = refine(a, b, m, near(0.3), SplineRefine(windows=(14 / 30,)), throw=False)
    shared = found.stats["blur"] ** 2 / COMMON_ERRORS
    rest = max(fit_clock(*curves_of(a, b), Clock(found.offset), 14 / 30).unbiased[0, 0], 0)
    rest *= 1 + SHORT * (FORGOTTEN / found.stats["overlap"]) ** 4
    assert found.sigma == pytest.approx(np.sqrt(shared**2 + rest + LEAST_SIGMA**2), rel=0.1)
    assert shared > 0.3 * found.sigma


def test_the_scatter_of_a_short_overlap_says_less():
    fit = fit_clock(*curves_of(*films()[:2]), Clock(0.3), 14 / 30)
    two, eight = (_of_short(fit, seconds).unbiased[0, 0] / fit.unbiased[0, 0] for seconds in (2.0, 8.0))
    assert 1.5 < two < 2.5 and eight == pytest.approx(1, abs=0.01)


def test_one_sigma_of_few_clusters_holds_68_percent():
    """Clusters whose errors are their own: their scatter, made wider, covers what it says."""
    rng = np.random.default_rng(0)
    for count in (2, 3, 4, 10):
        H = np.ones((count, 1, 1))
        error, sigma = np.empty((2, 4000))
        for k, scores in enumerate(rng.standard_normal((4000, count))):
            error[k] = scores.mean()
            sigma[k] = np.sqrt(bias_reduced(H, (scores - error[k])[:, None])[0, 0])
        within = (np.abs(error) < sigma).mean()
        assert within == pytest.approx(0.683, abs=0.025)
        assert (np.abs(error) < sigma / wider(np.ones(count))).mean() < within
    assert wider(np.ones(400)) == pytest.approx(1, abs=0.005)
    # one cluster that holds nearly everything: as little is known as of two
    assert wider(np.array([1.0, 1e-3, 1e-3])) == pytest.approx(wider(np.ones(2)))


@pytest.mark.parametrize("P", [1, 2])
def test_scatter_of_unlike_clusters_has_no_bias(P):
    """Alike errors of samples: the inverse of the information. The jackknife is above it."""
    rng = np.random.default_rng(P)
    J = [rng.standard_normal((n, P)) for n in (4, 8, 8, 12, 20)]
    H = np.stack([j.T @ j for j in J])
    true = np.linalg.inv(H.sum(0))
    found, cautious = np.zeros((2, P, P))
    turn = np.array([[1.0, 3.0], [0.0, 0.5]])[:P, :P]
    for _ in range(3000):
        e = [rng.standard_normal(len(j)) for j in J]
        moved = true @ sum(j.T @ x for j, x in zip(J, e, strict=True))
        g = np.stack([j.T @ (x - j @ moved) for j, x in zip(J, e, strict=True)])
        one = bias_reduced(H, g)
        found += one / 3000
        cautious += jackknife(H, g) / 3000
    # in other units of offset and rate: the same answer
    np.testing.assert_allclose(bias_reduced(turn.T @ H @ turn, g @ turn), _in_units(one, turn, H), rtol=1e-6)
    np.testing.assert_allclose(found / wider(H[:, 0, 0]) ** 2, true, atol=0.06 * np.trace(true))
    assert np.all(np.diag(cautious) > 1.15 * np.diag(found))


def _in_units(covariance, turn, H):
    """A covariance after x = turn y; what is wider goes with the information on the first of them."""
    back = np.linalg.inv(turn)
    ratio = wider((turn.T @ H @ turn)[:, 0, 0]) / wider(H[:, 0, 0])
    return back @ covariance @ back.T * ratio**2


def test_windows_that_know_less_may_differ_by_what_they_know_less():
    """Hausman: of two answers apart by less than the worse one's excess variance, nothing is the model's."""
    a, b, _ = films()
    curves = curves_of(a, b)
    fit = fit_clock(*curves, Clock(0.3), 14 / 30)
    refiner = SplineRefine()

    def other(late, excess):
        return dataclasses.replace(fit, clock=Clock(fit.clock.offset + late), unbiased=fit.unbiased + excess)

    assert refiner._beyond_noise(other(0.01, 0.011**2), fit, curves) == 0
    assert refiner._beyond_noise(other(0.01, 0.006**2), fit, curves) == pytest.approx(0.008**2)
    assert refiner._beyond_noise(other(0.01, -1e-6), fit, curves) == pytest.approx(0.01**2)
    assert refiner._beyond_noise(None, fit, curves) == pytest.approx(curves[0].frame ** 2)


@pytest.mark.parametrize("fit_rate", [False, True])
def test_a_fit_of_few_matches_at_a_time_is_the_same(fit_rate, monkeypatch):
    rng = np.random.default_rng(5)
    t = np.arange(200) / 30
    x = np.cumsum(0.02 * rng.standard_normal((12, 200, 3)), 1)
    x[:4, 60:90] = np.nan
    a, b = (TrackSplines(t - shift, x + 0.01 * rng.standard_normal(x.shape)) for shift in (0, 0.11))
    whole = fit_clock(a, b, Clock(0.1, 1.0), 14 / 30, fit_rate=fit_rate)
    monkeypatch.setattr(gauss_newton, "blocks", lambda rows, columns: blocks(rows, columns, 5 * columns))
    parts = fit_clock(a, b, Clock(0.1, 1.0), 14 / 30, fit_rate=fit_rate)
    assert whole.clock.offset == pytest.approx(0.11, abs=0.01)
    np.testing.assert_allclose(parts.clock.offset, whole.clock.offset, atol=1e-12)
    np.testing.assert_allclose(parts.covariance, whole.covariance, rtol=1e-8)
    np.testing.assert_allclose(parts.unbiased, whole.unbiased, rtol=1e-8)
    np.testing.assert_allclose(parts.weights, whole.weights, rtol=1e-9)
    assert (parts.blur, parts.wander) == pytest.approx((whole.blur, whole.wander), rel=1e-9)


def test_sigma_is_that_of_the_worse_witness():
    """Matches that agree and seconds that do not, or the other way round."""
    H, g = np.full((8, 1, 1), 10.0), np.array([1.0, -1, 2, -2, 1, -1, 2, -2])[:, None]
    wild, calm = (H, 5 * g), (H, g)
    for by_match, by_time in ((wild, calm), (calm, wild)):
        system = System(H.sum(0), np.zeros(1), by_match, by_time, np.ones(8), 0.0)
        for scatter in (jackknife, bias_reduced):
            np.testing.assert_allclose(system.covariance(scatter), scatter(*wild))
    assert jackknife(*wild)[0, 0] > 20 * jackknife(*calm)[0, 0]
