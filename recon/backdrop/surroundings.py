"""Where the background is when no depth tells: a floor and a shell around the scene, found by what cameras agree on.

A surface that is where it is believed to be has the same colours in all cameras that see it. So the height and the tilt
of the floor, and the centre and radius of the shell (the dome that cameras hang on, the walls of a hall, or just
"far away"), are those for which the cameras' backgrounds agree best. Nothing assumes which axis points up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter
from scipy.optimize import minimize

from recon.backdrop.stills import Still

AGREEMENT = 0.75
"""A surface is believed when colours on it differ by less than this share of what they differ overall."""


@dataclass(frozen=True, eq=False)
class Floor:
    """The plane ``normal · x = height``; the unit normal points up, away from the ground."""

    normal: Float[np.ndarray, " 3"]
    height: float

    def hit(self, origin: Float[np.ndarray, "N 3"], direction: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """How far along each ray it lies; infinite where the ray does not come down on it."""
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
        """How far along each ray (unit direction) it lies; infinite for rays that miss it."""
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
    """What lies behind the scene.

    Args:
        floor: or None where no plane below the cameras agrees.
        shell: everything that is not floor.
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
    """Find floor and shell from pictures of the background.

    Args:
        points: of what moves, anywhere in time: they tell the scale of a scene that one camera filmed, and what the
            floor lies under.
        floor: when it is known.
    """
    focus, distance = look_at(stills, points)
    views = [View.of(s) for s in stills]
    if floor is None and len(stills) > 1:
        floor = find_floor(views, up_axis(stills), focus, distance, points)
    return Surroundings(floor, find_shell(views, focus, distance, floor), focus, distance)


def look_at(
    stills: Sequence[Still], points: Float[np.ndarray, "N 3"] | None = None
) -> tuple[Float[np.ndarray, " 3"], float]:
    """The point that is nearest to all optical axes, and the cameras' median distance from it.

    Parallel axes meet nowhere: then, and for a single camera, the median of ``points`` is taken, or of the depth that
    the pictures have. ValueError without.
    """
    centers, axes = np.stack([s.center for s in stills]), np.stack([s.w2c[2, :3] for s in stills])
    focus = None
    across = np.eye(3) - axes[:, :, None] * axes[:, None]  # projections onto the planes across the axes
    if np.linalg.svd(across.sum(0))[1][-1] > 0.02 * len(stills):
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


def up_axis(stills: Sequence[Still]) -> Float[np.ndarray, " 3"]:
    """The direction that is up in the images of most cameras, at right angles to their horizontals as far as can be.

    Cameras around a scene are pitched towards it, which the horizontals do not show; a few that stand side by side
    have but one horizontal, and the images' vertical decides.
    """
    w2c = np.stack([s.w2c for s in stills])
    across, up = w2c[:, 0, :3], -w2c[:, 1, :3].mean(0)
    moment = across.T @ across / len(stills) - 0.1 * np.outer(up, up)
    axis = np.linalg.eigh(moment)[1][:, 0]
    return axis * np.sign(axis @ up)


