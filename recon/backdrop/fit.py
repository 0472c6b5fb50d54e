"""The static part of a scene: Gaussians fitted once to what fixed cameras see behind the things that move.

The background needs no synchronisation, so it is fitted before any motion and then stays as it is. Seeds come from
depth where it is given, else from a floor and a shell (:mod:`recon.backdrop.surroundings`).
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from otsync.compute.indices import evenly
from otsync.progress import bar
from recon.backdrop.colours import first_colours
from recon.backdrop.seeds import seed_discs, surface_of
from recon.backdrop.stills import Still, stills_of
from recon.backdrop.surroundings import Floor, surroundings
from recon.fit.optimize import Adam, Decay
from recon.fit.options import check_length
from recon.footage.depth import Depths
from recon.footage.footage import Footage
from recon.losses.ssim import photometric
from recon.losses.window import SMALL
from recon.observe.cameras import draw
from recon.observe.effects import ImageCircle
from recon.observe.vignetting import NO_FALLOFF, Falloff, darkening_
from recon.scene.device import device_of
from recon.scene.gaussians import Gaussians

log = logging.getLogger("recon.backdrop")

NEAR_SHARE = 0.22
"""Near plane, as a share of the cameras' distance from the scene: what only one side saw must not stand just in front
of another camera (with .01 m a held-out camera was blacked out: 6 dB)."""

RATES: Mapping[str, float] = {
    "means": 0.2,
    "quats": 3e-3,
    "log_scales": 8e-3,
    "opacity_logits": 0.03,
    "sh": 0.018,
    "gains": 2e-3,
    "falloff": 2e-3,
}
"""Adam's steps at the start; of means in footprints. Slower means would stay on the seeds' surface, a guess."""

DECAY = Decay(hold=0.3, last=0.03)
"""How the rates fall over the steps."""

OPAQUE, EVERY = 0.05, 4
"""Weight of the loss that asks for an opaque background in views between the cameras, and steps from one such view to
the next. Without it new views see cracks where no camera looked (24 instead of 31 dB in the synthetic room)."""

DSSIM = 0.2
"""Weight of structural dissimilarity in the photometric loss, as in 3DGS."""

GAUGE = 0.01
"""Weight that keeps the mean gain near 1: gains and colours share one freedom."""

STEPS = 1500
"""Steps where neither steps nor a budget are given."""

WARM, TIMED = 10, 30
"""With a budget in seconds: the step at which compilation is over, and the one up to which the pace is measured."""

MEDIAN_FRAMES, CHANGED, RARELY = 50, 14, 0.02
"""A fixed camera without masks: frames of its median image; levels of 255 by which a changed pixel differs from it; and
the share of frames in which an unchanging pixel may."""


SEARCHED = 32
"""Stills that floor and shell are searched with, at most; all of them are fitted."""


@dataclass(frozen=True, eq=False, repr=False)
class StaticFit:
    """A fitted background.

    Args:
        gaussians: on the CPU, without a graph.
        gains: (V,3) factors from the Gaussians' colours to every video's; 1 for videos that took no part.
        falloff: of the vignetting that all cameras share; zeros where the pictures show none.
        near: near plane to render with, world units.
        psnr: (V,) dB over the seen background of every video, gains applied; nan for videos that took no part.
        floor: as given or as found; None where there is none.
        stats: seconds, steps, seeds, loss.
    """

    gaussians: Gaussians
    gains: Float[np.ndarray, "V 3"]
    near: float
    psnr: Float[np.ndarray, " V"]
    floor: Floor | None = None
    falloff: Falloff = NO_FALLOFF
    stats: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        known = self.psnr[np.isfinite(self.psnr)]
        floor = "no floor" if self.floor is None else "a floor"
        dB = float(known.mean()) if len(known) else math.nan
        return f"StaticFit({self.gaussians}, {len(self.gains)} videos, {dB:.2f} dB, {floor})"


def fit_backdrop(
    footage: Sequence[Footage],
    *,
    depth: Sequence[Depths | None] | None = None,
    points: Float[np.ndarray, "N 3"] | None = None,
    floor: Floor | None = None,
    falloff: Falloff | None = None,
    steps: int | None = None,
    budget: float | None = None,
    at_most: float | None = None,
    sh_degree: int = 0,
    rates: Mapping[str, float] = RATES,
    seed: int = 0,
    device: torch.device | str = "cpu",
    progress: bool = True,
) -> StaticFit:
    """Fit static Gaussians to the backgrounds of the videos.

    Args:
        depth: per video, maps that include the background, of some frames at least; None: unknown.
        points: (N,3) some positions of what moves: they tell scale and floor where the cameras alone do not.
        floor: the ground plane, where it is known; else it is searched for.
        falloff: of the cameras' vignetting, where it is known: it stays as it is, and zeros mean none. None: told by
            points that several cameras show, and then fitted; none where that is not sure.
        steps, budget: a number of steps, or wall seconds. Default: 1500 steps.
        at_most: wall seconds; fewer steps are taken where they would take longer. Not beside ``budget``.
        sh_degree: of the view-dependent colour. With 14 cameras degree 1 fits them better, but new views worse.
        rates: a group without one is frozen.

    The result depends on the seed, not on the number of threads (with ``budget`` and ``at_most`` on the machine's speed
    as well).
    Raises ValueError when no video has a background: give masks; FloatingPointError when the fit diverges.
    """
    if budget is not None and at_most is not None:
        raise ValueError("budget, at_most: expected one of them; found both.")
    total, device = _total(steps, budget), device_of(device)
    unknown = sorted(set(rates) - set(RATES))
    if unknown:
        raise ValueError(f"rates: expected some of {', '.join(RATES)}; found {', '.join(unknown)}.")
    stills = stills_of(footage, depth)
    if not stills or not any(s.where.any() for s in stills):
        raise ValueError(
            "footage: expected a video whose background shows; found none. Give masks, which tell it from what moves."
        )
    started = time.perf_counter()
    around = surroundings([stills[i] for i in evenly(len(stills), SEARCHED)], points, floor)
    near = NEAR_SHARE * around.distance
    surfaces = [surface_of(s, around, near) for s in stills]
    gains, start_falloff = first_colours(stills, np.concatenate([s.at for s in surfaces]), len(footage), falloff)
    start, sharpest = seed_discs(stills, surfaces, around, near, gains, start_falloff).gaussians(sh_degree)
    log.info("backdrop: %d seeds, near plane %.3g", len(start), near)
    if falloff is not None:
        rates = {name: rate for name, rate in rates.items() if name != "falloff"}
    looks = stills, gains, start_falloff
    fit = _BackdropFit(start, sharpest.to(device), *looks, near, around.distance, rates, seed, device)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # torch's pool would compete with the rasterizer's
    try:
        loss = fit.run(total, budget if at_most is None else at_most, progress)
    finally:
        torch.set_num_threads(threads)
    gains, fitted, scores = fit.result()
    if falloff is not None:  # as it was given, not as a float32
        fitted = falloff
    stats = {"seconds": time.perf_counter() - started, "steps": fit.step, "seeds": len(start), "loss": loss}
    return StaticFit(fit.gaussians().detach(), gains, near, scores, around.floor, fitted, stats)


def colour_gain(
    rendered: Float[np.ndarray, "h w 3"], image: Float[np.ndarray, "h w 3"], mask: np.ndarray | None = None
) -> Float[np.ndarray, " 3"]:
    """The factor per channel that brings ``rendered`` nearest to ``image`` (least squares), both uint8 or 0..1.

    mask: (h,w) weights of pixels. For a held-out camera give its static part only, never people.
    """
    x, y = (_unit(a) for a in (rendered, image))
    w = np.ones(x.shape[:2]) if mask is None else np.asarray(mask, float)
    if not (w > 0).any():
        raise ValueError("mask: expected some pixels of the static part; found none.")
    down = np.einsum("hw,hwc->c", w, x * x)
    return np.where(down > 1e-9, np.einsum("hw,hwc->c", w, x * y) / np.maximum(down, 1e-9), 1.0)


def backdrop_of(
    fit: StaticFit, footage: Footage, gain: Float[np.ndarray, " 3"] | None = None, frame: int = 0
) -> Float[np.ndarray, "h w 3"]:
    """The static scene as the camera of ``footage`` sees it, float32 in 0..1, times ``gain``."""
    with torch.no_grad():
        w2c, K = (torch.as_tensor(a, dtype=torch.float32)[None] for a in (footage.pose(frame), footage.K))
        seen = _render(fit.gaussians, w2c, K, footage.size, fit.near)[0].numpy()
    if any(fit.falloff):
        seen = seen * fit.falloff.shade(ImageCircle.of(footage.K, footage.size), (0, 0, *footage.size))
    return (seen if gain is None else seen * np.asarray(gain, np.float32)).clip(0, 1)


def with_backdrop(
    fit: StaticFit, footage: Footage, gain: Float[np.ndarray, " 3"] | None = None, *, everywhere: bool = False
) -> Footage:
    """``footage`` of a fixed camera with the static scene as its background where its own was never seen.

    Args:
        gain: of the camera; None: fitted on the part of its background that was seen.
        everywhere: take nothing from the video itself, as for a held-out camera.
    """
    if footage.w2c.ndim != 2:
        raise ValueError(f"footage {footage.name!r}: expected a fixed camera; found a moving one. Render it jointly.")
    background, seen = footage.background, footage.background_seen
    if background is None or seen is None:
        background, seen = unchanging(footage)
    if gain is None:
        gain = colour_gain(backdrop_of(fit, footage), background, seen) if seen.any() else np.ones(3)
    own = np.zeros_like(seen) if everywhere or footage.background is None else seen
    rendered = np.rint(255 * backdrop_of(fit, footage, gain)).astype(np.uint8)
    return replace(
        footage, background=np.where(own[..., None], background, rendered), background_seen=np.ones_like(seen)
    )


def unchanging(footage: Footage, threshold: int = CHANGED) -> tuple[UInt8[np.ndarray, "h w 3"], np.ndarray]:
    """(median image, where at most 2 % of the frames differ from it by ``threshold``) of a fixed camera."""
    good = np.flatnonzero(~footage.bad)
    images = footage.images[good[evenly(len(good), MEDIAN_FRAMES)]]
    median = np.median(images, 0).astype(np.int16)
    changed = np.stack([np.abs(image - median).max(-1) > threshold for image in images])
    return median.astype(np.uint8), changed.mean(0) <= RARELY


class _BackdropFit:
    """A fit under way: its parameters, their optimiser, and the pictures that it looks at."""

    def __init__(
        self,
        start: Gaussians,
        sharpest: Tensor,
        stills: Sequence[Still],
        gains: np.ndarray,
        falloff: Falloff,
        near: float,
        distance: float,
        rates: Mapping[str, float],
        seed: int,
        device: torch.device | str,
    ):
        self.sharpest, self.near, self.stills, self.seed, self.step = sharpest, near, stills, seed, 0
        footprint = distance / float(np.median([s.K[0, 0] for s in stills]))
        values = {**vars(start), "gains": torch.as_tensor(gains - 1, dtype=torch.float32)}
        # one that was not seen is not fitted either: a few pictures would be fitted by it in place of their colours
        values["falloff"] = torch.tensor(falloff if any(falloff) else (), dtype=torch.float32)
        groups = {name: value.to(device) for name, value in values.items()}
        learned = {name: rate for name, rate in rates.items() if groups[name].numel()}
        self.adam = Adam(groups, learned, footprint, frame_step=1.0)
        self.groups = {**groups, **self.adam.groups}
        self.views = [
            (
                *(torch.as_tensor(a, dtype=torch.float32, device=device)[None] for a in (s.w2c, s.K)),
                torch.as_tensor(s.image, device=device),
                torch.as_tensor(s.where, device=device),
            )
            for s in stills
        ]
        shaded = stills if any(falloff) else ()
        whole = [ImageCircle.of(s.K, s.size).squared_radii((0, 0, *s.size)) for s in shaded]
        self.radii = [torch.as_tensor(r2, dtype=torch.float32, device=device) for r2 in whole]

    def gaussians(self) -> Gaussians:
        """The Gaussians as they are drawn, no sharper than they were seen."""
        g = self.groups
        scales = torch.logaddexp(2 * g["log_scales"], 2 * self.sharpest.log()[:, None]) / 2
        return Gaussians(g["means"], g["quats"], scales, g["opacity_logits"], g["sh"])

    def see(self, i: int) -> tuple[Tensor, Tensor, Tensor]:
        """(rendered, filmed, where) of still i."""
        w2c, K, image, where = self.views[i]
        still = self.stills[i]
        seen = _render(self.gaussians(), w2c, K, still.size, self.near)[0] * (1 + self.groups["gains"][still.video])
        if len(falloff := self.groups["falloff"]):
            r2 = self.radii[i]
            seen = seen * (r2 * (falloff[0] + falloff[1] * r2)).exp()[..., None]
        return seen, image.to(seen) / 255, where.to(seen)

    def cover(self) -> Tensor:
        """Alpha [1,h,w,1] in a view at a random place between two of the pictures."""
        rng = np.random.default_rng([self.seed, 3, self.step])
        a, b = rng.choice(len(self.stills), 2, replace=False)
        share, ends = rng.uniform(), (self.stills[a], self.stills[b])
        w2c = np.eye(4)
        w2c[:3, :3] = Slerp([0, 1], Rotation.from_matrix(np.stack([e.w2c[:3, :3] for e in ends])))(share).as_matrix()
        w2c[:3, 3] = -w2c[:3, :3] @ ((1 - share) * ends[0].center + share * ends[1].center)
        g = self.gaussians()
        view, nothing = torch.as_tensor(w2c[None]).to(g.means), torch.ones_like(g.means[:, :1])
        return draw(g, view, self.views[a][1], ends[0].size, self.near, colors=nothing).alphas

    def run(self, total: int | None, budget: float | None, progress: bool) -> float:
        """All steps, at most ``total`` of them, within ``budget`` seconds; the mean loss of the last tenth."""
        rng = np.random.default_rng([self.seed, 2])
        order: list[int] = []
        recent: list[float] = []
        began = time.perf_counter()
        with bar("backdrop", "step", total, shown=progress) as told:
            while total is None or self.step < total:
                if not order:
                    order = rng.permutation(len(self.views)).tolist()
                recent.append(self.one_step(order.pop(), 0.0 if total is None else self.step / total))
                told.update()
                if self.step == WARM:
                    began = time.perf_counter()  # the steps before compile and warm up
                if budget is not None and self.step == TIMED:
                    affordable = max(TIMED, int((TIMED - WARM) * budget / (time.perf_counter() - began)))
                    total = affordable if total is None else min(total, affordable)
                    told.total = total
                if self.step % 50 == 0:
                    told.set_postfix_str(f"loss {np.mean(recent[-50:]):.4f}", refresh=False)
        return float(np.mean(recent[-max(1, len(recent) // 10) :])) if recent else math.nan

    def one_step(self, i: int, progress: float) -> float:
        """One picture, one step of Adam; the loss."""
        seen, image, where = self.see(i)
        loss = photometric(seen, image, where, DSSIM, SMALL)
        if loss is None:  # nothing of the background shows in this picture
            self.step += 1
            return 0.0
        total = loss + GAUGE * self.groups["gains"].square().sum()
        if len(self.stills) > 1 and self.step % EVERY == 0:
            total = total + OPAQUE * (1 - self.cover()).mean()
        value = float(total.detach())
        if not math.isfinite(value):
            raise FloatingPointError(
                f"backdrop: expected a finite loss; found {value} at step {self.step}. Lower the rates."
            )
        gradients = torch.autograd.grad(total, list(self.adam.groups.values()), allow_unused=True)
        self.adam.step(dict(zip(self.adam.groups, gradients, strict=True)), DECAY(progress))
        if "falloff" in self.adam.groups:
            darkening_(self.adam.groups["falloff"])
        self.step += 1
        return value

    def result(self) -> tuple[np.ndarray, Falloff, np.ndarray]:
        """(gains [V,3], falloff, PSNR [V])."""
        videos = len(self.groups["gains"])
        error, weight = np.zeros(videos), np.zeros(videos)
        with torch.no_grad():
            for i, still in enumerate(self.stills):
                seen, image, where = self.see(i)
                error[still.video] += float(((seen.clamp(0, 1) - image).square().mean(-1) * where).sum())
                weight[still.video] += float(where.sum())
        with np.errstate(divide="ignore", invalid="ignore"):
            scores = -10 * np.log10(error / weight)
        gains = 1 + self.groups["gains"].detach().cpu().numpy().astype(float)
        gains[weight == 0] = 1
        falloff = self.groups["falloff"].detach().cpu().tolist()
        return gains, Falloff(*falloff) if falloff else NO_FALLOFF, np.where(weight > 0, scores, np.nan)


def _render(gaussians: Gaussians, w2c: Tensor, K: Tensor, size: tuple[int, int], near: float) -> Tensor:
    """Colours [1,h,w,3]."""
    return draw(gaussians, w2c, K, size, near).colors


def _unit(image: np.ndarray) -> np.ndarray:
    values = np.asarray(image)
    return values / 255 if values.dtype == np.uint8 else values.astype(float)


def _total(steps: int | None, budget: float | None) -> int | None:
    """Steps in all; None when the budget decides."""
    check_length(steps, budget)
    return None if budget is not None else STEPS if steps is None else steps
