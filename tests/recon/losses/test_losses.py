"""Image losses against closed forms; the fused kernel against its torch twin in float64."""

from __future__ import annotations

import math
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import correlate1d

from otsync import TrackSet
from otsync.compute.threads import get_threads
from recon.losses import image as losses
from recon.losses.image import Seen
from recon.losses.ssim import _convolved, _shifted_sums, photometric, photometric_reference, ssim_map
from recon.losses.window import C1, SMALL, STANDARD, Window
from recon.raster import set_threads


def images(shape, seed=0, noise=0.2):
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(shape, generator=g)
    return x, (x + noise * torch.randn(shape, generator=g)).clamp(0, 1)


def seen(**changes) -> Seen:
    x, y = images((20, 30, 3))
    start = Seen(x, torch.rand(20, 30, 1), y, 0, 0, torch.tensor(0.0, dtype=torch.float64), (0, 0, 30, 20))
    return replace(start, **changes)


def test_ssim_is_its_definition():
    x, y = (t.double() for t in images((17, 23, 3)))
    for window in (SMALL, STANDARD, Window(5, 0.8)):
        k = np.exp(-0.5 * ((np.arange(window.taps) - window.taps // 2) / window.sigma) ** 2)
        k /= k.sum()

        def blur(a, k=k):
            return correlate1d(correlate1d(a, k, axis=0, mode="constant"), k, axis=1, mode="constant")

        a, b = x.numpy(), y.numpy()
        ma, mb = blur(a), blur(b)
        va, vb, cov = blur(a * a) - ma**2, blur(b * b) - mb**2, blur(a * b) - ma * mb
        expected = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
        np.testing.assert_allclose(ssim_map(x, y, window).numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("window", [SMALL, STANDARD], ids=["small", "standard"])
def test_a_gpus_windows_are_those_of_the_cpu(window):
    image = torch.from_numpy(np.random.default_rng(2).random((9, 23, 15))).requires_grad_()
    weight = torch.linspace(0.5, 2, image.numel(), dtype=image.dtype).reshape(image.shape)
    found, told = _convolved(image, window), _shifted_sums(image, window)
    torch.testing.assert_close(found, told, rtol=0, atol=1e-14)
    gradients = [torch.autograd.grad((x * weight).sum(), image)[0] for x in (found, told)]
    torch.testing.assert_close(*gradients, rtol=0, atol=1e-13)
    torch.testing.assert_close(_convolved(image.float(), window), told.float(), rtol=0, atol=1e-6)


def test_ssim_of_flat_images_compares_means_only():
    a, b = 0.3, 0.7
    x, y = torch.full((25, 25, 1), a, dtype=torch.float64), torch.full((25, 25, 1), b, dtype=torch.float64)
    inside = ssim_map(x, y, STANDARD)[5:-5, 5:-5]
    torch.testing.assert_close(inside, torch.full_like(inside, (2 * a * b + C1) / (a * a + b * b + C1)))


def test_photometric_of_a_flat_difference():
    loss = losses.Photometric(ssim=0)(seen(rendered=torch.full((20, 30, 3), 0.75), image=torch.full((20, 30, 3), 0.5)))
    assert float(loss) == pytest.approx(0.25)


def test_photometric_of_equal_images_is_zero_and_flat():
    x, _ = images((40, 50, 3))
    x.requires_grad_()
    loss = photometric(x, x.detach().clone(), None, 0.2, SMALL)
    loss.backward()
    assert abs(float(loss.detach())) < 1e-7 and float(x.grad.abs().max()) < 1e-9


@given(
    st.integers(1, 140),
    st.integers(1, 40),
    st.sampled_from([1, 3, 4]),
    st.sampled_from([SMALL, STANDARD, Window(3, 0.7)]),
    st.booleans(),
    st.integers(0, 9),
)
@settings(max_examples=60, deadline=None)
def test_the_kernel_is_its_twin(h, w, c, window, weighted, seed):
    x, y = images((h, w, c), seed)
    usable = torch.rand(h, w, generator=torch.Generator().manual_seed(seed)).round(decimals=1) if weighted else None
    if usable is not None and float(usable.sum()) == 0:
        return
    x.requires_grad_()
    value = photometric(x, y, usable, 0.2, window)
    (3 * value).backward()
    z = x.detach().double().requires_grad_()
    expected = photometric_reference(z, y.double(), usable if usable is None else usable.double(), 0.2, window)
    (3 * expected).backward()
    assert float(value.detach()) == pytest.approx(float(expected.detach()), rel=1e-5, abs=1e-6)
    torch.testing.assert_close(x.grad.double(), z.grad, rtol=0, atol=1e-4 * float(z.grad.abs().max()))


def test_without_a_gradient_the_value_is_the_same():
    x, y = images((140, 33, 3))
    with_gradient = photometric(x.clone().requires_grad_(), y, None, 0.2, SMALL).detach()
    assert torch.equal(photometric(x, y, None, 0.2, SMALL), with_gradient)


def test_gradcheck_of_the_twin():
    x, y = (t.double() for t in images((7, 6, 2)))
    usable = torch.rand(7, 6, dtype=torch.float64)
    torch.autograd.gradcheck(lambda x: photometric(x, y, usable, 0.2, Window(5, 1.0)), x.requires_grad_())


def test_unusable_pixels_say_nothing():
    x, y = images((30, 40, 3))
    usable = torch.ones(30, 40)
    usable[10:20, 5:25] = 0
    other = x.clone()
    other[10:20, 5:25] = torch.rand(10, 20, 3)
    results = []
    for image in (x, other):
        leaf = image.clone().requires_grad_()
        value = photometric(leaf, y, usable, 0.2, SMALL)
        value.backward()
        results.append((value.detach(), leaf.grad))
    assert torch.equal(results[0][0], results[1][0]) and torch.equal(results[0][1], results[1][1])
    assert not results[0][1][10:20, 5:25].any() and results[0][1][:10].all()
    assert photometric(x, y, torch.zeros(30, 40), 0.2, SMALL) is None


def both(x, y):
    leaf = x.clone().requires_grad_()
    value = photometric(leaf, y, None, 0.2, SMALL)
    value.backward()
    return value.detach(), leaf.grad


def test_threads_change_no_bit_and_callers_do_not_disturb_each_other():
    x, y = images((300, 37, 3))
    before = get_threads()
    try:
        set_threads(1)
        one = both(x, y)
        set_threads(3)
        results = [both(x, y)]
        callers = [threading.Thread(target=lambda: results.extend(both(x, y) for _ in range(5))) for _ in range(4)]
        for caller in callers:
            caller.start()
        for caller in callers:
            caller.join()
    finally:
        set_threads(before)
    assert len(results) == 21
    assert all(torch.equal(value, one[0]) and torch.equal(gradient, one[1]) for value, gradient in results)


def test_mask_is_the_mean_absolute_difference():
    alpha, mask = torch.full((20, 30, 1), 0.25), torch.full((20, 30), 0.75)
    assert float(losses.Mask()(seen(alpha=alpha, mask=mask))) == pytest.approx(0.5)
    assert losses.Mask()(seen()) is None


def pseudo_huber(e, c):
    return c * (math.sqrt(1 + (e / c) ** 2) - 1)


def test_depth_is_relative_robust_and_asks_only_where_both_are_known():
    given = torch.full((20, 30), 4.0)
    given[0, :7], given[1, :7] = 0, math.nan
    s = seen(alpha=torch.ones(20, 30, 1), depth=torch.full((20, 30, 1), 4.4), given_depth=given)
    assert float(losses.Depth()(s)) == pytest.approx(pseudo_huber(0.1, 0.05), rel=1e-5)
    # any unit of length
    milli = replace(s, depth=1000 * s.depth, given_depth=1000 * given)
    assert float(losses.Depth()(milli)) == pytest.approx(float(losses.Depth()(s)), rel=1e-5)
    # the scale of a monocular estimate does not count, its shape does
    free = losses.Depth(scale="median")
    assert float(free(s)) == pytest.approx(0, abs=1e-7)
    steep = s.depth * torch.linspace(0.8, 1.2, 30)[None, :, None]
    assert float(free(replace(s, depth=steep))) > 0.01
    # outside the mask, and where the Gaussians are thin, depth is not theirs
    mask = torch.zeros(20, 30)
    mask[5:] = 1
    wrong = s.depth.clone()
    wrong[:5] = 100
    assert float(losses.Depth()(replace(s, depth=wrong, mask=mask))) == pytest.approx(pseudo_huber(0.1, 0.05), rel=1e-5)
    assert losses.Depth()(replace(s, alpha=torch.zeros(20, 30, 1))) is None and losses.Depth()(seen()) is None
    assert losses.Depth().needs == {"depth"}


def test_the_free_scale_is_no_way_for_gradients():
    """Else the one pixel at the median would carry the scale of all."""
    given = torch.full((20, 30), 4.0, dtype=torch.float64)
    ratios = torch.linspace(0.9, 1.3, 600, dtype=torch.float64).reshape(20, 30)
    depth = (given * ratios)[..., None].requires_grad_()
    losses.Depth(scale="median")(seen(alpha=torch.ones(20, 30, 1), depth=depth, given_depth=given)).backward()
    s = ratios.median()
    e = ratios / s - 1
    expected = e / 0.05 / (1 + (e / 0.05) ** 2).sqrt() / (s * given) / 600
    torch.testing.assert_close(depth.grad[..., 0], expected)


def test_gradients_are_those_of_finite_differences():
    g = torch.Generator().manual_seed(0)

    def numbers(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    sightings = losses.Sightings(torch.tensor([[0, 1], [2, 2]]), numbers(2, 3), 20 * numbers(2, 2))
    still = seen(
        alpha=0.6 + 0.3 * numbers(3, 4, 1),
        mask=0.55 * torch.ones(3, 4, dtype=torch.float64),
        given_depth=1 + numbers(3, 4),
        given_features=numbers(3, 4, 2),
        view=(K.double(), W2C.double()),
        tracks=sightings,
        footprint=0.1,
    )
    for loss, name, shape in (
        (losses.Mask(), "alpha", (3, 4, 1)),
        (losses.Depth(), "depth", (3, 4, 1)),
        (losses.Track(), "means", (3, 3)),
        (losses.Feature(), "features", (3, 4, 2)),
        (losses.ScaleHinge(), "scales", (5, 3)),
    ):
        value = (0.6 + numbers(*shape)).requires_grad_()
        assert torch.autograd.gradcheck(lambda x, loss=loss, name=name: loss(replace(still, **{name: x})), value), loss


def test_robust_is_squared_near_and_absolute_far():
    e = torch.tensor([1e-3, 1e3], dtype=torch.float64)
    torch.testing.assert_close(
        losses.robust(e, 2.0), torch.tensor([1e-6 / 4, 1e3 - 2], dtype=torch.float64), rtol=3e-6, atol=0
    )
    e.requires_grad_()
    torch.autograd.gradcheck(
        lambda e: losses.robust(e, 0.7), torch.linspace(-3, 3, 7, dtype=torch.float64).requires_grad_()
    )


K = torch.tensor([[100.0, 0, 15], [0, 110, 10], [0, 0, 1]])
W2C = torch.tensor([[1.0, 0, 0, 0.1], [0, 0, -1, 0.2], [0, 1, 0, 5], [0, 0, 0, 1]])


def project(points):
    camera = points @ W2C[:3, :3].T + W2C[:3, 3]
    return camera[:, :2] / camera[:, 2:] * torch.tensor([100.0, 110]) + torch.tensor([15.0, 10])


def test_track_is_the_distance_in_pixels():
    means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -9, 0]], requires_grad=True)
    nearest = torch.tensor([[0, 1], [2, 2], [3, 3]])
    shift = torch.tensor([[0.0, 0, 0.5], [0, 0, 0], [0, 0, 0]])
    points = torch.tensor([[0.5, 0, 0.5], [0, 1, 0], [0, -9, 0]])  # the last one is behind the camera
    uv = project(points) + torch.tensor([[3.0, 4], [0, 0], [0, 0]])
    s = seen(means=means, view=(K, W2C), tracks=losses.Sightings(nearest, shift, uv))
    loss = losses.Track()(s)
    assert float(loss.detach()) == pytest.approx(pseudo_huber(5, 2) / 2, rel=1e-5)
    loss.backward()
    assert means.grad[0].any() and means.grad[1].any() and not means.grad[3].any()
    assert losses.Track()(seen()) is None


def test_tied_tracks_go_where_their_gaussians_go():
    rng = np.random.default_rng(0)
    start = rng.uniform(-1, 1, (40, 1, 3)).astype(np.float32)
    drift = np.cumsum(rng.normal(0, 0.1, (1, 6, 3)), 1).astype(np.float32)
    gaussians = start + drift
    xyz = np.concatenate([gaussians[:5] + 0.01, np.full((1, 6, 3), 50, np.float32)])  # the last one is nowhere near
    visible = rng.random((6, 6)) < 0.7
    visible[4] = False
    uv = np.stack([project(torch.from_numpy(xyz[:, f]).float()).numpy() for f in range(6)], 1)
    frames = losses.tie_tracks(TrackSet(xyz, visible, uv=2 * uv, fps=30), gaussians, reach=2.0, scale=0.5)
    counts = [0 if f is None else len(f.uv) for f in frames]
    assert counts == visible[:4].sum(0).tolist()
    for f, sightings in enumerate(frames):
        if sightings is not None:
            s = seen(means=torch.from_numpy(gaussians[:, f]), view=(K, W2C), tracks=sightings)
            assert float(losses.Track()(s)) < 1e-6
    with pytest.raises(ValueError, match="xyz"):
        losses.tie_tracks(TrackSet(None, visible, uv=uv, fps=30), gaussians, reach=2.0)
    with pytest.raises(ValueError, match="gaussians"):
        losses.tie_tracks(TrackSet(xyz, visible, uv=uv, fps=30), gaussians[:, :3], reach=2.0)


def test_feature_is_the_mean_absolute_difference_over_the_foreground():
    given = torch.zeros(20, 30, 5)
    rendered = torch.full((20, 30, 5), 0.5)
    rendered[:10] = 2.0
    mask = torch.zeros(20, 30)
    mask[10:] = 0.5
    assert float(losses.Feature()(seen(features=rendered, given_features=given, mask=mask))) == pytest.approx(0.5)
    assert float(losses.Feature()(seen(features=rendered, given_features=given))) == pytest.approx(1.25)
    assert losses.Feature()(seen()) is None and losses.Feature().needs == {"features"}


def test_scale_hinge_is_in_footprints():
    scales = torch.tensor([[0.1, 0.2, 0.8], [0.38, 0.5, 0.0]])
    expected = (0.42 + 0.12) / 6 / 0.1
    assert float(losses.ScaleHinge()(seen(scales=scales, footprint=0.1))) == pytest.approx(expected, rel=1e-5)
    assert float(losses.ScaleHinge()(seen(scales=1000 * scales, footprint=100.0))) == pytest.approx(expected, rel=1e-5)
    assert losses.ScaleHinge()(seen()) is None


def test_windows_are_checked():
    for wrong in ({"taps": 4}, {"taps": 0}, {"sigma": 0.0}):
        with pytest.raises(ValueError, match="Window"):
            Window(**wrong)


@pytest.mark.parametrize(
    "shapes", [((5, 6, 3), (5, 5, 3), None), ((5, 6, 3), (5, 6, 3), (6, 5)), ((5, 6), (5, 6), None)]
)
def test_images_of_other_shapes_are_refused(shapes):
    x, y, usable = (None if s is None else torch.zeros(s) for s in shapes)
    with pytest.raises(ValueError, match="x, y, usable"):
        photometric(x, y, usable, 0.2, SMALL)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_cuda_the_twin_says_the_same():
    x, y = images((50, 70, 3))
    usable = torch.rand(50, 70)
    here, there = (t.clone().requires_grad_() for t in (x, x.cuda()))
    losses.Photometric()(seen(rendered=here, image=y, usable=usable)).backward()
    losses.Photometric()(seen(rendered=there, image=y.cuda(), usable=usable.cuda())).backward()
    torch.testing.assert_close(there.grad.cpu(), here.grad, rtol=0, atol=1e-4 * float(here.grad.abs().max()))
