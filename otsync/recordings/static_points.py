"""Points of the static background with known depth, without learned weights: what ties estimated depth to the world.

Cameras whose poses are known look at one background, whatever their clocks: features of it (SIFT) are matched between
videos, and between frames of a camera that moves, held against the epipolar geometry, and triangulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ..compute.indices import evenly
from ..geometry import common_target, fundamental, sampson, undistort
from ..priors.working import WorkingFrames
from ..types import Camera, Video

SAMPLES = 25
"""Frames that the background of a static camera is the median of: what moves is seldom in one place."""

VIEWS = 12
"""Frames of a moving camera that are looked at, evenly spread."""

FEATURES = 3000
"""Of a picture, the strongest ones."""

RATIO = 0.8
"""Of the distances to the nearest and the second-nearest descriptor, from which on a match is a guess (Lowe 2004)."""

OFF = 1.5
"""Pixels at 640 of width that a match may lie off its epipolar line, and a point off its pixels."""

NARROWEST, WIDEST = 2.0, 60.0
"""Degrees between two rays: below, depth is a guess; beyond, the same thing looks different."""

PARTNERS = 8
"""Views that each is matched with."""

CHANCE = 4.0
"""Times as many matches as would lie on their lines by chance: below, a pair of views tells nothing."""

LEAST = 6
"""Matches of a pair of views, from which on it counts."""


@dataclass(frozen=True, eq=False)
class View:
    """A picture of the background. frame: -1 where it is of the whole clip.

    uv: (N,2) undistorted pixels of the features, raw: the image's own; words: (N,128) unit vectors.
    """

    video: int
    frame: int
    camera: Camera
    uv: Float[np.ndarray, "N 2"]
    raw: Float[np.ndarray, "N 2"]
    words: Float[np.ndarray, "N 128"]


@dataclass(frozen=True, eq=False)
class Points:
    """Points of the background that a video sees.

    xyz: (M,3) world. uv: (M,2) the image's own pixels, where it was seen. frame: (M,) where, -1 in a static camera.
    sigma: (M,) error of its depth, as a share of it.
    """

    xyz: Float[np.ndarray, "M 3"]
    uv: Float[np.ndarray, "M 2"]
    frame: Int[np.ndarray, " M"]
    sigma: Float[np.ndarray, " M"]

    def __len__(self) -> int:
        return len(self.xyz)


def static_points(
    videos: Sequence[Video], masks: Sequence[Sequence[np.ndarray]], width: int, map: Any = map
) -> list[Points]:
    """For every video the points of the background that it shares with another one, or with its own other frames.

    Args:
        videos: with poses in one frame. masks: (h,w) foreground per frame at working size, left out of single frames.
        width: pixels of width that is worked at.
    """
    listed = [(v, k) for v, video in enumerate(videos) for k in _frames(video)]
    views = list(map(lambda at: _view(videos[at[0]], masks[at[0]], at[0], at[1], width), listed))
    found: list[list[tuple[int, Int[np.ndarray, " K"], np.ndarray, np.ndarray]]] = [[] for _ in views]
    pairs = partners(views)
    for (i, j), seen in zip(pairs, map(lambda pair: matched(views[pair[0]], views[pair[1]]), pairs), strict=True):
        for one, other, kept in ((i, j, seen), (j, i, seen[:, ::-1])):
            if len(kept):
                found[one].append(_depths(views[one], views[other], kept))
    out = []
    for v in range(len(videos)):
        own = [_joined(view, found[n]) for n, view in enumerate(views) if view.video == v]
        out.append(Points(*(np.concatenate([getattr(p, f) for p in own]) for f in ("xyz", "uv", "frame", "sigma"))))
    return out


def _frames(video: Video) -> list[int]:
    return [-1] if video.camera.w2c.ndim == 2 else evenly(len(video.frames), VIEWS).tolist()


def _view(video: Video, masks: Sequence[np.ndarray], v: int, k: int, width: int) -> View:
    import cv2

    camera = video.camera
    frames = WorkingFrames(video.frames, (camera.width, camera.height), width)
    use = None
    if k < 0:
        picks = evenly(len(frames), SAMPLES)
        image = np.median(np.stack([frames[int(p)] for p in picks]), 0).astype(np.uint8)
    else:
        image, camera = frames[k], replace(camera, w2c=camera.w2c[k])
        edge = max(3, round(9 * frames.unit))
        moving = frames.mask(np.asarray(masks[k])).astype(np.uint8)
        use = 255 - 255 * cv2.dilate(moving, np.ones((edge, edge), np.uint8))
    sift: Any = cv2.SIFT_create(FEATURES, contrastThreshold=0.02)  # type: ignore[attr-defined]
    keys, words = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), use)
    if not keys:
        return View(v, k, camera, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    # the square root makes Euclid's distance Hellinger's (Arandjelovic and Zisserman 2012)
    words = np.sqrt(words / np.maximum(words.sum(1, keepdims=True), 1e-12))
    raw = frames.to_full(np.array([key.pt for key in keys]))
    return View(v, k, camera, undistort(camera, raw), raw, words.astype(np.float32))


def partners(views: Sequence[View]) -> list[tuple[int, int]]:
    """Pairs of views to match: of each the nearest in direction that stand apart enough to triangulate."""
    if len(views) < 2:
        return []
    target = common_target([v.camera for v in views])
    centre = np.stack([v.camera.center for v in views])
    axis = np.stack([v.camera.w2c[2, :3] for v in views])
    away = np.linalg.norm(centre - target, axis=1)
    pairs = set()
    for i in range(len(views)):
        turned = np.degrees(np.arccos(np.clip(axis @ axis[i], -1, 1)))
        apart = np.linalg.norm(centre - centre[i], axis=1)
        good = (turned <= WIDEST) & (apart > np.tan(np.radians(NARROWEST)) * min(away[i], float(np.median(away))) / 2)
        good[i] = False
        near = np.flatnonzero(good)
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in near[np.argsort(turned[near], kind="stable")][:PARTNERS]}
    return sorted(pairs)


def matched(a: View, b: View) -> Int[np.ndarray, "K 2"]:
    """Pairs of features that are each other's nearest, by far, and obey the geometry; none where chance would do it."""
    none = np.zeros((0, 2), int)
    if min(len(a.uv), len(b.uv)) < LEAST:
        return none
    near = a.words @ b.words.T
    pairs = _mutual(near)
    tolerance = OFF * a.camera.width / 640
    F = fundamental(a.camera, b.camera)
    on_line = np.abs(sampson(F, a.uv[pairs[:, 0]], b.uv[pairs[:, 1]])) <= tolerance
    by_chance = len(pairs) * 2 * tolerance / b.camera.height
    kept = pairs[on_line]
    if len(kept) < max(LEAST, CHANCE * by_chance):
        return none
    return kept[_triangulates(a, b, kept)]


