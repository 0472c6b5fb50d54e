"""A textured room with moving things, and what a camera in it sees: images that feature detectors can read.

The walls carry "dead leaves": discs of many sizes that cover each other, whose edges, corners and spectrum are those of
photographs (Lee, Mumford and Huang 2001). Furniture stands still; things fly along smooth paths. Metres, seconds, y
down, cameras in OpenCV axes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, UInt8

from .observation import stream

TEXTURE = (1000, 800)
"""Pixels of a wall's picture: 6 mm on a wall of 6 m."""

LEAVES, SMALLEST, LARGEST = 2600, 5.0, 140.0
"""Discs that are dropped on a picture, and the bounds of their radii in pixels."""

SKIN = 0.3
"""Share of a picture that a ball wears: its pattern is coarser than the walls'."""

CORNERS = (np.array([-3.2, -1.6, -3.0]), np.array([3.2, 1.4, 3.6]))
"""The room, m: the corner with the lowest and that with the highest coordinates."""

FURNITURE = np.array([[-1.5, 0.9, 1.8], [1.4, 0.9, 2.0], [-2.0, 0.9, -0.5], [2.0, 0.9, 0.2]])
FURNITURE_RADIUS = 0.45
"""Balls that lie on the floor, m."""

TINTS = np.array(
    [[176, 168, 150], [150, 160, 176], [206, 202, 192], [128, 112, 98], [166, 176, 160], [182, 172, 160]], float
)
"""Of painted walls, in the order of :attr:`Room.pictures`: the third is the ceiling, the fourth the floor."""

MIDDLE = np.array([0.0, 0.2, 0.3])
"""Around this point things move, m."""

NOISE = 3.0
"""Standard deviation of the images' noise, in 255ths."""


@dataclass(frozen=True, eq=False)
class ShownBoard:
    """A flat board in the room; its back is plain.

    Args:
        picture: of its front. size: (width, height), m.
        pose: a real time (s) -> (4,4) from the board (metres; x right, y down, from a corner) to the world.
    """

    picture: UInt8[np.ndarray, "h w 3"]
    size: tuple[float, float]
    pose: Callable[[float], Float[np.ndarray, "4 4"]]


@dataclass(frozen=True, eq=False, repr=False)
class Room:
    """A room and what moves in it.

    Args:
        pictures: six walls' pictures, two for each axis (low, high). skins: what balls wear, in turns.
        radii: (B,) of the moving balls, m. colours: (B,3) what shines through their pictures, 0 to 255.
        places: seconds (T,) -> centres (B,T,3) of the moving balls, m, at every real time.
        board: one that is carried about, or None.
    """

    pictures: tuple[UInt8[np.ndarray, "h w 3"], ...]
    skins: tuple[UInt8[np.ndarray, "h w 3"], ...]
    radii: Float[np.ndarray, " B"]
    colours: Float[np.ndarray, "B 3"]
    places: Callable[[Float[np.ndarray, " T"]], Float[np.ndarray, "B T 3"]]
    board: ShownBoard | None = None

    def __repr__(self) -> str:
        return f"Room({len(self.radii)} moving things)"


def draw_room(seed: int, *, things: int = 7, contrast: float = 1.0, pace: float = 1.0, painted: bool = False) -> Room:
    """A room; ``seed`` decides everything.

    Args:
        things: how many move.
        contrast: of the pictures on the walls, 0 (plain grey) to 1.
        pace: how fast things move, as a multiple.
        painted: whether the walls have a tint each, and each thing a colour of its own and a picture of full contrast:
            easier to look at, and to follow.
    """
    if things < 1 or not 0 <= contrast <= 1 or not 0 < pace < np.inf:
        raise ValueError(
            "things, contrast, pace: expected at least 1, a number from 0 to 1, and one above 0; "
            f"found {things}, {contrast} and {pace}."
        )
    rng = stream(seed, "things")
    waves = [(f, rng.normal(size=(things, 1, 3)), rng.uniform(0, 2 * np.pi, (things, 1, 3))) for f in (0.4, 0.9, 1.7)]
    rest = 0.4 * rng.normal(size=(things, 1, 3))

    def places(t: Float[np.ndarray, " T"]) -> Float[np.ndarray, "B T 3"]:
        t = pace * np.asarray(t, float)[None, :, None]
        path = rest + sum(0.3 / f**0.5 * size * np.sin(2 * np.pi * f * t + phase) for f, size, phase in waves)
        return MIDDLE + 0.9 * np.tanh(path / 0.9) * [1, 0.8, 1]

    colours = stream(seed, "colours").integers(0, 2, (things, 3)) * 200.0 + 25
    walls = skins = _pictures(seed, contrast)
    if painted:
        walls = tuple(
            np.clip(wall + (tint - 128), 0, 255).astype(np.uint8) for wall, tint in zip(walls, TINTS, strict=True)
        )
        skins, colours = _pictures(seed, 1.0), hues(things)
    return Room(walls, skins, stream(seed, "radii").uniform(0.14, 0.24, things), colours, places)


