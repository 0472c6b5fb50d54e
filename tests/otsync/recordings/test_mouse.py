"""A mouse in a glass cylinder, five cameras with long lenses at 120 frames a second, whole-frame shifts put in."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from otsync.files.cache import Cache
from otsync.io import open_scene
from otsync.recordings.routes import pairs_in_pixels, select
from otsync.recordings.stages import Stages
from otsync.types import Camera, Status, Video

FIRST, FRAMES, USED = 1640, 300, 240
"""Of the recording: where the mouse runs, what is tracked, and the length of a clip."""


@pytest.fixture(scope="module")
def tracked(data):
    """Per camera its video at half size and the tracks of it, made when they are asked for."""
    scene, made = open_scene(data / "mouse"), {}

    def of(name: str):
        if name not in made:
            video = scene.videos[scene.names.index(name)]
            images = [
                cv2.resize(video.frames[k], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
                for k in range(FIRST, FIRST + FRAMES)
            ]
            c = video.camera
            K = np.diag([0.5, 0.5, 1.0]) @ c.K
            camera = Camera(K, c.w2c, c.width // 2, c.height // 2, c.distortion)
            half = Video(images, camera, 120.0, None, name)
            made[name] = half, Stages().tracking(half)
        return made[name]

    return of


@pytest.mark.slow
@pytest.mark.parametrize("cameras", ["RU", "ELR", "ELRSU"])
@pytest.mark.parametrize("seed", [12, 13])
def test_a_mouse_is_synchronised_to_about_a_frame_of_120_a_second(tracked, cameras, seed):
    rng, spare = np.random.default_rng(seed), (FRAMES - USED) // 2
    shifts = np.array([0, *(int(rng.integers(-spare, spare + 1)) for _ in cameras[1:])])
    sets = []
    for name, shift in zip(cameras, shifts, strict=True):
        video, raw = tracked(name)
        frames = slice(spare + int(shift), spare + int(shift) + USED)
        part = {"uv": raw["uv"][:, frames], "features": raw["features"]}
        clip = replace(video, frames=video.frames[frames], timestamps=None)
        sets.append(select(clip, part, Stages(), "world"))
    offsets = pairs_in_pixels(sets, 0, Stages(), Cache())
    error = offsets.seconds * 120 - shifts
    # the recording's own cameras agree to a frame, see its description: nobody can know them to a third of one
    assert all(set(flags) <= {Status.COARSE} for flags in offsets.flags)
    assert np.abs(error).max() < 1 and (np.abs(error[1:]) < 2 * offsets.sigma[1:] * 120).all()