def _mutual(near: Float[np.ndarray, "N M"]) -> Int[np.ndarray, "K 2"]:
    """Each other's nearest, much nearer than the second: cosines of unit vectors."""
    best = near.argmax(1)
    rows = np.arange(len(near))
    first = near[rows, best]
    second = np.partition(near, -2, axis=1)[:, -2]
    distance = np.sqrt(np.maximum(2 - 2 * np.stack([first, second]), 0))
    good = (near.argmax(0)[best] == rows) & (distance[0] < RATIO * distance[1])
    return np.stack([rows[good], best[good]], 1)


def _triangulates(a: View, b: View, pairs: Int[np.ndarray, "K 2"]) -> Bool[np.ndarray, " K"]:
    """Whether rays meet before both cameras, at an angle that tells depth, near both pixels."""
    q, _, angle = _inverse_depths(a, b, pairs)
    good = (q > 0) & (angle >= NARROWEST) & (angle <= 2 * WIDEST)
    xyz = _places(a, a.uv[pairs[:, 0]], 1 / np.where(good, q, 1.0))
    seen = b.camera.project(xyz[:, None])[:, 0]
    off = np.linalg.norm(seen - b.uv[pairs[:, 1]], axis=1)
    return good & (off <= 2 * OFF * b.camera.width / 640)  # nan, behind b, is not


