"""The renderer's example runs and writes a video that plays."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import av

ROOT = Path(__file__).parents[2]


def test_a_circling_camera_becomes_a_video(tmp_path):
    command = [sys.executable, ROOT / "examples" / "05_render.py", "--frames", "6", "--width", "96", "--height", "64"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=3600, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stderr[-2000:]
    with av.open(str(tmp_path / "circle.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == 6 and frames[0].shape == (64, 96, 3)
    assert all(frame.max() > 100 for frame in frames)
    assert abs(frames[0].astype(int) - frames[3]).mean() > 5  # the camera moved
    assert (tmp_path / "circle.ply").exists()
