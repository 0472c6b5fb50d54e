"""Effects of a camera on the light of one instant, as wrappers of the function that renders it.

An ``Observe`` renders what the Gaussians show of one video at one world time. An effect takes an Observe and gives
another: it may ask for several instants (motion blur), for other rows at other times (rolling shutter), or change the
colours (gain). Effects stand in a tuple, the one nearest to the scene first; what is not in the tuple is not computed.

The moment of a frame is the middle of its exposure and of its readout, as in the simulator: the middle row is read at
``t``. Sensors that stamp the beginning shift all frames of a video alike, which is absorbed by the video's offset.

Effects act on what is rendered, *before* a cached backdrop is put behind it: the backdrop is a picture by the camera
itself and has been through its effects already. A camera that was held out has no such picture: what is static is
rendered for it, and put through the effects by ``on_still``.

An effect is one class, which says all that others must know of it: what it learns (``groups``, ``parameters``,
``prior``), how it acts (``wrap``), whether a recording calls for it by itself (``called_for``, ``begun``), how one
camera looks through it once the fit is done (``alone``), and how ``run.json`` keeps it (``kept``, ``restored``).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from otsync.clocks.shutter import check_within_a_frame
from recon.scene.groups import Group

Params = Mapping[str, Tensor]


@dataclass(frozen=True)
class ImageCircle:
    """Where the principal point of a camera's images is, and how far their corners are from their middle.

    Args:
        x, y: the principal point, pixels of the working image. radius: half of the image's diagonal, pixels.
    """

    x: float
    y: float
    radius: float

    @classmethod
    def of(cls, K: Any, size: tuple[int, int]) -> ImageCircle:
        """Of a camera matrix [3,3] and the image's (width, height)."""
        return cls(float(K[0, 2]), float(K[1, 2]), math.hypot(*size) / 2)

    def squared_radii(self, box: tuple[int, int, int, int]) -> np.ndarray:
        """Squared distances [h,w] of the pixels in ``box`` (x0, y0, x1, y1) from the principal point, in half
        diagonals."""
        x0, y0, x1, y1 = box
        return self.squared(np.arange(x0, x1) + 0.5, np.arange(y0, y1)[:, None] + 0.5)

    def squared(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The same of image coordinates."""
        return ((u - self.x) / self.radius) ** 2 + ((v - self.y) / self.radius) ** 2


@dataclass(frozen=True, eq=False)
class Shot:
    """One observation that is asked for.

    Args:
        video: index of the video whose camera looks.
        t: world seconds, a float64 scalar; renderings are differentiable in it.
        box: (x0, y0, x1, y1) of the wanted crop, pixels of the working image; x1 and y1 are exclusive.
        height: rows of the whole working image, which a rolling shutter reads from the first to the last.
        frame: index of the frame. later: seconds of the camera's own clock that the instant comes after the frame's; a
            camera that moves looks from where it is then.
        rate: world seconds per second of the camera's own clock.
        circle: of the camera; None: not known.
    """

    video: int
    t: Tensor
    box: tuple[int, int, int, int]
    height: int
    frame: int = 0
    later: float = 0.0
    rate: Tensor | float = 1.0
    circle: ImageCircle | None = None

    def after(self, seconds: float) -> Shot:
        """The same a little later (or earlier, below 0) by the camera's own clock."""
        return replace(self, t=self.t + self.rate * seconds, later=self.later + seconds)


@dataclass(frozen=True, eq=False)
class Rendered:
    """What the Gaussians add to a crop of h x w pixels; nothing is behind them yet.

    Args:
        rgb: [h,w,3], weighted by alpha: the image over a backdrop is ``rgb + (1 - alpha) * backdrop``.
        alpha: [h,w,1] share of the light that is theirs.
        depth: [h,w,1] expected z in the camera frame, world units, or None.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor | None = None


Observe = Callable[[Shot], Rendered]


@dataclass(frozen=True, eq=False)
class Recorded:
    """What is known of the videos of a fit before it begins.

    Args:
        readouts: seconds from the first to the last row that each video's camera declares; None where it declares none.
        gains: (V,3) factors from the scene's colours to each video's, from the fit of the static part; None: not known.
        falloff: of all cameras' vignetting, from the same; zeros where it shows none; None: not known.
    """

    readouts: tuple[float | None, ...]
    gains: np.ndarray | None = None
    falloff: tuple[float, float] | None = None


class Effect(ABC):
    """A frozen dataclass that changes how videos are observed. Inherit from it; only :meth:`wrap` must be there."""

    groups: ClassVar[tuple[Group, ...]] = ()
    """The parameter groups that it learns, with the rates that they begin with."""

    instant: ClassVar[bool] = False
    """Whether it asks only for the frame's own instant and box: then a GPU renders the images of a step at once."""

    def parameters(self, n_videos: int) -> dict[str, Tensor]:
        """Learnable groups at their initial values, by the names of ``groups``; {} when there is nothing to learn."""
        return {}

    def prior(self, params: Params) -> Tensor | None:
        """A term of the loss that holds the parameters near where they are believed; None when there is none."""
        return None

    @abstractmethod
    def wrap(self, observe: Observe, params: Params) -> Observe:
        """``observe`` as seen through this effect."""

    @classmethod
    def called_for(cls, recorded: Recorded) -> Effect | None:
        """The effect that a recording calls for by itself, where the user gave none of this class; None: none."""
        return None

    def begun(self, recorded: Recorded) -> Effect:
        """The effect as the fit begins with it: what was left open is taken from the recording."""
        return self

    def alone(self, video: int | None, learned: Params) -> Effect | None:
        """The effect for a look through one camera, as its video 0 and without parameters.

        Args:
            video: the camera's place in the fit; None: it took no part, so that only what holds for all is known of it.
            learned: parameters that the fit came to.

        Returns:
            None where the effect does not tell how this camera sees. What learns must say so itself.
        """
        return None if self.groups else self

    def on_still(self, image: Tensor, circle: ImageCircle) -> Tensor:
        """What it makes of a picture [...,h,w,3] of what stands still, beyond a gain; shutters change nothing there."""
        return image

    def check(self, times: np.ndarray) -> None:
        """ValueError where it cannot be of a camera whose frames are at these seconds of its own clock."""
        return

    def kept(self) -> dict[str, Any]:
        """What ``run.json`` keeps of an effect that :meth:`alone` gave: here the fields of a dataclass, as JSON takes
        them.
        """
        return {f.name: getattr(self, f.name) for f in fields(self)} if is_dataclass(self) else {}

    @classmethod
    def restored(cls, kept: Mapping[str, Any]) -> Effect:
        """The effect that :meth:`kept` told of. ValueError or TypeError for anything else."""
        return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in kept.items()})


