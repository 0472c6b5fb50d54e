"""The static part of a scene: Gaussians fitted once to what fixed cameras see behind the things that move.

The background needs no synchronisation, so it is fitted before any motion and then stays as it is. Seeds come from
depth where it is given, else from a floor and a shell (:mod:`recon.surroundings`).
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
from tqdm import tqdm

from recon.backdrop.seeds import seed_discs, surface_of
from recon.backdrop.stills import Still, stills_of
from recon.backdrop.surroundings import Floor, View, surroundings
from recon.footage.depth import Depths
from recon.footage.footage import Footage
from recon.losses.ssim import photometric
from recon.losses.window import SMALL
from recon.raster import render, sh
from recon.scene.device import device_of
from recon.scene.gaussians import Gaussians

log = logging.getLogger("recon.backdrop")

NEAR = 0.22
"""Near plane, as a share of the cameras' distance from the scene: what is seen from one side only must not stand before
the eyes of another camera (with .01 m a held-out camera was blacked out: 6 dB)."""

RATES: Mapping[str, float] = {
    "means": 0.2,
    "quats": 3e-3,
    "log_scales": 8e-3,
    "opacity_logits": 0.03,
    "sh": 0.018,
    "gains": 2e-3,
}
"""Adam's steps at the start; means in footprints. Slower means stay on the seeds' surface, which is only a guess."""

HOLD, LAST = 0.3, 0.03
"""Rates are constant for this share of the steps, then fall exponentially to this factor at the end."""

OPAQUE, EVERY = 0.05, 4
"""Weight of the loss that asks for an opaque background in views between the cameras, and the steps between two of
them: without it new views see cracks where no camera looked (24 instead of 31 dB in the synthetic room)."""


@dataclass(frozen=True, eq=False)
class StaticFit:
    """A fitted background.

    Args:
        gaussians: on the CPU, without a graph.
        gains: (V,3) factors of every video's colours relative to the Gaussians'; 1 for videos that took no part.
        near: near plane to render with, world units.
        psnr: (V,) dB over the seen background of every video, gains applied; nan for videos that took no part.
        floor: found or given, or None.
        stats: seconds, steps, seeds, loss.
    """

    gaussians: Gaussians
    gains: Float[np.ndarray, "V 3"]
    near: float
    psnr: Float[np.ndarray, " V"]
    floor: Floor | None = None
    stats: dict[str, float] = field(default_factory=dict)


def fit_backdrop(
    footage: Sequence[Footage],
    *,
    depth: Sequence[Depths | None] | None = None,
    points: Float[np.ndarray, "N 3"] | None = None,
    floor: Floor | None = None,
    steps: int | None = None,
    budget: float | None = None,
    sh_degree: int = 0,
    rates: Mapping[str, float] = RATES,
    seed: int = 0,
    device: torch.device | str = "cpu",
    progress: bool = True,
) -> StaticFit:
    """Fit static Gaussians to the backgrounds of the videos.

    Args:
        depth: per video, maps that include the background, of some frames at least; None: not known.
        points: some positions of what moves, (N,3): scale and floor of a scene that cameras alone do not tell.
        floor: the ground plane, when it is known; else it is searched for.
        steps, budget: how long: a number of steps, or wall seconds. Default: 1500 steps.
        sh_degree: of the view-dependent colour. With 14 cameras degree 1 fits them better, new views worse.
        rates: a group without one is frozen.

    The result depends on the seed, not on the number of threads (with ``budget`` on the machine's speed as well).
    Raises ValueError when no video has a background: give masks; FloatingPointError when the fit diverges.
    """
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
    around = surroundings(_some(stills, 32), points, floor)
    near = NEAR * around.distance
    surfaces = [surface_of(s, around, near) for s in stills]
    gains = first_gains(stills, np.concatenate([s.at for s in surfaces]), len(footage))
    start, sharpest = seed_discs(stills, surfaces, around, near, gains).gaussians(sh_degree)
    log.info("backdrop: %d seeds, near plane %.3g", len(start), near)
    fit = _Fit(start, sharpest.to(device), stills, gains, near, around.distance, rates, seed, device)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # torch's pool would compete with the rasterizer's
    try:
        loss = fit.run(total, budget, progress)
    finally:
        torch.set_num_threads(threads)
    gains, scores = fit.result()
    stats = {"seconds": time.perf_counter() - started, "steps": fit.step, "seeds": len(start), "loss": loss}
    return StaticFit(fit.gaussians().detach(), gains, near, scores, around.floor, stats)


def first_gains(stills: Sequence[Still], points: Float[np.ndarray, "N 3"], videos: int) -> Float[np.ndarray, "V 3"]:
    """Gains of the videos by the colours that they show of the same surface points, of geometric mean 1.

    Occlusion and points that are in the wrong place change colours too, but not all one way: medians are taken.
    """
    looks = [View.of(still).look(points[:: max(1, len(points) // 4000)]) for still in stills]
    colors = np.where(np.stack([k for _, k in looks])[..., None], np.stack([c for c, _ in looks]), np.nan)
    twice = np.isfinite(colors[..., 0]).sum(0) >= 2
    shift, video = np.zeros((videos, 3)), np.array([s.video for s in stills])
    if not twice.any():
        return np.ones((videos, 3))
    for _ in range(20):
        apart = colors[:, twice] - shift[video][:, None]
        apart = apart - np.nanmean(apart, 0)
        for v in np.unique(video):
            own = apart[video == v].reshape(-1, 3)
            own = own[np.isfinite(own[:, 0])]
            shift[v] += np.median(own, 0) if len(own) else 0.0
    taking_part = np.isin(np.arange(videos), video)
    return np.where(taking_part[:, None], np.exp(shift - shift[taking_part].mean(0)), 1.0)


def colour_gain(
    rendered: Float[np.ndarray, "h w 3"], image: Float[np.ndarray, "h w 3"], mask: np.ndarray | None = None
) -> Float[np.ndarray, " 3"]:
    """The factor per channel by which ``rendered`` is nearest to ``image`` (least squares), both uint8 or 0..1.

    mask: (h,w) weights of pixels. For a camera that no fit saw give its static part only, never people.
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
    """What the camera of ``footage`` sees of the static scene, float32 in 0..1, times ``gain``."""
    with torch.no_grad():
        w2c, K = (torch.as_tensor(a, dtype=torch.float32)[None] for a in (footage.pose(frame), footage.K))
        seen = _render(fit.gaussians, w2c, K, footage.size, fit.near)[0].numpy()
    return (seen if gain is None else seen * np.asarray(gain, np.float32)).clip(0, 1)


def with_backdrop(
    fit: StaticFit, footage: Footage, gain: Float[np.ndarray, " 3"] | None = None, *, everywhere: bool = False
) -> Footage:
    """``footage`` of a fixed camera with the static scene as its background where its own was never seen.

    Args:
        gain: of the camera; None: fitted on the part of its background that was seen.
        everywhere: take nothing from the video itself: how a held-out camera is rendered.
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


def unchanging(footage: Footage, threshold: int = 14) -> tuple[UInt8[np.ndarray, "h w 3"], np.ndarray]:
    """(median image, where at most 2 % of the frames differ from it by ``threshold``) of a fixed camera without masks."""
    good = np.flatnonzero(~footage.bad)
    images = footage.images[good[np.unique(np.linspace(0, len(good) - 1, min(50, len(good))).round().astype(int))]]
    median = np.median(images, 0).astype(np.int16)
    changed = np.stack([np.abs(image - median).max(-1) > threshold for image in images])
    return median.astype(np.uint8), changed.mean(0) <= 0.02


class _Fit:
    """A background fit under way."""

    def __init__(
        self,
        start: Gaussians,
        sharpest: Tensor,
        stills: Sequence[Still],
        gains: np.ndarray,
        near: float,
        distance: float,
        rates: Mapping[str, float],
        seed: int,
        device: torch.device | str,
    ):
        self.sharpest, self.near, self.stills, self.seed, self.step = sharpest, near, stills, seed, 0
        footprint = distance / float(np.median([s.K[0, 0] for s in stills]))
        values = {**vars(start), "gains": torch.as_tensor(gains - 1, dtype=torch.float32)}
        self.groups = {name: value.to(device).clone() for name, value in values.items()}
        self.rates = {n: r * (footprint if n == "means" else 1.0) for n, r in rates.items() if self.groups[n].numel()}
        for name in self.rates:
            self.groups[name].requires_grad_()
        self.adam = torch.optim.Adam(
            [{"params": [self.groups[n]], "lr": r, "name": n} for n, r in self.rates.items()],
            betas=(0.9, 0.99),
            eps=1e-15,
            fused=True,
        )
        self.views = [
            (
                *(torch.as_tensor(a, dtype=torch.float32, device=device)[None] for a in (s.w2c, s.K)),
                torch.as_tensor(s.image, device=device),
                torch.as_tensor(s.where, device=device),
            )
            for s in stills
        ]

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
        splats = (g.means, g.quats, g.scales, g.opacities, torch.ones_like(g.means[:, :1]))
        view = torch.as_tensor(w2c[None]).to(g.means)
        return render(*splats, view, self.views[a][1], *ends[0].size, near_plane=self.near, depth=None).alphas

    def run(self, total: int | None, budget: float | None, progress: bool) -> float:
        """All steps; the mean loss of the last tenth."""
        rng = np.random.default_rng([self.seed, 2])
        order: list[int] = []
        recent: list[float] = []
        began = time.perf_counter()
        with tqdm(total=total, desc="backdrop", unit="step", disable=None if progress else True) as bar:
            while total is None or self.step < total:
                if not order:
                    order = rng.permutation(len(self.views)).tolist()
                recent.append(self.one_step(order.pop(), 0.0 if total is None else self.step / total))
                bar.update()
                if total is None and self.step == 10:
                    began = time.perf_counter()  # what comes before is compilation and warming up
                if total is None and self.step == 30:
                    assert budget is not None
                    total = max(30, int(20 * budget / (time.perf_counter() - began)))
                    bar.total = total
                if self.step % 50 == 0:
                    bar.set_postfix_str(f"loss {np.mean(recent[-50:]):.4f}", refresh=False)
        return float(np.mean(recent[-max(1, len(recent) // 10) :])) if recent else math.nan

    def one_step(self, i: int, progress: float) -> float:
        """One picture, one step of Adam; the loss."""
        seen, image, where = self.see(i)
        loss = photometric(seen, image, where, 0.2, SMALL)
        if loss is None:  # nothing of the background shows in this picture
            self.step += 1
            return 0.0
        # gains and colours share one freedom: keep the mean gain near 1
        total = loss + 0.01 * self.groups["gains"].square().sum()
        if len(self.stills) > 1 and self.step % EVERY == 0:
            total = total + OPAQUE * (1 - self.cover()).mean()
        value = float(total.detach())
        if not math.isfinite(value):
            raise FloatingPointError(f"backdrop: the loss is no number at step {self.step}: lower the rates")
        self.adam.zero_grad(set_to_none=True)
        total.backward()
        factor = LAST ** max(0.0, (progress - HOLD) / (1 - HOLD))
        for group in self.adam.param_groups:
            group["lr"] = self.rates[group["name"]] * factor
        self.adam.step()
        self.step += 1
        return value

    def result(self) -> tuple[np.ndarray, np.ndarray]:
        """(gains [V,3], PSNR [V])."""
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
        return gains, np.where(weight > 0, scores, np.nan)


def _render(gaussians: Gaussians, w2c: Tensor, K: Tensor, size: tuple[int, int], near: float) -> Tensor:
    """Colours [1,h,w,3]."""
    degree = gaussians.sh_degree or None
    colors = gaussians.sh if degree else (sh.C0 * gaussians.sh[:, 0] + 0.5).clamp_min(0)
    splats = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors)
    return render(*splats, w2c, K, *size, near_plane=near, depth=None, sh_degree=degree).colors


def _some(stills: list[Still], most: int) -> list[Still]:
    """At most so many, spread over all."""
    return [stills[i] for i in np.unique(np.linspace(0, len(stills) - 1, min(most, len(stills))).round().astype(int))]


def _unit(image: np.ndarray) -> np.ndarray:
    values = np.asarray(image)
    return values / 255 if values.dtype == np.uint8 else values.astype(float)


def _total(steps: int | None, budget: float | None) -> int | None:
    if steps is not None and budget is not None:
        raise ValueError("steps, budget: expected one of them; found both.")
    if budget is not None and not (math.isfinite(budget) and budget > 0):
        raise ValueError(f"budget: expected seconds above 0; found {budget}.")
    if steps is not None and steps < 0:
        raise ValueError(f"steps: expected 0 or more; found {steps}.")
    return None if budget is not None else 1500 if steps is None else steps
