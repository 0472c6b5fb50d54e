"""Camera effects on a moving splat, against closed forms, per-row rendering and finite differences."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from recon.observe.effects import (
    Gain,
    MotionBlur,
    Rendered,
    RollingShutter,
    Shot,
    compose,
    initial_parameters,
    prior,
)
from recon.observe.recorded import optics, with_declared
from recon.raster import render

WIDTH, HEIGHT, FOCAL, DISTANCE = 64, 48, 200.0, 10.0
SPEED = 60.0  # pixels a second, to the right
SIGMA, OPACITY = 4.0, 0.9
COLOR = (0.2, 0.5, 0.8)


def observe(shot: Shot, backend: str = "torch", scales=(SIGMA, SIGMA)) -> Rendered:
    """One splat that is in the middle of the image at t = 0 and moves to the right."""
    x0, y0, x1, y1 = shot.box
    pixel = DISTANCE / FOCAL
    one = torch.ones(1, dtype=torch.float64)
    means = torch.stack([SPEED * shot.t * pixel, 0 * shot.t, DISTANCE + 0 * shot.t])[None]
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
    spread = torch.tensor([[scales[0] * pixel, scales[1] * pixel, 1e-3]], dtype=torch.float64)
    K = torch.tensor([[[FOCAL, 0, WIDTH / 2 - x0], [0, FOCAL, HEIGHT / 2 - y0], [0, 0, 1]]], dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64)[None]
    color = torch.tensor([COLOR], dtype=torch.float64)
    out = render(means, quats, spread, OPACITY * one, color, view, K, x1 - x0, y1 - y0, backend=backend, eps2d=0.0)
    return Rendered(out.colors[0], out.alphas[0], out.depths[0])


def shot(t: float = 0.03, box=(0, 0, WIDTH, HEIGHT), video: int = 0) -> Shot:
    return Shot(video, torch.tensor(t, dtype=torch.float64), box, HEIGHT)


def same(a: Rendered, b: Rendered) -> bool:
    return torch.equal(a.rgb, b.rgb) and torch.equal(a.alpha, b.alpha) and torch.equal(a.depth, b.depth)


def close(a: Rendered, b: Rendered) -> None:
    for name in ("rgb", "alpha", "depth"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=1e-8)


def test_nothing_composed_is_the_function_itself():
    assert compose(observe, (), {}) is observe
    assert initial_parameters((), 3) == {} and prior((), {}) is None


ABSENT = [
    (Gain(),),
    (Gain(white_balance=False),),
    (MotionBlur(0.0),),
    (MotionBlur(0.02, samples=1),),
    (RollingShutter(0.0),),
    (RollingShutter(0.02, bands=1),),
    (MotionBlur((0.0, 0.02)), RollingShutter((0.0, 0.02)), Gain()),
]


@pytest.mark.parametrize("effects", ABSENT, ids=str)
def test_an_effect_of_no_strength_changes_no_bit(effects):
    params = initial_parameters(effects, 2)
    for box in ((0, 0, WIDTH, HEIGHT), (5, 7, 40, 31)):
        seen = compose(observe, effects, params)(shot(box=box))
        if any(isinstance(e, Gain) for e in effects):
            seen = replace(seen, rgb=seen.rgb.double())
        assert same(seen, observe(shot(box=box)))
    start = prior(effects, params)
    assert start is None or float(start) == 0


def test_gain_multiplies_the_colours_of_its_video_only():
    start = torch.tensor([[1.0, 1, 1], [0.9, 1.0, 1.2]])
    effect = Gain(start)
    params = {"gain": torch.tensor([[1.0, 1, 1], [0.8, 1.1, 1.0]], requires_grad=True)}
    plain, seen = observe(shot()), compose(observe, (effect,), params)(shot(video=1))
    torch.testing.assert_close(seen.rgb, plain.rgb * params["gain"][1])
    assert torch.equal(seen.alpha, plain.alpha)
    assert torch.equal(compose(observe, (effect,), params)(shot()).rgb, plain.rgb)
    held = prior((effect,), params)
    assert float(held.detach()) == pytest.approx(0.02 * (0.01 + 0.01 + 0.04), rel=1e-5)
    (seen.rgb.sum() + held).backward()
    expected = plain.rgb.sum((0, 1)) + 0.04 * (params["gain"][1].detach() - start[1])
    torch.testing.assert_close(params["gain"].grad[1].double(), expected, rtol=1e-5, atol=0)
    assert not params["gain"].grad[0].any()
    assert torch.equal(effect.parameters(2)["gain"], start)
    assert Gain((0.9, 1.1)).parameters(2)["gain"].tolist() == [[pytest.approx(0.9)] * 3, [pytest.approx(1.1)] * 3]
    assert Gain((0.9, 1.1), white_balance=False).parameters(2)["gain"].shape == (2, 1)
    assert Gain(weight=0).prior(params) is None


def test_blur_of_a_moving_splat_is_the_integral():
    exposure, t = 0.4, 0.03
    seen = compose(observe, (MotionBlur(exposure, samples=24),), {})(shot(t))
    x = torch.arange(WIDTH, dtype=torch.float64) + 0.5 - WIDTH / 2 - SPEED * t
    y = torch.arange(HEIGHT, dtype=torch.float64) + 0.5 - HEIGHT / 2
    length = SPEED * exposure
    ends = [torch.erf((x + s * length / 2) / (math.sqrt(2) * SIGMA)) for s in (1, -1)]
    along = math.sqrt(math.pi / 2) * SIGMA / length * (ends[0] - ends[1])
    alpha = OPACITY * along * torch.exp(-0.5 * (y / SIGMA) ** 2)[:, None]
    # splats fainter than 1/255 are not drawn
    torch.testing.assert_close(seen.alpha[..., 0], alpha, rtol=0, atol=1 / 255)
    torch.testing.assert_close(seen.rgb, alpha[..., None] * torch.tensor(COLOR), rtol=0, atol=1 / 255)
    # its middle is where the splat is at the frame's moment
    middle = (seen.alpha[..., 0] * x).sum() / seen.alpha.sum()
    assert abs(float(middle)) < 0.01
    assert float(seen.depth[HEIGHT // 2, WIDTH // 2]) == pytest.approx(DISTANCE)


def test_blur_without_depth():
    def flat(shot):
        return replace(observe(shot), depth=None)

    assert compose(flat, (MotionBlur(0.1),), {})(shot()).depth is None
    assert compose(flat, (RollingShutter(0.1),), {})(shot()).depth is None


@pytest.mark.parametrize("box", [(0, 0, WIDTH, HEIGHT), (9, 11, 50, 30), (0, 20, WIDTH, 21)])
@pytest.mark.parametrize("bands", [HEIGHT, 5])
def test_rolling_shutter_is_rendering_row_by_row(box, bands):
    readout, t = 0.2, 0.03
    seen = compose(observe, (RollingShutter(readout, bands),), {})(shot(t, box))
    edges = [round(i * HEIGHT / bands) for i in range(bands + 1)]
    for row in range(box[1], box[3]):
        band = max(i for i in range(bands) if edges[i] <= row)
        middle = (edges[band] + edges[band + 1]) / 2
        alone = observe(shot(t + readout * (middle / HEIGHT - 0.5), (box[0], row, box[2], row + 1)))
        close(Rendered(*(getattr(seen, n)[row - box[1]][None] for n in ("rgb", "alpha", "depth"))), alone)
        assert abs(middle - (row + 0.5)) <= HEIGHT / bands / 2 + 0.5


def test_rolling_shutter_slants_what_moves():
    readout = 0.2

    def bar(shot):
        return observe(shot, scales=(SIGMA, 40.0))

    seen = compose(bar, (RollingShutter(readout, HEIGHT),), {})(shot(0.0))
    x = torch.arange(WIDTH, dtype=torch.float64) + 0.5 - WIDTH / 2
    centre = (seen.alpha[..., 0] * x).sum(1) / seen.alpha[..., 0].sum(1)
    row = torch.arange(HEIGHT, dtype=torch.float64) + 0.5
    torch.testing.assert_close(centre, SPEED * readout * (row / HEIGHT - 0.5), rtol=0, atol=0.02)


def test_more_bands_than_rows_and_a_box_within_one_band():
    fine = compose(observe, (RollingShutter(0.1, 3 * HEIGHT),), {})(shot())
    assert fine.rgb.shape == (HEIGHT, WIDTH, 3)
    one = compose(observe, (RollingShutter(0.1, 2),), {})(shot(box=(0, 2, WIDTH, 9)))
    close(one, observe(shot(0.03 + 0.1 * (0.25 - 0.5), (0, 2, WIDTH, 9))))


@pytest.mark.parametrize(
    "effects",
    [(MotionBlur(0.1, 4),), (RollingShutter(0.1, 6),), (MotionBlur(0.05, 2), RollingShutter(0.1, 3), Gain((1.2,)))],
    ids=str,
)
def test_the_derivative_in_time_is_that_of_finite_differences(effects):
    look = compose(observe, effects, initial_parameters(effects, 1))
    g = torch.Generator().manual_seed(0)
    weights = [torch.randn(HEIGHT, WIDTH, n, generator=g, dtype=torch.float64) for n in (3, 1)]
    # the middle of the splat, where no pixel crosses the threshold below which it is not drawn
    weights = [w * (torch.arange(HEIGHT)[:, None, None].sub(HEIGHT / 2).abs() < 6) for w in weights]
    box = (WIDTH // 2 - 6, 0, WIDTH // 2 + 6, HEIGHT)
    weights = [w[:, box[0] : box[2]] for w in weights]

    def value(t):
        seen = look(Shot(0, t, box, HEIGHT))
        return (seen.rgb * weights[0]).sum() + (seen.alpha * weights[1]).sum()

    t = torch.tensor(0.003, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(value(t), t)
    h = 1e-5
    with torch.no_grad():
        expected = (value(t + h) - value(t - h)) / (2 * h)
    assert abs(float(slope)) > 0.1
    assert float(slope) == pytest.approx(float(expected), rel=1e-6)


def test_order_is_from_the_scene_outwards():
    calls = []

    def spy(shot):
        calls.append((float(shot.t), shot.box[1]))
        return observe(shot)

    compose(spy, (MotionBlur(0.02, 2), RollingShutter(0.04, 2)), {})(shot(0.0))
    expected = [(-0.015, 0), (-0.005, 0), (0.005, HEIGHT // 2), (0.015, HEIGHT // 2)]
    assert calls == [(pytest.approx(t), row) for t, row in expected]


@pytest.mark.parametrize(
    "make, says",
    [
        (lambda: MotionBlur(-0.1), "exposure"),
        (lambda: MotionBlur((0.1, math.nan)), "exposure"),
        (lambda: MotionBlur(0.1, samples=0), "samples"),
        (lambda: RollingShutter(math.inf), "readout"),
        (lambda: RollingShutter(0.1, bands=0), "bands"),
        (lambda: initial_parameters((MotionBlur((0.1, 0.1)),), 3), "exposure"),
        (lambda: initial_parameters((RollingShutter((0.1, 0.1)),), 3), "readout"),
        (lambda: initial_parameters((Gain(torch.ones(2, 3)),), 3), "start"),
        (lambda: initial_parameters((Gain(torch.ones(3, 2)),), 3), "start"),
        (lambda: initial_parameters((Gain((1.0, 0.0)),), 2), "start"),
        (lambda: initial_parameters((Gain(), Gain()), 2), "gain"),
    ],
)
def test_bad_effects_are_refused_by_name(make, says):
    with pytest.raises(ValueError, match=says):
        make()


def test_a_declared_readout_becomes_a_shutter_once():
    blur = MotionBlur(0.01)
    assert with_declared((blur,), [None, 0.0]) == (blur,)
    assert with_declared((blur,), [None, 0.02]) == (blur, RollingShutter((0.0, 0.02)))
    own = RollingShutter(0.03)
    assert with_declared((own,), [0.02, 0.02]) == (own,)


def test_the_optics_of_one_camera():
    effects = (Gain(), MotionBlur((0.01, 0.02)), RollingShutter(0.03))
    assert optics(effects, None, 1) == (MotionBlur(0.02), RollingShutter(0.03))
    # another camera's shutter is not known, and gains are no optics
    assert optics(effects, 0.01) == (RollingShutter(0.03),)
    assert optics(effects[:2], 0.01) == (RollingShutter((0.01,)),)
    assert optics((), None) == ()


def test_effects_tell_time_by_the_cameras_own_clock():
    """In slow motion a readout and an exposure cover less of the world's time."""
    asked = []

    def watched(shot: Shot) -> Rendered:
        asked.append((round(float(shot.t), 9), round(shot.later, 9)))
        return observe(shot)

    slow = replace(shot(0.5), rate=0.25)
    MotionBlur(0.03, samples=3).wrap(watched, {})(slow)
    RollingShutter(0.04, bands=2).wrap(watched, {})(slow)
    assert asked == [(0.4975, -0.01), (0.5, 0.0), (0.5025, 0.01), (0.4975, -0.01), (0.5025, 0.01)]
