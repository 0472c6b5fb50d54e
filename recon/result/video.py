"""Rendered images to a video file or a folder of PNG files."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from otsync.export.encode import CONTAINERS, write_video


def check_target(out: Path) -> None:
    """ValueError, before anything is rendered, for a target that :func:`write_images` cannot write."""
    if out.suffix and out.suffix.lower() not in CONTAINERS:
        raise ValueError(f"{out}: expected {', '.join(CONTAINERS)}, or a folder for PNG frames; found {out.suffix}.")
    if not out.suffix and out.is_file():
        raise ValueError(f"{out}: expected a folder for PNG frames; found a file. Choose another place.")


def refuse_longer(out: Path, count: int) -> None:
    """ValueError for a folder of more frames than ``count``: some would stay and look like those of this rendering."""
    stale = sorted(p.name for p in out.glob("*.png") if p.stem.isdecimal() and int(p.stem) >= count)
    if not out.suffix and stale:
        raise ValueError(
            f"{out}: expected a folder without frames of another rendering; it holds {stale[0]}. Choose another."
        )


def write_images(images: Iterable[UInt8[np.ndarray, "h w 3"]], out: str | os.PathLike[str], fps: float = 30.0) -> int:
    """Write RGB images of one size as they come, and return how many there were.

    ``out`` with the suffix of a container: H.264 at ``fps``, without an odd last row or column; else a folder for
    ``00000.png``, ``00001.png``, ... A video appears under its name once it is complete.
    """
    out = Path(out)
    check_target(out)
    return _video(images, out, fps) if out.suffix else _frames(images, out)


def _frames(images: Iterable[np.ndarray], folder: Path) -> int:
    from PIL import Image

    from otsync.files.arrays import atomic_write

    count = 0
    for image in images:
        with atomic_write(folder / f"{count:05d}.png") as stream:
            Image.fromarray(image).save(stream, "PNG")
        count += 1
    return count


def _video(images: Iterable[np.ndarray], out: Path, fps: float) -> int:
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps: expected frames per second above 0; found {fps}.")
    return write_video(out, ((n / fps, image) for n, image in enumerate(images)), fps)
