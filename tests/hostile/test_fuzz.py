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
def test_two_thousand_damaged_files_are_read_or_refused(kind: Kind, tmp_path):
    """140 of each of 15 kinds."""
    assert fuzzed(kind, tmp_path, 140, seed=14) >= 10
