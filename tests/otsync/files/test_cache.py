"""The cache of stages: what was computed is read again, under a folder named in any way."""

from __future__ import annotations

import numpy as np
import pytest

from otsync.files.arrays import read_npz, write_npz
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


def test_threads_that_parse_headers_at_once_spoil_no_file(tmp_path, monkeypatch):
    """CPython 3.11 may raise SystemError then (its issue 106905); the file is as good as before."""
    write_npz(tmp_path / "a.npz", {"x": np.arange(3)})
    load, failed = np.load, []

    def now_and_then(*args, **how):
        if len(failed) < 2:
            failed.append(1)
            raise SystemError("AST constructor recursion depth mismatch (before=42, after=39)")
        return load(*args, **how)

    monkeypatch.setattr(np, "load", now_and_then)
    assert read_npz(tmp_path / "a.npz")["x"].tolist() == [0, 1, 2] and len(failed) == 2
    monkeypatch.setattr(np, "load", lambda *args, **how: (_ for _ in ()).throw(SystemError("each time")))
    with pytest.raises(ValueError, match=r"a.npz.*each time"):
        read_npz(tmp_path / "a.npz")