def find_floor(
    views: Sequence[View],
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
        lowest = np.percentile(points @ up, 0.5)
        low, high = lowest - 0.1 * distance, lowest + 0.05 * distance
    # a direction of the scene, not of its axes: a turned scene gets the turned floor
    sides = np.cross(up, np.stack([v.center for v in views]) - focus)
    side = max(sides, key=np.linalg.norm)
    side = side / np.linalg.norm(side)
    frame = np.stack([side, np.cross(up, side)])
    grid = np.linspace(-0.75, 0.75, 48) * distance
    spots = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    spots = spots[(spots**2).sum(1) < (0.75 * distance) ** 2]
    level = focus - (focus @ up) * up + spots @ frame

    def at(height: float, tilt: Float[np.ndarray, " 2"]) -> Float[np.ndarray, "N 3"]:
        return level + (height + spots @ tilt)[:, None] * up

    heights = np.linspace(low, high, 41)
    scores = [disagreement(views, at(h, np.zeros(2))) for h in heights]
    best = int(np.argmin(scores))
    step = heights[1] - heights[0]

    def cost(x: np.ndarray) -> float:
        """Of a height and a tilt; few cameras would else agree on a tilt that suits a stain."""
        return disagreement(views, at(heights[best] + x[0] * step, x[1:] * 0.01)) + 0.02 * float((x[1:] ** 2).sum()) / 9

    start = np.vstack([np.zeros(3), np.eye(3)])
    found = minimize(cost, start[0], method="Nelder-Mead", options={"maxfev": 160, "initial_simplex": start})
    height, tilt = heights[best] + found.x[0] * step, found.x[1:] * 0.01
    if not disagreement(views, at(height, tilt)) < AGREEMENT:
        return None
    normal = up - tilt @ frame
    normal /= np.linalg.norm(normal)
    return Floor(normal, float(at(height, tilt)[0] @ normal))


def find_shell(views: Sequence[View], focus: Float[np.ndarray, " 3"], distance: float, floor: Floor | None) -> Shell:
    """The sphere on which the cameras agree best about what is not floor; a wide one where none convinces.

    Centres tried: that of the sphere through the cameras (they hang on a dome), the focus, and the cameras' own middle
    (they stand side by side).
    """
    centers = np.stack([v.center for v in views])
    origin = np.concatenate([np.broadcast_to(v.center, v.rays.shape) for v in views])
    rays = np.concatenate([v.rays for v in views])
    below = np.full(len(rays), np.inf) if floor is None else floor.hit(origin, rays)
    wide = Shell(focus, 2.5 * distance)
    if len(views) < 2:
        return wide

    def cost(shell: Shell) -> float:
        away = shell.hit(origin, rays)
        ok = np.isfinite(away) & (away < below)
        return disagreement(views, origin[ok] + away[ok, None] * rays[ok]) if ok.mean() > 0.02 else 1.0

    tried: list[tuple[float, Shell]] = []
    for middle in (_sphere(centers, focus, distance), focus, centers.mean(0)):
        least = max(np.linalg.norm(centers - middle, axis=1).max(), 0.5 * distance)
        radii = np.geomspace(least, 8 * distance, 20)
        costs = [cost(Shell(middle, float(r))) for r in radii]
        i = int(np.argmin(costs))
        around = np.geomspace(radii[max(i - 1, 0)], radii[min(i + 1, len(radii) - 1)], 9)
        tried += [(c, Shell(middle, float(r))) for r, c in zip(radii, costs, strict=True)]
        tried += [(cost(shell), shell) for shell in (Shell(middle, float(r)) for r in around)]
    score, best = min(tried, key=lambda pair: pair[0])
    return best if score < AGREEMENT else wide


@dataclass(frozen=True, eq=False)
class View:
    """One camera's background, blurred a little, as colours to compare: log RGB, and where it was seen."""

    colors: Float[np.ndarray, "h w 3"]
    seen: Bool[np.ndarray, "h w"]
    K: Float[np.ndarray, "3 3"]
    w2c: Float[np.ndarray, "4 4"]
    center: Float[np.ndarray, " 3"]
    rays: Float[np.ndarray, "N 3"]

    @classmethod
    def of(cls, still: Still) -> View:
        blurred = uniform_filter(still.image.astype(np.float32) / 255, (5, 5, 0))
        u, v = still.pixels(max(1, still.size[0] // 32))
        return cls(np.log(blurred + 0.02), still.where, still.K, still.w2c, still.center, still.rays(u, v))

    def look(self, points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, "N 3"], Bool[np.ndarray, " N"]]:
        """(log colours, which are in view) of points."""
        cam = points @ self.w2c[:3, :3].T + self.w2c[:3, 3]
        h, w = self.seen.shape
        z = np.maximum(cam[:, 2], 1e-9)
        u = np.floor(cam[:, 0] / z * self.K[0, 0] + self.K[0, 2]).clip(-1, w).astype(int)
        v = np.floor(cam[:, 1] / z * self.K[1, 1] + self.K[1, 2]).clip(-1, h).astype(int)
        inside = (cam[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < w) & (v < h)
        u, v = np.where(inside, u, 0), np.where(inside, v, 0)
        return self.colors[v, u], inside & self.seen[v, u]


def disagreement(views: Sequence[View], points: Float[np.ndarray, "N 3"]) -> float:
    """How much cameras differ about the colours of surface points, as a share of how much colours differ at all.

    0: they agree; about 1: they see unrelated things. Gains of the cameras are taken out. 1 where too few points are
    seen twice to tell.
    """
    looks = [view.look(points) for view in views]
    colors, ok = np.stack([c for c, _ in looks]), np.stack([k for _, k in looks])
    twice = ok.sum(0) >= 2
    if twice.sum() < max(30, 0.05 * len(points)):
        return 1.0
    colors, weight = colors[:, twice], ok[:, twice, None].astype(np.float32)
    count = weight.sum(0)
    for _ in range(3):
        mean = (colors * weight).sum(0) / count
        colors = colors - (((colors - mean) * weight).sum(1) / np.maximum(weight.sum(1), 1))[:, None]
    mean = (colors * weight).sum(0) / count
    # n samples stay nearer to their own mean than to the truth: correct for it, or pairs would seem to agree
    within = (np.abs(colors - mean) * weight * np.sqrt(count / (count - 1))).sum()
    overall = np.median(colors[ok[:, twice]], 0)
    return float(within / max((np.abs(colors - overall) * weight).sum(), 1e-12))


def _lifted(still: Still) -> Float[np.ndarray, "N 3"]:
    """Some points of the background at their known depth."""
    u, v = still.pixels(max(1, still.size[0] // 32))
    if still.depth is None:
        return np.empty((0, 3))
    known = still.depth[v, u] > 0
    return still.lift(u[known], v[known], still.depth[v, u][known])


def _sphere(
    centers: Float[np.ndarray, "V 3"], focus: Float[np.ndarray, " 3"], distance: float
) -> Float[np.ndarray, " 3"]:
    """Centre of the sphere nearest to the cameras; where they leave it open (a ring does), towards the focus."""
    x = (centers - focus) / distance
    lhs = np.concatenate([np.c_[2 * x, np.ones(len(x))], np.c_[0.1 * np.eye(3), np.zeros(3)]])
    rhs = np.concatenate([(x**2).sum(1), np.zeros(3)])
    return focus + distance * np.linalg.lstsq(lhs, rhs, rcond=None)[0][:3]
