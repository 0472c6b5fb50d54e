"""All videos in one picture: as filmed beside synchronised."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ..progress import counted
from .encode import write_video
from .slot import Aligned, Export, grid, reopened

GAP, BAR = 8, 30
"""Pixels between pictures, and of a line of text."""

GROUND, INK, SOFT = (14, 16, 20), (236, 238, 242), (163, 171, 186)
"""Colours, as on the scene page."""


class Mosaic(Export):
    """A video of all videos, with time stamps: on the left as filmed, when all begin together; on the right on the
    common clock."""

    name = "mosaic"
    heeds = frozenset({"width", "fps"})

    def targets(self, videos: Aligned, folder: Path) -> list[Path]:
        return [folder / "mosaic.mp4"]

    def write(self, videos: Aligned, folder: Path, *, width: int, fps: float) -> list[str]:
        ends = [float(c.as_filmed(videos.origin)[-1]) for c in videos.clips]
        times = grid(videos, (videos.span[0], max(videos.span[1], *ends)), fps)
        pictures = Pictures(videos, width)
        write_video(folder / "mosaic.mp4", _frames(pictures, times, fps), fps)
        return []


def _frames(pictures: Pictures, times: np.ndarray, fps: float) -> Iterator[tuple[float, np.ndarray]]:
    for n, t in enumerate(counted(times, "mosaic", "frame", len(times))):
        yield n / fps, pictures.at(float(t))


class Pictures:
    """Draws the mosaic of one moment.

    Args:
        width: pixels of one video's picture; all have the height of the tallest.
    """

    def __init__(self, videos: Aligned, width: int):
        from PIL import ImageFont

        clips = videos.clips

        if not 16 <= width <= 4096:
            raise ValueError(f"width: expected 16 to 4096 pixels; found {width}.")
        self.clips, self.origin, self.width = clips, videos.origin, width
        self.height = max(round(width * c.video.camera.height / c.video.camera.width) for c in clips)
        self.columns = math.ceil(math.sqrt(len(clips)))
        rows = -(-len(clips) // self.columns)
        self.side = self.columns * (width + GAP) - GAP
        self.size = 2 * self.side + 5 * GAP, BAR + rows * (self.height + GAP) + GAP
        self.font: Any = ImageFont.load_default(size=max(9, min(16, width // 14)))
        self.title: Any = ImageFont.load_default(size=16)
        # each half has its own decoders: they are seconds apart in the same files
        self.readers = [[reopened(c.video.frames) for c in clips] for _ in range(2)]
        self._last: dict[tuple[int, int], tuple[int, Any]] = {}

    def at(self, t: float) -> UInt8[np.ndarray, "H W 3"]:
        from PIL import Image, ImageDraw

        sheet = Image.new("RGB", self.size, GROUND)
        draw = ImageDraw.Draw(sheet)
        for half, title in enumerate(("as filmed", "synchronised")):
            left = GAP + half * (self.side + 3 * GAP)
            draw.text((left, 6), title, INK, font=self.title)
            draw.text((left + self.side, 6), f"{t:.3f} s", SOFT, font=self.title, anchor="ra")
            for v, clip in enumerate(self.clips):
                x = left + v % self.columns * (self.width + GAP)
                y = BAR + v // self.columns * (self.height + GAP)
                k = clip.nearest(t, self.origin if half == 0 else None)
                if k >= 0:
                    sheet.paste(self._picture(half, v, k), (x, y))
                words = f"{clip.name}  {clip.video.times[k]:.3f} s  #{k}" if k >= 0 else f"{clip.name}  –"
                box = draw.textbbox((x + 6, y + 4), words, font=self.font)
                draw.rectangle((x, y, min(box[2] + 6, x + self.width), box[3] + 4), GROUND)
                draw.text((x + 6, y + 4), words, INK, font=self.font)
        return np.asarray(sheet)

    def _picture(self, half: int, v: int, k: int) -> Any:
        from PIL import Image

        if self._last.get((half, v), (-1, None))[0] != k:
            camera = self.clips[v].video.camera
            height = max(1, round(self.width * camera.height / camera.width))
            picture = Image.fromarray(np.asarray(self.readers[half][v][k])).resize(
                (self.width, height), Image.Resampling.BOX if self.width < camera.width else Image.Resampling.BILINEAR
            )
            self._last[half, v] = k, picture
        return self._last[half, v][1]
