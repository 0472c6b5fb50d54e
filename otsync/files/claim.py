"""A folder belongs to one command at a time: a lock against two runs in it, and no writing over another's result.

The lock is one of the operating system's on ``.otsync.lock``: it goes with the process, however that ends. The file
stays beside the result and says which command wrote it; folders without it are known by the files that they hold.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LOCK = ".otsync.lock"

MARKS = {
    "otsync run": ("offsets_coarse.json",),
    "recon fit": ("run.json", "scene.npz", "fit.npz"),
    "recon simulate": ("start.json",),
    "otsync simulate": ("truth.json",),
    "otsync sync": ("sync.json", "offsets.json"),
    "otsync demo": ("demo.json",),
    "otsync calibrate": ("calibration.html",),
    "otsync film": ("cameras.json",),
    "otsync audit": ("audit.json",),
    "otsync import-offsets": ("offsets.json",),
    "otsync export": ("timeline.otio",),
    "recon export": ("frames.json",),
    "recon render": ("00000.png",),
}
"""Files by which the result of a command is known, the surest sign first."""

OF_A_RESULT = frozenset(name for command in ("otsync run", "recon fit", "otsync sync") for name in MARKS[command]) | {
    "metrics.json",
    "strips.npz",
    "report.html",
    "sync.html",
}
"""Files of a finished result that no export may replace."""


def owner(folder: Path) -> str | None:
    """The command whose result a folder holds; None where it holds none."""
    there = {name for names in MARKS.values() for name in names if (folder / name).exists()}
    if not there:
        return None
    with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        named = json.loads((folder / LOCK).read_bytes()[:1000])["command"]
        if set(MARKS[named]) & there:
            return named
    return next(command for command, names in MARKS.items() if set(names) & there)


@contextmanager
def claimed(folder: str | os.PathLike[str], command: str, *, keep: bool = True) -> Iterator[Path]:
    """Hold ``folder`` for ``command`` while the block runs; it is made where there is none.

    Unfinished files that killed runs left in it, and in its ``stages``, are removed.

    Args:
        keep: leave the lock's file beside the result, to say whose it is. Off for folders of frames, which other
            programs read file by file.

    ValueError where the folder holds the result of another command, or where another run works in it.
    """
    folder = Path(folder)
    refuse_others(folder, command)
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    lock = _locked(folder, command)
    try:
        refuse_others(folder, command)  # another run may have ended between the first look and the lock
        if lock is not None:
            os.ftruncate(lock, 0)
            os.write(lock, json.dumps({"command": command, "pid": os.getpid()}).encode())
        clear_parts(folder, folder / "stages")
        yield folder
    finally:
        if lock is not None:
            if not keep or owner(folder) is None:  # where nothing was written, nothing is left
                with suppress(OSError):
                    (folder / LOCK).unlink()
                if made:
                    with suppress(OSError):  # it is not empty
                        folder.rmdir()
            os.close(lock)


def refuse_others(folder: Path, command: str) -> None:
    """ValueError where the folder holds the result of another command."""
    there = owner(folder)
    if there is not None and there != command:
        raise ValueError(
            f"--out: expected a folder without another command's result; {folder} holds that of {there}. Choose "
            "another folder, or delete it."
        )


def refuse_parts_of_a_result(out: Path) -> None:
    """ValueError for a file to write that is a part of a finished result, beside which it lies."""
    if out.name in OF_A_RESULT and out.exists() and owner(out.parent) is not None:
        raise ValueError(
            f"--out: expected a file that is no part of a result; {out} belongs to that of {owner(out.parent)}. "
            "Choose another name."
        )


def _locked(folder: Path, command: str) -> int | None:
    """The descriptor that holds the lock; None where the system has no such locks."""
    try:
        import fcntl
    except ModuleNotFoundError:
        return None
    path = folder / LOCK
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            told = os.read(descriptor, 1000).decode("utf-8", "replace")
            os.close(descriptor)
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):  # a file system without locks
                return None
            raise ValueError(
                f"--out: expected a folder that no other run works in; {folder} is in use{_by(told)}. Wait for that "
                "run, stop it, or choose another folder."
            ) from None
        with suppress(FileNotFoundError):
            if os.fstat(descriptor).st_ino == path.stat().st_ino:
                return descriptor
        os.close(descriptor)  # another run ended just now and took its lock away


def _by(told: str) -> str:
    with suppress(ValueError, KeyError, TypeError, RecursionError):
        about = json.loads(told)
        if about["command"] in MARKS and isinstance(about["pid"], int):
            return f" by {about['command']} (process {about['pid']})"
    return ""


def clear_parts(*folders: Path) -> None:
    """Remove unfinished files that killed writers left in ``folders`` (see :func:`otsync.files.arrays.atomic_write`).

    Those of living processes stay: another run may be writing there.
    """
    if os.name != "posix":  # elsewhere asking for a process would end it
        return
    for part in (p for folder in folders for p in folder.glob(".*.part")):
        pid = part.name.removesuffix(".part").rpartition(".")[2].partition("-")[0]
        if pid.isdecimal() and not _lives(int(pid)):
            part.unlink(missing_ok=True)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
