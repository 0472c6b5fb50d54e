"""Vignetting: against its formula, through other effects, for what stands still, and kept in a file."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from otsync.types import Camera, Clock
from recon.observe.effects import ImageCircle, Recorded, Rendered, RollingShutter, Shot, compose, on_still
from recon.observe.recorded import kept, optics, restored, with_declared
from recon.observe.vignetting import NO_FALLOFF, Falloff, Vignetting
from recon.result.folder import FilmedBy
from recon.simulate.effects import DarkCorners

WIDTH, HEIGHT = 64, 48
K = np.array([[50.0, 0, 30], [0, 50, 25], [0, 0, 1]])
CIRCLE = ImageCircle.of(K, (WIDTH, HEIGHT))
WHOLE = (0, 0, WIDTH, HEIGHT)

coefficients = st.floats(-1, 1)


def bright(shot: Shot) -> Rendered:
    x0, y0, x1, y1 = shot.box
    return Rendered(torch.ones(y1 - y0, x1 - x0, 3), torch.full((y1 - y0, x1 - x0, 1), 0.5))


def shot(box=WHOLE) -> Shot:
    return Shot(0, torch.tensor(0.0, dtype=torch.float64), box, HEIGHT, circle=CIRCLE)


@given(coefficients, coefficients, st.integers(0, WIDTH - 1), st.integers(0, HEIGHT - 1))
def test_every_pixel_is_as_the_formula_says(a, b, column, row):
    seen = compose(bright, (Vignetting(a, b),), {})(shot())
    r2 = ((column + 0.5 - 30) ** 2 + (row + 0.5 - 25) ** 2) / ((WIDTH**2 + HEIGHT**2) / 4)
    assert seen.rgb[row, column].numpy() == pytest.approx(np.full(3, math.exp(a * r2 + b * r2**2)), rel=1e-5)
    assert (seen.alpha == 0.5).all()


def test_a_crop_shows_what_the_image_does():
    effect, (x0, y0, x1, y1) = Vignetting(-0.3, 0.1), (7, 11, 50, 40)
    whole, part = (effect.wrap(bright, {})(shot(box)).rgb for box in (WHOLE, (x0, y0, x1, y1)))
    assert torch.equal(whole[y0:y1, x0:x1], part)
    banded = compose(bright, (RollingShutter(0.02), effect), {})(shot((x0, y0, x1, y1))).rgb
    inside = compose(bright, (effect, RollingShutter(0.02)), {})(shot((x0, y0, x1, y1))).rgb
    assert torch.equal(banded, part) and torch.equal(inside, part)


def test_what_stands_still_is_darkened_alike():
    effect = Vignetting(-0.3, 0.1)
    pictures = torch.rand(2, HEIGHT, WIDTH, 3)
    shaded = on_still((RollingShutter(0.02), effect), pictures, CIRCLE)
    assert torch.equal(shaded, pictures * effect.wrap(bright, {})(shot()).rgb)
    assert Falloff(-0.3, 0.1).corner == pytest.approx(math.exp(-0.2))


def test_a_recording_calls_for_it_where_its_static_part_shows_it():
    assert not any(isinstance(e, Vignetting) for e in with_declared((), [None]))
    assert with_declared((), [None], None, NO_FALLOFF) == ()
    assert with_declared((), [None], None, Falloff(-0.2, 0.1)) == (Vignetting(-0.2, 0.1),)
    # one that was asked for takes the same numbers, or keeps its own; measured to be none, it changes nothing
    assert with_declared((Vignetting(),), [None], None, (-0.2, 0.1)) == (Vignetting(-0.2, 0.1),)
    own = Vignetting(-0.5, 0.0)
    assert with_declared((own,), [None], None, (-0.2, 0.1)) == (own,)
    none = Vignetting().begun(Recorded((None,), falloff=NO_FALLOFF))
    assert torch.equal(none.wrap(bright, {})(shot()).rgb, bright(shot()).rgb)


def test_cameras_that_were_held_out_have_it_too():
    effect = Vignetting(-0.2, 0.1)
    assert optics((effect,), None) == (effect,) and optics((effect,), None, 1) == (effect,)


def test_a_file_keeps_it():
    effect = Vignetting(-0.2, 0.1)
    assert restored(kept((effect,))) == (effect,)
    with pytest.raises(ValueError, match="second"):
        restored([{"name": "vignetting", "second": 1e9, "fourth": 0.0}])
    for row in ({"falloff": 3}, {"second": None, "fourth": 0.0}, {"second": True, "fourth": 0.0}, {"second": -0.1}):
        with pytest.raises(ValueError, match="expected the numbers second and fourth"):
            restored([{"name": "vignetting", **row}])


@pytest.mark.parametrize(
    ("second", "fourth", "named"), [(math.nan, 0.0, "second"), (9.0, 0.0, "second"), (0.1, 9.0, "fourth")]
)
def test_no_lens_is_like_that(second, fourth, named):
    with pytest.raises(ValueError, match=f"{named}: expected a coefficient of at most 5"):
        Vignetting(second, fourth)
    with pytest.raises(ValueError, match="second: expected a number beside fourth"):
        Vignetting(fourth=0.1)


def test_what_it_lacks_it_names():
    with pytest.raises(ValueError, match="second: expected a coefficient, since no static part tells"):
        Vignetting().wrap(bright, {})
    with pytest.raises(ValueError, match="shot: expected the circle"):
        Vignetting(0.1, 0.0).wrap(bright, {})(replace(shot(), circle=None))


def test_a_camera_of_a_result_shows_its_colours():
    """At its own size and at another: the corner is as dark."""
    camera = Camera(K=K, w2c=np.eye(4), width=WIDTH, height=HEIGHT)
    video = FilmedBy(
        "a", camera, Clock(0.0), np.array([0.5, 1.0, 1.0]), np.arange(3.0), optics=(Vignetting(-0.4, 0.0),)
    )
    own = video.coloured(torch.full((HEIGHT, WIDTH, 3), 0.8))
    middle, corner = own[25, 30], own[0, 0]
    assert middle.tolist() == [102, 204, 204]
    r2 = float(CIRCLE.squared_radii((0, 0, 1, 1))[0, 0])
    assert corner[1] == pytest.approx(204 * math.exp(-0.4 * r2), abs=1)
    double = replace(camera, K=K * np.array([[2.0], [2.0], [1.0]]), width=2 * WIDTH, height=2 * HEIGHT)
    large = video.coloured(torch.full((2 * HEIGHT, 2 * WIDTH, 3), 0.8), double)
    assert abs(int(large[0, 0, 1]) - int(corner[1])) <= 2


def test_simulated_corners_lose_what_was_asked_for():
    camera = Camera(K=np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), w2c=np.eye(4), width=WIDTH, height=HEIGHT)
    shade = DarkCorners(0.3).shade(camera)
    assert shade.shape == (HEIGHT, WIDTH, 1) and shade.max() == pytest.approx(1, abs=1e-3)
    assert shade[0, 0, 0] == pytest.approx(0.7, abs=0.02)
    with pytest.raises(ValueError, match="size: expected a share"):
        DarkCorners(1.0)
