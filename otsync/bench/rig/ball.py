"""``otsync bench ball SCENE``: when a rig's cameras really expose, by one ball and without a model of the scene.

How synchronous is a recording that counts as synchronised? A ball's centre is one point that every camera sees, from
its outline alone: no tracks, no matches, no depth, nothing of what is being judged. Where the ball moves and a camera
is late, the centre lags along its path in that camera, and in no other; a wrong calibration shifts it the same way
wherever it moves. Path, clocks and shifts are solved together; sigma is a jackknife over stretches of the clip.

The clocks are written as a truth (``ball_offsets.json``), which ``--against`` holds finished answers to.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix

from ...compute.threads import pool_of
from ...geometry import undistort
from ...io import open_scene
from ...metrics import offset_error
from ...progress import counted
from ...types import Camera, Offsets, Video
from ..record import table, write_rows

RED = 22
"""Lab a* from which on a pixel belongs to the ball: skin and brick stay below 20."""

SMALLEST, LARGEST = 5.0, 120.0
"""Pixels of a ball's radius."""

ROUND, ROUNDABOUT = 0.6, 0.5
"""Share of an outline that lies on the circle, and of the circle that has an outline: hands hide the rest."""

ON_CIRCLE = 0.05
"""Of its radius: how far from a circle points are on it."""

FEWEST = 20
"""Frames in which a camera must see the ball for a clock of its own."""

FARTHEST = 1.0
"""Frames between a camera's clock and the mean: beyond, the centres of one frame no longer tell of one place."""

STRETCHES = 10
"""Parts of the clip that the jackknife leaves out, one at a time."""

STIFF = 2.0
"""Pixels that a metre per squared frame costs: holds the path where nobody sees it, and yields elsewhere."""


@dataclass(frozen=True)
class Centres:
    """N centres of the ball. camera, frame: (N,) indices. pixel: (N,2) without distortion. radius: (N,) pixels."""

    camera: np.ndarray
    frame: np.ndarray
    pixel: np.ndarray
    radius: np.ndarray

    def take(self, keep: np.ndarray) -> Centres:
        return Centres(self.camera[keep], self.frame[keep], self.pixel[keep], self.radius[keep])


@dataclass(frozen=True)
class Witness:
    """Frames of the offset (V,), nan where the ball is seen too rarely, with sigma and how often it was seen."""

    frames: np.ndarray
    sigma: np.ndarray
    seen: np.ndarray
    residual: float


def run(out: Path, *, scene: str | os.PathLike[str], against: Sequence[Path] = ()) -> int:
    """Write ``ball_offsets.json`` and a row a camera; a row an answer of ``against``. Exit code 0."""
    opened = open_scene(scene)
    rates = {round(float(v.fps or 0), 6) for v in opened.videos}
    if len(rates) > 1:
        raise ValueError(
            f"scene: expected videos of one frame rate; found {', '.join(f'{r:g}' for r in sorted(rates))} fps. A ball "
            "is looked for at equal frames of a synchronised recording."
        )
    with pool_of(os.cpu_count() or 1) as pool:
        seen = list(counted(pool.map(outlines, opened.videos), "ball", "camera", len(opened.videos)))
    told = witness([v.camera for v in opened.videos], joined(seen))
    fps = float(opened.videos[0].fps or 1.0)
    names = opened.names
    rows: list[dict[str, Any]] = [
        {
            "camera": name,
            "seen in frames": int(told.seen[v]),
            "offset": _told(told.frames[v]),
            "sigma": _told(told.sigma[v]),
        }
        for v, name in enumerate(names)
    ]
    known = np.isfinite(told.frames)
    reference = int(np.flatnonzero(known)[0])
    kept = [n for n, k in zip(names, known, strict=True) if k]
    truth = Offsets.known(kept, (told.frames - told.frames[reference])[known] / fps, fps)
    held = [_held(path, truth, fps) for path in against]
    out.mkdir(parents=True, exist_ok=True)
    truth.save(out / "ball_offsets.json")
    about = {"median residual, pixels": round(told.residual, 3), "gauge": "the mean of all cameras is 0"}
    print(table(rows))
    print(f"frames of 1/{fps:g} s, the mean of all cameras is 0; residual {told.residual:.2f} pixels")
    if held:
        print(table(held))
    write_rows(out, "ball", rows, about)
    if held:
        write_rows(out, "ball_against", held, about)
    return 0


