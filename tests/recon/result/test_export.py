"""Exports of a 4D scene are read back by other readers, and say the same."""

from __future__ import annotations

import json
from dataclasses import replace

import av
import numpy as np
import pytest
import torch
from plyfile import PlyData

from otsync.types import Camera, TrackSet
from recon.motion import HermiteSpline, PerGaussian
from recon.result.export import (
    Checkpoint,
    Ply,
    PlySequence,
    Splat,
    Tracks,
    check_times,
    export,
    frame_times,
    scene_tracks,
)
from recon.result.orbit import orbit
from recon.result.video import write_images
from recon.rotations import look_at
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D
from recon.scene.ply import load_ply


def blobs(n: int, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians.from_colors(
        torch.randn(n, 3, generator=g),
        torch.randn(n, 4, generator=g),
        torch.rand(n, 3, generator=g) * 0.1 + 0.02,
        torch.rand(n, generator=g) * 0.8 + 0.1,
        torch.rand(n, 3, generator=g),
    )


@pytest.fixture(scope="module")
def scene() -> Gaussians4D:
    path = HermiteSpline.of(0.0, 1.0, 0.2, 0.2)
    g = torch.Generator().manual_seed(1)
    knots = 0.3 * torch.randn(path.count, 40, 3, generator=g)
    return Gaussians4D(
        blobs(40),
        PerGaussian(path, knots),
        footprint=0.01,
        frame_step=1 / 30,
        span=(0.0, 1.0),
        static=blobs(15, 2),
        features=torch.nn.functional.normalize(torch.randn(40, 8, generator=g), dim=1),
    )


def test_a_ply_of_a_moment_holds_the_warped_means_first_and_then_the_static_ones(scene, tmp_path):
    export(scene, Ply(), tmp_path / "a.ply", [0.37])
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    xyz = np.stack([vertex[k] for k in "xyz"], 1)
    assert len(xyz) == 55
    np.testing.assert_array_equal(xyz[:40], scene.moving(0.37).means.numpy())
    np.testing.assert_array_equal(xyz[40:], scene.static.means.numpy())
    with pytest.raises(ValueError, match="one moment"):
        export(scene, Ply(), tmp_path / "b.ply", [0.1, 0.2])


def test_a_sequence_has_one_ply_a_frame_and_tells_their_seconds(scene, tmp_path):
    times = frame_times(scene, 10)
    export(scene, PlySequence(), tmp_path / "seq", times)
    told = json.loads((tmp_path / "seq" / "frames.json").read_text())["frames"]
    assert [f["seconds"] for f in told] == pytest.approx(np.arange(11) / 10)
    for frame in (told[0], told[7]):
        read = load_ply(tmp_path / "seq" / frame["file"])
        np.testing.assert_array_equal(read.means[:40].numpy(), scene.moving(frame["seconds"]).means.numpy())
    with pytest.raises(ValueError, match="another sequence"):
        export(scene, PlySequence(), tmp_path / "seq", times[:4])


def test_a_splat_file_holds_32_bytes_a_gaussian(scene, tmp_path):
    export(scene, Splat(), tmp_path / "a.splat", [0.5])
    assert (tmp_path / "a.splat").stat().st_size == 55 * 32
    record = np.frombuffer((tmp_path / "a.splat").read_bytes(), "<f4").reshape(55, 8)[:, :3]
    expected = scene.at(0.5).means.numpy()
    assert np.abs(np.sort(record, 0) - np.sort(expected, 0)).max() == 0


def test_a_checkpoint_is_the_scene_at_every_time(scene, tmp_path):
    export(scene, Checkpoint(), tmp_path / "s.npz", [])
    read = Gaussians4D.load(tmp_path / "s.npz")
    for t in (-0.1, 0.0, 0.41, 1.2):
        for a, b in zip(vars(read.at(t)).values(), vars(scene.at(t)).values(), strict=True):
            assert torch.equal(a, b)


def test_tracks_are_a_track_set_on_the_worlds_clock(scene, tmp_path):
    times = frame_times(scene)
    export(scene, Tracks(), tmp_path / "t.npz", times, frame="studio")
    read = TrackSet.load(tmp_path / "t.npz")
    assert read.frame == "studio" and len(read) == 40 and read.n_frames == 31
    np.testing.assert_allclose(read.times, times)
    np.testing.assert_array_equal(read.xyz[:, 12], scene.moving(times[12]).means.numpy())
    np.testing.assert_allclose(read.features, scene.features.numpy(), atol=1e-6)
    trained = replace(scene, features=torch.cat([torch.zeros(1, 8), 3 * scene.features[1:]]))  # one that nobody saw
    told = scene_tracks(trained, times[:2])
    told.check("tracks", features=True)
    np.testing.assert_allclose(told.features[1:], scene.features[1:].numpy(), atol=1e-6)
    assert scene_tracks(scene, times[:2]).seen.all()


def test_times_beyond_what_was_filmed_are_refused(scene, tmp_path):
    check_times(scene, [0.0, 1.0 + 1 / 30])
    for t in (-0.2, 1.2, float("nan")):
        with pytest.raises(ValueError, match="which the videos cover"):
            export(scene, Ply(), tmp_path / "a.ply", [t])
    with pytest.raises(ValueError, match="fps"):
        frame_times(scene, -3)


def ring(n: int, arc: float, radius: float = 3.0, height: float = 1.0) -> list[Camera]:
    K = np.array([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]])
    out = []
    for angle in arc * np.arange(n) / n:
        eye = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        out.append(Camera(K, look_at(eye, np.zeros(3), np.array([0, 0, 1.0])), 128, 96))
    return out


