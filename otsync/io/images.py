"""Single images, masks and depth maps from files that a stranger may have written."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ..files.arrays import beside_threads, check_declared, existing, read_npz

MAX_PIXELS = 64 * 2**20
"""Largest image that is decoded (64 megapixels, 8K x 8K)."""

MOST_INSTANCES = 64
"""Largest value of a mask whose values are numbers of instances: what is black and white is bright somewhere."""

FORMATS = ("JPEG", "PNG", "BMP")
"""Decoders that are offered a stranger's bytes; Pillow knows thirty more."""


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Width and height, of the header alone. ValueError names a file that is no image, or a larger one than is read."""
    from PIL import Image

    path = existing(path)
    try:
        with Image.open(path, formats=FORMATS) as image:
            size = image.size
    except Exception as error:  # decoders raise OSError, SyntaxError, struct.error, ... on damaged bytes
        raise ValueError(
            f"{path}: expected a readable image ({', '.join(FORMATS)}); {type(error).__name__}: {error}. Copy it again."
        ) from None
    if size[0] * size[1] > MAX_PIXELS:
        raise ValueError(f"{path}: expected at most {MAX_PIXELS} pixels; found {size[0]} x {size[1]}. Reduce it.")
    return size


def read_image(path: str | os.PathLike[str]) -> UInt8[np.ndarray, "H W 3"]:
    """An RGB image. ValueError names the file when it is truncated, damaged, too large or no image at all."""
    return np.asarray(_decode(path).convert("RGB"))


def read_mask(path: str | os.PathLike[str]) -> Bool[np.ndarray, "H W"]:
    """Foreground where an image is brighter than half of its own maximum (files hold 0/1 as well as 0/255).

    An image, ``.npy``, or ``.npz`` with one array. Numbers of a palette or of 16 bits are instances: all but 0 count.
    ValueError for small numbers that can only be instances too, where some of them would be lost.
    """
    suffix = os.path.splitext(path)[1].lower()
    exact = suffix not in (".jpg", ".jpeg")
    if suffix in (".npy", ".npz"):
        values = _array(path, "mask")
        exact = values.dtype.kind in "iu"
        if values.ndim != 2 or values.dtype.kind not in "biuf":
            raise ValueError(f"{path}: expected a mask (H,W); found {values.dtype} of {values.shape}. Write it again.")
        values = np.nan_to_num(values.astype(np.float32))
    else:
        image = _decode(path)
        if image.mode == "P" or image.mode.startswith("I"):
            return np.asarray(image) != 0
        values = np.asarray(image.convert("L"))
    most = values.max(initial=0)
    if exact and most <= MOST_INSTANCES and ((values > 0) & (values < most)).any():
        some = ", ".join(f"{x:g}" for x in np.unique(values)[:5])
        raise ValueError(
            f"{path}: expected a mask of two values; found {some}, ..., which look like numbers of instances. Say so "
            'in scene.json: "masks": {"frames": ..., "kind": "labels"}, with "kind": "stack" for .npy and .npz.'
        )
    return values > most / 2


def read_labels(path: str | os.PathLike[str]) -> Int[np.ndarray, "H W"]:
    """Whole numbers of a single-channel image (8 or 16 bits, or a palette's indices); 0: no label."""
    values = np.asarray(_decode(path))
    if values.ndim != 2 or values.dtype.kind not in "iu":
        raise ValueError(
            f"{path}: expected labels (H,W) as whole numbers; found {values.dtype} of {values.shape}. Save one "
            "number a pixel in a grey PNG."
        )
    return values


def read_depth(path: str | os.PathLike[str], scale: float) -> Float[np.ndarray, "H W"]:
    """Depth along z in world units, 0 where unknown: what the file holds times ``scale``.

    A 16-bit PNG, ``.npy``, or ``.npz`` with one array.
    """
    suffix = os.path.splitext(path)[1].lower()
    values = _array(path, "depth") if suffix in (".npy", ".npz") else np.asarray(_decode(path))
    if values.ndim != 2 or values.dtype.kind not in "iuf":
        raise ValueError(f"{path}: expected a depth map (H,W) of numbers; found {values.dtype} of {values.shape}.")
    with np.errstate(invalid="ignore", over="ignore"):  # what is no number is unknown
        depth = values.astype(np.float32) * np.float32(scale)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _array(path: str | os.PathLike[str], name: str) -> np.ndarray:
    """The one array of an ``.npy`` or ``.npz``, or that of a name."""
    if os.path.splitext(path)[1].lower() == ".npy":
        return read_npy(path)
    arrays = read_npz(path, max_bytes=8 * MAX_PIXELS)
    if len(arrays) != 1 and name not in arrays:
        raise ValueError(
            f"{path}: expected one array, or one named {name!r}; found {', '.join(arrays)}. Write it again."
        )
    return arrays[name] if name in arrays else next(iter(arrays.values()))


def read_npy(path: str | os.PathLike[str], *, memmap: bool = False) -> np.ndarray:
    """A plain ``.npy`` array without pickle, its declared size checked against the file's."""
    path = existing(path)

    def read() -> np.ndarray:
        with open(path, "rb") as stream:
            check_declared(stream, path.stat().st_size, "it")
        return np.load(path, mmap_mode="r" if memmap or path.stat().st_size > 2**20 else None, allow_pickle=False)

    try:
        return beside_threads(read)
    except MemoryError:
        raise MemoryError(f"{path}: expected an array that fits into memory; it does not. Use a smaller one.") from None
    except Exception as error:  # tokenize.TokenError and the like: whatever a damaged header raises
        raise ValueError(f"{path}: expected a plain .npy array; {error}. Write it again.") from None


def _decode(path: str | os.PathLike[str]) -> Any:
    """The decoded image. Pillow checks the whole stream, where OpenCV fills a truncated JPEG with grey in silence."""
    from PIL import Image

    path = existing(path)
    try:
        with Image.open(path, formats=FORMATS) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(f"{image.width} x {image.height} pixels, more than the {MAX_PIXELS} allowed")
            image.load()
            return image.copy()
    except MemoryError:
        raise MemoryError(
            f"{path}: expected an image that fits into memory; found none left. Use smaller ones."
        ) from None
    except Exception as error:  # decoders raise OSError, SyntaxError, struct.error, ... on damaged bytes
        raise ValueError(
            f"{path}: expected a readable image ({', '.join(FORMATS)}); {type(error).__name__}: {error}. "
            "Copy the file again, or leave this frame out."
        ) from None
