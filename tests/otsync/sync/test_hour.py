"""An hour of tracks: what it costs in memory, and that nothing is lost where memory is saved."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from otsync import TrackSet
from otsync.clocks.common import BELOW_NOISE, LONG, narrowed
from tests.docs.pages import ROOT

FRAMES, TRACKS, FPS = 108_000, 100, 30.0

OFFSET = -37.4 / FPS
"""Seconds by which b begins earlier."""


def filmed(frames: int, tracks: int, offset: float, seed: int, noise: float = 0.02) -> TrackSet:
    """Points that wander smoothly about a home of their own, with noise and gaps, in double precision."""
    world, own = np.random.default_rng(0), np.random.default_rng(seed)
    knots = np.arange(-100, frames / FPS + 100, 0.5)
    times = np.arange(frames) / FPS + offset
    xyz, features = np.empty((tracks, frames, 3)), world.normal(size=(tracks, 32))
    for m in range(tracks):
        home, moves = world.normal(0, 2, 3), world.normal(0, 0.15, (len(knots), 3))
        xyz[m] = CubicSpline(knots, home + moves)(times) + own.normal(0, noise, (frames, 3))
    visible = np.ones((tracks, frames), bool)
    for m in range(tracks):
        for first in own.integers(0, frames, frames // 5000):
            visible[m, first : first + own.integers(5, 300)] = False
    xyz[~visible] = np.nan
    order = own.permutation(tracks)
    features = features + own.normal(0, 0.3, features.shape)
    return TrackSet(xyz[order], visible[order], features[order], fps=FPS, name=f"v{seed}", frame="world")


MEASURED = """
import resource, subprocess, sys
done = subprocess.run(sys.argv[1:])
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(done.returncode)
"""


@pytest.mark.slow
def test_an_hour_of_two_videos_takes_less_than_a_gigabyte(tmp_path):
    """108,000 frames of 100 tracks each, in double precision: 540 MB of positions."""
    files = [tmp_path / "a.npz", tmp_path / "b.npz"]
    for n, path in enumerate(files):
        filmed(FRAMES, TRACKS, n * OFFSET, seed=n + 1).save(path)
    command = [sys.executable, "-m", "otsync.cli", "--quiet", "sync", *map(str, files), "--out", str(tmp_path / "out")]
    # a process between measures this one alone, not the compilers and commands of other tests
    done = subprocess.run([sys.executable, "-c", MEASURED, *command], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "out" / "offsets.json").read_text())["videos"][1]
    assert found["status"] == "ok" and abs(found["offset_seconds"] - OFFSET) < 0.02 / FPS
    unit = 1 if sys.platform == "darwin" else 1024
    assert int(done.stdout.split()[-1]) * unit < 0.95e9


def test_long_clips_in_double_precision_are_narrowed_where_rounding_is_below_noise():
    noisy = filmed(LONG, 3, 0.0, seed=1)
    few = narrowed(noisy)
    assert few.xyz.dtype == np.float32 and few.frame == noisy.frame
    rounding = np.abs(few.positions() - noisy.positions())
    assert np.nanmax(rounding) < BELOW_NOISE * 0.02
    np.testing.assert_array_equal(few.seen, noisy.seen)


@pytest.mark.parametrize("why", ["short", "without noise", "far away", "single already", "pixels"])
def test_other_clips_stay_as_they_are(why):
    clip = filmed(LONG - (why == "short"), 3, 0.0, seed=1, noise=0.0 if why == "without noise" else 0.02)
    match why:
        case "without noise":  # whoever stands still
            clip = replace(clip, xyz=np.where(clip.seen[..., None], clip.xyz[:, :1] + np.zeros(clip.xyz.shape), np.nan))
        case "far away":  # map coordinates: single precision tells decimetres there
            clip = replace(clip, xyz=clip.xyz + 4e6)
        case "single already":
            clip = replace(clip, xyz=clip.xyz.astype(np.float32))
        case "pixels":
            clip = replace(clip, xyz=None, uv=clip.xyz[..., :2])
    assert narrowed(clip) is clip
