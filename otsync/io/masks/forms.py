"""The forms of masks, one reader each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Bool

from ...files.arrays import read_npz
from ..frames import ImageFrames, LazyFrames, file_digest
from ..images import MAX_PIXELS, read_labels, read_mask, read_npy
from .run_lengths import RunLengths, refuse_ids

MOST_BYTES = 4 * 2**30
"""Of an ``.npz`` of masks, which is read as a whole; an ``.npy`` is not."""


class MaskReader(Protocol):
    """One form of masks."""

    @property
    def name(self) -> str: ...
    @property
    def suffixes(self) -> tuple[str, ...]: ...

    def one_a_frame(self, paths: Sequence[Path], ids: Sequence[int]) -> LazyFrames:
        """Masks of files, one a frame."""
        ...

    def of_all(self, path: Path, ids: Sequence[int]) -> LazyFrames:
        """Masks of one file for the whole video."""
        ...


def read_masks(files: Sequence[Path] | Path, kind: str | None, ids: Sequence[int] = ()) -> LazyFrames:
    """Masks (H,W) bool of every frame: of files, one a frame, or of one for all.

    Args:
        kind: name of a reader; default: the one whose suffixes fit.
        ids: of the instances that count, where a reader tells them apart; default: all but 0.
    """
    first = files if isinstance(files, Path) else files[0]
    readers = {reader.name: reader for reader in MASKS}
    fitting = [r.name for r in MASKS if first.suffix.lower() in r.suffixes]
    if kind is None and len(fitting) != 1:
        raise ValueError(f"masks.kind: expected one of {', '.join(fitting or readers)} for {first.name}; found none.")
    reader = readers[kind or fitting[0]]
    if first.suffix.lower() not in reader.suffixes:
        raise ValueError(
            f"masks.kind: expected files {', '.join(reader.suffixes)} for {reader.name!r}; found {first.name}. Choose "
            "another kind."
        )
    return reader.of_all(files, ids) if isinstance(files, Path) else reader.one_a_frame(files, ids)


@dataclass(frozen=True)
class BlackAndWhite:
    """Images whose bright half is foreground."""

    name: str = "binary"
    suffixes: tuple[str, ...] = (".png", ".jpg", ".jpeg", ".bmp")

    def one_a_frame(self, paths: Sequence[Path], ids: Sequence[int]) -> LazyFrames:
        refuse_ids(ids, self.name)
        return ImageFrames(paths, read_mask, "mask")

    def of_all(self, path: Path, ids: Sequence[int]) -> LazyFrames:
        raise ValueError(f"masks.file: expected 'frames' for images, one a frame; found {path.name}. Name it so.")


@dataclass(frozen=True)
class LabelImages:
    """Images of whole numbers, 8 or 16 bits or a palette's (DAVIS, SAM 2): each number an instance, 0 none."""

    name: str = "labels"
    suffixes: tuple[str, ...] = (".png", ".bmp")

    def one_a_frame(self, paths: Sequence[Path], ids: Sequence[int]) -> LazyFrames:
        def read(path: Path) -> Bool[np.ndarray, "H W"]:
            return chosen(read_labels(path), ids)

        return ImageFrames(paths, read, f"mask of labels {sorted(ids)}")

    def of_all(self, path: Path, ids: Sequence[int]) -> LazyFrames:
        raise ValueError(f"masks.file: expected 'frames' for images, one a frame; found {path.name}. Name it so.")


@dataclass(frozen=True)
class Stack:
    """One array of all frames: ``.npy``, read through a memory map, or ``.npz`` with one array or one named masks."""

    name: str = "stack"
    suffixes: tuple[str, ...] = (".npy", ".npz")

    def one_a_frame(self, paths: Sequence[Path], ids: Sequence[int]) -> LazyFrames:
        def read(path: Path) -> Bool[np.ndarray, "H W"]:
            return chosen(_maps(path, 2), ids)

        return ImageFrames(paths, read, f"mask of arrays {sorted(ids)}")

    def of_all(self, path: Path, ids: Sequence[int]) -> LazyFrames:
        return StackFrames(path, ids)


class StackFrames(LazyFrames):
    """Masks of one array (T,H,W), or (T,N,H,W): what any of N instances covers."""

    def __init__(self, path: Path, ids: Sequence[int]):
        self.path, self.ids = path, tuple(ids)
        self.array = _maps(path, 3)
        if ids and self.array.ndim == 4:
            raise ValueError(
                f"{path}: ids: expected an array (T,H,W) of numbers to choose from; found {self.array.shape}. Leave "
                "ids out, or keep the instances that count."
            )

    def __len__(self) -> int:
        return len(self.array)

    def frame(self, k: int) -> Bool[np.ndarray, "H W"]:
        own = np.asarray(self.array[k])
        return chosen(own, self.ids) if own.ndim == 2 else (own != 0).any(0)

    def digest(self) -> str:
        return f"{file_digest(self.path)} mask of stack {sorted(self.ids)}"


def chosen(values: np.ndarray, ids: Sequence[int]) -> Bool[np.ndarray, "H W"]:
    """Where the numbers of the instances that count stand; default: all but 0."""
    if ids and values.dtype.kind == "b":
        raise ValueError("masks.ids: expected numbers to choose from; found true and false. Leave ids out.")
    return np.isin(values, np.asarray(ids)) if len(ids) else values != 0


def _maps(path: Path, ndim: int) -> np.ndarray:
    """The array of an ``.npy`` or ``.npz``: of whole numbers or of true and false, with ``ndim`` axes, or one more."""
    if path.suffix.lower() == ".npy":
        array = read_npy(path, memmap=True)
    else:
        arrays = read_npz(path, max_bytes=MOST_BYTES)
        if len(arrays) != 1 and "masks" not in arrays:
            raise ValueError(
                f"{path}: expected one array, or one named 'masks'; found {', '.join(arrays)}. Write it again."
            )
        array = arrays["masks"] if "masks" in arrays else next(iter(arrays.values()))
    shapes = {2: "(H,W)", 3: "(T,H,W) or (T,N,H,W)"}[ndim]
    if array.dtype.kind not in "biu" or array.ndim not in ((2,) if ndim == 2 else (3, 4)) or 0 in array.shape:
        raise ValueError(
            f"{path}: expected masks {shapes} as true and false or whole numbers; found {array.dtype} of "
            f"{array.shape}. Of scores save where they are above 0."
        )
    if array.shape[-1] * array.shape[-2] > MAX_PIXELS:
        raise ValueError(f"{path}: expected masks of at most {MAX_PIXELS} pixels; found {array.shape}. Reduce them.")
    return array


MASKS: tuple[MaskReader, ...] = (BlackAndWhite(), LabelImages(), Stack(), RunLengths())
"""Forms of masks."""
