"""CoTracker (Karaev et al., 2024): points followed through occlusion and together, in windows that overlap.

There is no package of it: its code is a clone of github.com/facebookresearch/co-tracker on the path, its weights are a
file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ..working import WorkingFrames
from .loading import device_of, digest_of, dtype_of, package, weights
from .tiles import positions

CLONE = (
    "Clone github.com/facebookresearch/co-tracker and put the clone on PYTHONPATH, so that 'import cotracker' works."
)

NETWORKS: dict[str, dict[str, Any]] = {
    "cotracker3": {"window_len": 60, "v2": False},
    "cotracker2v1": {"window_len": 16, "v2": True},
    "cotracker2": {"window_len": 8, "v2": True},
}
"""How the clone makes the network of a kind of weights (its hubconf.py)."""

Run = Callable[[Float[np.ndarray, "n 3"]], tuple[Float[np.ndarray, "n W 2"], Bool[np.ndarray, "n W"]]]
"""Queries (frame of the window, x, y) to places in every frame of it, and where they are seen."""


@dataclass(frozen=True)
class CoTracker:
    """Points of a grid on what moves, followed by CoTracker both ways. Pixels at 640 of width, frame counts at 30 fps.

    Args:
        model: file of weights: a path, or a name in the folder of weights. network: what they are of: "cotracker3",
            "cotracker2v1" or "cotracker2".
        grid: spacing of seeds. every: frames between seedings; a seed closer than half of the grid to a track that is
            seen there is left out.
        window: frames (of the video) that are looked at at once. overlap: those that two windows share: a track goes
            on from where it was last seen in them.
        agree: largest median distance between what both windows say of a track there; beyond, it ends.
        points: followed at once. Memory is bounded by it and by ``window``.
        min_life, most: as of :class:`otsync.priors.ChainedFlow`.
        device, dtype: where and in which numbers it is computed.
    """

    model: str = "scaled_offline.pth"
    network: str = "cotracker3"
    grid: int = 12
    every: int = 20
    window: int = 60
    overlap: int = 12
    agree: float = 3.0
    points: int = 512
    min_life: int = 8
    most: int = 4000
    device: str = "auto"
    dtype: str = "float32"

    def __post_init__(self) -> None:
        if self.network not in NETWORKS:
            raise ValueError(f"network: expected one of {', '.join(NETWORKS)}; found {self.network!r}.")
        for name, least in (("grid", 1), ("every", 1), ("window", 2), ("overlap", 1), ("points", 1), ("most", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected {least} or more; found {getattr(self, name)}.")
        if self.overlap >= self.window:
            raise ValueError(f"overlap: expected fewer frames than window ({self.window}); found {self.overlap}.")

    @property
    def cache_key(self) -> Any:
        """Its fields, with the content of the weights in place of their name; where it computes does not count."""
        held = {k: v for k, v in vars(self).items() if k not in ("model", "device")}
        return ("CoTracker", tuple(sorted(held.items())), digest_of(self._path()))

    def predictor(self) -> Any:
        """The network behind its ``CoTrackerPredictor``, made once a process.

        It is called as (video (1,T,3,H,W) of 0 to 255, queries=(1,N,3) of (frame, x, y), backward_tracking=True) and
        gives (1,T,N,2) pixel indices and (1,T,N) whether they are seen.
        """
        return _predictor(self._path(), self.network, device_of(self.device))

    def __call__(self, frames: WorkingFrames, masks: Sequence[np.ndarray], fps: float) -> Float[np.ndarray, "N T 2"]:
        """Working pixel indices of every track, nan where it is hidden, outside, or not on what moves."""
        T = len(frames)
        uv = np.full((0, T, 2), np.nan, np.float32)
        if T < 2 or not any(np.asarray(m).any() for m in masks):
            return uv
        predictor, every = self.predictor(), max(1, round(self.every * fps / 30))
        least, known = min(max(3, round(self.min_life * fps / 30)), T), 0
        for start in positions(T, self.window, self.overlap, 1):
            stop = min(start + self.window, T)
            run = self._runner(predictor, frames, masks, start, stop)
            uv[:, start:stop] = self._going_on(uv[:, start:stop], known - start, run, frames.unit)
            for k in range(-(-known // every) * every, stop, every):
                seeds = seeds_at(np.asarray(masks[k]), uv[:, k], max(2, round(self.grid * frames.unit)))
                if len(seeds):
                    places, seen = run(np.concatenate([np.full((len(seeds), 1), k - start), seeds], 1))
                    new = np.full((len(seeds), T, 2), np.nan, np.float32)
                    new[:, start:stop] = np.where(seen[..., None], places, np.nan)
                    uv = np.concatenate([uv, new])
            known = stop
            life = np.isfinite(uv[..., 0]).sum(1)
            goes_on = np.isfinite(uv[:, max(start, stop - self.overlap) : stop, 0]).any(1)
            kept = np.flatnonzero((life >= least) | (goes_on & (stop < T)))
            # of tracks as long as each other nobody knows yet which will live: some more than are returned wait
            most = self.most if stop == T else 2 * self.most
            uv = uv[np.sort(kept[np.argsort(-life[kept], kind="stable")[:most]])]
        return uv

    def _going_on(
        self, uv: Float[np.ndarray, "N W 2"], shared: int, run: Run, unit: float
    ) -> Float[np.ndarray, "N W 2"]:
        """The tracks in this window, whose first ``shared`` frames the one before knows: on from the last one where
        each is seen."""
        seen = np.isfinite(uv[..., 0])
        rows = np.flatnonzero(seen.any(1))
        if shared <= 0 or len(rows) == 0:
            return uv
        last = uv.shape[1] - 1 - seen[rows, ::-1].argmax(1)
        places, found = run(np.concatenate([last[:, None], uv[rows, last]], 1))
        off = np.where(found, np.linalg.norm(places - uv[rows], axis=2), np.inf)  # unseen: the windows disagree too
        off[np.arange(len(rows)), last] = 0.0  # the query itself
        agrees = np.nanmedian(np.where(seen[rows], off, np.nan), axis=1) <= self.agree * unit
        out = uv.copy()
        for n in np.flatnonzero(agrees):
            behind = slice(last[n] + 1, None)
            out[rows[n], behind] = np.where(found[n, behind, None], places[n, behind], np.nan)
        return out

    def _runner(self, predictor: Any, frames: WorkingFrames, masks: Sequence[np.ndarray], start: int, stop: int) -> Run:
        """What follows points through the frames from ``start`` to ``stop``, so many at once."""
        torch = package("torch", "learned")
        device = device_of(self.device)
        images = np.stack([frames[k] for k in range(start, stop)]).transpose(0, 3, 1, 2)
        video = torch.from_numpy(np.ascontiguousarray(images)).to(device).float()[None]
        inside = np.stack([np.asarray(masks[k], bool) for k in range(start, stop)])
        kind, reduced = device.partition(":")[0], self.dtype != "float32"

        def run(queries: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
            places, seen = [], []
            for first in range(0, len(queries), self.points):
                own = torch.from_numpy(queries[None, first : first + self.points].astype(np.float32)).to(device)
                with torch.inference_mode(), torch.autocast(kind, dtype=dtype_of(self.dtype), enabled=reduced):
                    tracks, visible = predictor(video, queries=own, backward_tracking=True)
                places.append(tracks[0].float().cpu().numpy().swapaxes(0, 1))
                seen.append(visible[0].cpu().numpy().swapaxes(0, 1) > 0)
            uv = np.concatenate(places)
            return uv, np.concatenate(seen) & on(inside, uv)

        return run

    def _path(self) -> Path:
        return weights(self.model, "points: co-tracker", "The repository's page links them (scaled_offline.pth).")


def on(masks: Bool[np.ndarray, "W h w"], uv: Float[np.ndarray, "n W 2"]) -> Bool[np.ndarray, "n W"]:
    """Which places lie in the image and on what moves."""
    h, w = masks.shape[1:]
    there = np.isfinite(uv).all(-1)
    x, y = np.moveaxis(np.round(np.where(there[..., None], uv, -1)), -1, 0).astype(int)
    there &= (x >= 0) & (x < w) & (y >= 0) & (y < h)
    frame: Int[np.ndarray, " W"] = np.arange(len(masks))
    return there & masks[frame[None], np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)]


def seeds_at(mask: Bool[np.ndarray, "h w"], living: Float[np.ndarray, "N 2"], pitch: int) -> Float[np.ndarray, "n 2"]:
    """Points of a grid inside the mask, away from its edge and from tracks that are seen (others are nan)."""
    import cv2

    h, w = mask.shape
    grid = np.stack(np.meshgrid(np.arange(pitch // 2, w, pitch), np.arange(pitch // 2, h, pitch)), -1).reshape(-1, 2)
    taken = np.zeros((h, w), np.uint8)
    x, y = np.round(living[np.isfinite(living[:, 0])]).astype(int).T
    taken[np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)] = 1
    core = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    free = core & (cv2.dilate(taken, np.ones((pitch + 1,) * 2, np.uint8)) == 0)
    return grid[free[grid[:, 1], grid[:, 0]]].astype(np.float32)


def state_of(path: Path) -> dict[str, Any]:
    """The numbers of a file of weights. ValueError for one with other objects in it, which could run code."""
    torch = package("torch", "learned")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # unpickling errors, archives that are none
        said = " ".join(str(error).split())[:160]
        raise ValueError(
            f"{path}: expected a state dict without pickled objects; {said}. Save it again: torch.save(state_dict)."
        ) from None
    return state.get("model", state) if isinstance(state, dict) else {}


@cache
def _predictor(path: Path, network: str, device: str) -> Any:
    module = package("cotracker.predictor", remedy=CLONE)
    state = state_of(path)
    try:
        made = module.CoTrackerPredictor(checkpoint=None, **NETWORKS[network])
    except (TypeError, AttributeError) as error:
        raise ValueError(f"cotracker: expected a clone of version 3; {error}. {CLONE}") from None
    try:
        made.model.load_state_dict(state)
    except (RuntimeError, TypeError, AttributeError) as error:
        said = " ".join(str(error).split())[:160]
        raise ValueError(
            f"{path}: expected the weights of {network}; {said}. Choose network=, or another file."
        ) from None
    return made.eval().to(device)
