"""Arrays as bytes for a page: quantised to what the eye can tell, and deflated. ``web/decode.js`` unpacks them."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np

KINDS = {"u1": "u8", "u2": "u16", "u4": "u32", "f4": "f32"}


class Packing:
    """Collects arrays; :attr:`entries` describes them, :meth:`text` holds them, one after the other.

    An array of more than one byte a value lies in planes, all first bytes before all second ones: they deflate better.
    """

    def __init__(self) -> None:
        self.entries: list[dict[str, Any]] = []
        self._parts: list[bytes] = []

    def whole(self, name: str, values: np.ndarray) -> None:
        """Whole numbers >= 0, in as few bytes as the largest needs."""
        kind = np.min_scalar_type(int(values.max(initial=0)))
        if values.size and (values.min() < 0 or kind.itemsize > 4):
            raise ValueError(f"{name}: expected whole numbers 0 to 2^32 - 1; found {values.min()} to {values.max()}.")
        self._put(name, values.astype(kind.newbyteorder("<")))

    def exact(self, name: str, values: np.ndarray) -> None:
        """Numbers as float32."""
        self._put(name, values.astype("<f4"))

    def measured(self, name: str, values: np.ndarray, bits: int, finest: float = np.inf) -> None:
        """Numbers in steps from the lowest to the highest of each column (the last axis), ``bits`` (8 or 16) a value.

        finest: the largest step that does; where the range asks for larger ones, the numbers stay float32.
        """
        columns = values.reshape(-1, values.shape[-1]).astype(float)
        if not len(columns):
            return self.exact(name, values)
        low, top = columns.min(0), 2**bits - 1
        step = (columns.max(0) - low) / top
        if step.max() > finest:
            return self.exact(name, values)
        steps = np.rint((columns - low) / np.where(step > 0, step, 1)).clip(0, top)
        self._put(name, steps.reshape(values.shape).astype(f"<u{bits // 8}"), low=low.tolist(), step=step.tolist())

    def _put(self, name: str, values: np.ndarray, **how: Any) -> None:
        kind = KINDS[values.dtype.str[1:]]
        self.entries.append({"name": name, "kind": kind, "shape": list(values.shape), **how})
        planes = np.frombuffer(values.tobytes(), np.uint8).reshape(-1, values.dtype.itemsize)
        self._parts.append(planes.T.tobytes())

    def text(self) -> str:
        """Everything as base64 of a zlib stream."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 9)).decode()
