"""Gaussians on a visual hull: on the surface that moves, in its colours, and with it; and where masks do not agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from otsync.types import Offsets
from recon.motion import BSpline, PerGaussian
from recon.scene.gaussians4d import Gaussians4D
from recon.scene.hull import followed, hull_scene
from recon.scene.seed import Seeding
from recon.simulate.capture import synthetic

STEP = 1 / 30


@pytest.fixture(scope="module")
def capture():
    return synthetic(5, cameras=6, held_out=0, frames=13, size=(96, 64), offsets=[0.0] * 6)


def begun(footage, frames=None, **options) -> Gaussians4D:
    frames = np.zeros(len(footage)) if frames is None else np.array(frames, float)
    offsets = Offsets.known([f.name for f in footage], frames * STEP, 30.0)
    about = {"frame_step": STEP, "span": (0.0, 12 * STEP), "path": BSpline.of(0.0, 12 * STEP, 3 * STEP, STEP)}
    return hull_scene(footage, offsets, **{**about, **options})


def test_seeds_lie_on_what_moves_in_its_colours_and_go_with_it(capture):
    scene = begun(capture.footage, options=Seeding(voxel=2.0))
    moving = capture.world.moving(6 * STEP)
    apart, nearest = cKDTree(moving.means.numpy()).query(scene.dynamic.means.numpy())
    voxel = 2.0 * scene.footprint
    assert len(scene) > 500 and np.quantile(apart, 0.8) < 3 * voxel
    back = cKDTree(scene.dynamic.means.numpy()).query(moving.means.numpy())[0]
    assert np.quantile(back, 0.95) < 2 * voxel  # all of it is covered
    colour = 0.5 + 0.28209479 * scene.dynamic.sh[:, 0].numpy()
    close = apart < voxel
    assert np.abs(colour[close] - capture.world.colors[nearest[close]]).mean() < 0.15
    assert isinstance(scene.motion, PerGaussian)
    ways = scene.motion.path.at_knots(scene.motion.own_knots).norm(dim=2).amax(1)
    assert ways.min() < 1e-6 * ways.max()  # at the moment of the seeds they are where they were seen
    for t in (0.0, 12 * STEP):
        there = cKDTree(capture.world.moving(t).means.numpy())
        gone, stood = (there.query(x)[0] for x in (scene.moving(t).means.numpy(), scene.dynamic.means.numpy()))
        assert np.median(gone) < 0.9 * np.median(stood)
    assert scene.motion.path.times[0] <= -STEP and scene.motion.path.times[-1] >= 13 * STEP - 1e-9
    gains = np.full((6, 3), 2.0)
    darker = begun(capture.footage, options=Seeding(voxel=2.0), gains=gains)
    half = 0.5 + 0.28209479 * darker.dynamic.sh[:, 0].numpy()
    seen = (np.abs(colour - 0.5) > 1e-4).any(1)  # grey is what stands before nothing
    assert seen.mean() > 0.9 and np.allclose(half[seen], colour[seen] / 2, atol=1e-5)


def test_masks_that_do_not_agree_still_begin_something(capture):
    """Clocks that are wrong by more than the clip is long leave few videos; one mask on its own is no hull."""
    shifted = begun(capture.footage, [0, 2, -2, 2, -2, 1])
    assert len(shifted) > 100
    with pytest.raises(ValueError, match=r"footage: expected two videos with masks.*found fewer"):
        begun(capture.footage, [0, 90, 90, 90, 90, 90])
    empty = [replace(f, masks=0 * f.masks) for f in capture.footage]
    with pytest.raises(ValueError, match="masks: expected something that two views agree on"):
        begun(empty)


def test_points_follow_a_hull_and_slow_down_where_there_is_none():
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(300, 3))
    way = np.arange(-3, 4)[:, None, None] * np.array([0.05, -0.1, 0.02])
    hulls = [cloud + step for step in way[:, 0]]
    np.testing.assert_allclose(followed(cloud, hulls, 3), np.broadcast_to(way, (7, 300, 3)), atol=0.02)
    lost = [*hulls[:5], np.zeros((0, 3)), np.zeros((0, 3))]
    found = followed(cloud, lost, 3)
    np.testing.assert_allclose(found[5] - found[4], (found[4] - found[3]) / 2, atol=1e-12)
    assert not found[3].any()
