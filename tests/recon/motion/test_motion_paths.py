"""Curves in time: scipy is the oracle; derivatives, continuity, what happens beyond the ends, rotations."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline as ScipyBSpline
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from recon.motion import BSpline, HermiteSpline, Path, Sampled
from recon.motion.paths import path_arrays, path_from_arrays, resampled
from recon.rotations import conjugate, continuous, product, quaternions, rotation_matrices, rotation_vectors, unit

SPLINES = (HermiteSpline, BSpline)


def scipy_spline(path: Path, knots: np.ndarray) -> CubicHermiteSpline | ScipyBSpline:
    if isinstance(path, BSpline):
        beyond = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
        return ScipyBSpline(path.start + path.spacing * np.arange(-3, path.count + 3), beyond, 3)
    tangents = np.empty_like(knots)
    tangents[1:-1] = (knots[2:] - knots[:-2]) / 2
    tangents[0], tangents[-1] = knots[1] - knots[0], knots[-1] - knots[-2]
    return CubicHermiteSpline(path.times, knots, tangents / path.spacing)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(SPLINES), st.integers(4, 30), st.floats(-1e3, 1e3), st.floats(0.01, 10), st.integers(0, 10**6))
def test_the_spline_is_scipys(kind, count, start, spacing, seed):
    rng = np.random.default_rng(seed)
    path = kind(start, spacing, count)
    knots = rng.normal(size=(count, 5, 3))
    times = np.concatenate([path.times, rng.uniform(path.times[0], path.times[-1], 40)])
    oracle = scipy_spline(path, knots)
    tolerance = 1e-12 + 1e-13 * abs(start) / spacing  # of (t - start) / spacing
    found = path.at(torch.from_numpy(knots), torch.from_numpy(times)).numpy()
    assert np.abs(found - oracle(times)).max() < tolerance
    one = path.at(torch.from_numpy(knots), float(times[-1])).numpy()
    assert np.abs(one - found[-1]).max() < 1e-13
    first, _, slopes = path.basis(times)
    windows = knots[first[:, None] + np.arange(4)]
    inside = np.abs((times - path.times[-1]) / spacing) > 1e-9  # scipy's derivative at the very end is its own affair
    derivative = np.einsum("sa,saij->sij", slopes, windows)
    assert np.abs((derivative - oracle(times, 1))[inside] * spacing).max() < 10 * tolerance


@pytest.mark.parametrize("kind", SPLINES)
@pytest.mark.parametrize("t", [-0.3, 0.05, 0.33, 0.71, 0.95, 1.4])
def test_gradients_in_knots_and_time(kind, t):
    path = kind(0.0, 0.25, 5)
    knots = torch.randn(5, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    time = torch.tensor(t, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda k, s: path.at(k, s), (knots, time))
    several = torch.tensor([t, 0.5 * t, 0.4], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda k, s: path.at(k, s), (knots, several))
    assert torch.autograd.gradgradcheck(lambda s: path.at(knots.detach(), s), (time,))


@pytest.mark.parametrize("kind", SPLINES)
def test_value_and_slope_are_continuous_at_every_knot(kind):
    path = kind(2.0, 0.1, 7)
    knots = np.random.default_rng(0).normal(size=(7, 3))

    def value_and_slope(t):
        first, w, slope = path.basis(t)
        window = knots[first[:, None] + np.arange(4)]
        return np.einsum("sa,sai->si", w, window), np.einsum("sa,sai->si", slope, window)

    eps = 1e-9
    before, after = value_and_slope(path.times - eps), value_and_slope(path.times + eps)
    assert np.abs(after[0] - before[0]).max() < 1e-6
    assert np.abs(after[1] - before[1]).max() < 1e-4
    at_knots = path.at_knots(torch.from_numpy(knots)).numpy()
    assert np.abs(before[0] - at_knots).max() < 1e-6
    if kind is HermiteSpline:
        assert np.abs(at_knots - knots).max() < 1e-12  # the curve runs through its knots


@settings(max_examples=30, deadline=None)
@given(st.sampled_from((*SPLINES, Sampled)), st.integers(4, 40), st.floats(-1e2, 1e2), st.integers(0, 10**6))
def test_a_curve_has_the_values_that_are_asked_for_at_its_knots(kind, count, start, seed):
    path, values = kind(start, 0.13, count), np.random.default_rng(seed).normal(size=(count, 3, 2))
    knots = torch.from_numpy(path.through(values))
    weighted = np.tensordot(path.design(path.times).toarray(), knots.numpy(), 1)
    for found in (weighted, path.at_knots(knots).numpy()):
        assert found.shape == values.shape and np.abs(found - values).max() < 1e-9
    other = BSpline(start, 0.13, count)
    assert np.abs(other.at_knots(resampled(knots, path, other)).numpy() - values).max() < 1e-9


def test_a_swing_is_ten_times_nearer_on_the_b_spline_at_one_hertz_and_four_times_at_two():
    """The nearest curve of each, by least squares."""
    t = np.linspace(0, 4, 900)
    inner = (t > 0.5) & (t < 3.5)
    for hertz, least, times in ((1.0, 0.008, 10), (2.0, 0.07, 4)):
        swing, off = np.sin(2 * np.pi * hertz * t), {}
        for kind in SPLINES:
            design = kind.of(0.0, 4.0, 4 / 30, 4 / 30).design(t).toarray()
            off[kind] = np.abs(design @ np.linalg.lstsq(design, swing, rcond=None)[0] - swing)[inner].max()
        assert off[HermiteSpline] > least and off[BSpline] * times < off[HermiteSpline]


@pytest.mark.parametrize("kind", [*SPLINES, Sampled])
def test_a_lone_knot_moves_its_curve_by_its_peak(kind):
    path = kind(0.0, 0.13, 12)
    weights = path.design(np.linspace(0, 11 * 0.13, 11 * 40 + 1)).toarray()[:, 3:-3]
    assert np.allclose(weights.max(0), path.peak, atol=1e-9)


@pytest.mark.parametrize("kind", SPLINES)
def test_beyond_the_ends_the_spline_goes_straight_on(kind):
    path = kind(0.0, 0.5, 6)
    knots = torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    for seconds in (0.1, 3.0, 1e4):
        early, late = path.at(knots, -seconds), path.at(knots, 2.5 + seconds)
        assert torch.allclose(early, knots[0] - (knots[1] - knots[0]) * seconds / 0.5)
        assert torch.allclose(late, knots[5] + (knots[5] - knots[4]) * seconds / 0.5)
    assert (path.basis(np.array([-7.0, 9.0]))[2].sum(-1) == 0).all()


def test_weights_sum_to_one_and_their_slopes_to_nought():
    t = np.linspace(-1, 3, 101)
    for path in (HermiteSpline(0.0, 0.3, 6), BSpline(0.0, 0.3, 6), Sampled(0.0, 0.3, 6)):
        first, w, slope = path.basis(t)
        assert np.abs(w.sum(-1) - 1).max() < 1e-12 and np.abs(slope.sum(-1)).max() < 1e-10
        assert first.min() >= 0 and first.max() <= path.count - 4
        assert np.allclose(path.design(t).toarray() @ np.ones(6), 1)


def test_samples_are_the_nearest_and_have_no_slope():
    path = Sampled(1.0, 0.5, 6)
    knots = torch.arange(6, dtype=torch.float64)[:, None]
    times = torch.tensor([-5.0, 1.0, 1.24, 1.26, 2.74, 3.3, 3.49, 9.0], dtype=torch.float64, requires_grad=True)
    found = path.at(knots, times)
    assert found[:, 0].tolist() == [0, 0, 0, 1, 3, 5, 5, 5]
    (slope,) = torch.autograd.grad(found.sum(), times)
    assert (slope == 0).all()
    assert path.step(1 / 30) == 0.5 and path.step(0.8) == 1.0
    assert HermiteSpline(1.0, 0.5, 6).step(1 / 30) == BSpline(1.0, 0.5, 6).step(1 / 30) == 1 / 30


def test_sizes():
    """150 frames and a margin of four at each end, knots every four: the study's 41; never fewer than a window."""
    four = 4 / 30
    path = HermiteSpline.of(0.0, 149 / 30, four, four)
    assert path.count == 41 and path.times[0] == pytest.approx(-four) and path.times[-1] >= 149 / 30 + four - 1e-9
    assert HermiteSpline.of(0.0, 47 / 30, four, four).count == 15
    assert HermiteSpline.of(3.0, 3.0, four).count == 4
    assert Sampled.of(0.0, 47 / 30, 1 / 30).count == 48


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: HermiteSpline(0.0, 0.0, 5), "spacing"),
        (lambda: HermiteSpline(float("nan"), 1.0, 5), "start"),
        (lambda: HermiteSpline(0.0, 1.0, 3), "count"),
        (lambda: Sampled(0.0, 1.0, 10**9), "count"),
        (lambda: HermiteSpline.of(0.0, 1e300, 0.1), "offsets"),
        (lambda: HermiteSpline.of(1.0, 0.0, 0.1), "last"),
        (lambda: HermiteSpline.of(0.0, float("inf"), 0.1), "last"),
    ],
)
def test_paths_that_cannot_be_are_refused(make, name):
    with pytest.raises(ValueError, match=name):
        make()


