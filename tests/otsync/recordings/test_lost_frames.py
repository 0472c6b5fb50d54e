"""Real cameras without depth, one of which loses frames: where and how many is named, and all are trusted."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from otsync import Status
from otsync.bench.panoptic import Material, _solver
from otsync.files.cache import Cache
from otsync.io import open_scene
from otsync.recordings.stages import Stages
from otsync.recordings.tracking import pixel_tracks

SHIFTS = (0, 5, 11, 3)


@pytest.fixture(scope="module")
def material(data, tmp_path_factory):
    scene = open_scene(data / "panoptic_basketball")
    cache = Cache(tmp_path_factory.mktemp("stages"))
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return Material.of(scene, Stages(), cache, pool.map, lambda text: None)


def clip(material: Material, v: int, frames: np.ndarray):
    video, stages = material.scene.videos[v], material.stages
    uv = material.uv[v][:, frames]
    keep = stages.selection(uv, video.camera.width, 30.0)
    return pixel_tracks(uv[keep], material.features[v][keep], video.camera, fps=30.0, name=video.name, frame="world")


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0, 10])
@pytest.mark.parametrize("seed", range(3))
def test_of_four_cameras_the_one_that_loses_frames_is_named(material, lost, seed):
    cameras = np.random.default_rng(seed).choice(len(material.uv), 4, replace=False)
    tracks = []
    for k, v in enumerate(cameras.tolist()):
        frames = np.arange(SHIFTS[k], material.frames - 12 + SHIFTS[k])
        tracks.append(clip(material, v, np.delete(frames, np.arange(60, 60 + lost)) if k == 1 else frames))
    offsets = _solver("depth-free", Stages())(tracks)
    assert not any(Status.BROKEN_CLOCK in flags for flags in offsets.flags)
    assert [len(breaks) for breaks in offsets.breaks] == [0, int(lost > 0), 0, 0]
    for broke in offsets.breaks[1]:
        assert broke.at * 30 == pytest.approx(60) and abs(broke.jump * 30 - lost) < 0.3
    error = np.abs(offsets.seconds * 30 - SHIFTS)
    sure = [k for k in range(4) if offsets.status[k].ok]
    assert len(sure) >= 3 and error[sure].max() < 0.5
