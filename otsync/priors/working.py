"""Frames at the resolution that priors work at. Their pixel constants are given at 640 pixels of width."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8

WIDTH = 640


class WorkingFrames(Sequence[np.ndarray]):
    """Frames reduced to at most ``width`` pixels of width; smaller ones stay as they are.

    ``scale`` is working pixels per original pixel. Frames of another size than the first are an error.

    Args:
        keep: bytes of grey images that are kept, the first that are asked for, so that who comes later need not read
            the frames again.
    """

    def __init__(self, frames: Sequence[np.ndarray], size: tuple[int, int], width: int = WIDTH, keep: int = 0):
        self.frames = frames
        self.full = size
        self.scale = min(1.0, width / size[0])
        self.size = (max(1, round(size[0] * self.scale)), max(1, round(size[1] * self.scale)))
        #: factor for pixel constants, which are measured at 640 pixels of width
        self.unit = self.size[0] / WIDTH
        self._most = keep // (self.size[0] * self.size[1])
        self._gray: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, k: int) -> np.ndarray:  # type: ignore[override]
        import cv2

        frame = self.frames[k]
        if (frame.shape[1], frame.shape[0]) != self.full:
            raise ValueError(
                f"frame {k}: expected {self.full[0]} x {self.full[1]} pixels as the camera says; found "
                f"{frame.shape[1]} x {frame.shape[0]}. Correct width and height, or leave the frame out."
            )
        if self.scale != 1.0:
            frame = cv2.resize(frame, self.size, interpolation=cv2.INTER_AREA)
        if k not in self._gray and len(self._gray) < self._most:
            self._gray[k] = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
        return frame

    def gray(self, k: int) -> UInt8[np.ndarray, "h w"]:
        import cv2

        if k in self._gray:
            return self._gray[k]
        frame = self[k]
        return self._gray[k] if k in self._gray else cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)

    def to_full(self, uv: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
        """Working pixels (index convention: centre of the first pixel at 0) to the camera's (+0.5 convention)."""
        return (uv + 0.5) / self.scale

    def from_full(self, uv: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
        """The other way round."""
        return uv * self.scale - 0.5

    def mask(self, mask: np.ndarray) -> Bool[np.ndarray, "h w"]:
        import cv2

        if mask.shape == (self.size[1], self.size[0]):
            return mask > 0
        return cv2.resize(mask.astype(np.uint8), self.size, interpolation=cv2.INTER_NEAREST) > 0


def bilinear(image: np.ndarray, uv: Float[np.ndarray, "N 2"]) -> np.ndarray:
    """Samples of ``image`` (H,W) or (H,W,C) at pixel indices ``uv``, clamped to its border, in float32."""
    u = np.clip(uv[:, 0], 0, image.shape[1] - 1.001)
    v = np.clip(uv[:, 1], 0, image.shape[0] - 1.001)
    i, j = u.astype(int), v.astype(int)
    a, b = (u - i).astype(np.float32), (v - j).astype(np.float32)
    if image.ndim == 3:
        a, b = a[:, None], b[:, None]
    top = (1 - a) * image[j, i] + a * image[j, i + 1]
    return (1 - b) * top + b * ((1 - a) * image[j + 1, i] + a * image[j + 1, i + 1])
