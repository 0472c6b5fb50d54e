"""What a reader does with a damaged file: it reads it, or refuses it in one line that names the file and the field."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from tests.hostile.files import Kind, damaged

HANGS = 120
"""Seconds after which a reader hangs: far beyond what a busy machine needs for a file of some kilobytes."""


@contextmanager
def no_hang(what: str) -> Iterator[None]:
    def stop(number: int, frame: object) -> None:
        raise AssertionError(f"{what} hangs")

    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "SIGALRM"):
        yield
        return
    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(HANGS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def fuzzed(kind: Kind, folder: Path, count: int, seed: int) -> int:
    """Read ``count`` damaged files of a kind; how many were refused. AssertionError for a refusal that is not clean."""
    kind.write(folder)
    path = folder / kind.file
    if kind.sound:
        kind.read(path)
    sound, refused = path.read_bytes(), 0
    for n in range(count):
        content, fields = damaged(sound, kind.file, np.random.default_rng((seed, n)))
        path.write_bytes(content)
        what = f"{kind.name}, seed {seed}, file {n}"
        try:
            with no_hang(what):
                kind.read(path)
        except (ValueError, OSError, MemoryError) as error:
            refused += 1
            said = str(error)
            assert type(error) is not UnicodeEncodeError, f"{what}: {said}"
            named = any(str(folder / name) in said or name in said for name in (kind.file, *kind.others))
            assert named, f"{what}: the file is not named: {said}"
            assert "\n" not in said and said.isprintable(), f"{what}: not one line: {said!r}"
            assert "expected" in said or "no such file" in said or "occurs twice" in said, f"{what}: no remedy: {said}"
            if fields and kind.sound:
                fields += tuple(
                    f"Camera.{name.removeprefix('camera_')}" for name in fields if name.startswith("camera_")
                )
                fields += tuple(last for name in fields if (last := name.rpartition(".")[2]) != name)
                known = (*fields, "format", "version", "expected JSON", "pickled", "no files")
                assert any(name in said for name in known), f"{what}: the field {fields} is not named: {said}"
    path.write_bytes(sound)
    return refused