def compose(observe: Observe, effects: Sequence[Effect], params: Params) -> Observe:
    """``observe`` through all effects, the first one nearest to the scene; without effects it is ``observe`` itself."""
    for effect in effects:
        observe = effect.wrap(observe, params)
    return observe


def initial_parameters(effects: Sequence[Effect], n_videos: int) -> dict[str, Tensor]:
    """The parameters of all effects. ValueError when two effects want the same name."""
    out: dict[str, Tensor] = {}
    for effect in effects:
        own = effect.parameters(n_videos)
        twice = sorted(own.keys() & out.keys())
        if twice:
            raise ValueError(
                f"effects: expected every parameter once, found {twice[0]!r} in two effects: drop one of them"
            )
        out.update(own)
    return out


def on_still(effects: Sequence[Effect], image: Tensor, circle: ImageCircle) -> Tensor:
    """A picture [...,h,w,3] of what stands still through all effects, the first one nearest to the scene."""
    for effect in effects:
        image = effect.on_still(image, circle)
    return image


def prior(effects: Sequence[Effect], params: Params) -> Tensor | None:
    """Sum of the effects' priors; None when no effect has one."""
    terms = [term for effect in effects if (term := effect.prior(params)) is not None]
    return sum(terms[1:], terms[0]) if terms else None


