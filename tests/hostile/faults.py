"""A plugin that ends a command, holds it, or fills its disk, at a moment that is counted in files written, not in time.

FAULT: ``kill`` (SIGKILL, which nothing can catch), ``wait`` (until a line comes in), ``full`` (from there on every
write fails as on a full disk). FAULT_AT: the moment, from 1 on; every file has three: half written, before and after
it gets its name. Of a full disk the number of the file.
"""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
from typing import Any

HOW, AT = os.environ["FAULT"], int(os.environ["FAULT_AT"])
AS_WRITTEN = 100
"""Bytes of a file that still go on a full disk."""

seen = 0
fsync, replace, fdopen = os.fsync, os.replace, os.fdopen


def moment() -> None:
    """Count a moment; at the one that was asked for do it."""
    global seen
    seen += 1
    if seen != AT:
        return
    if HOW == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif HOW == "wait":
        print("waiting", flush=True)
        sys.stdin.readline()


def half_written(descriptor: int) -> None:
    if HOW == "kill" and seen + 1 == AT:
        os.ftruncate(descriptor, os.fstat(descriptor).st_size // 2)
    moment()
    fsync(descriptor)


def renamed(*args: Any, **options: Any) -> None:
    moment()
    replace(*args, **options)
    moment()


class Full(io.FileIO):
    """A file on a full disk."""

    def write(self, data: Any) -> int:
        left = AS_WRITTEN - self.tell()
        if left <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(memoryview(data)[:left])


def on_a_full_disk(descriptor: int, mode: str = "r", *args: Any, **options: Any) -> Any:
    global seen
    seen += "w" in mode
    if "w" not in mode or seen < AT:
        return fdopen(descriptor, mode, *args, **options)
    stream = io.BufferedWriter(Full(descriptor, "wb"))
    return stream if "b" in mode else io.TextIOWrapper(stream, **options)


if HOW == "full":
    os.fdopen = on_a_full_disk
else:
    os.fsync, os.replace = half_written, renamed