def _told(value: float) -> float | None:
    """Four digits; None where there is no answer."""
    return round(float(value), 4) if np.isfinite(value) else None


def _held(path: Path, truth: Offsets, fps: float) -> dict[str, Any]:
    """An answer beside the ball, and beside the claim that all cameras are synchronous; common shifts taken out."""
    found = Offsets.load(path)
    same = np.isfinite(found.seconds) & (found.component == found.reference)
    both = [n for n, answered in zip(found.names, same, strict=True) if answered and n in truth.names]
    if len(both) < 3:
        raise ValueError(
            f"{path}: expected offsets of three cameras that the ball tells of; found {len(both)}. Give an answer on "
            "this recording."
        )
    ours = np.array([found.seconds[found.names.index(n)] for n in both])
    true = np.array([truth.seconds[truth.names.index(n)] for n in both])
    beside = offset_error(ours, true, fps, "median")
    told = min(np.ptp(ours), np.ptp(true)) > 0  # else there is nothing to correlate
    return {
        "answer": str(path),
        "cameras": len(both),
        "mean, beside the ball": round(beside.mean, 4),
        "largest": round(beside.max, 4),
        "mean, beside 0": round(offset_error(ours, np.zeros(len(both)), fps, "median").mean, 4),
        "correlation": round(float(np.corrcoef(ours, true)[0, 1]), 3) if told else None,
    }


def outlines(video: Video) -> Centres:
    """Where one video sees a whole red ball, or enough of its outline."""
    frames, pixels, radii = [], [], []
    for k in range(len(video.frames)):
        circle = ball_in(np.asarray(video.frames[k]))
        if circle is not None:
            frames.append(k)
            pixels.append(circle[:2])
            radii.append(circle[2])
    uv = undistort(video.camera, np.array(pixels, float).reshape(-1, 2))
    return Centres(np.zeros(len(frames), int), np.array(frames, int), uv, np.array(radii, float))


def joined(seen: Sequence[Centres]) -> Centres:
    """All cameras' centres, numbered by camera."""
    return Centres(
        np.repeat(np.arange(len(seen)), [len(s.frame) for s in seen]),
        np.concatenate([s.frame for s in seen]),
        np.concatenate([s.pixel for s in seen]),
        np.concatenate([s.radius for s in seen]),
    )


