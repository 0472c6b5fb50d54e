"""Depth Anything 3's own network with random weights: several views at once, poses, and what is missing."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from otsync.cli.shell import missing_package
from otsync.priors.learned import DepthAnything3
from otsync.priors.learned.multiview import told_poses
from otsync.priors.slots import cache_key
from otsync.recordings.stages import stages_from
from otsync.types import Camera

from .test_learned import picture


@pytest.fixture(scope="module")
def weights(tmp_path_factory: Any) -> Path:
    """The smallest network as drawn, saved as its authors do; skips without the package."""
    pytest.importorskip("torch")
    cfg = pytest.importorskip("depth_anything_3.cfg", reason="pip install --no-deps depth-anything-3")
    registry = pytest.importorskip("depth_anything_3.registry")
    pytest.importorskip("depth_anything_3.model.da3", reason="pip install einops omegaconf addict")
    tensors, torch = pytest.importorskip("safetensors.torch"), sys.modules["torch"]
    torch.manual_seed(0)
    whole = torch.nn.Module()
    whole.model = cfg.create_object(cfg.load_config(registry.MODEL_REGISTRY["da3-small"]))
    home = tmp_path_factory.mktemp("da3")
    tensors.save_model(whole, str(home / "model.safetensors"))
    (home / "config.json").write_text(json.dumps({"model_name": "da3-small"}))
    return home


def cameras(count: int, step: float) -> list[Camera]:
    """Cameras side by side."""
    K = np.array([[140.0, 0, 80], [0, 140, 45], [0, 0, 1]])
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = -step * np.arange(count)
    return [Camera(K, w2c, 160, 90) for w2c in poses]


def test_views_are_seen_together_and_poses_told_where_they_move(weights, capsys):
    prior = DepthAnything3(model=str(weights), largest=112, views=3, device="cpu")
    assert prior.gives == "depth" and prior.together == 3
    images = [picture(seed=k) for k in range(3)]
    still = prior(images, cameras(3, 0.0))
    assert still.shape == (3, 56, 112) and still.dtype == np.float32 and (still > 0).all()
    moved = prior(images, cameras(3, 0.2))
    assert np.abs(moved - still).max() > 0
    unsaid = DepthAnything3(model=str(weights), largest=112, views=3, device="cpu", poses=False)
    np.testing.assert_array_equal(unsaid(images, cameras(3, 0.2)), still)
    # poses count up to the unit and the frame of the world
    np.testing.assert_allclose(prior(images, cameras(3, 7.0)), moved, atol=1e-5)
    alone = prior(images[:1], cameras(1, 0.0))
    assert alone.shape == (1, 56, 112) and np.abs(alone[0] - still[0]).max() > 0  # of one it says something else
    assert capsys.readouterr().out == ""  # results of commands go there


def test_numbers_are_chosen_and_results_kept_by_the_weights(weights, tmp_path):
    import shutil

    told = {"largest": 56, "device": "cpu"}
    exact = DepthAnything3(model=str(weights), **told)([picture()], cameras(1, 0))
    coarse = DepthAnything3(model=str(weights), **told, dtype="bfloat16")([picture()], cameras(1, 0))
    assert coarse.dtype == np.float32 and 0 < np.abs(exact - coarse).max() < 0.1
    shutil.copytree(weights, tmp_path / "elsewhere")
    assert cache_key(DepthAnything3(model=str(weights))) == cache_key(DepthAnything3(model=str(tmp_path / "elsewhere")))
    assert cache_key(DepthAnything3(model=str(weights))) != cache_key(DepthAnything3(model=str(weights), views=2))


def test_foreign_weights_are_refused(weights, tmp_path):
    tensors, torch = pytest.importorskip("safetensors.torch"), sys.modules["torch"]
    prior = DepthAnything3(model=str(tmp_path), device="cpu")
    with pytest.raises(FileNotFoundError, match=r"expected model.safetensors in it"):
        prior([picture()], cameras(1, 0))
    tensors.save_file({"model.head": torch.zeros(2)}, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"expected the weights of da3-small; backbone.* Choose network="):
        prior([picture()], cameras(1, 0))
    (tmp_path / "model.safetensors").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="expected the weights of da3-small"):
        prior([picture()], cameras(1, 0))
    (tmp_path / "config.json").write_text('{"model_name": "da9"}')
    with pytest.raises(ValueError, match=r"network: expected one of da3-base.*found 'da9'"):
        prior([picture()], cameras(1, 0))


def test_poses_are_told_in_the_first_ones_axes_and_a_unit_of_their_own():
    turned = np.array([[0.0, 0, 1, 3], [0, 1, 0, -2], [-1, 0, 0, 5], [0, 0, 0, 1]])
    here = cameras(4, 0.3)
    there = [Camera(c.K, c.w2c @ turned, 160, 90) for c in here]
    np.testing.assert_allclose(told_poses(here), told_poses(there), atol=1e-9)
    np.testing.assert_allclose(told_poses(here), told_poses(cameras(4, 30.0)), atol=1e-9)
    np.testing.assert_allclose(told_poses(here)[0], np.eye(4), atol=1e-12)
    assert told_poses(cameras(4, 0.0)) is None and told_poses(cameras(1, 1.0)) is None


def test_a_missing_package_says_how_it_is_installed(monkeypatch, tmp_path):
    pytest.importorskip("torch")
    (tmp_path / "model.safetensors").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "depth_anything_3", None)
    monkeypatch.setitem(sys.modules, "depth_anything_3.cfg", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install --no-deps depth-anything-3") as missing:
        DepthAnything3(model=str(tmp_path), device="cpu")([picture()], cameras(1, 0))
    assert "pip install --no-deps depth-anything-3" in missing_package(missing.value)
    monkeypatch.setenv("OTSYNC_WEIGHTS", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"depth: depth-anything3: expected weights at .*da3-small"):
        _ = DepthAnything3().cache_key


def test_it_stands_in_the_slot_by_name():
    assert stages_from(depth="depth-anything3:views=4").depth == DepthAnything3(views=4)
    with pytest.raises(ValueError, match="views: expected 1 or more; found 0"):
        stages_from(depth="depth-anything3:views=0")
