"""Reading and writing files so that nothing is half written and no stranger's file takes the memory."""

from __future__ import annotations

import json
import os
import threading
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np

MAX_BYTES = 8 * 2**30
"""Largest total size of the arrays of one file that is read without being asked (8 GiB)."""

AGAIN = 3
"""How often a file is read once more, see :func:`beside_threads`."""

T = TypeVar("T")


@contextmanager
def atomic_write(path: str | os.PathLike[str], mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a temporary file beside ``path`` and rename it into place when the block ends well.

    An exception or Ctrl-C inside the block leaves the old file as it was and no temporary one behind.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        # created by hand, not by tempfile: the file gets the permissions that the user's umask gives any other
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        with os.fdopen(handle, mode, encoding=None if "b" in mode else "utf-8") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError as error:  # a disk that is full names no file; a temporary one's name would help nobody
        _remove(temporary)
        if error.filename is not None and str(error.filename) != str(temporary):
            raise
        raise type(error)(
            error.errno, f"cannot be written ({error.strerror or error}); nothing is half written", str(path)
        ) from None
    except BaseException:
        _remove(temporary)
        raise


def _remove(temporary: Path) -> None:
    with suppress(OSError):
        temporary.unlink(missing_ok=True)


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write ``value`` as indented JSON, atomically; nan and infinity are refused (use None)."""
    text = json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    with atomic_write(path, "w") as stream:
        stream.write(text)


def read_json(
    path: str | os.PathLike[str], *, max_bytes: int = 64 * 2**20, remedy: str = "Write it again with otsync."
) -> Any:
    """Read a JSON file of at most ``max_bytes``. ValueError with the file and the remedy for anything else."""
    path = existing(path)
    if path.stat().st_size > max_bytes:
        raise ValueError(f"{path}: expected a JSON file of at most {max_bytes} bytes; found {path.stat().st_size}.")
    try:
        return json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:  # a ValueError also for a number of more than 4300 digits
        raise ValueError(f"{path}: expected JSON; {error}. {remedy}") from None
    except OSError as error:
        raise type(error)(error.errno, f"cannot be read ({error.strerror}). Check its permissions", str(path)) from None
    except MemoryError:
        raise MemoryError(f"{path}: expected JSON that fits into memory; found too much. Cut the file.") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON. ValueError for a key that occurs twice, of which one would be dropped in silence."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice[:80]!r} occurs twice in one object; leave one of them")
    return found


def existing(path: str | os.PathLike[str]) -> Path:
    """``path`` as a Path to a regular file. FileNotFoundError names what is missing and what lies beside it."""
    path = Path(path)
    if path.is_file():
        return path
    if path.is_dir():
        raise ValueError(f"{path}: expected a file; found a folder.")
    beside = sorted(p.name for p in path.parent.glob(f"*{path.suffix}"))[:8] if path.parent.is_dir() else []
    hint = f"beside it lie {', '.join(beside)}" if beside else f"its folder holds no {path.suffix or 'such'} files"
    raise FileNotFoundError(f"{path}: no such file; {hint}. Check the path.")


def write_npz(path: str | os.PathLike[str], arrays: dict[str, np.ndarray]) -> None:
    """Write plain arrays as ``.npz``, atomically. Object arrays are refused: they would need pickle."""
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise ValueError(f"{name}: expected a plain array; found dtype {array.dtype}. Convert it first.")
    with atomic_write(path) as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def read_npz(path: str | os.PathLike[str], *, max_bytes: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """Read every array of an ``.npz`` without pickle, after checking the declared sizes against the file.

    Raises ValueError naming the file for a foreign, truncated, tampered or oversized one.
    """
    path = existing(path)
    try:
        return beside_threads(lambda: _arrays(path, max_bytes))
    except MemoryError:
        raise MemoryError(
            f"{path}: expected arrays that fit into memory; they do not. Use fewer or smaller ones."
        ) from None
    except (
        zipfile.BadZipFile,
        ValueError,
        KeyError,
        EOFError,
        OSError,
        NotImplementedError,
        zipfile.LargeZipFile,
    ) as e:
        raise ValueError(f"{path}: expected a readable .npz of plain arrays; {e}.") from None
    except Exception as error:  # zlib.error and the like: whatever a corrupted stream raises
        raise ValueError(
            f"{path}: expected a readable .npz of plain arrays; {type(error).__name__}: {error}."
        ) from None


def beside_threads(read: Callable[[], T]) -> T:
    """What ``read`` returns; called again where headers could not be parsed because other threads parsed some, too.

    CPython 3.11 raises SystemError then (its issue 106905).
    """
    for _ in range(AGAIN):
        with suppress(SystemError):
            return read()
    return read()


def _arrays(path: Path, max_bytes: int) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        total = sum(_declared_bytes(archive, info) for info in archive.infolist())
    if total > max_bytes:
        raise ValueError(f"arrays of {total} bytes, more than the {max_bytes} allowed; pass a larger max_bytes")
    with np.load(path, allow_pickle=False) as data:
        return {name: data[name] for name in data.files}


_HEADERS: dict[tuple[int, int], Callable[..., tuple[tuple[int, ...], bool, np.dtype]]] = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def _declared_bytes(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> int:
    """Bytes of one member's array by its own header, which must agree with the archive's directory."""
    with archive.open(info) as member:
        return check_declared(member, info.file_size, f"member {info.filename!r}")


def check_declared(stream: Any, length: int, what: str) -> int:
    """Bytes of an ``.npy`` array by its header. ValueError unless ``length``, of header and array, is as declared."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"{what} has the unknown .npy version {version}")
    shape, _, dtype = _HEADERS[version](stream)
    header = stream.tell()
    if dtype.hasobject:
        raise ValueError(f"{what} holds pickled objects, which are never read")
    size = dtype.itemsize
    for n in shape:
        size *= int(n)
    if any(n < 0 for n in shape) or size + header != length:
        raise ValueError(f"{what} declares {size} bytes but holds {length - header}")
    return size
