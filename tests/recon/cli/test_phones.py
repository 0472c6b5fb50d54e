"""The whole way as a new user goes it: videos of uncalibrated phones in a folder, one command, a scene."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from otsync.cli import main
from otsync.types import Offsets

LENGTH = ("--width", "160", "--steps", "200", "--backdrop-steps", "300", "--views", "8", "--held-out", "phone4")


def films(folder: Path, *more: str) -> None:
    assert main(["film", str(folder), "--seed", "41", "--phones", "5", "--gap", "60", "--frames", "90", *more]) == 0


def run(folder: Path, out: Path) -> float:
    """PSNR (dB) of the held-out phone; the offsets are right."""
    code = main(["run", str(folder), "--out", str(out), "--truth", str(folder / "truth.json"), *LENGTH])
    truth, found = (Offsets.load(path) for path in (folder / "truth.json", out / "offsets_coarse.json"))
    true = np.array([truth.seconds[truth.names.index(name)] for name in found.names])
    error = np.abs((found.seconds - true + true[found.reference]) * 30)
    assert error.mean() <= 0.15, error
    assert code == 0, [(n, [f.code for f in flags]) for n, flags in zip(found.names, found.flags, strict=True)]
    return float(json.loads((out / "metrics.json").read_text())["held_out"]["psnr"])


@pytest.mark.slow
@pytest.mark.parametrize("walk", [("--walk", "300")], ids=["tripods"])
def test_four_phones_in_a_folder_become_a_scene_as_with_true_cameras(tmp_path, walk):
    films(tmp_path / "park", *walk)
    known = tmp_path / "known"
    known.mkdir()
    for file in (tmp_path / "park").iterdir():
        if file.name not in ("cameras.json", "walk.mp4"):
            shutil.copy(file, known)
    cameras = json.loads((tmp_path / "park" / "cameras.json").read_text())
    cameras["videos"] = [video for video in cameras["videos"] if video["name"] != "walk"]
    (known / "scene.json").write_text(json.dumps(cameras))
    (tmp_path / "park" / "cameras.json").unlink()
    found = run(tmp_path / "park", tmp_path / "scene")
    assert (tmp_path / "scene" / "scene.html").is_file()
    assert found > run(known, tmp_path / "beside") - 1.5
