"""Checkpoints: what goes in comes out, and nothing else gets in."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from otsync.files import read_npz, write_npz
from recon.checkpoint import Checkpoint, Snapshot
from recon.gaussians4d import scene_arrays

from .motion_worlds import random_scene


def snapshot(step: int = 7) -> Snapshot:
    return Snapshot(
        step, 20, scene_arrays(random_scene()), {"means": torch.randn(4, 3), "offsets": torch.zeros(2).double()},
        {"means.exp_avg": torch.randn(4, 3), "means.step": torch.tensor(7.0)}, np.random.default_rng(0).normal(size=(2, 6)),
        1, torch.randn(2, 4), np.ones((3, 2)),
    )  # fmt: skip


def test_a_snapshot_comes_back_bit_by_bit(tmp_path):
    keep = Checkpoint(tmp_path / "fit.npz", "key")
    assert keep.load() is None
    before = snapshot()
    keep.save(before)
    after = keep.load()
    assert (after.step, after.steps, after.densified) == (7, 20, 1)
    assert torch.equal(after.pull, before.pull) and np.array_equal(after.since, before.since)
    for part in ("groups", "moments"):
        for name, tensor in getattr(before, part).items():
            found = getattr(after, part)[name]
            assert found.dtype == tensor.dtype and torch.equal(found, tensor)
    assert after.scene.keys() == before.scene.keys()
    assert all(np.array_equal(after.scene[k], v) for k, v in before.scene.items())
    assert np.array_equal(after.history, before.history)


def test_a_checkpoint_of_another_fit_is_refused(tmp_path):
    Checkpoint(tmp_path / "fit.npz", "one").save(snapshot())
    with pytest.raises(ValueError, match="belongs to other videos"):
        Checkpoint(tmp_path / "fit.npz", "another").load()


@pytest.mark.parametrize("damage", ["cut", "flip", "foreign", "empty"])
def test_damage_is_a_clear_error(tmp_path, damage):
    path = tmp_path / "fit.npz"
    keep = Checkpoint(path, "key")
    keep.save(snapshot())
    data = bytearray(path.read_bytes())
    if damage == "cut":
        data = data[: len(data) // 2]
    elif damage == "flip":
        data[len(data) // 3] ^= 0xFF
    elif damage == "empty":
        data = bytearray()
    path.write_bytes(bytes(data))
    if damage == "foreign":
        with open(path, "wb") as stream:
            np.savez(stream, a=np.zeros(3))
    with pytest.raises(ValueError, match=r"fit\.npz"):
        keep.load()


@pytest.mark.parametrize("part", ["scene", "fit"])
def test_a_header_of_other_things_is_a_clear_error(tmp_path, part):
    """The scene that a fit continues from is read with the rest, so that its errors name the file too."""
    for header in (b"[" * 100_000, b"[]", b"null", b'{"format":', b"\xff"):
        before = snapshot()
        before.scene["scene"] = np.frombuffer(header, np.uint8) if part == "scene" else before.scene["scene"]
        keep = Checkpoint(tmp_path / "fit.npz", "key")
        keep.save(before)
        if part == "fit":
            arrays = read_npz(tmp_path / "fit.npz")
            write_npz(tmp_path / "fit.npz", arrays | {"fit": np.frombuffer(header, np.uint8)})
        with pytest.raises(ValueError, match=r"fit\.npz: not a sound checkpoint"):
            keep.load()


def test_a_scene_whose_indices_lead_nowhere_is_refused(tmp_path):
    before = snapshot()
    before.scene["motion.binding_nodes"] = before.scene["motion.binding_nodes"] + 1000
    keep = Checkpoint(tmp_path / "fit.npz", "key")
    keep.save(before)
    with pytest.raises(ValueError, match=r"fit\.npz.*binding_nodes: expected indices"):
        keep.load()


def test_without_a_path_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    keep = Checkpoint(None, "key", every=0.0)
    assert not keep.due() and keep.load() is None
    keep.save(snapshot())
    assert not list(tmp_path.iterdir())
