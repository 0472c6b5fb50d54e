"""Formats of other programs, read back by their own conventions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData

from otsync.io.tracks import TrackFile
from otsync.types import Camera, Clock, Offsets
from recon.raster import sh
from recon.result.export import export, export_result
from recon.result.folder import FilmedBy, SavedReconstruction
from recon.result.others import Dynamic3DGaussians, SuperSplat, TapVid3D, shortest_turn, turned_harmonics, upright
from tests.recon.result.test_export import blobs, scene  # noqa: F401

TIMES = [0.1, 0.4, 0.8]


@pytest.fixture
def result(scene):  # noqa: F811
    """Two cameras that stand on a wall: the world's x axis is up."""
    up = np.array([1.0, 0.0, 0.0])
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    videos = []
    for name, eye in (("a", [0.3, 4.0, 0.2]), ("b", [-0.2, 0.5, 4.0])):
        camera = Camera(K, pose(np.array(eye), up), 64, 48)
        videos.append(FilmedBy(name, camera, Clock(), np.ones(3), np.arange(30) / 30))
    return SavedReconstruction(scene, Offsets.known(["a", "b"], np.zeros(2), 30), tuple(videos))


def pose(eye: np.ndarray, up: np.ndarray) -> np.ndarray:
    """w2c of a camera that looks at the origin, its upper edge along ``up``."""
    ahead = -eye / np.linalg.norm(eye)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(ahead, right), ahead])
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = R, -R @ eye
    return w2c


def test_dynamic3dgaussians_parameters_say_where_every_gaussian_is(result, scene, tmp_path):  # noqa: F811
    export_result(result, Dynamic3DGaussians(), tmp_path / "params.npz", TIMES)
    with np.load(tmp_path / "params.npz") as params:
        assert params["means3D"].shape == (3, 55, 3) and params["unnorm_rotations"].shape == (3, 55, 4)
        assert params["cam_m"].shape == (2, 3) and params["logit_opacities"].shape == (55, 1)
        for n, t in enumerate(TIMES):
            moment = scene.at(t)
            np.testing.assert_array_equal(params["means3D"][n], moment.means.numpy())
            np.testing.assert_array_equal(params["unnorm_rotations"][n], moment.quats.numpy())
        np.testing.assert_array_equal(params["log_scales"], moment.log_scales.numpy())
        np.testing.assert_allclose(params["rgb_colors"][1], 0.5 + sh.C0 * moment.sh[:, 0].numpy(), atol=1e-6)


def test_tracks_of_tapvid3d_project_where_the_gaussians_are(result, scene, tmp_path):  # noqa: F811
    export_result(result, TapVid3D(), tmp_path / "tapvid3d.npz", TIMES)
    camera = result.videos[0].camera
    uv = TrackFile(tmp_path / "tapvid3d.npz").read(3, (64, 48))
    expected = camera.project(scene.tracks(TIMES))
    inside = (expected >= 0).all(-1) & (expected < [64, 48]).all(-1)
    assert inside.any()
    np.testing.assert_array_equal(np.isfinite(uv[..., 0]), inside)
    np.testing.assert_allclose(uv[inside], expected[inside], atol=1e-3)
    # as TAPVid-3D's own loaders read it: (T,N,3) in the camera's axes, projected by fx, fy, cx, cy
    with np.load(tmp_path / "tapvid3d.npz") as told:
        xyz, seen, (fx, fy, cx, cy) = told["tracks_XYZ"], told["visibility"], told["fx_fy_cx_cy"]
        queries = told["queries_xyt"]
    assert xyz.shape == (3, 40, 3) and seen.shape == (3, 40) and queries.shape == (40, 3)
    at = np.stack([fx * xyz[..., 0] / xyz[..., 2] + cx, fy * xyz[..., 1] / xyz[..., 2] + cy], -1)
    np.testing.assert_array_equal(seen.T, inside)
    np.testing.assert_allclose(at.transpose(1, 0, 2)[inside], expected[inside], atol=1e-3)
    for n in np.flatnonzero(inside.any(1)):
        np.testing.assert_allclose(queries[n, :2], expected[n, int(queries[n, 2])], atol=1e-3)
    with pytest.raises(ValueError, match="needs a camera"):
        export(scene, TapVid3D(), tmp_path / "x.npz", TIMES)


def test_supersplat_shows_the_cameras_up_as_up(result, scene, tmp_path):  # noqa: F811
    export_result(result, SuperSplat(), tmp_path / "a.ply", [0.4])
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    xyz = np.stack([vertex[k] for k in "xyz"], 1)
    # SuperSplat turns by half a turn about z: then y is up, as far as the cameras tell
    shown = xyz * [-1, -1, 1]
    up = np.mean([-v.camera.w2c[1, :3] for v in result.videos], 0)
    heights = scene.at(0.4).means.numpy() @ (up / np.linalg.norm(up))
    assert np.corrcoef(shown[:, 1], heights)[0, 1] > 0.999
    apart = np.linalg.norm(xyz[:5, None] - xyz[None, :5], axis=-1)
    own = scene.at(0.4).means[:5].numpy()
    np.testing.assert_allclose(apart, np.linalg.norm(own[:, None] - own[None], axis=-1), atol=1e-5)


def test_colours_that_depend_on_the_view_turn_along():
    g = torch.Generator().manual_seed(3)
    gaussians = replace(blobs(7), sh=0.2 * torch.randn(7, 16, 3, generator=g))
    up = np.array([0.3, 0.9, -0.4])
    turned = upright(gaussians, up)
    R = torch.as_tensor(shortest_turn(up, np.array([0.0, -1.0, 0.0])), dtype=torch.float32)
    np.testing.assert_allclose(R.numpy() @ up / np.linalg.norm(up), [0, -1, 0], atol=1e-6)
    directions = torch.nn.functional.normalize(torch.randn(7, 3, generator=g), dim=1)
    before = sh.evaluate(3, directions, gaussians.sh)
    np.testing.assert_allclose(sh.evaluate(3, directions @ R.T, turned.sh).numpy(), before.numpy(), atol=1e-5)
    assert torch.equal(turned_harmonics(gaussians.sh[:, :1], R), gaussians.sh[:, :1])
    np.testing.assert_allclose(shortest_turn(up, up), np.eye(3), atol=1e-12)
    half = shortest_turn(np.array([0, 1.0, 0]), np.array([0, -1.0, 0]))
    np.testing.assert_allclose(half @ [0, 1, 0], [0, -1, 0], atol=1e-12)