@dataclass(frozen=True, eq=False)
class Gain(Effect):
    """Every video's own exposure and white balance: colours times a factor per channel, with a prior towards its start.

    Unmodelled gains of 5 % bias offsets by .01 to .03 frame where few small cameras see the scene.

    Args:
        start: initial factors, [V,3] or [V]; None: those of the static fit, or all 1.
        weight: of the prior ``weight * sum (gain - start)^2``.
        white_balance: one factor per channel; False: one for all three.
    """

    start: Any = None
    weight: float = 0.02
    white_balance: bool = True
    groups: ClassVar[tuple[Group, ...]] = (Group("gain", 1e-3),)
    instant: ClassVar[bool] = True

    def parameters(self, n_videos: int) -> dict[str, Tensor]:
        """``gain`` [V,3], or [V,1] without white balance."""
        return {"gain": self._start(n_videos)}

    def prior(self, params: Params) -> Tensor | None:
        """Squared departure from the start, times the weight."""
        if not self.weight:
            return None
        gain = params["gain"]
        return self.weight * (gain - self._start(len(gain)).to(gain)).square().sum()

    def wrap(self, observe: Observe, params: Params) -> Observe:
        """Multiply the colours by the video's gain."""
        gain = params["gain"]

        def with_gain(shot: Shot) -> Rendered:
            seen = observe(shot)
            return replace(seen, rgb=seen.rgb * gain[shot.video])

        return with_gain

    @classmethod
    def called_for(cls, recorded: Recorded) -> Gain | None:
        """Wherever the static part tells the videos' colours."""
        return None if recorded.gains is None else cls(start=recorded.gains)

    def begun(self, recorded: Recorded) -> Gain:
        """From the static part's gains, unless it has a start of its own."""
        return self if self.start is not None else replace(self, start=recorded.gains)

    def _start(self, n_videos: int) -> Tensor:
        channels = 3 if self.white_balance else 1
        if self.start is None:
            return torch.ones(n_videos, channels)
        start = torch.as_tensor(self.start, dtype=torch.float32)
        if start.ndim == 1:
            start = start[:, None]
        if start.ndim != 2 or start.shape[0] != n_videos or start.shape[1] not in (1, 3):
            raise ValueError(f"start: expected gains [{n_videos}] or [{n_videos},3], found {list(start.shape)}")
        if not (start.isfinite() & (start > 0)).all():
            raise ValueError("start: expected gains > 0, found zero, negative or NaN: a gain multiplies colours")
        return start.expand(-1, channels).clone() if self.white_balance else start.mean(1, keepdim=True)


@dataclass(frozen=True)
class MotionBlur(Effect):
    """A shutter that is open for a while: the mean over ``samples`` instants spread evenly over the exposure.

    Args:
        exposure: seconds of the own clock, one for all videos or one per video; 0: no blur, the same bits.
        samples: instants per frame; each one is a rendering. They lie in the middles of equal parts of the exposure
            (midpoint rule), symmetrically about the frame's time.
    """

    exposure: float | tuple[float, ...]
    samples: int = 3

    def __post_init__(self) -> None:
        _check_seconds("exposure", self.exposure)
        if self.samples < 1:
            raise ValueError(f"samples: expected at least one instant, found {self.samples}")

    def parameters(self, n_videos: int) -> dict[str, Tensor]:
        """Nothing to learn."""
        _check_count("exposure", self.exposure, n_videos)
        return {}

    def alone(self, video: int | None, learned: Params) -> MotionBlur | None:
        """With that video's exposure, or the one of all."""
        own = _of_one(self.exposure, video)
        return None if own is None else replace(self, exposure=own)

    def check(self, times: np.ndarray) -> None:
        """An exposure is no longer than a frame."""
        if not isinstance(self.exposure, tuple):
            check_within_a_frame(self.exposure, times, "exposure")

    def wrap(self, observe: Observe, params: Params) -> Observe:
        """Average what is seen over the exposure."""

        def blurred(shot: Shot) -> Rendered:
            exposure = _of_video(self.exposure, shot.video)
            if exposure == 0:
                return observe(shot)
            moments = [((i + 0.5) / self.samples - 0.5) * exposure for i in range(self.samples)]
            return _mean([observe(shot.after(moment)) for moment in moments])

        return blurred