def hues(count: int) -> Float[np.ndarray, "B 3"]:
    """Bright colours, evenly round the circle of hues, 0 to 255."""
    turn = np.arange(count)[:, None] / count + np.array([0.0, 1 / 3, 2 / 3])
    return 255 * np.clip(0.5 + 0.7 * np.cos(2 * np.pi * turn), 0, 1)


@lru_cache(4)
def _pictures(seed: int, contrast: float) -> tuple[UInt8[np.ndarray, "h w 3"], ...]:
    return tuple(dead_leaves(stream(seed, "wall", n), contrast) for n in range(6))


def dead_leaves(rng: np.random.Generator, contrast: float = 1.0) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of discs that cover each other; their radii r are drawn with density 1/r^3, as in photographs."""
    import cv2

    w, h = TEXTURE
    ground = cv2.resize(rng.normal(0, 1, (6, 8, 3)), (w, h), interpolation=cv2.INTER_CUBIC)
    picture = np.clip(128 + 40 * ground, 0, 255).astype(np.uint8)
    few, many = LARGEST**-2, SMALLEST**-2
    radii = (few + rng.uniform(0, 1, LEAVES) * (many - few)) ** -0.5
    order = np.argsort(-radii * rng.uniform(0.3, 1, LEAVES))  # small ones tend to lie on top
    for radius, x, y in zip(radii[order], rng.uniform(0, w, LEAVES), rng.uniform(0, h, LEAVES), strict=True):
        colour = np.clip(rng.normal(128, 55) + rng.normal(0, 25, 3), 0, 255)
        axes = (max(1, round(radius)), max(1, round(radius * rng.uniform(0.4, 1))))
        centre = (round(x), round(y))
        cv2.ellipse(picture, centre, axes, rng.uniform(0, 180), 0, 360, colour.tolist(), -1, cv2.LINE_AA)
    grain = rng.normal(0, 6, (h, w, 1))
    return np.clip(128 + contrast * (picture + grain - 128), 0, 255).astype(np.uint8)


@dataclass
class RoomCamera:
    """Films a room. What stands still is drawn once for each pose that it is asked for again.

    Args:
        room: the room. K: intrinsics in pixels. size: (width, height) in pixels.
        noise: of the images, in 255ths; drawn from ``rng``.
    """

    room: Room
    K: Float[np.ndarray, "3 3"]
    size: tuple[int, int]
    rng: np.random.Generator
    noise: float = NOISE
    _still: tuple[bytes, tuple[np.ndarray, np.ndarray, np.ndarray]] | None = field(default=None, repr=False)

    def film(
        self, w2c: Float[np.ndarray, "4 4"], t: float
    ) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
        """The image at world time ``t`` (s) from the pose ``w2c``, and which of its pixels show a thing that moves."""
        image, moving, _ = self._seen(w2c, t)
        grain = self.rng.normal(0, self.noise, image.shape[:2])[..., None] if self.noise else 0.0
        return np.clip(image + grain, 0, 255).astype(np.uint8), moving

    def depth(self, w2c: Float[np.ndarray, "4 4"], t: float) -> Float[np.ndarray, "H W"]:
        """Depth along z of what :meth:`film` shows, m."""
        return self._seen(w2c, t)[2]

    def _seen(self, w2c: Float[np.ndarray, "4 4"], t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The image without grain, which of its pixels show a thing that moves, and its depth."""
        rays, image, depth = self._background(w2c)
        image, depth = image.copy(), depth.copy()
        moving = np.zeros(depth.shape, bool)
        for b, (centre, radius) in enumerate(zip(self.room.places(np.array([t]))[:, 0], self.room.radii, strict=True)):
            where, hit = self._ball(w2c, rays, image, depth, centre, float(radius), b)
            image[where][hit] = 0.55 * image[where][hit] + 0.45 * self.room.colours[b]
            moving[where] |= hit
        if self.room.board is not None:
            self._board(self.room.board, w2c, t, rays, image, depth, moving)
        return image, moving, depth

    def _background(self, w2c: Float[np.ndarray, "4 4"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        key = w2c.tobytes()
        if self._still is None or self._still[0] != key:
            self._still = (key, self._draw(w2c))
        return self._still[1]

    def _draw(self, w2c: Float[np.ndarray, "4 4"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays (H,W,3) with unit z in the world's axes, the image and the depth of everything that stands still."""
        import cv2

        w, h = self.size
        u, v = np.meshgrid(np.arange(w, dtype=np.float32) + 0.5, np.arange(h, dtype=np.float32) + 0.5)
        f, cx, cy = self.K[0, 0], self.K[0, 2], self.K[1, 2]
        rays = np.stack([(u - cx) / f, (v - cy) / f, np.ones_like(u)], -1) @ w2c[:3, :3].astype(np.float32)
        eye = _eye(w2c).astype(np.float32)
        low, high = (c.astype(np.float32) for c in CORNERS)
        rays = rays.astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            far = np.where(rays > 0, (high - eye) / rays, (low - eye) / rays)
        axis, depth = far.argmin(-1), far.min(-1)
        place = (eye + rays * depth[..., None] - low) / (high - low)
        image = np.zeros((h, w, 3), np.uint8)
        for a in range(3):
            for side in (0, 1):
                on = (axis == a) & ((rays[..., a] > 0) == bool(side))
                if on.any():
                    x, y = (place[..., k] for k in range(3) if k != a)
                    picture = self.room.pictures[2 * a + side]
                    x, y = (np.float32(n - 1) * c.astype(np.float32) for n, c in zip(TEXTURE, (x, y), strict=True))
                    image[on] = cv2.remap(picture, x, y, cv2.INTER_LINEAR)[on]
        for n, centre in enumerate(FURNITURE):
            self._ball(w2c, rays, image, depth, centre, FURNITURE_RADIUS, n + 3)
        return rays, image, depth

    def _ball(
        self,
        w2c: np.ndarray,
        rays: np.ndarray,
        image: np.ndarray,
        depth: np.ndarray,
        centre: np.ndarray,
        radius: float,
        picture: int,
    ) -> tuple[tuple[slice, slice], np.ndarray]:
        """Draw a ball into image and depth; the part of the image where it may be, and which pixels of it show it."""
        import cv2

        local = w2c[:3, :3] @ centre + w2c[:3, 3]
        nothing = (slice(0, 0), slice(0, 0)), np.zeros((0, 0), bool)
        if local[2] < 0.2:
            return nothing
        u, v = (self.K @ local / local[2])[:2]
        reach = 1.6 * self.K[0, 0] * radius / max(local[2] - radius, 0.05) + 2
        h, w = depth.shape
        (y0, y1), (x0, x1) = ((max(0, int(c - reach)), min(n, int(c + reach) + 2)) for c, n in ((v, h), (u, w)))
        if x0 >= x1 or y0 >= y1:
            return nothing
        where = slice(y0, y1), slice(x0, x1)
        d, away = rays[where], (_eye(w2c) - centre).astype(np.float32)
        a, b = (d**2).sum(-1), d @ away
        root = b * b - a * np.float32(away @ away - radius**2)
        z = (-b - np.sqrt(np.maximum(root, 0))) / a
        hit = (root > 0) & (z > 0) & (z < depth[where])
        n = (away + d * z[..., None]) / np.float32(radius)
        x = (np.arctan2(n[..., 0], n[..., 2]) / np.float32(2 * np.pi) + 0.5) * np.float32(SKIN * TEXTURE[0])
        y = (np.arcsin(np.clip(n[..., 1], -1, 1)) / np.float32(np.pi) + 0.5) * np.float32(SKIN * TEXTURE[1])
        skin = cv2.remap(self.room.skins[picture % 6], x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
        image[where][hit] = skin[hit]
        depth[where][hit] = z[hit]
        return where, hit

    def _board(
        self,
        board: ShownBoard,
        w2c: np.ndarray,
        t: float,
        rays: np.ndarray,
        image: np.ndarray,
        depth: np.ndarray,
        moving: np.ndarray,
    ) -> None:
        """Draw the board into image, depth and what moves."""
        import cv2

        pose = board.pose(t)
        corners = np.array([[x, y, 0] for x in (0, board.size[0]) for y in (0, board.size[1])]) @ pose[:3, :3].T
        local = (corners + pose[:3, 3]) @ w2c[:3, :3].T + w2c[:3, 3]
        if (local[:, 2] < 0.2).any():
            return
        uv = (local @ self.K.T)[:, :2] / local[:, 2:]
        (x0, y0), (x1, y1) = (
            np.clip(uv.min(0), 0, self.size).astype(int),
            np.clip(uv.max(0) + 1, 0, self.size).astype(int),
        )
        where = slice(y0, y1), slice(x0, x1)
        way, away = rays[where] @ pose[:3, 2].astype(np.float32), pose[:3, 3] - _eye(w2c)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.float32(away @ pose[:3, 2]) / way
            at = (rays[where] * z[..., None] - away.astype(np.float32)) @ pose[:3, :2].astype(np.float32)
        hit = (z > 0) & (z < depth[where]) & (at >= 0).all(-1) & (at <= np.array(board.size)).all(-1)
        h, w = board.picture.shape[:2]
        x, y = (np.where(hit, at[..., k] * n / board.size[k] - 0.5, 0).astype(np.float32) for k, n in enumerate((w, h)))
        front = cv2.remap(board.picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        image[where][hit] = np.where((way > 0)[..., None], front, 205)[hit]
        depth[where][hit] = z[hit]
        moving[where] |= hit


def _eye(w2c: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 3"]:
    return -w2c[:3, :3].T @ w2c[:3, 3]


def look_at(
    eye: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"], turn: Float[np.ndarray, " 3"] | None = None
) -> Float[np.ndarray, "4 4"]:
    """World to camera of an upright camera (y down) at ``eye`` that looks at ``target``, then turned by ``turn``
    (rotation vector in camera axes, rad)."""
    import cv2

    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross([0, 1.0, 0], forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    if turn is not None:
        R = cv2.Rodrigues(np.asarray(turn, float))[0] @ R
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = R, -R @ eye
    return w2c
