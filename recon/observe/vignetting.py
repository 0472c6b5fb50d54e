"""Vignetting: images darken from their middle to their corners."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from recon.observe.effects import Effect, ImageCircle, Observe, Params, Recorded, Rendered, Shot

STRONGEST = 5.0
"""Coefficients of a falloff beyond this are those of no lens: corners would be 150 times darker than the middle."""


class Falloff(NamedTuple):
    """``log V = second * r^2 + fourth * r^4``: the factor V of colours at a distance r from the principal point, in
    half diagonals of the image.

    The even polynomial of lens profiles (Adobe's and lensfun's "pa" model), in logarithms, so that no factor is
    negative.
    """

    second: float
    fourth: float

    @property
    def corner(self) -> float:
        """The factor at r = 1: in the corners of an image whose principal point is its middle."""
        return math.exp(self.second + self.fourth)

    def shade(self, circle: ImageCircle, box: tuple[int, int, int, int]) -> np.ndarray:
        """V [h,w,1] float32 of the pixels in ``box`` (x0, y0, x1, y1)."""
        return self.at(circle.squared_radii(box)).astype(np.float32)[..., None]

    def at(self, r2: np.ndarray) -> np.ndarray:
        """V at squared distances of r."""
        return np.exp(self.second * r2 + self.fourth * r2 * r2)


NO_FALLOFF = Falloff(0.0, 0.0)


@dataclass(frozen=True)
class Vignetting(Effect):
    """Colours times ``exp(a r^2 + b r^4)``, r from the principal point in half diagonals; one falloff for all cameras.

    What it is comes from the static part, which the cameras see at different places of their images
    (:func:`recon.backdrop.colours.first_falloff`). A rig's cameras share a lens, mostly: a falloff for each would fit
    them better, and cameras that were held out worse.

    Args:
        second, fourth: coefficients a and b; second None: both as the static part tells.
    """

    second: float | None = None
    fourth: float = 0.0
    instant: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name, value in (("second", self.second), ("fourth", self.fourth)):
            if value is not None and not abs(value) <= STRONGEST:
                raise ValueError(
                    f"{name}: expected a coefficient of at most {STRONGEST:g} either way; found {value}. Leave second "
                    "and fourth out to take what the static part tells."
                )
        if self.second is None and self.fourth:
            raise ValueError("second: expected a number beside fourth; found None. Give both, or leave both out.")

    @classmethod
    def called_for(cls, recorded: Recorded) -> Vignetting | None:
        """Wherever the static part shows it."""
        return None if recorded.falloff is None or not any(recorded.falloff) else cls(*recorded.falloff)

    def begun(self, recorded: Recorded) -> Vignetting:
        """As the static part tells, unless it has coefficients of its own."""
        return self if self.second is not None or recorded.falloff is None else type(self)(*recorded.falloff)

    @classmethod
    def restored(cls, kept: Mapping[str, Any]) -> Vignetting:
        """From both coefficients. ValueError without them."""
        if kept.keys() != {"second", "fourth"} or not all(type(x) in (int, float) for x in kept.values()):
            raise ValueError(f"vignetting: expected the numbers second and fourth; found {dict(kept)}.")
        return cls(float(kept["second"]), float(kept["fourth"]))

    def _known(self) -> Falloff:
        if self.second is None:
            raise ValueError(
                "second: expected a coefficient, since no static part tells the vignetting; found None. Give "
                "vignetting second and fourth, or leave it out."
            )
        return Falloff(self.second, self.fourth)

    def wrap(self, observe: Observe, params: Params) -> Observe:
        """Multiply the colours by the falloff."""
        falloff = self._known()
        if not any(falloff):
            return observe

        def shaded(shot: Shot) -> Rendered:
            seen = observe(shot)
            if shot.circle is None:
                raise ValueError("shot: expected the circle that vignetting is of; found none. Give Shot.circle.")
            return replace(seen, rgb=seen.rgb * torch.from_numpy(falloff.shade(shot.circle, shot.box)).to(seen.rgb))

        return shaded

    def on_still(self, image: Tensor, circle: ImageCircle) -> Tensor:
        """The same for a picture of what stands still."""
        if not any(self._known()):
            return image
        height, width = image.shape[-3:-1]
        return image * torch.from_numpy(self._known().shade(circle, (0, 0, width, height))).to(image)


def darkening_(falloff: Tensor) -> None:
    """Bring coefficients [2], in place, to those of images that darken all the way from their middle to r = 1."""
    with torch.no_grad():
        falloff[0].clamp_(-STRONGEST, 0)
        falloff[1].clamp_(-STRONGEST, float(-falloff[0] / 2))


def own_falloff(effects: Sequence[Effect]) -> Falloff | None:
    """The falloff that somebody gave; None where it is left to the static part."""
    given = [e for e in effects if isinstance(e, Vignetting) and e.second is not None]
    return Falloff(float(given[0].second or 0.0), given[0].fourth) if given else None
