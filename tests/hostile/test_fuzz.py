"""Damaged files of every kind, over all readers of otsync: no traceback, no hang, errors that name file and field."""

from __future__ import annotations

import pytest

from tests.hostile.files import KINDS, Kind
from tests.hostile.fuzzing import fuzzed

ALL = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)


@ALL
def test_damaged_files_are_read_or_refused(kind: Kind, tmp_path):
    assert fuzzed(kind, tmp_path, 12, seed=1) >= 1 or kind.name in ("mask",)


@pytest.mark.slow
@ALL
@pytest.mark.parametrize("seed", [14, 15, 16])
def test_thousands_of_damaged_files_are_read_or_refused(kind: Kind, seed: int, tmp_path):
    """140 of each of 15 kinds, with every seed."""
    assert fuzzed(kind, tmp_path, 140, seed) >= 10