@dataclass(frozen=True)
class RollingShutter(Effect):
    """Rows are read one after the other: row r is seen at ``t + readout * ((r + 1/2) / height - 1/2)``.

    Args:
        readout: seconds of the own clock from the first to the last row (``Camera.readout``), one for all videos or one
            per video; 0: all rows at once, the same bits. None: as the cameras of the recording declare.
        bands: equal bands of rows that share the time of their middle; each one is a rendering of its rows only. They
            divide the whole image, so that a crop shows what the image would. A row is at most
            ``readout / (2 * bands)`` from its own time.
    """

    readout: float | tuple[float, ...] | None = None
    bands: int = 8

    def __post_init__(self) -> None:
        if self.readout is not None:
            _check_seconds("readout", self.readout)
        if self.bands < 1:
            raise ValueError(f"bands: expected at least one band of rows, found {self.bands}")

    def parameters(self, n_videos: int) -> dict[str, Tensor]:
        """Nothing to learn."""
        _check_count("readout", self._known(), n_videos)
        return {}

    def _known(self) -> float | tuple[float, ...]:
        if self.readout is None:
            raise ValueError("readout: expected seconds; found None, which only a recording fills in (with_declared).")
        return self.readout

    @classmethod
    def called_for(cls, recorded: Recorded) -> RollingShutter | None:
        """Wherever a camera declares a readout."""
        return cls().begun(recorded) if any(recorded.readouts) else None

    def begun(self, recorded: Recorded) -> RollingShutter:
        """With the readouts that the cameras declare, unless it has its own. ValueError where none declares any."""
        if self.readout is not None:
            return self
        if not any(recorded.readouts):
            raise ValueError(
                "readout: expected seconds, since no camera declares any; found none. Give RollingShutter a readout, "
                "or "
                "declare camera.readout in the recording."
            )
        return replace(self, readout=tuple(float(r or 0.0) for r in recorded.readouts))

    def alone(self, video: int | None, learned: Params) -> RollingShutter | None:
        """With that video's readout, or the one of all."""
        own = None if self.readout is None else _of_one(self.readout, video)
        return None if own is None else replace(self, readout=own)

    def check(self, times: np.ndarray) -> None:
        """A readout is no longer than a frame."""
        if self.readout is not None and not isinstance(self.readout, tuple):
            check_within_a_frame(self.readout, times, "readout")

    def wrap(self, observe: Observe, params: Params) -> Observe:
        """Show every band of rows at its own time."""
        known = self._known()

        def rolled(shot: Shot) -> Rendered:
            readout = _of_video(known, shot.video)
            if readout == 0:
                return observe(shot)
            x0, y0, x1, y1 = shot.box
            edges = [round(i * shot.height / self.bands) for i in range(self.bands + 1)]
            parts = []
            for top, bottom in pairwise(edges):
                if max(top, y0) >= min(bottom, y1):
                    continue
                later = readout * ((top + bottom) / (2 * shot.height) - 0.5)
                box = (x0, max(top, y0), x1, min(bottom, y1))
                parts.append(observe(replace(shot.after(later), box=box)))
            return _stack(parts)

        return rolled


def _mean(parts: Sequence[Rendered]) -> Rendered:
    """The mean of renderings; depths weighted by alpha, as their expectation asks for."""
    rgb = torch.stack([p.rgb for p in parts]).mean(0)
    alpha = torch.stack([p.alpha for p in parts]).mean(0)
    depths = [p.depth * p.alpha for p in parts if p.depth is not None]
    if len(depths) < len(parts):
        return Rendered(rgb, alpha)
    return Rendered(rgb, alpha, torch.stack(depths).mean(0) / alpha.clamp_min(1e-10))


def _stack(parts: Sequence[Rendered]) -> Rendered:
    """Bands one below the other."""
    if len(parts) == 1:
        return parts[0]
    depths = [p.depth for p in parts if p.depth is not None]
    depth = torch.cat(depths) if len(depths) == len(parts) else None
    return Rendered(torch.cat([p.rgb for p in parts]), torch.cat([p.alpha for p in parts]), depth)


def _of_video(seconds: float | tuple[float, ...], video: int) -> float:
    return seconds[video] if isinstance(seconds, tuple) else seconds


def _of_one(seconds: float | tuple[float, ...], video: int | None) -> float | None:
    if not isinstance(seconds, tuple) or video is None:
        return None if isinstance(seconds, tuple) else seconds
    if video >= len(seconds):
        raise ValueError(f"effects: expected seconds of every video; found {len(seconds)}, none for video {video}.")
    return seconds[video]


def _check_seconds(name: str, seconds: float | tuple[float, ...]) -> None:
    for value in seconds if isinstance(seconds, tuple) else (seconds,):
        if not 0 <= value < float("inf"):
            raise ValueError(f"{name}: expected seconds >= 0, found {value}")


def _check_count(name: str, seconds: float | tuple[float, ...], n_videos: int) -> None:
    if isinstance(seconds, tuple) and len(seconds) != n_videos:
        raise ValueError(f"{name}: expected one number of seconds, or {n_videos}, one per video; found {len(seconds)}")
