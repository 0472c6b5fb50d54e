"""Cameras that no fit has seen: when and with which colours they looked at the finished scene, and how well it shows it.

Nothing about the scene is fitted here. A camera's gain is one factor per channel, by least squares over what is static
and never over what moves. Its clock may be known (a benchmark); otherwise it is found with the scene frozen: the offset
for which the rendered motion differs least from the filmed one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize_scalar
from torch import Tensor

from otsync.types import Clock
from recon.evaluate.figures import mean_scores, score_image
from recon.evaluate.lpips import Lpips
from recon.footage.footage import Footage
from recon.observe.cameras import colours
from recon.observe.effects import Effect, Rendered, Shot, compose
from recon.observe.effects import optics as optics_of
from recon.raster import render
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D

"""Told from outside, found on the frozen scene, or fitted together with the scene."""

BRIGHTEST = 4.0
"""Gains beyond this or below its inverse are no gains: the static part does not match the camera's view."""

SCAN_FRAMES, FINE_FRAMES = 6, 16
"""Frames that a candidate offset is tried on in the scan, and in the refinement."""

TOLERANCE = 0.004
"""Frames: precision of the refinement, far below what photometry can tell."""


@dataclass(frozen=True, eq=False)
class ViewScore:
    """How well a scene shows what one camera filmed.

    Args:
        times: (F,) world seconds of the frames that were compared.
        frames: their figures by name, see :func:`recon.evaluate.score_image`.
        mean: of the figures. gain: factors of R, G, B that the rendering was multiplied with.
        pictures: (rendered, filmed) uint8 images of some frames.
        moving: whether the camera's masks tell what moves; without them there are no figures of it.
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
    stats: dict[str, float] = field(default_factory=dict)


def view(
    scene: Gaussians4D,
    footage: Footage,
    clock: Clock | None = None,
    *,
    gain: Float[np.ndarray, " 3"] | None = None,
    layered: bool = True,
    optics: tuple[Effect, ...] | None = None,
) -> View:
    """A camera on the scene's clock.

    Args:
        clock: of the camera; None: not known, all of the scene's span is searched.
        gain: of the camera; None: found.
        layered: see :class:`View`.
        optics: see :func:`recon.effects.optics`; None: the rolling shutter that the camera declares.
    """
    own = np.ones(3) if gain is None else gain
    optics = optics_of((), footage.readout) if optics is None else optics
    looking = View(scene, footage, clock or Clock(0.0), own, _static_views(scene, footage), layered, optics)
    if gain is None:
        looking = looking.with_gain()
    return looking.scanned() if clock is None else looking


@dataclass(frozen=True, eq=False)
class View:
    """A camera that looks at a scene: its clock, its gain, and the static Gaussians as it sees them (none: black).

    layered: what moves is drawn over what is static, as a fit of fixed cameras assumes it: there the floor's splats,
    whose depth nothing but the cameras' parallax tells, would otherwise hide the feet that stand on it. False: one
    rendering of both, for fits that did so (moving cameras). optics: what blurs and slants what moves in its images.
    """

    scene: Gaussians4D
    footage: Footage
    clock: Clock
    gain: Float[np.ndarray, " 3"]
    static: Tensor | None
    layered: bool = True
    optics: tuple[Effect, ...] = ()

    def _clock(self, seconds: float | None) -> Clock:
        return self.clock if seconds is None else replace(self.clock, offset=seconds)

    def world(self, frame: int, seconds: float | None = None) -> float:
        """World seconds of a frame, also under another offset."""
        return self._clock(seconds).world(float(self.footage.times[frame]))

    def image(self, t: float, frame: int = 0) -> Tensor:
        """[h,w,3] at world second ``t`` by the pose of ``frame``, times the gain, 0..1."""
        if self.layered and self.static is not None:
            rgb, alpha = self._through(self.scene.moving, t, frame, 0.01 * self.scene.near)
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
        box: tuple[int, int, int, int] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Colours [h,w,3] and alpha [h,w,1] of the Gaussians ``at`` a time, through the camera's optics."""

        def observe(shot: Shot) -> Rendered:
            return Rendered(*_draw(at(float(shot.t)), self.footage, frame, near, shot.box, shot.later))

        w, h = self.footage.size
        shot = Shot(0, torch.tensor(t, dtype=torch.float64), box or (0, 0, w, h), h, frame, rate=self.clock.rate)
        seen = compose(observe, self.optics, {})(shot)
        return seen.rgb, seen.alpha

    def with_gain(self) -> View:
        """The gain for which the static part matches best where nothing ever moves; 1 where that cannot be told."""
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
        """(rendered static part, filmed background, weight) of the pixels that show no motion."""
        assert self.static is not None
        f = self.footage
        if f.background is not None and f.background_seen is not None and len(self.static) == 1:
            drawn = self.static[0].numpy()
            covered = drawn.max(-1) > 0
            yield drawn, f.background / 255.0, (f.background_seen & covered).astype(float)
            return
        for k in _spread(np.flatnonzero(~f.bad), 6):
            drawn = self.static[k if len(self.static) > 1 else 0].numpy()
            still = np.ones(f.images.shape[1:3], bool) if f.masks is None else f.masks[k] < 26
            yield drawn, f.images[k] / 255.0, (still & (drawn.max(-1) > 0)).astype(float)

    def disagreement(self, seconds: float, frames: np.ndarray) -> float:
        """Squared difference where things move, as a share of what it is without what moves; below 1 is good.

        What moves is drawn over the camera's own background where it has one: the search is for a clock, not for a
        score, and shall not depend on how good the static part is.
        """
        with_motion, without = 0.0, 0.0
        gain = torch.as_tensor(self.gain, dtype=torch.float32)
        for k in frames:
            x0, y0, x1, y1 = (int(x) for x in self.footage.boxes[k])
            filmed = torch.as_tensor(self.footage.images[k, y0:y1, x0:x1]).float() / 255
            behind = self._behind(int(k))[y0:y1, x0:x1]
            box, near = (x0, y0, x1, y1), 0.01 * self.scene.near
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
        """Frames that something moves in and whose world time the scene knows."""
        f, (low, high), slack = self.footage, self.scene.span, 0.5 * self.scene.frame_step
        t = self._clock(seconds).world(f.times)
        return np.flatnonzero(~f.bad & (f.boxes[:, 2] > f.boxes[:, 0]) & (t >= low - slack) & (t <= high + slack))

    def scanned(self) -> View:
        """With the offset at which the motion fits best, searched over everything that leaves half a clip in common."""
        f, (low, high), step = self.footage, self.scene.span, self.scene.frame_step
        own = np.array([f.times[0], f.times[-1]]) * self.clock.rate
        slack = 0.5 * min(own[1] - own[0], high - low)
        with torch.no_grad():
            tried: dict[float, float] = {}
            for o in np.arange(low - own[1] + slack, high - own[0] - slack + step, step):
                frames = self.usable(o)
                if len(frames) >= 2:
                    tried[float(o)] = self.disagreement(o, _spread(frames, SCAN_FRAMES))
        if not tried:
            raise ValueError(
                f"video {f.name}: expected moving things at times that the scene covers; found none, so its clock "
                "cannot be found. Give its offset, or hold out another camera."
            )
        best = min(tried, key=lambda o: (tried[o], abs(o)))
        return replace(self, clock=Clock(best, self.clock.rate)).refined()

    def refined(self) -> View:
        """With the offset within a frame of the present one at which the motion fits best."""
        frames, step, start = _spread(self.usable(), FINE_FRAMES), self.scene.frame_step, self.clock.offset
        if len(frames) < 2:
            return self
        with torch.no_grad():
            found = minimize_scalar(
                lambda x: self.disagreement(start + x * step, frames),
                bounds=(-1.0, 1.0),
                method="bounded",
                options={"xatol": TOLERANCE},
            )
        return replace(self, clock=Clock(start + float(found.x) * step, self.clock.rate, "found"))

    def score(
        self, *, most: int = 50, pictures: int = 3, lpips: Lpips | None = None, held_out: bool = True
    ) -> ViewScore:
        """Compare up to ``most`` frames, spread over the clip; ``pictures`` of them are kept."""
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
        chosen = _spread(inside, most)
        kept = set(
            _spread(chosen, pictures + 2)[1:-1].tolist() if len(chosen) > pictures + 1 else chosen[:pictures].tolist()
        )
        rows, shown = [], []
        with torch.no_grad():
            for k in chosen.tolist():
                image = self.image(self.world(k), k)
                mask = None if f.masks is None else f.masks[k] > 127
                rows.append(score_image(image, f.images[k], mask, lpips))
                if k in kept:
                    shown.append(((image.numpy() * 255).round().astype(np.uint8), f.images[k]))
        return ViewScore(
            f.name,
            self.clock,
            self.gain,
            t[chosen],
            tuple(rows),
            mean_scores(rows),
            tuple(shown),
            f.masks is not None,
            held_out,
        )


