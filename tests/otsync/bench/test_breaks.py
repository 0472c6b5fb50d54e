"""``otsync bench breaks``: pictures that a camera loses or repeats, and what is said of them."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from otsync.bench.rig.breaks import KINDS, LATEST, LOST, SHORTEST, STILL, _summary, shown
from otsync.cli import main
from tests.recording_world import write_recording


def test_what_a_broken_camera_shows():
    whole, lost, late, caught_up = (shown(kind, 5, 100, 40) for kind in KINDS)
    np.testing.assert_array_equal(whole, np.arange(5, 105))
    np.testing.assert_array_equal(lost, [*range(5, 45), *range(45 + LOST, 105)])
    np.testing.assert_array_equal(late, [*range(5, 45), *[44] * STILL, *range(45, 105 - STILL)])
    np.testing.assert_array_equal(caught_up, [*range(5, 45), *[44] * STILL, *range(45 + STILL, 105)])
    assert len(late) == len(caught_up) == 100


def test_a_trusted_answer_that_does_not_say_what_was_lost_is_wrong():
    row = {"named": 0, "flagged": False, "named of others": 1, "flagged of others": 0, "error": 0.1, "largest": 0.2}
    row |= {"trusted": 3, "of": 3, "trusted, wrong": 1, "jump off": None}
    other = row | {"named": 1, "jump off": 0.5, "trusted, wrong": 0, "error": None, "largest": None, "trusted": 0}
    told = _summary(KINDS[1], [row, other, other | {"named": 0, "flagged": True, "jump off": None}])
    assert (told["named"], told["named or flagged"], told["others named"], told["trusted, wrong"]) == (1, 2, 3, 1)
    assert told["jump off, mean"] == 0.5 and told["error, mean"] == 0.1 and told["largest"] == 0.2


def test_short_recordings_are_refused(tmp_path, capsys):
    write_recording(tmp_path, [0.0, 0.0], frames=20, balls=1)
    assert main(["bench", "breaks", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert f"two videos and more of {SHORTEST + LATEST - 1} frames" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.slow
def test_a_real_recording_is_named_or_flagged_and_never_wrong(data, tmp_path):
    args = ["bench", "breaks", str(data / "panoptic_basketball"), "--out", str(tmp_path), "--seeds", "2"]
    assert main([*args, "--first-seed", "9800"]) == 0
    with open(tmp_path / "breaks_draws.csv") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 8 and all(row["named of others"] == "0" for row in rows)
    broken = [row for row in rows if row["kind"] in KINDS[1:3]]
    assert all(int(row["named"]) or row["flagged"] == "True" for row in broken)
    assert all(int(row["named"]) == 0 for row in rows if row not in broken)