def _inverse_depths(
    a: View, b: View, pairs: Int[np.ndarray, "K 2"]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """Of a's features: inverse depth along a's z, its sigma as a share, and the angle between the rays in degrees."""
    ra, rb = (_rays(v, v.uv[pairs[:, n]]) for n, v in enumerate((a, b)))  # world, unit z in the camera
    base = b.camera.center - a.camera.center
    aa, bb, ab = (ra * ra).sum(1), (rb * rb).sum(1), (ra * rb).sum(1)
    det = np.maximum(aa * bb - ab * ab, 1e-12)
    z = ((ra @ base) * bb - (rb @ base) * ab) / det
    angle = np.degrees(np.arccos(np.clip(ab / np.sqrt(aa * bb), -1, 1)))
    q = np.where(z > 1e-9, 1 / np.where(z > 1e-9, z, 1.0), -1.0)
    # a pixel across the epipolar line of b moves the meeting point by about its angle over that between the rays
    pixel = 0.5 * OFF * b.camera.width / 640 / b.camera.K[0, 0]
    zb = np.maximum(((_places(a, a.uv[pairs[:, 0]], np.maximum(z, 0)) - b.camera.center) * rb).sum(1) / bb, 0)
    share = pixel * zb * np.sqrt(bb) / np.maximum(np.linalg.norm(base) * np.abs(np.sin(_to_base(ra, base))), 1e-9)
    return q, share, angle


def _to_base(rays: np.ndarray, base: np.ndarray) -> np.ndarray:
    cosine = rays @ base / np.maximum(np.linalg.norm(rays, axis=1) * np.linalg.norm(base), 1e-12)
    return np.arccos(np.clip(cosine, -1, 1))


def _rays(view: View, uv: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K 3"]:
    """Directions in the world whose z in the camera is 1."""
    local = np.concatenate([uv, np.ones((len(uv), 1))], 1) @ np.linalg.inv(view.camera.K).T
    return local @ view.camera.w2c[:3, :3]


def _places(view: View, uv: Float[np.ndarray, "K 2"], z: Float[np.ndarray, " K"]) -> Float[np.ndarray, "K 3"]:
    return view.camera.center + _rays(view, uv) * z[:, None]


def _depths(a: View, b: View, pairs: Int[np.ndarray, "K 2"]) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    q, sigma, _ = _inverse_depths(a, b, pairs)
    return b.video, pairs[:, 0], q, sigma


def _joined(view: View, found: Sequence[tuple[int, np.ndarray, np.ndarray, np.ndarray]]) -> Points:
    """One point a feature: what its matches in other views agree on."""
    if not found:
        return Points(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0, int), np.zeros(0))
    of, q, sigma = (np.concatenate([f[n] for f in found]) for n in (1, 2, 3))
    features, row = np.unique(of, return_inverse=True)
    depth, share, keep = np.zeros(len(features)), np.zeros(len(features)), np.zeros(len(features), bool)
    for n in range(len(features)):
        own, s = q[row == n], np.maximum(sigma[row == n], 1e-4)
        middle = own[np.argsort(own)[len(own) // 2]] if len(own) != 2 else own[s.argmin()]
        agree = np.abs(own - middle) <= 3 * np.hypot(s, 0.01) * middle
        weight = agree / s**2
        depth[n], share[n] = weight.sum() / (weight @ own), weight.sum() ** -0.5
        keep[n] = agree.sum() * 2 > len(own) or len(own) == 1
    features, depth, share = features[keep], depth[keep], share[keep]
    frame = np.full(len(features), view.frame)
    return Points(_places(view, view.uv[features], depth), view.raw[features], frame, share)
