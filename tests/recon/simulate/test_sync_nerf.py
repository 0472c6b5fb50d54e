"""A capture in Sync-NeRF's layout is read back by the layout's reader: cameras, pictures, clocks, and the truth."""

from __future__ import annotations

import json

import numpy as np
import pytest

from otsync.io import find_reader, open_scene
from otsync.types import Offsets
from recon.simulate import Rolling, synthetic
from recon.simulate.sync_nerf import write_sync_nerf

SMALL = {"cameras": 2, "held_out": 1, "frames": 5, "size": (80, 48)}


@pytest.fixture(scope="module")
def capture():
    return synthetic(3, **SMALL, offsets=[0.0, 2.5])


def test_what_was_filmed_comes_back(capture, tmp_path):
    assert write_sync_nerf(capture, tmp_path) == ("cam_00", "cam_01", "cam_02")
    assert find_reader(tmp_path)[0] == "sync-nerf-blender"
    scene = open_scene(tmp_path)
    every = [*capture.held_out, *capture.footage]
    for video, footage in zip(scene.videos, every, strict=True):
        np.testing.assert_allclose(video.camera.K, footage.K, atol=1e-9)
        np.testing.assert_allclose(video.camera.w2c, footage.w2c, atol=1e-9)
        np.testing.assert_allclose(video.times, np.arange(5) / 30, atol=1e-6)
        for own, image in zip(video.frames, footage.images, strict=True):
            assert np.abs(own.astype(float) - image).mean() < 6  # colours at half resolution
    truth, start = (Offsets.load(tmp_path / f"{name}.json") for name in ("truth", "start"))
    assert truth.names == scene.names and truth.names[truth.reference] == "cam_01"
    np.testing.assert_allclose(truth.frames, [0, 0, 2.5], atol=1e-9)
    assert not start.seconds.any()
    told = json.loads((tmp_path / "transforms.json").read_text())
    assert len(told["frames"]) == 3 and not any("offset" in key for key in told)
    with pytest.raises(ValueError, match=r"found transforms\.json"):
        write_sync_nerf(capture, tmp_path)


def test_the_reference_is_the_first_that_is_fitted(tmp_path):
    late = synthetic(3, **SMALL, offsets=[1.0, 2.5])
    write_sync_nerf(late, tmp_path)
    np.testing.assert_allclose(Offsets.load(tmp_path / "truth.json").frames, [-1, 0, 1.5], atol=1e-9)


def test_a_rolling_shutter_has_no_place_in_it(tmp_path):
    with pytest.raises(ValueError, match="readout: expected none"):
        write_sync_nerf(synthetic(3, **SMALL, effects=(Rolling(0.02),)), tmp_path)
