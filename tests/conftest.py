"""Shared worlds and paths."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from otsync import TrackSet
from tests.slow import mark

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    # a shell starts background jobs with Ctrl-C ignored, and children inherit that; what interrupts does is tested here
    signal.signal(signal.SIGINT, signal.default_int_handler)

# no verdict depends on how busy the machine is
settings.register_profile("otsync", deadline=None)
settings.load_profile("otsync")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    # what failed last, or comes behind it, is no whole file
    part = config.getoption("lf", False) or config.getoption("stepwise", False)
    mark(items, whole_files=not part and not any("::" in argument for argument in config.args))


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real recordings and motion files; skips where there is none."""
    for candidate in (os.environ.get("OTSYNC_DATA"), Path(__file__).parents[2] / "shared" / "data"):
        if candidate and Path(candidate).is_dir():
            return Path(candidate)
    pytest.skip("no data folder: set OTSYNC_DATA to run the tests on real recordings")


def wiggle(rng: np.random.Generator, n: int, frames: int, scale: float = 1.0) -> np.ndarray:
    """(n, frames, 3) smooth random tracks of a loosely rigid cloud: no two alike."""
    t = np.arange(frames) / 30
    cloud = rng.normal(size=(n, 1, 3))
    waves = sum(
        rng.normal(size=(n, 1, 3)) * np.sin(2 * np.pi * f * t[None, :, None] + rng.uniform(0, 6.3, (n, 1, 3)))
        for f in (0.3, 0.7, 1.3)
    )
    return scale * (cloud + 0.15 * waves)


@pytest.fixture
def pair() -> tuple[TrackSet, TrackSet, np.ndarray]:
    """Two videos of one cloud in different rigid frames, b permuted; and where each of a's tracks is in b."""
    rng = np.random.default_rng(7)
    n = 60
    xyz, features = wiggle(rng, n, 50), rng.normal(size=(n, 16))
    order = rng.permutation(n)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    a = TrackSet(xyz, features=features + 0.5 * rng.normal(size=features.shape), fps=30, name="a")
    noise = 0.5 * rng.normal(size=features.shape)
    b = TrackSet((xyz @ rotation.T + 2.0)[order], features=(features + noise)[order], fps=30, name="b")
    return a, b, np.argsort(order)
