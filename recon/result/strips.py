"""Strips of small pictures of what the cameras filmed, for the scene page: ``strips.npz`` of a result folder."""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from otsync.compute.indices import evenly
from otsync.files.arrays import read_npz, write_npz
from recon.footage.footage import Footage

FILE = "strips.npz"
FORMAT, VERSION = "otsync.strips", 1

MOST_BYTES = 1_500_000
"""Of the strips of all videos together: with them the page of 15,000 Gaussians stays below 4 MB."""

SIZES = ((240, 48), (200, 40), (160, 40), (128, 32), (96, 24), (64, 16), (48, 8))
"""Widths of a picture in pixels and pictures of a video, the best first: the first that is small enough is taken."""

QUALITY = 62
MOST_SIDE = 16_383
"""Pixels of a side of a WebP image."""


@dataclass(frozen=True, eq=False)
class Strip:
    """Pictures of one video, in rows of ``columns`` on one WebP image.

    Args:
        times: (n,) seconds of the pictures on the video's own clock.
        size: (width, height) of a picture in pixels.
    """

    name: str
    times: Float[np.ndarray, " n"]
    columns: int
    size: tuple[int, int]
    webp: bytes


def strips_of(footage: Sequence[Footage], most_bytes: int = MOST_BYTES) -> tuple[Strip, ...]:
    """A strip of every video, as sharp as ``most_bytes`` for all of them allow.

    The number of pictures does not grow with the video. ModuleNotFoundError where there is no pillow.
    """
    strips: tuple[Strip, ...] = ()
    for width, count in SIZES:
        strips = tuple(_strip(f, width, count) for f in footage)
        if sum(len(s.webp) for s in strips) <= most_bytes:
            break
    return strips


def _strip(footage: Footage, width: int, count: int) -> Strip:
    from PIL import Image

    good = np.flatnonzero(~footage.bad)
    frames = good[evenly(len(good), count)]
    w, h = footage.size
    size = min(width, w), max(1, round(min(width, w) * h / w))
    pictures = [np.asarray(Image.fromarray(footage.images[k]).resize(size, Image.Resampling.BOX)) for k in frames]
    footage.release()
    sheet, columns = tiled(pictures)
    buffer = io.BytesIO()
    Image.fromarray(sheet).save(buffer, "WEBP", quality=QUALITY, method=4)
    return Strip(footage.name, footage.times[frames], columns, size, buffer.getvalue())


def tiled(pictures: Sequence[UInt8[np.ndarray, "h w 3"]]) -> tuple[UInt8[np.ndarray, "H W 3"], int]:
    """Pictures of one size in rows of equal length, about as many rows as fit a square; and the number of columns."""
    height, width = pictures[0].shape[:2]
    columns = max(1, min(len(pictures), MOST_SIDE // width, math.ceil(math.sqrt(len(pictures) * height / width))))
    rows = -(-len(pictures) // columns)
    sheet = np.zeros((rows * height, columns * width, 3), np.uint8)
    for n, picture in enumerate(pictures):
        y, x = n // columns * height, n % columns * width
        sheet[y : y + height, x : x + width] = picture
    return sheet, columns


def write_strips(folder: str | os.PathLike[str], strips: Sequence[Strip]) -> None:
    """Write ``strips.npz`` of a result folder, atomically."""
    about = {
        "format": FORMAT,
        "version": VERSION,
        "videos": [{"name": s.name, "columns": s.columns, "size": list(s.size)} for s in strips],
    }
    arrays = {"about": np.frombuffer(json.dumps(about).encode(), np.uint8)}
    for n, strip in enumerate(strips):
        arrays |= {f"times.{n}": strip.times, f"webp.{n}": np.frombuffer(strip.webp, np.uint8)}
    write_npz(Path(folder) / FILE, arrays)


def read_strips(folder: str | os.PathLike[str]) -> tuple[Strip, ...]:
    """The strips of a result folder; none where it holds none. ValueError names a file that is unsound."""
    path = Path(folder) / FILE
    if not path.is_file():
        return ()
    arrays = read_npz(path, max_bytes=64 * 2**20)
    try:
        about = json.loads(arrays["about"].tobytes().decode())
        if about["format"] != FORMAT or about["version"] != VERSION:
            raise ValueError("another format")
        return tuple(_read(row, arrays[f"times.{n}"], arrays[f"webp.{n}"]) for n, row in enumerate(about["videos"]))
    except (KeyError, TypeError, ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected strips of pictures; {error}. Delete it, or run the fit again.") from None


def _read(row: dict, times: np.ndarray, webp: np.ndarray) -> Strip:
    columns, (width, height) = int(row["columns"]), (int(x) for x in row["size"])
    if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or min(columns, width, height) < 1:
        raise ValueError(f"times, columns and size do not make a strip: {row!r}")
    return Strip(str(row["name"]), times.astype(float), columns, (width, height), webp.tobytes())
