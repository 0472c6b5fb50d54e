"""Views of held-out cameras: place a camera on the scene's clock, match its colours, and score what it sees.

The scene stays as it is. A camera's gain is one factor per channel, fitted by least squares to what is static, never to
what moves. Its clock may be known (a benchmark); otherwise it is searched for: the offset at which the rendered motion
differs least from the filmed motion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize_scalar
from torch import Tensor

from otsync.compute.indices import evenly
from otsync.types import Clock
from recon.evaluate.figures import mean_scores, score_image
from recon.evaluate.lpips import Lpips
from recon.footage.footage import Footage
from recon.observe.cameras import Box, Clip, draw
from recon.observe.effects import Effect, Rendered, Shot, compose, on_still
from recon.observe.recorded import optics as optics_of
from recon.raster import Rendering
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D

BRIGHTEST = 4.0
"""A gain above this or below its inverse is not used: the static part does not match the camera's view."""

SCAN_FRAMES, FINE_FRAMES = 6, 16
"""Frames on which an offset is tried: in the scan, and in the refinement."""

TOLERANCE = 0.004
"""Precision of the refinement, in frames: far below what photometry can tell."""

BACKGROUNDS = 6
"""Frames of a camera without a background of its own from which its gain is taken."""

STILL = 26
"""Masks of 0..255 below which a pixel counts as background: a tenth."""

COMMON = 0.5
"""Share of the shorter of clip and scene that an offset must leave in common to be tried."""


@dataclass(frozen=True, eq=False, repr=False)
class ViewScore:
    """How well a scene shows what one camera filmed.

    Args:
        clock: where the camera stands in world time. gain: factors of R, G, B by which the rendering was multiplied.
        times: (F,) world seconds of the compared frames.
        frames: the figures of each by name, see :func:`recon.evaluate.figures.score_image`. mean: their means.
        pictures: (rendered, filmed) uint8 images of some frames.
        moving: whether the camera has masks; without them there are no figures for what moves.
    """

    name: str
    clock: Clock
    gain: Float[np.ndarray, " 3"]
    times: Float[np.ndarray, " F"]
    frames: tuple[dict[str, float], ...]
    mean: dict[str, float]
    pictures: tuple[tuple[np.ndarray, np.ndarray], ...] = ()
    moving: bool = True
    held_out: bool = True

    def __repr__(self) -> str:
        role = "held out" if self.held_out else "training"
        figures = "".join(f", {name} {value:.2f}" for name, value in self.mean.items())
        return f"ViewScore({self.name!r}, {len(self.frames)} frames, {role}{figures})"


def view(
    scene: Gaussians4D,
    footage: Footage,
    clock: Clock | None = None,
    *,
    gain: Float[np.ndarray, " 3"] | None = None,
    layered: bool = True,
    optics: tuple[Effect, ...] | None = None,
) -> CameraView:
    """Put a camera on the scene's clock.

    Args:
        clock: of the camera; None: unknown, so the scene's whole span is searched.
        gain: of the camera; None: fitted to what is static.
        layered: see :class:`CameraView`.
        optics: see :func:`recon.observe.recorded.optics`; None: the rolling shutter that the camera declares.

    Raises ValueError where the clock is unknown and nothing that moves can be compared.
    """
    own = np.ones(3) if gain is None else gain
    optics = optics_of((), footage.readout) if optics is None else optics
    static = _static_views(scene, footage, optics)
    looking = CameraView(scene, footage, clock or Clock(0.0), own, static, layered, optics)
    if gain is None:
        looking = looking.with_gain()
    return looking.scanned() if clock is None else looking