def _static_views(scene: Gaussians4D, footage: Footage) -> Tensor | None:
    """The static Gaussians [1 or T,h,w,3] as the camera sees them, without gain."""
    if scene.static is None:
        return None
    poses = 1 if footage.w2c.ndim == 2 else len(footage)
    with torch.no_grad():
        return torch.stack([_draw(scene.static, footage, k, scene.near)[0] for k in range(poses)])


def _draw(
    gaussians: Gaussians,
    footage: Footage,
    frame: int,
    near: float,
    box: tuple[int, int, int, int] | None = None,
    later: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Colours [h,w,3] and alpha [h,w,1] of a part of the image, ``later`` seconds after the frame."""
    x0, y0, x1, y1 = box or (0, 0, *footage.size)
    K = torch.as_tensor(footage.K, dtype=torch.float32).clone()
    K[0, 2] -= x0
    K[1, 2] -= y0
    w2c = torch.as_tensor(footage.pose_after(frame, later), dtype=torch.float32)
    with torch.no_grad():
        out = render(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            colours(gaussians, w2c[None]),
            w2c[None],
            K[None],
            x1 - x0,
            y1 - y0,
            near_plane=near,
            depth=None,
        )
    return out.colors[0], out.alphas[0]


def _spread(index: np.ndarray, count: int) -> np.ndarray:
    """At most ``count`` of ``index``, evenly."""
    if len(index) <= count:
        return index
    return index[np.unique(np.linspace(0, len(index) - 1, count).round().astype(int))]