def ball_in(rgb: np.ndarray) -> tuple[float, float, float] | None:
    """Centre (pixel centres at +0.5) and radius of the largest red thing, where it is round; else None."""
    red = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)[..., 1].astype(np.float32) - 128
    count, labels, stats, _ = cv2.connectedComponentsWithStats((red > RED).astype(np.uint8), connectivity=8)
    if count < 2:
        return None
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    x, y, w, h, area = stats[largest]
    inside = x > 1 and y > 1 and x + w < rgb.shape[1] - 1 and y + h < rgb.shape[0] - 1
    if not inside or area < 3 * SMALLEST**2:
        return None
    filled = cv2.morphologyEx((labels == largest).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    contours, _ = cv2.findContours(filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    edge = _steepest(red, max(contours, key=len)[:, 0].astype(np.float32))
    circle = _circle(edge) if len(edge) >= FEWEST else None
    return None if circle is None else (circle[0] + 0.5, circle[1] + 0.5, circle[2])


def _steepest(red: np.ndarray, contour: np.ndarray) -> np.ndarray:
    """A contour's points, each moved along its ray from the middle to where red falls fastest: parts of a pixel."""
    smooth = cv2.GaussianBlur(red, (0, 0), 1.0)
    ray = contour - contour.mean(0)
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-6)
    step = 0.25
    along = np.arange(-3.0, 3.01, step, dtype=np.float32)
    at = (contour[:, None] + along[None, :, None] * ray[:, None]).astype(np.float32)
    fall = -np.gradient(cv2.remap(smooth, at[..., 0], at[..., 1], cv2.INTER_LINEAR), axis=1)
    rows = np.arange(len(contour))
    best = fall[:, 1:-1].argmax(1) + 1
    before, top, after = fall[rows, best - 1], fall[rows, best], fall[rows, best + 1]
    bend = before - 2 * top + after
    part = np.where(bend < -1e-6, 0.5 * (before - after) / np.where(bend < -1e-6, bend, -1.0), 0.0).clip(-0.5, 0.5)
    clear = top > 0.8  # of a* in a quarter of a pixel: an edge of the ball, not of a seam
    return (contour + (along[best] + part * step)[:, None] * ray)[clear]


def _circle(points: np.ndarray) -> tuple[float, float, float] | None:
    """Centre and radius of the circle that most points lie on; None where too few do, or on one side alone."""
    rng = np.random.default_rng(0)
    best, on = None, np.zeros(len(points), bool)
    for _ in range(200):
        found = _through(points[rng.choice(len(points), 3, replace=False)])
        if found is None:
            continue
        near = _on(points, found)
        if near.sum() > on.sum():
            best, on = found, near
    for _ in range(3):
        if best is None or on.sum() < 3:
            return None
        best = _through(points[on])
        if best is not None:
            on = _on(points, best)
    if best is None or on.mean() < ROUND:
        return None
    angles = np.arctan2(points[on, 1] - best[1], points[on, 0] - best[0])
    around = (np.histogram(angles, 24, (-np.pi, np.pi))[0] > 0).mean()
    return (float(best[0]), float(best[1]), float(best[2])) if around >= ROUNDABOUT else None


def _on(points: np.ndarray, circle: np.ndarray) -> np.ndarray:
    """Which points lie on a circle."""
    return np.abs(np.hypot(*(points - circle[:2]).T) - circle[2]) < ON_CIRCLE * circle[2]


def _through(points: np.ndarray) -> np.ndarray | None:
    """Centre and radius of the circle through points, by least squares (Kasa 1976)."""
    A = np.c_[2 * points, np.ones(len(points))]
    s, _, rank, _ = np.linalg.lstsq(A, (points**2).sum(1), rcond=None)
    if rank < 3:
        return None
    radius = np.sqrt(max(s[2] + s[0] ** 2 + s[1] ** 2, 0.0))
    return np.array([s[0], s[1], radius]) if SMALLEST <= radius <= LARGEST else None


def witness(cameras: Sequence[Camera], seen: Centres) -> Witness:
    """Offsets in frames, their mean 0, with the jackknife's sigma.

    ValueError where cameras move, fewer than three see the ball in :data:`FEWEST` frames, or one is far from the mean.
    """
    if any(c.w2c.ndim == 3 for c in cameras):
        raise ValueError("scene: expected static cameras: a ball tells clocks only where the cameras stand.")
    seen = in_space(cameras, seen)
    often = np.bincount(seen.camera, minlength=len(cameras))
    asked = often >= FEWEST
    if asked.sum() < 3:
        raise ValueError(
            f"scene: expected a red ball that three cameras see at one place in {FEWEST} frames or more; "
            f"{int(asked.sum())} do. Choose a recording with one, or film a ball of one strong colour."
        )
    seen = seen.take(asked[seen.camera])
    chosen = np.flatnonzero(asked)
    cameras = [cameras[int(v)] for v in chosen]
    seen = dataclasses.replace(seen, camera=np.searchsorted(chosen, seen.camera))
    solved, residual, start = _solve(cameras, seen)
    if np.abs(solved).max() > FARTHEST:
        raise ValueError(
            f"scene: expected a recording whose cameras are within {FARTHEST:g} frame of each other; the ball says "
            f"{np.abs(solved).max():.2f}. Synchronise it first (otsync sync)."
        )
    edges = np.linspace(seen.frame.min(), seen.frame.max() + 1, STRETCHES + 1)
    part = np.searchsorted(edges, seen.frame, side="right") - 1
    without = []
    for one in counted(range(STRETCHES), "ball", "fit", STRETCHES):
        rest = part != one
        if rest.any() and not rest.all() and np.bincount(seen.camera[rest], minlength=len(cameras)).all():
            without.append(_solve(cameras, seen.take(rest), start)[0])
    n = len(without)
    if n < 2:
        sigma = np.full(len(cameras), np.nan)
    else:
        apart = np.array(without) - np.mean(without, axis=0)
        sigma = np.sqrt((n - 1) / n * (apart**2).sum(0))
    frames, sigmas = np.full((2, len(asked)), np.nan)
    frames[chosen], sigmas[chosen] = solved, sigma
    return Witness(frames, sigmas, often, residual)


def in_space(cameras: Sequence[Camera], seen: Centres) -> Centres:
    """The centres that agree with the place most cameras of their frame point to, within six pixels; three and more."""
    keep = np.zeros(len(seen.frame), bool)
    projections = [c.K @ c.w2c[:3] for c in cameras]
    for frame in np.unique(seen.frame):
        own = np.flatnonzero(seen.frame == frame)
        if len(own) < 3:
            continue
        P = np.array([projections[c] for c in seen.camera[own]])
        uv = seen.pixel[own]
        least, best = np.inf, None
        for a, b in combinations(range(len(own)), 2):
            point = _meeting(P[[a, b]], uv[[a, b]])
            local = P @ point
            off = np.linalg.norm(local[:, :2] / local[:, 2:] - uv, axis=1)
            cost = np.minimum(np.where(local[:, 2] > 0, off, np.inf), 6.0).sum()
            if cost < least:
                least, best = cost, off < 6.0
        if best is not None and best.sum() >= 3:
            keep[own[best]] = True
    return seen.take(keep)


def _meeting(P: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """The homogeneous point that projections (N,3,4) see at pixels (N,2), by the direct linear transform."""
    rows = (uv[:, :, None] * P[:, 2:3] - P[:, :2]).reshape(-1, 4)
    point = np.linalg.svd(rows)[2][-1]
    return point / (point[3] if abs(point[3]) > 1e-12 else 1e-12)


def _solve(
    cameras: Sequence[Camera], seen: Centres, start: np.ndarray | None = None
) -> tuple[np.ndarray, float, np.ndarray]:
    """Offsets (V,) in frames, the median residual in pixels, and all unknowns (places, offsets, shifts)."""
    V = len(cameras)
    K = np.array([c.K for c in cameras])[seen.camera]
    w2c = np.array([c.w2c for c in cameras])[seen.camera]
    rays = (seen.pixel - K[:, :2, 2]) / K[:, [0, 1], [0, 1]]
    # half the angle of the cone that touches the ball: the outline's middle lies beyond the centre's projection
    sine = (seen.radius / K[:, 0, 0]) ** 2 / (1 + (rays**2).sum(1))

    def split(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return x[: 3 * T].reshape(T, 3), x[3 * T : 3 * T + V], x[3 * T + V :].reshape(V, 2)

    def misses(x: np.ndarray) -> np.ndarray:
        places, offsets, shifts = split(x)
        i, w = _weights(seen.frame + offsets[seen.camera] - first, T)
        point = np.einsum("nk,nkd->nd", w, places[i[:, None] + np.arange(-1, 3)])
        local = np.einsum("nij,nj->ni", w2c[:, :3, :3], point) + w2c[:, :3, 3]
        return (
            np.einsum("nij,nj->ni", K[:, :2, :2], outline_middle(local, sine))
            + K[:, :2, 2]
            + shifts[seen.camera]
            - seen.pixel
        )

    def residuals(x: np.ndarray) -> np.ndarray:
        places, offsets, shifts = split(x)
        bend = STIFF * (places[2:] - 2 * places[1:-1] + places[:-2])
        return np.concatenate([misses(x).ravel(), bend.ravel(), 0.05 * shifts.ravel(), [100 * offsets.sum()]])

    first = int(seen.frame.min()) - 2
    T = int(seen.frame.max()) + 3 - first
    if start is None or len(start) != 3 * T + 3 * V:
        start = np.concatenate([_first_path(cameras, seen, first, T).ravel(), np.zeros(3 * V)])
    solved = least_squares(
        residuals, start, jac_sparsity=_sparsity(seen, first, T, V), loss="soft_l1", f_scale=0.4, x_scale="jac"
    )
    offsets = split(solved.x)[1]
    return offsets - offsets.mean(), float(np.median(np.abs(misses(solved.x)))), solved.x


def outline_middle(local: np.ndarray, sine: np.ndarray) -> np.ndarray:
    """Middles (N,2) of the outlines of balls at ``local`` (N,3) in camera axes, on the plane z = 1.

    Args:
        sine: (N,) squared sine of half the angle that each ball is seen under.
    """
    towards = local / np.linalg.norm(local, axis=1, keepdims=True)
    return towards[:, :2] * towards[:, 2:] / (towards[:, 2:] ** 2 - sine[:, None])


def _weights(at: np.ndarray, T: int) -> tuple[np.ndarray, np.ndarray]:
    """Cubic convolution (Keys 1981) at times ``at``: the sample before each, and four weights from one before that."""
    i = np.floor(at).astype(int).clip(1, T - 3)
    f = at - i
    return i, np.stack(
        [
            -0.5 * f + f**2 - 0.5 * f**3,
            1 - 2.5 * f**2 + 1.5 * f**3,
            0.5 * f + 2 * f**2 - 1.5 * f**3,
            -0.5 * f**2 + 0.5 * f**3,
        ],
        1,
    )


def _first_path(cameras: Sequence[Camera], seen: Centres, first: int, T: int) -> np.ndarray:
    """Places (T,3) frame by frame as if all cameras were synchronous, straight between them."""
    projections = np.array([c.K @ c.w2c[:3] for c in cameras])
    frames = np.unique(seen.frame)
    at = [seen.frame == f for f in frames]
    points = np.array([_meeting(projections[seen.camera[own]], seen.pixel[own])[:3] for own in at])
    return np.stack([np.interp(np.arange(T) + first, frames, points[:, d]) for d in range(3)], 1)


def _sparsity(seen: Centres, first: int, T: int, V: int) -> Any:
    """Which residual depends on which unknown; offsets move a centre by two frames at the most."""
    N = len(seen.frame)
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    for d in range(2):
        row = 2 * np.arange(N) + d
        for step in range(-3, 5):
            place = (seen.frame - first + step).clip(0, T - 1)
            pairs += [(row, 3 * place + axis) for axis in range(3)]
        pairs += [(row, 3 * T + seen.camera), (row, 3 * T + V + 2 * seen.camera + d)]
    bent = np.arange(3 * (T - 2))
    pairs += [(2 * N + bent, bent + 3 * step) for step in range(3)]
    shift = np.arange(2 * V)
    after = 2 * N + 3 * (T - 2)
    pairs += [(after + shift, 3 * T + V + shift), (np.full(V, after + 2 * V), 3 * T + np.arange(V))]
    rows, columns = (np.concatenate(x) for x in zip(*pairs, strict=True))
    shape = (after + 2 * V + 1, 3 * T + 3 * V)
    return coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=shape)
