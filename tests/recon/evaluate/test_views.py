"""A camera that no fit has seen is placed in time, and its colours found, on a scene whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from otsync.types import Clock
from recon.evaluate.views import view
from recon.motion import HermiteSpline, PerGaussian
from recon.observe import Vignetting
from recon.scene.gaussians4d import Gaussians4D
from recon.simulate.capture import synthetic
from recon.simulate.effects import DarkCorners, Rolling
from tests.recon.worlds import CAMERAS, FRAMES, SIZE, capture

STEP = 1 / 30


@pytest.fixture(scope="module")
def truth() -> Gaussians4D:
    """The simulated world itself, its motion splined through every frame."""
    c = capture()
    path = HermiteSpline.of(-0.1, FRAMES * STEP + 0.1, STEP, 0.1)
    rest = c.world.moving(0.2)
    knots = torch.as_tensor(c.world.positions(np.asarray(path.times)), dtype=torch.float32).transpose(0, 1)
    return Gaussians4D(
        rest,
        PerGaussian(path, knots - rest.means),
        footprint=0.02,
        frame_step=STEP,
        span=(0.0, (FRAMES - 1) * STEP),
        static=c.world.static,
        near=c.near,
    )


@pytest.mark.parametrize("shift", [0.0, 0.123, -0.071])
def test_the_clock_of_a_held_out_camera_is_found(truth, shift):
    footage = replace(capture().held_out[0], times=capture().held_out[0].times + shift)
    found = view(truth, footage)
    assert found.clock.how == "found"
    assert abs(found.clock.offset + shift) < 0.06 * STEP
    score = found.score(most=4)
    assert score.mean["psnr"] > 33 and score.mean["mask_psnr"] > 30  # noise of 1 % is 40 dB, depth order costs some


def test_a_known_clock_is_taken_as_it_is(truth):
    assert view(truth, capture().held_out[0], Clock(0.01)).clock == Clock(0.01, 1.0, "given")
    right = view(truth, capture().held_out[0], Clock(0.0)).score(most=4).mean["mask_psnr"]
    assert view(truth, capture().held_out[0], Clock(STEP)).score(most=4).mean["mask_psnr"] < right - 1


def test_the_gain_comes_from_what_is_static(truth):
    f = capture().held_out[0]
    gain = np.array([0.9, 1.0, 0.8])
    dim = replace(
        f, images=np.rint(f.images * gain).astype(np.uint8), background=np.rint(f.background * gain).astype(np.uint8)
    )
    np.testing.assert_allclose(view(truth, dim, Clock(0.0)).gain, view(truth, f, Clock(0.0)).gain * gain, rtol=0.01)
    # people of another colour change nothing
    moved = replace(f, images=np.where(f.masks[..., None] > 25, 255 - f.images, f.images))
    np.testing.assert_allclose(view(truth, moved, Clock(0.0)).gain, view(truth, f, Clock(0.0)).gain)


def test_frames_beyond_the_scene_are_not_compared(truth):
    f = capture().held_out[0]
    late = view(truth, f, Clock(0.2))
    assert late.score(most=50).times.max() <= truth.span[1] + 0.5 * STEP
    with pytest.raises(ValueError, match="Check its offset"):
        view(truth, f, Clock(9.0)).score()


def test_nothing_that_moves_leaves_the_clock_unknown(truth):
    f = capture().held_out[0]
    still = replace(f, masks=np.zeros_like(f.masks), boxes=np.zeros_like(f.boxes))
    with pytest.raises(ValueError, match="expected things that move"):
        view(truth, still)


def test_a_declared_readout_is_looked_through(truth):
    """The clock of a camera whose rows are read one after the other is found, and its images are slanted alike."""
    world = {"cameras": CAMERAS, "held_out": 1, "frames": FRAMES, "size": SIZE, "offsets": 0.8}
    rolled = synthetic(5, **world, effects=(Rolling(0.03),)).held_out[0]
    assert rolled.readout == 0.03
    through, plain = view(truth, rolled, Clock(0.0)), view(truth, rolled, Clock(0.0), optics=())
    assert through.score(most=6).mean["mask_psnr"] > plain.score(most=6).mean["mask_psnr"] + 1
    assert abs(view(truth, rolled).clock.offset) < 0.06 * STEP


@pytest.mark.parametrize("layered", [True, False])
def test_dark_corners_are_looked_through(truth, layered):
    """What stands still and what moves: as good as through an even lens."""
    world = {"cameras": CAMERAS, "held_out": 1, "frames": FRAMES, "size": SIZE, "offsets": 0.8}
    dark, even = synthetic(5, **world, effects=(DarkCorners(0.4),)).held_out[0], synthetic(5, **world).held_out[0]

    def score(footage, *optics) -> dict[str, float]:
        return view(truth, footage, Clock(0.0), layered=layered, optics=optics).score(most=6).mean

    through, plain, best = score(dark, Vignetting(float(np.log(0.6)))), score(dark), score(even)
    assert through["psnr"] > plain["psnr"] + 5 and through["mask_psnr"] > plain["mask_psnr"]
    assert through["psnr"] > best["psnr"] - 0.5 and through["mask_psnr"] > best["mask_psnr"] - 0.5
