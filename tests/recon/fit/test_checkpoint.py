"""Checkpoints: what goes in comes out, and nothing else gets in."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from otsync.files.arrays import read_npz, write_npz
from recon.fit.checkpoint import Checkpoint, Snapshot
from recon.fit.problem import scene_groups
from recon.scene.gaussians4d import scene_arrays
from tests.recon.motion.worlds import random_scaffold, random_scene

GROUPS = scene_groups(random_scene()) | {"offsets": torch.zeros(2).double(), "gain": torch.ones(2, 3)}


def snapshot(step: int = 7, n: int = 200) -> Snapshot:
    """Of a fit of two videos; n: Gaussians, as many as densification has left."""
    scene = random_scene(random_scaffold(gaussians=n), n)
    groups = scene_groups(scene) | {name: GROUPS[name] for name in ("offsets", "gain")}
    moments = {
        "means.exp_avg": torch.randn(n, 3),
        "means.exp_avg_sq": torch.rand(n, 3),
        "means.step": torch.tensor(7.0),
    }
    return Snapshot(
        step,
        20,
        scene_arrays(scene),
        groups,
        moments,
        np.random.default_rng(0).normal(size=(2, 6)),
        1,
        torch.randn(2, n),
        np.ones((3, 2)),
    )


def test_a_snapshot_comes_back_bit_by_bit(tmp_path):
    keep = Checkpoint(tmp_path / "fit.npz", "key")
    assert keep.load(GROUPS) is None
    before = snapshot()
    keep.save(before)
    after = keep.load(GROUPS)
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
        Checkpoint(tmp_path / "fit.npz", "another").load(GROUPS)


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
        keep.load(GROUPS)


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
            keep.load(GROUPS)


def test_a_scene_whose_indices_lead_nowhere_is_refused(tmp_path):
    before = snapshot()
    before.scene["motion.binding_nodes"] = before.scene["motion.binding_nodes"] + 1000
    keep = Checkpoint(tmp_path / "fit.npz", "key")
    keep.save(before)
    with pytest.raises(ValueError, match=r"fit\.npz.*binding_nodes: expected indices"):
        keep.load(GROUPS)


def test_as_many_gaussians_as_densification_left(tmp_path):
    keep = Checkpoint(tmp_path / "fit.npz", "key")
    keep.save(snapshot(n=230))
    assert len(keep.load(GROUPS).groups["means"]) == 230


@pytest.mark.parametrize(
    "change, says",
    [
        (
            {"groups/means": torch.zeros(199, 3)},
            r"groups/means: expected float32 of shape \(200, 3\); found .*\(199, 3\)",
        ),
        ({"groups/means": torch.zeros(200, 3).double()}, r"groups/means: expected float32 .*; found float64"),
        (
            {"groups/offsets": torch.zeros(3).double()},
            r"groups/offsets: expected float64 of shape \(2,\); found .*\(3,\)",
        ),
        ({"groups/gain": torch.ones(2, 4)}, r"groups/gain: expected float32 of shape \(2, 3\)"),
        ({"groups/gain": None}, r"groups: expected .*gain.*; found .*"),
        ({"groups/blur": torch.ones(1)}, r"groups: expected .*; found .*blur"),
        ({"moments/means.exp_avg": torch.zeros(3)}, r"moments/means.exp_avg: expected float32 of shape \(200, 3\)"),
        ({"moments/means.step": torch.zeros(3)}, r"moments/means.step: expected float32 of shape \(\)"),
        ({"moments/other.exp_avg": torch.zeros(3)}, r"moments/other.exp_avg: expected step, exp_avg or exp_avg_sq"),
        ({"pull": torch.zeros(2, 3)}, r"pull: expected float32 of shape \(2, 200\)"),
        ({"history": torch.zeros(5, 5).double()}, r"history: expected float64 of shape \(5, 6\)"),
        ({"history": torch.tensor(1.0)}, r"history: expected float64 of shape \(6,\)"),
        ({"since": torch.zeros(4, 2)}, r"since: expected float64 of shape \(4, 2\); found float32"),
    ],
)
def test_arrays_of_other_shapes_name_file_and_group(tmp_path, change, says):
    path = tmp_path / "fit.npz"
    keep = Checkpoint(path, "key")
    keep.save(snapshot())
    arrays = read_npz(path) | {name: None if t is None else t.numpy() for name, t in change.items()}
    write_npz(path, {name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(ValueError, match=rf"fit\.npz: not a sound checkpoint; .*{says}.*Delete it"):
        keep.load(GROUPS)


def test_without_a_path_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    keep = Checkpoint(None, "key", every=0.0)
    assert not keep.due() and keep.load(GROUPS) is None
    keep.save(snapshot())
    assert not list(tmp_path.iterdir())
