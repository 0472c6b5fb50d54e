"""The example of a whole reconstruction runs, improves the clocks, and writes what it says."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from otsync.types import TrackSet

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_example_refines_offsets_and_writes_a_scene(tmp_path):
    command = [sys.executable, ROOT / "examples" / "06_reconstruct.py", "--out", str(tmp_path / "r")]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=3600, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stderr[-2000:]
    rows = re.findall(r"cam\d: +(\S+) -> +(\S+) frames \(true +(\S+)\)", done.stdout)
    before, after, true = np.array(rows, float).T
    assert np.abs(after - true).mean() < 0.06 and np.abs(after - true).max() < 0.12 < np.abs(before - true).max()
    assert float(re.search(r"held0: \S+ dB, (\S+) dB", done.stdout).group(1)) > 26
    assert len(TrackSet.load(tmp_path / "r" / "tracks.npz")) > 1000
    assert (tmp_path / "r" / "orbit.mp4").stat().st_size > 10_000
