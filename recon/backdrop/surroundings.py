"""Where the background lies without depth: a floor and a shell around the scene, searched for by photo-consistency.

A surface in its true place has the same colours in all cameras that see it. So the height and the tilt of the floor,
and the centre and radius of the shell (the dome that cameras hang on, the walls of a hall, or just "far away"), are
those at which the cameras' backgrounds agree best. Nothing assumes which axis points up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter
from scipy.optimize import minimize

from recon.backdrop.stills import Still

PARALLEL = 0.02
"""Least curvature of the optical axes' common point, per camera: below, the axes are parallel and meet nowhere."""

HEIGHTS, LEVEL, SPOTS = 41, 0.75, 48
"""The search for a floor: heights; radius of the compared disc, in distances of the cameras; spots across it."""

BELOW, ABOVE, LOWEST = 0.1, 0.05, 0.5
"""With points of what moves: heights from this far below to this far above their lowest, in distances of the cameras; a
percentile stands for the lowest, since some points are wrong."""

TILT, TILT_COST, TILT_TRIES = 0.01, 0.02, 160
"""Tilting the floor: a step, as a slope; what a tilt of three steps must gain in agreement; tries at most."""

RADII, WIDEST, CLOSER = 20, 8.0, 9
"""The search for a shell: radii, up to this many distances of the cameras; radii in the second, closer search."""

FAR_AWAY = 2.5
"""Radius of the shell, in distances of the cameras, where they agree on none."""

SEEN_TWICE, SHARE_SEEN = 30, 0.05
"""Points that two cameras must see for a verdict on a surface, and share of all of its points."""

RAYS = 32
"""Rays per image width along which a shell is searched."""

UPRIGHT = 0.1
"""Weight of the images' vertical against the cameras' horizontals in the search for up: it decides only where they do
not."""

AGREEMENT = 0.75
"""A surface is believed where the colours on it differ by less than this share of how much they differ overall."""