def test_an_orbit_goes_around_at_the_cameras_height_and_distance():
    poses = orbit(ring(7, 2 * np.pi), np.zeros(3), 12)
    eyes = -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3])
    np.testing.assert_allclose(eyes[:, 2], 1.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(eyes[:, :2], axis=1), 3.0)
    turn = np.unwrap(np.arctan2(eyes[:, 1], eyes[:, 0]))
    np.testing.assert_allclose(np.abs(np.diff(turn)), 2 * np.pi / 12)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1)
    # the middle of the scene lies in the middle of the image, and up is up: image rows point down
    np.testing.assert_allclose(poses[:, :2, 3], 0, atol=1e-9)
    assert (poses[:, 1, 2] < 0).all()


def test_cameras_on_one_side_give_a_swing_within_their_arc():
    poses = orbit(ring(5, np.radians(80)), np.zeros(3), 40)
    eyes = -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3])
    angle = np.degrees(np.arctan2(eyes[:, 1], eyes[:, 0]))
    assert angle.min() > 0 and angle.max() < 64  # the five stand at 0, 16, ... 64 degrees
    assert np.ptp(angle) == pytest.approx(0.9 * 64, abs=0.2)


def test_a_video_and_a_folder_hold_what_was_written(tmp_path):
    images = [np.full((31, 45, 3), 20 * k, np.uint8) for k in range(8)]
    assert write_images(iter(images), tmp_path / "v.mp4", 12.5) == 8
    with av.open(str(tmp_path / "v.mp4")) as video:
        assert float(video.streams.video[0].average_rate) == 12.5
        frames = [f.to_ndarray(format="rgb24") for f in video.decode(video=0)]
    assert len(frames) == 8 and frames[0].shape == (30, 44, 3)
    assert abs(frames[5].astype(int) - 100).max() < 6
    assert write_images(images, tmp_path / "frames") == 8
    assert sorted(p.name for p in (tmp_path / "frames").iterdir())[-1] == "00007.png"
    with pytest.raises(ValueError, match=r"\.avi"):
        write_images(images, tmp_path / "v.avi")

    def broken():
        yield images[0]
        raise RuntimeError("lost")

    with pytest.raises(RuntimeError):
        write_images(broken(), tmp_path / "w.mp4")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["frames", "v.mp4"]