@dataclass(frozen=True, eq=False, repr=False)
class CameraView:
    """A camera that looks at a scene.

    Args:
        clock: where the camera stands in world time. gain: factors of R, G, B from the scene's colours to its images.
        static: [1 or T,h,w,3] the static Gaussians as it sees them through its optics, without gain; None: black.
        layered: draw what moves over what is static, as fits of fixed cameras do. Nothing but parallax tells the depth
            of the floor's splats, which would otherwise hide the feet that stand on them. False: one rendering of both,
            as fits with moving cameras do.
        optics: what blurs and slants moving things in its images, and darkens its corners.
    """

    scene: Gaussians4D
    footage: Footage
    clock: Clock
    gain: Float[np.ndarray, " 3"]
    static: Tensor | None
    layered: bool = True
    optics: tuple[Effect, ...] = ()

    def __repr__(self) -> str:
        return f"CameraView({self.footage}, {self.clock})"

    @cached_property
    def _clip(self) -> Clip:
        return Clip.of(self.footage)

    def _clock(self, seconds: float | None) -> Clock:
        return self.clock if seconds is None else replace(self.clock, offset=seconds)

    def world(self, frame: int, seconds: float | None = None) -> float:
        """World seconds of a frame; ``seconds``: under this offset instead of the clock's own."""
        return self._clock(seconds).world(float(self.footage.times[frame]))

    def image(self, t: float, frame: int = 0) -> Tensor:
        """The image [h,w,3] at world second ``t`` from the pose of ``frame``, times the gain, in 0..1."""
        if self.layered and self.static is not None:
            rgb, alpha = self._through(self.scene.moving, t, frame, self.scene.moving_near)
            out = rgb + (1 - alpha) * self.static[frame if len(self.static) > 1 else 0]
        else:
            out = self._through(self.scene.at, t, frame, self.scene.near)[0]
        return (out * torch.as_tensor(self.gain, dtype=out.dtype)).clamp(0, 1)

    def _through(
        self,
        at: Callable[[float], Gaussians],
        t: float,
        frame: int,
        near: float,
        box: Box | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Colours [h,w,3] and alpha [h,w,1] of the Gaussians ``at`` a time, through the camera's optics."""

        def observe(shot: Shot) -> Rendered:
            out = _draw(at(float(shot.t)), self._clip, frame, near, shot.box, shot.later)
            return Rendered(out.colors[0], out.alphas[0])

        w, h = self.footage.size
        shot = Shot(
            0,
            torch.tensor(t, dtype=torch.float64),
            box or (0, 0, w, h),
            h,
            frame,
            rate=self.clock.rate,
            circle=self._clip.circle,
        )
        seen = compose(observe, self.optics, {})(shot)
        return seen.rgb, seen.alpha

    def with_gain(self) -> CameraView:
        """The same with the gain at which the static part matches best; 1 where no static part can be compared."""
        if self.static is None:
            return self
        top, bottom = np.zeros(3), np.zeros(3)
        for rendered, filmed, weight in self._backgrounds():
            top += (weight[..., None] * filmed * rendered).sum((0, 1))
            bottom += (weight[..., None] * rendered**2).sum((0, 1))
        gain = np.divide(top, bottom, out=np.ones(3), where=bottom > 0)
        sane = (gain > 1 / BRIGHTEST) & (gain < BRIGHTEST)
        return replace(self, gain=np.where(sane, gain, 1.0))

    def _backgrounds(self) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """(rendered static part, filmed background, weight per pixel), of pixels that show no motion."""
        assert self.static is not None
        f = self.footage
        if f.background is not None and f.background_seen is not None and len(self.static) == 1:
            drawn = self.static[0].numpy()
            covered = drawn.max(-1) > 0
            yield drawn, f.background / 255.0, (f.background_seen & covered).astype(float)
            return
        for k in _some(np.flatnonzero(~f.bad), BACKGROUNDS):
            drawn = self.static[k if len(self.static) > 1 else 0].numpy()
            still = np.ones(f.images.shape[1:3], bool) if f.masks is None else f.masks[k] < STILL
            yield drawn, f.images[k] / 255.0, (still & (drawn.max(-1) > 0)).astype(float)

    def disagreement(self, seconds: float, frames: np.ndarray) -> float:
        """Squared difference where things move, as a share of what it is with nothing moving drawn; good: below 1.

        What moves is drawn over the camera's own background where there is one, so that the search for its clock does
        not depend on how good the static part is.
        """
        with_motion, without = 0.0, 0.0
        gain = torch.as_tensor(self.gain, dtype=torch.float32)
        for k in frames:
            x0, y0, x1, y1 = (int(x) for x in self.footage.boxes[k])
            filmed = torch.as_tensor(self.footage.images[k, y0:y1, x0:x1]).float() / 255
            behind = self._behind(int(k))[y0:y1, x0:x1]
            box, near = (x0, y0, x1, y1), self.scene.moving_near
            rgb, alpha = self._through(self.scene.moving, self.world(int(k), seconds), int(k), near, box)
            drawn = rgb * gain + (1 - alpha) * behind
            with_motion += float((drawn - filmed).square().sum())
            without += float((behind - filmed).square().sum())
        return with_motion / max(without, 1e-9)

    def _behind(self, frame: int) -> Tensor:
        f = self.footage
        if f.background is not None:
            return torch.as_tensor(f.background).float() / 255
        if self.static is None:
            return torch.zeros(f.images.shape[1:])
        gain = torch.as_tensor(self.gain, dtype=torch.float32)
        return self.static[frame if len(self.static) > 1 else 0] * gain

    def usable(self, seconds: float | None = None) -> np.ndarray:
        """Frames in which something moves and whose world time the scene covers."""
        f, (low, high), slack = self.footage, self.scene.span, 0.5 * self.scene.frame_step
        t = self._clock(seconds).world(f.times)
        return np.flatnonzero(~f.bad & (f.boxes[:, 2] > f.boxes[:, 0]) & (t >= low - slack) & (t <= high + slack))

    def scanned(self) -> CameraView:
        """The same with the offset at which the motion fits best, among all that leave half of the clip in common."""
        f, (low, high), step = self.footage, self.scene.span, self.scene.frame_step
        own = np.array([f.times[0], f.times[-1]]) * self.clock.rate
        slack = COMMON * min(own[1] - own[0], high - low)
        with torch.no_grad():
            tried: dict[float, float] = {}
            for o in np.arange(low - own[1] + slack, high - own[0] - slack + step, step):
                frames = self.usable(o)
                if len(frames) >= 2:
                    tried[float(o)] = self.disagreement(o, _some(frames, SCAN_FRAMES))
        if not tried:
            raise ValueError(
                f"video {f.name}: expected things that move at times that the scene covers; found none to "
                "find its clock by. Give its offset, or hold out another camera."
            )
        best = min(tried, key=lambda o: (tried[o], abs(o)))
        return replace(self, clock=Clock(best, self.clock.rate)).refined()

    def refined(self) -> CameraView:
        """The same with the offset at which the motion fits best, within a frame of the present one."""
        frames, step, start = _some(self.usable(), FINE_FRAMES), self.scene.frame_step, self.clock.offset
        if len(frames) < 2:
            return self
        with torch.no_grad():
            best = minimize_scalar(
                lambda x: self.disagreement(start + x * step, frames),
                bounds=(-1.0, 1.0),
                method="bounded",
                options={"xatol": TOLERANCE},
            )
        return replace(self, clock=Clock(start + float(best.x) * step, self.clock.rate, "found"))

    def score(
        self, *, most: int = 50, pictures: int = 3, lpips: Lpips | None = None, held_out: bool = True
    ) -> ViewScore:
        """Compare at most ``most`` frames, spread over the clip, and keep ``pictures`` of them.

        Raises ValueError where the scene covers none of its frames.
        """
        f = self.footage
        low, high = self.scene.span
        t = self.clock.world(f.times)
        slack = 0.5 * self.scene.frame_step
        inside = np.flatnonzero(~f.bad & (t >= low - slack) & (t <= high + slack))
        if not len(inside):
            raise ValueError(
                f"video {f.name}: expected frames at world seconds {low:.3f} to {high:.3f}, which the scene covers; "
                f"found {t[0]:.3f} to {t[-1]:.3f}. Check its offset."
            )
        chosen = _some(inside, most)
        # of many frames those between the first and the last, which are the least like the rest
        shown = _some(chosen, pictures + 2)[1:-1] if len(chosen) > pictures + 1 else chosen[:pictures]
        rows, images = [], []
        with torch.no_grad():
            for k in chosen.tolist():
                image = self.image(self.world(k), k)
                mask = None if f.masks is None else f.masks[k] > 127
                rows.append(score_image(image, f.images[k], mask, lpips))
                if k in shown:
                    images.append(((image.numpy() * 255).round().astype(np.uint8), f.images[k]))
        return ViewScore(
            name=f.name,
            clock=self.clock,
            gain=self.gain,
            times=t[chosen],
            frames=tuple(rows),
            mean=mean_scores(rows),
            pictures=tuple(images),
            moving=f.masks is not None,
            held_out=held_out,
        )


def _static_views(scene: Gaussians4D, footage: Footage, optics: tuple[Effect, ...]) -> Tensor | None:
    """The static Gaussians [1 or T,h,w,3] as the camera sees them through its optics, without gain."""
    if scene.static is None:
        return None
    clip, whole = Clip.of(footage), (0, 0, *footage.size)
    poses = range(len(clip.w2c))
    seen = torch.stack([_draw(scene.static, clip, k, scene.near, whole).colors[0] for k in poses])
    return on_still(optics, seen, clip.circle)


def _draw(gaussians: Gaussians, clip: Clip, frame: int, near: float, box: Box, later: float = 0.0) -> Rendering:
    """A part of a frame's image, ``later`` seconds after the frame; without a graph."""
    x0, y0, x1, y1 = box
    with torch.no_grad():
        return draw(gaussians, *clip.view(frame, box, later), (x1 - x0, y1 - y0), near)


def _some(frames: np.ndarray, most: int) -> np.ndarray:
    """At most ``most`` of the frames, evenly spread."""
    return frames[evenly(len(frames), most)]