@dataclass(frozen=True, eq=False)
class Floor:
    """The plane ``normal · x = height``; the unit normal points up, away from the ground."""

    normal: Float[np.ndarray, " 3"]
    height: float

    def hit(self, origin: Float[np.ndarray, "N 3"], direction: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """Distance to it along each ray; infinite where the ray does not come down on it."""
        falling = direction @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            away = (self.height - origin @ self.normal) / falling
        return np.where((falling < -1e-9) & (away > 0), away, np.inf)

    def normals(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        return np.broadcast_to(self.normal, points.shape)


@dataclass(frozen=True, eq=False)
class Shell:
    """A sphere seen from inside: the far side of every ray."""

    center: Float[np.ndarray, " 3"]
    radius: float

    def hit(self, origin: Float[np.ndarray, "N 3"], direction: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """Distance to it along each ray (unit direction); infinite for rays that miss it."""
        apart = origin - self.center
        b = (direction * apart).sum(1)
        inside = b**2 - (apart**2).sum(1) + self.radius**2
        away = -b + np.sqrt(np.maximum(inside, 0))
        return np.where((inside >= 0) & (away > 0), away, np.inf)

    def normals(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        inward = self.center - points
        return inward / np.linalg.norm(inward, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The surfaces behind the scene.

    Args:
        floor: None where the cameras agree on no plane below them.
        shell: stands for everything that is not floor.
        focus: the point that the cameras look at.
        distance: median distance of the cameras from it, world units: the scale of the scene.
    """

    floor: Floor | None
    shell: Shell
    focus: Float[np.ndarray, " 3"]
    distance: float

    def cast(
        self, origin: Float[np.ndarray, "N 3"], direction: Float[np.ndarray, "N 3"]
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
        """(distance along each ray of unit direction, surface normal there); infinite where nothing is hit."""
        away = self.shell.hit(origin, direction)
        on_floor = np.zeros(len(away), bool)
        if self.floor is not None:
            below = self.floor.hit(origin, direction)
            on_floor = below < away
            away = np.minimum(away, below)
        points = origin + np.where(np.isfinite(away), away, 0)[:, None] * direction
        normals = self.shell.normals(points)
        if self.floor is not None:
            normals = np.where(on_floor[:, None], self.floor.normal, normals)
        return away, normals


def surroundings(
    stills: Sequence[Still],
    points: Float[np.ndarray, "N 3"] | None = None,
    floor: Floor | None = None,
) -> Surroundings:
    """Find floor and shell in pictures of the background.

    Args:
        points: of what moves, at any time: they tell the scale of a scene that one camera filmed, and the floor lies
            under them.
        floor: where it is known.
    """
    focus, distance = common_focus(stills, points)
    lookups = [Lookup.of(s) for s in stills]
    if floor is None and len(stills) > 1:
        floor = find_floor(lookups, up_axis(np.stack([s.w2c for s in stills])), focus, distance, points)
    return Surroundings(floor, find_shell(lookups, focus, distance, floor), focus, distance)


def common_focus(
    stills: Sequence[Still], points: Float[np.ndarray, "N 3"] | None = None
) -> tuple[Float[np.ndarray, " 3"], float]:
    """The point that is nearest to all optical axes, and the cameras' median distance from it.

    Parallel axes meet nowhere: then, and for a single camera, the median of ``points`` is taken, or of the depth that
    the pictures have. ValueError without.
    """
    centers, axes = np.stack([s.center for s in stills]), np.stack([s.w2c[2, :3] for s in stills])
    focus = None
    across = np.eye(3) - axes[:, :, None] * axes[:, None]  # projections onto the planes across the axes
    if np.linalg.svd(across.sum(0))[1][-1] > PARALLEL * len(stills):
        focus = np.linalg.solve(across.sum(0), np.einsum("vij,vj->i", across, centers))
        if np.median(((focus - centers) * axes).sum(1)) <= 0:
            focus = None
    if focus is None:
        if points is None or not len(points):
            points = np.concatenate([_lifted(s) for s in stills])
        if not len(points):
            raise ValueError(
                "points: expected some of the scene, since the cameras do not look at one place and so tell no "
                "distance; found none. Give lifted tracks or depth."
            )
        focus = np.median(points, 0)
    return focus, float(np.median(np.linalg.norm(focus - centers, axis=1)))


def up_axis(poses: Float[np.ndarray, "V 4 4"]) -> Float[np.ndarray, " 3"]:
    """The world's up, unit: as far as can be at right angles to the horizontals of the cameras ``poses`` (w2c).

    Cameras around a scene are pitched towards it, which their horizontals do not show. A few that stand side by side
    have but one horizontal; then the vertical of their images decides.
    """
    across, up = poses[:, 0, :3], -poses[:, 1, :3].mean(0)
    moment = across.T @ across / len(poses) - UPRIGHT * np.outer(up, up)
    axis = np.linalg.eigh(moment)[1][:, 0]
    return axis * (np.sign(axis @ up) or 1.0)


def find_floor(
    lookups: Sequence[Lookup],
    up: Float[np.ndarray, " 3"],
    focus: Float[np.ndarray, " 3"],
    distance: float,
    points: Float[np.ndarray, "N 3"] | None = None,
) -> Floor | None:
    """The plane across ``up`` below the focus on which the cameras agree best, then tilted to agree still better.

    With ``points`` of what moves only heights near their lowest are tried: things stand on floors.
    """
    low, high = focus @ up - distance, focus @ up
    if points is not None and len(points):
        lowest = np.percentile(points @ up, LOWEST)
        low, high = lowest - BELOW * distance, lowest + ABOVE * distance
    # a direction of the scene, not of its axes: a turned scene gets the turned floor
    sides = np.cross(up, np.stack([v.center for v in lookups]) - focus)
    side = max(sides, key=np.linalg.norm)
    side = side / np.linalg.norm(side)
    frame = np.stack([side, np.cross(up, side)])
    grid = np.linspace(-LEVEL, LEVEL, SPOTS) * distance
    spots = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    spots = spots[(spots**2).sum(1) < (LEVEL * distance) ** 2]
    level = focus - (focus @ up) * up + spots @ frame

    def at(height: float, tilt: Float[np.ndarray, " 2"]) -> Float[np.ndarray, "N 3"]:
        return level + (height + spots @ tilt)[:, None] * up

    heights = np.linspace(low, high, HEIGHTS)
    scores = [disagreement(lookups, at(h, np.zeros(2))) for h in heights]
    best = int(np.argmin(scores))
    step = heights[1] - heights[0]

    def cost(x: np.ndarray) -> float:
        """Of a height and a tilt, which costs something: a few cameras would agree on one that suits a stain."""
        return (
            disagreement(lookups, at(heights[best] + x[0] * step, x[1:] * TILT))
            + TILT_COST * float((x[1:] ** 2).sum()) / 3**2
        )

    start = np.vstack([np.zeros(3), np.eye(3)])
    tilted = minimize(cost, start[0], method="Nelder-Mead", options={"maxfev": TILT_TRIES, "initial_simplex": start})
    height, tilt = heights[best] + tilted.x[0] * step, tilted.x[1:] * TILT
    if not disagreement(lookups, at(height, tilt)) < AGREEMENT:
        return None
    normal = up - tilt @ frame
    normal /= np.linalg.norm(normal)
    return Floor(normal, float(at(height, tilt)[0] @ normal))


def find_shell(
    lookups: Sequence[Lookup], focus: Float[np.ndarray, " 3"], distance: float, floor: Floor | None
) -> Shell:
    """The sphere on which the cameras agree best about what is not floor; a wide one where they agree on none.

    Centres tried: that of the sphere through the cameras (they hang on a dome), the focus, and the cameras' own middle
    (they stand side by side).
    """
    centers = np.stack([v.center for v in lookups])
    origin = np.concatenate([np.broadcast_to(v.center, v.rays.shape) for v in lookups])
    rays = np.concatenate([v.rays for v in lookups])
    below = np.full(len(rays), np.inf) if floor is None else floor.hit(origin, rays)
    wide = Shell(focus, FAR_AWAY * distance)
    if len(lookups) < 2:
        return wide

    def cost(shell: Shell) -> float:
        away = shell.hit(origin, rays)
        ok = np.isfinite(away) & (away < below)
        return disagreement(lookups, origin[ok] + away[ok, None] * rays[ok]) if ok.mean() > 0.02 else 1.0

    tried: list[tuple[float, Shell]] = []
    for middle in (_sphere(centers, focus, distance), focus, centers.mean(0)):
        least = max(np.linalg.norm(centers - middle, axis=1).max(), 0.5 * distance)
        radii = np.geomspace(least, WIDEST * distance, RADII)
        costs = [cost(Shell(middle, float(r))) for r in radii]
        i = int(np.argmin(costs))
        around = np.geomspace(radii[max(i - 1, 0)], radii[min(i + 1, len(radii) - 1)], CLOSER)
        tried += [(c, Shell(middle, float(r))) for r, c in zip(radii, costs, strict=True)]
        tried += [(cost(shell), shell) for shell in (Shell(middle, float(r)) for r in around)]
    score, best = min(tried, key=lambda pair: pair[0])
    return best if score < AGREEMENT else wide


@dataclass(frozen=True, eq=False)
class Lookup:
    """Colours of one camera's background at points of the world: log RGB, blurred a little, and where it was seen."""

    colors: Float[np.ndarray, "h w 3"]
    seen: Bool[np.ndarray, "h w"]
    K: Float[np.ndarray, "3 3"]
    w2c: Float[np.ndarray, "4 4"]
    center: Float[np.ndarray, " 3"]
    rays: Float[np.ndarray, "N 3"]

    @classmethod
    def of(cls, still: Still) -> Lookup:
        blurred = uniform_filter(still.image.astype(np.float32) / 255, (5, 5, 0))
        u, v = still.pixels(max(1, still.size[0] // RAYS))
        return cls(np.log(blurred + 0.02), still.where, still.K, still.w2c, still.center, still.rays(u, v))

    def project(self, points: Float[np.ndarray, "N 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(columns, rows, depths) [N] of points in the image; where the depth is not above 0, columns and rows say
        nothing.
        """
        cam = points @ self.w2c[:3, :3].T + self.w2c[:3, 3]
        z = np.maximum(cam[:, 2], 1e-9)
        return cam[:, 0] / z * self.K[0, 0] + self.K[0, 2], cam[:, 1] / z * self.K[1, 1] + self.K[1, 2], cam[:, 2]

    def look(self, points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, "N 3"], Bool[np.ndarray, " N"]]:
        """(log colours of points, which of them are in view)."""
        h, w = self.seen.shape
        x, y, z = self.project(points)
        u = np.floor(x).clip(-1, w).astype(int)
        v = np.floor(y).clip(-1, h).astype(int)
        inside = (z > 0) & (u >= 0) & (v >= 0) & (u < w) & (v < h)
        u, v = np.where(inside, u, 0), np.where(inside, v, 0)
        return self.colors[v, u], inside & self.seen[v, u]


def disagreement(lookups: Sequence[Lookup], points: Float[np.ndarray, "N 3"]) -> float:
    """How much cameras differ in the colours of surface points, as a share of how much colours differ overall.

    0: they agree; about 1: they see unrelated things. The cameras' gains are taken out. 1 where too few points are seen
    twice.
    """
    looks = [lookup.look(points) for lookup in lookups]
    colors, ok = np.stack([c for c, _ in looks]), np.stack([k for _, k in looks])
    twice = ok.sum(0) >= 2
    if twice.sum() < max(SEEN_TWICE, SHARE_SEEN * len(points)):
        return 1.0
    colors, weight = colors[:, twice], ok[:, twice, None].astype(np.float32)
    count = weight.sum(0)
    for _ in range(3):
        mean = (colors * weight).sum(0) / count
        colors = colors - (((colors - mean) * weight).sum(1) / np.maximum(weight.sum(1), 1))[:, None]
    mean = (colors * weight).sum(0) / count
    # n samples lie nearer to their own mean than to the truth: without the correction pairs would seem to agree
    within = (np.abs(colors - mean) * weight * np.sqrt(count / (count - 1))).sum()
    overall = np.median(colors[ok[:, twice]], 0)
    return float(within / max((np.abs(colors - overall) * weight).sum(), 1e-12))


def _lifted(still: Still) -> Float[np.ndarray, "N 3"]:
    """Some points of the background at their known depth."""
    u, v = still.pixels(max(1, still.size[0] // RAYS))
    if still.depth is None:
        return np.empty((0, 3))
    known = still.depth[v, u] > 0
    return still.lift(u[known], v[known], still.depth[v, u][known])


def _sphere(
    centers: Float[np.ndarray, "V 3"], focus: Float[np.ndarray, " 3"], distance: float
) -> Float[np.ndarray, " 3"]:
    """Centre of the sphere nearest to the cameras; drawn towards the focus where they leave it open, as a ring does."""
    x = (centers - focus) / distance
    lhs = np.concatenate([np.c_[2 * x, np.ones(len(x))], np.c_[0.1 * np.eye(3), np.zeros(3)]])
    rhs = np.concatenate([(x**2).sum(1), np.zeros(3)])
    return focus + distance * np.linalg.lstsq(lhs, rhs, rcond=None)[0][:3]
