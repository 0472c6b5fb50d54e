"""Optical flow between neighbouring frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8


@dataclass(frozen=True)
class DISFlow:
    """Dense inverse search (Kroeger et al., Fast Optical Flow using Dense Inverse Search, ECCV 2016), OpenCV's.

    The medium preset solves down to half resolution; pyramidal Lucas-Kanade measured as good and slower.
    """

    preset: Literal["fast", "medium"] = "medium"

    def pair(
        self, before: UInt8[np.ndarray, "H W"], after: UInt8[np.ndarray, "H W"]
    ) -> tuple[Float[np.ndarray, "H W 2"], Float[np.ndarray, "H W 2"]]:
        """Pixels that each point moves by, from ``before`` to ``after`` and from ``after`` back."""
        import cv2

        # the solver divides the image among OpenCV's threads and its answer depends on how many there are; videos run
        # in parallel instead
        cv2.setNumThreads(1)
        presets = {"fast": cv2.DISOPTICAL_FLOW_PRESET_FAST, "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM}
        solver: Any = cv2.DISOpticalFlow.create(presets[self.preset])
        return solver.calc(before, after, None), solver.calc(after, before, None)
