"""The figures of own-frames, on answers that were made with their errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from otsync.bench.own_frames import MID, Pair, camera_errors, errors, random_similarity, summary
from otsync.simulate import simulate
from otsync.types import Alignment, Offsets, Similarity, Status

TURN = np.diag([1.0, -1.0, -1.0])


def cameras(n: int, seed: int = 0) -> tuple[list[Similarity], list[np.ndarray], Offsets]:
    """Random frames, camera centres, and the exact answer."""
    rng = np.random.default_rng(seed)
    changes, centres = [random_similarity(rng) for _ in range(n)], list(rng.normal(0, 3, (n, 3)))
    known = [changes[0].after(c.inverse()).with_covariance(1e-4 * np.eye(7)) for c in changes]
    return changes, centres, Offsets.known([f"v{k}" for k in range(n)], np.arange(n) / 30, 30, transforms=known)


def test_exact_cameras_have_no_error():
    changes, centres, offsets = cameras(6)
    rows, row = camera_errors(offsets, np.arange(6), changes, centres, 1.0)
    assert max(r["centre_error"] for r in rows) < 1e-9 and max(r["rotation_error"] for r in rows) < 1e-4
    assert row["wrong"] == 0 and row["flagged"] == 0 and row["offset_max"] < 1e-9


def test_a_camera_that_is_off_is_counted_unless_it_is_flagged():
    changes, centres, offsets = cameras(6)
    transforms = list(offsets.transforms)
    transforms[3] = replace(transforms[3], R=transforms[3].R @ TURN)
    off = replace(offsets, transforms=tuple(transforms))
    assert camera_errors(off, np.arange(6), changes, centres, 1.0)[1]["wrong"] >= 1
    late = offsets.seconds.copy()
    late[2] += 0.2
    assert camera_errors(replace(offsets, seconds=late), np.arange(6), changes, centres, 1.0)[1]["wrong"] == 1
    flags = tuple((Status.WEAK,) if v == 2 else () for v in range(6))
    told = replace(offsets, seconds=late, flags=flags)
    assert camera_errors(told, np.arange(6), changes, centres, 1.0)[1]["wrong"] == 0


@pytest.mark.parametrize(
    ("late", "turn", "flags", "right", "wrong"),
    [
        (0.0, None, (), True, False),
        (0.1, None, (), False, True),
        (0.0, TURN, (), False, True),
        (0.1, TURN, (Status.WEAK,), False, False),
        (0.008, None, (), False, False),
    ],
)
def test_what_is_right_and_what_is_wrong(late, turn, flags, right, wrong):
    (a, b), truth = simulate("boxes", own_frames=True, offsets=[0.0, 0.3], seed=1)
    T = truth.transform(0, 1)
    found = Similarity(T.scale, T.R if turn is None else T.R @ turn, T.t, 1e-4 * np.eye(7))
    row = errors(Pair("p", 40.0, a, b, 0.3, T), Alignment(0.3 + late, sigma=0.001, flags=flags, transform=found), MID)
    assert (row["right"], row["wrong"]) == (right, wrong)
    assert summary("x", [row])["wrong"] == wrong
