""".4dgs files are read back by the format's own library: every Gaussian is where the scene has it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from recon.raster import sh
from recon.result.export import export, export_result
from recon.result.four_dgs import FourDgs, _halfway
from tests.recon.result.test_export import blobs, scene  # noqa: F401
from tests.recon.result.test_others import result  # noqa: F401

fourdgs = pytest.importorskip("fourdgs", reason="no fourdgs: pip install 'otsync[4dgs]'")

TIMES = [0.1, 0.2, 0.35, 0.4]


def nearest(expected: np.ndarray, found: np.ndarray) -> np.ndarray:
    """For every expected centre the index of the found one that is nearest."""
    return np.linalg.norm(expected[:, None] - found[None], axis=-1).argmin(1)


def test_every_gaussian_is_where_the_scene_has_it(scene, tmp_path):  # noqa: F811
    export(scene, FourDgs(), tmp_path / "a.4dgs", TIMES, frame="studio")
    read = fourdgs.read(str(tmp_path / "a.4dgs"))
    assert read.duration_sec == pytest.approx(0.3 + 1 / 30)
    told = read.header.attributes
    assert told["frame"] == "studio" and float(told["zero"]) == 0.1
    bound = 3**0.5 * 1.05 * 0.02 * float(np.median(scene.at(0.1).log_scales.exp().numpy())) * 2
    for n, t in enumerate(TIMES):
        state, expected = read.state_at(t - TIMES[0]), scene.at(t)
        assert len(state["centers"]) == 55
        order = nearest(expected.means.numpy(), state["centers"])
        assert sorted(order) == list(range(55))
        np.testing.assert_allclose(state["centers"][order], expected.means.numpy(), atol=bound)
        alpha = torch.sigmoid(expected.opacity_logits).numpy()
        np.testing.assert_allclose(state["opacity"][order], alpha, atol=0.003)
        own = state["indices"][order]
        np.testing.assert_allclose(read.gaussians.scales[own], expected.log_scales.exp().numpy(), rtol=0.006)
        colours = (0.5 + sh.C0 * expected.sh[:, 0]).clamp(0, 1).numpy()
        np.testing.assert_allclose(read.gaussians.colors[own, :3], colours, atol=0.003)
        after = scene.at(TIMES[min(n + 1, 3)]).quats.numpy()
        for q in (expected.quats.numpy(), after):  # xyzw, half-way between two frames; these ones do not turn
            q = q / np.linalg.norm(q, axis=1, keepdims=True)
            cosine = np.abs((state["orientations"][order] * q[:, [1, 2, 3, 0]]).sum(1))
            assert cosine.min() > 0.999
    # half-way between two frames: half-way along the line
    middle = 0.5 * (scene.at(0.2).means + scene.at(0.35).means).numpy()
    state = read.state_at(0.175)
    np.testing.assert_allclose(state["centers"][nearest(middle, state["centers"])], middle, atol=bound)


def test_orientations_are_half_way_between_two_frames():
    turn = np.random.default_rng(0).normal(size=(6, 3))
    before, after = Rotation.from_rotvec(0.3 * turn), Rotation.from_rotvec(0.5 * turn)
    middle = _halfway(-2 * before.as_quat(scalar_first=True), after.as_quat(scalar_first=True))
    apart = Rotation.from_rotvec(0.4 * turn).inv() * Rotation.from_quat(middle)
    np.testing.assert_allclose(apart.magnitude(), 0, atol=1e-7)


def test_a_moment_and_what_depends_on_the_view_are_kept(scene, tmp_path):  # noqa: F811
    g = torch.Generator().manual_seed(5)
    bright = replace(scene, dynamic=replace(blobs(40), sh=0.3 * torch.randn(40, 9, 3, generator=g)))
    export(bright, FourDgs(), tmp_path / "a.4dgs", [0.5])
    read = fourdgs.read(str(tmp_path / "a.4dgs"))
    state = read.state_at(0.0)
    expected = bright.moving(0.5)
    order = state["indices"][nearest(expected.means.numpy(), state["centers"])]
    assert read.gaussians.sh_degree == 2 and read.gaussians.sh.shape == (55, 24)
    values = read.gaussians.sh[order] / 255 * 8 - 4
    np.testing.assert_allclose(values.reshape(40, 3, 8).transpose(0, 2, 1), expected.sh[:, 1:].numpy(), atol=0.017)


def test_a_player_begins_where_the_first_camera_stood(result, tmp_path):  # noqa: F811
    export_result(result, FourDgs(), tmp_path / "a.4dgs", TIMES)
    camera = fourdgs.read(str(tmp_path / "a.4dgs")).camera
    first = result.videos[0].camera
    np.testing.assert_allclose(camera.position, first.center, atol=1e-6)
    np.testing.assert_allclose(camera.fov_y_deg, 2 * np.degrees(np.arctan(24 / 60)), atol=1e-6)
    ahead = np.array(camera.target) - camera.position
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), first.w2c[2, :3], atol=1e-6)


def test_too_many_gaussians_are_refused(scene, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr("recon.result.four_dgs.MOST", 100)
    with pytest.raises(ValueError, match="fewer frames a second"):
        export(scene, FourDgs(), tmp_path / "a.4dgs", TIMES)
