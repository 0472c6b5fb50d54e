"""The cache of stages: what was computed is read again, under a folder named in any way."""

from __future__ import annotations

import numpy as np
import pytest

from otsync.files.cache import Cache


@pytest.mark.parametrize("kind", [str, lambda p: p])
def test_what_was_computed_is_read_again(tmp_path, kind):
    calls = []

    def compute():
        calls.append(1)
        return {"x": np.arange(3.0)}

    for _ in range(2):
        found = Cache(kind(tmp_path)).arrays("stage", (1, "a"), compute)
        assert found["x"].tolist() == [0, 1, 2]
    assert len(calls) == 1 and Cache(tmp_path).holds("stage", (1, "a"))
