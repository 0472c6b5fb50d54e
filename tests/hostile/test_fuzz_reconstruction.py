"""Damaged files of a reconstruction: its scene, its cameras, its checkpoint, and Gaussians of other tools."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from otsync.types import Camera, Clock, Offsets  # noqa: E402
from recon.fit.checkpoint import Checkpoint  # noqa: E402
from recon.observe import MotionBlur  # noqa: E402
from recon.result.folder import FilmedBy, load_result, save_run  # noqa: E402
from recon.scene.gaussians4d import Gaussians4D  # noqa: E402
from recon.scene.ply import load_ply, save_ply  # noqa: E402
from tests.hostile.files import Kind  # noqa: E402
from tests.hostile.fuzzing import fuzzed  # noqa: E402
from tests.recon.motion.worlds import random_scaffold, random_scene  # noqa: E402


def scene(folder: Path) -> None:
    random_scene(random_scaffold(), features=True).save(folder / "scene.npz")


def result(folder: Path) -> None:
    scene(folder)
    Offsets.known(["a", "b"], np.array([0.0, 0.5]), fps=30).save(folder / "offsets.json")
    K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    filmed = [
        FilmedBy(name, Camera(K, np.eye(4), 64, 48), Clock(), np.ones(3), np.arange(3) / 30, False, (MotionBlur(0.01),))
        for name in "ab"
    ]
    options = {"width": 64, "frames": [0, 3], "seed": 0, "layered": True, "optics": []}
    save_run(folder, filmed, options=options, frame="world", notes=["a note"], seconds={"fit": 1.0})


KINDS = (
    Kind("4D scene", "scene.npz", scene, Gaussians4D.load),
    Kind("run", "run.json", result, lambda path: load_result(path.parent)),
    Kind("result's scene", "scene.npz", result, lambda path: load_result(path.parent)),
    Kind(
        "ply",
        "scene.ply",
        lambda folder: save_ply(random_scene(random_scaffold()).at(0.1), folder / "scene.ply"),
        load_ply,
    ),
    Kind(
        "checkpoint",
        "fit.npz",
        lambda folder: random_scene(random_scaffold()).save(folder / "fit.npz"),
        lambda path: Checkpoint(path, "key").load({}),
        sound=False,
    ),
)

ALL = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)


@ALL
def test_damaged_files_are_read_or_refused(kind: Kind, tmp_path):
    assert fuzzed(kind, tmp_path, 12, seed=1) >= 1


@pytest.mark.slow
@ALL
@pytest.mark.parametrize("seed", [14, 15, 16, 17])
def test_hundreds_of_damaged_files_are_read_or_refused(kind: Kind, seed: int, tmp_path):
    assert fuzzed(kind, tmp_path, 140, seed) >= 10