def test_a_path_survives_its_arrays():
    for path in (HermiteSpline(0.1, 1 / 7, 9), BSpline(0.1, 1 / 7, 9), Sampled(-2.0, 1 / 30, 50)):
        assert path_from_arrays(path_arrays(path)) == path
    with pytest.raises(ValueError, match="path"):
        path_from_arrays({"path": np.array("os.system"), "path_knots": np.zeros(3)})


def test_quaternion_algebra_is_scipys():
    rng = np.random.default_rng(0)
    a, b = Rotation.random(50, random_state=1), Rotation.random(50, random_state=2)
    p, q = (torch.from_numpy(r.as_quat(scalar_first=True)) for r in (a, b))
    assert np.abs(rotation_matrices(product(p, q)).numpy() - (a * b).as_matrix()).max() < 1e-12
    assert np.abs(rotation_matrices(conjugate(p)).numpy() - a.inv().as_matrix()).max() < 1e-12
    sign = torch.from_numpy(rng.choice([-1.0, 1.0], 50))[:, None]
    assert np.abs(rotation_vectors(sign * p).numpy() - a.as_rotvec()).max() < 1e-9
    assert np.abs(np.abs((quaternions(a.as_matrix()) * p.numpy()).sum(1)) - 1).max() < 1e-12
    tiny = torch.tensor([[1.0, 1e-9, 0, 0], [1.0, 0, 0, 0]], dtype=torch.float64, requires_grad=True)
    vectors = rotation_vectors(unit(tiny))
    assert torch.allclose(vectors[0], torch.tensor([2e-9, 0, 0], dtype=torch.float64))
    (g,) = torch.autograd.grad(vectors.sum(), tiny)
    assert g.isfinite().all()


@pytest.mark.parametrize("kind", SPLINES)
@pytest.mark.parametrize("degrees_per_knot", [20.0, 45.0])
def test_rotations_cross_the_hemisphere_smoothly(kind, degrees_per_knot):
    """A node that turns by more than 360 degrees: signs of its quaternions flip on the way, its spline must not."""
    path, n = kind(0.0, 1.0, 24), 24
    axis = np.array([0.3, -0.8, 0.5]) / np.linalg.norm([0.3, -0.8, 0.5])
    exact = Rotation.from_rotvec(np.radians(degrees_per_knot) * np.arange(n)[:, None] * axis)
    # scipy hands out either sign; make it worse still
    raw = quaternions(exact.as_matrix()) * np.where(np.arange(n) % 3 == 0, -1.0, 1.0)[:, None]
    knots = torch.from_numpy(path.through(continuous(raw)))
    far = 4 if kind is BSpline else 1  # a natural end bends a curve that turns evenly
    times = np.linspace(far, n - 1 - far, 400)
    splined = unit(path.at(knots, torch.from_numpy(times))).numpy()
    error = (Rotation.from_quat(splined, scalar_first=True).inv() * Slerp(np.arange(n), exact)(times)).magnitude()
    assert np.degrees(error.max()) < {20.0: 0.02, 45.0: 0.4}[degrees_per_knot]
    steps = np.linalg.norm(np.diff(splined, axis=0), axis=1)
    assert steps.max() < 1.5 * steps.min()  # no flip, no standstill
    naive = unit(path.at(torch.from_numpy(path.through(raw)), torch.from_numpy(times))).numpy()
    assert (
        Rotation.from_quat(naive, scalar_first=True).inv() * Slerp(np.arange(n), exact)(times)
    ).magnitude().max() > 1
