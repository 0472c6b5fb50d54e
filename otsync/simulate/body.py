"""Bodies: rigid parts with a surface, and the human figure of fifteen limbs that most worlds are made of.

Axes: z up; in a figure's own frame x points to its right, y forward. Metres and radians throughout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class Parts:
    """P rigid parts with their surfaces; a part is one limb of a figure, or one thing.

    A surface is a capsule (the segment ``start``-``end`` swept by an ellipsoid of semi-axes ``radii``) or, where
    ``box``, the box of half sides ``radii`` around ``start``; in the part's own frame.

    Args:
        object: (P,) which figure or thing a part belongs to.
        limb: (P,) number of the limb within its object.
        kind: (P,) appearance class; the left and the right limb of a pair share one.
        figure: (P,) True for limbs of a figure: those have a left and a right.
        rest_rotation, rest_position: (P,3,3), (P,3) the pose that defines the body coordinate (arms and legs spread,
            so that near in the coordinate means near on the body; x = 0 is the plane of symmetry).
        weight: (P,) relative chance of a surface point; area, but small things count for more.
    """

    object: Int[np.ndarray, " P"]
    limb: Int[np.ndarray, " P"]
    kind: Int[np.ndarray, " P"]
    figure: Bool[np.ndarray, " P"]
    start: Float[np.ndarray, "P 3"]
    end: Float[np.ndarray, "P 3"]
    radii: Float[np.ndarray, "P 3"]
    box: Bool[np.ndarray, " P"]
    rest_rotation: Float[np.ndarray, "P 3 3"]
    rest_position: Float[np.ndarray, "P 3"]
    weight: Float[np.ndarray, " P"]

    def __len__(self) -> int:
        return len(self.object)

    def body_coordinate(self, part: Int[np.ndarray, " N"], local: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Points of parts in the rest pose of their object."""
        return np.einsum("nij,nj->ni", self.rest_rotation[part], local) + self.rest_position[part]

    @staticmethod
    def join(groups: Sequence[Parts]) -> Parts:
        return Parts(**{f.name: np.concatenate([getattr(g, f.name) for g in groups]) for f in fields(Parts)})


def sample_surface(
    parts: Parts, n: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """``n`` random surface points: (part, position and unit normal in the part's frame)."""
    part = rng.choice(len(parts), n, p=parts.weight / parts.weight.sum())
    u = rng.standard_normal((n, 3))
    along, which = rng.random(n), rng.random(n)
    start, axis, radii = parts.start[part], (parts.end - parts.start)[part], parts.radii[part]
    length = np.linalg.norm(axis, axis=1)
    axis = axis / np.maximum(length, 1e-12)[:, None]
    r = np.cbrt(radii.prod(1))
    lift = np.einsum("ni,ni->n", u, axis)
    # areas: side 2 pi r L, the two round ends 4 pi r^2
    side = which * (length + 2 * r) < length
    u[side] -= (lift[:, None] * axis)[side]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    at = np.where(side, along, (lift > 0).astype(float)) * length
    local = start + at[:, None] * axis + radii * u
    normal = u / radii
    if parts.box.any():
        boxed = parts.box[part]
        local[boxed], normal[boxed] = _on_box(start[boxed], radii[boxed], u[boxed], which[boxed], rng)
    return part, local, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _on_box(
    center: np.ndarray, half: np.ndarray, u: np.ndarray, which: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    face = half.prod(1, keepdims=True) / half
    edges = np.cumsum(face, 1)
    k = (which[:, None] * edges[:, -1:] > edges).sum(1)
    rows = np.arange(len(half))
    spot = rng.uniform(-1.0, 1.0, half.shape)
    normal = np.zeros_like(half)
    normal[rows, k] = np.where(u[rows, k] > 0, 1.0, -1.0)
    spot[rows, k] = normal[rows, k]
    return center + spot * half, normal


def capsule_area(start: np.ndarray, end: np.ndarray, radii: np.ndarray) -> np.ndarray:
    r = np.cbrt(np.asarray(radii).prod(-1))
    return 2 * np.pi * r * np.linalg.norm(np.asarray(end) - start, axis=-1) + 4 * np.pi * r**2


def thing(
    object: int, kind: int, radii: Sequence[float], *, box: bool = False, center: Sequence[float] = (0.0, 0.0, 0.0)
) -> Parts:
    """One rigid thing: an ellipsoid (a ball) or a box, around ``center`` of its own frame."""
    at, r = np.asarray(center, float), np.asarray(radii, float)
    area = capsule_area(at, at, r) * (2 if box else 1)
    return Parts(
        object=np.array([object]),
        limb=np.array([0]),
        kind=np.array([kind]),
        figure=np.array([False]),
        start=at[None],
        end=at[None],
        radii=r[None],
        box=np.array([box]),
        rest_rotation=np.eye(3)[None],
        rest_position=np.zeros((1, 3)),
        weight=np.array([max(area, 0.08)]),
    )


def euler(angles: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3 3"]:
    """Rz(c) Ry(b) Rx(a) of angles (a, b, c): flexion first, then abduction, then twist."""
    (ca, cb, cc), (sa, sb, sc) = np.moveaxis(np.cos(angles), -1, 0), np.moveaxis(np.sin(angles), -1, 0)
    R = np.empty((*angles.shape[:-1], 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = -sb, cb * sa, cb * ca
    return R


@dataclass(frozen=True)
class Limb:
    name: str
    parent: int
    joint: tuple[float, float, float]  # where it hinges, in the parent's frame
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radii: tuple[float, float, float]
    kind: int


def _sided(side: int, first: int) -> list[Limb]:
    """Arm and leg of one side (+1 right, -1 left); the arm's limbs start at index ``first``."""
    a, leg = first, first + 3
    return [
        Limb("upper arm", 1, (side * 0.19, 0.0, 0.38), (0, 0, 0), (0, 0, -0.28), (0.05, 0.05, 0.05), 3),
        Limb("forearm", a, (0, 0, -0.28), (0, 0, -0.02), (0, 0, -0.24), (0.04, 0.04, 0.04), 4),
        Limb("hand", a + 1, (0, 0, -0.25), (0, 0, -0.03), (0, 0, -0.13), (0.02, 0.042, 0.04), 5),
        Limb("thigh", 0, (side * 0.10, 0.0, -0.05), (0, 0, -0.04), (0, 0, -0.40), (0.08, 0.08, 0.08), 6),
        Limb("shin", leg, (0, 0, -0.42), (0, 0, -0.02), (0, 0, -0.38), (0.055, 0.055, 0.055), 7),
        Limb("foot", leg + 1, (0, 0, -0.41), (0, -0.04, -0.03), (0, 0.15, -0.04), (0.045, 0.04, 0.035), 8),
    ]


#: the figure: about 1.75 m tall, arms hanging; 0-2 trunk and head, 3-8 right arm and leg, 9-14 left ones
HUMAN: tuple[Limb, ...] = (
    Limb("pelvis", -1, (0, 0, 0), (-0.07, 0, 0), (0.07, 0, 0), (0.10, 0.11, 0.12), 0),
    Limb("chest", 0, (0, 0, 0.10), (0, 0, 0.08), (0, 0, 0.30), (0.18, 0.11, 0.13), 1),
    Limb("head", 1, (0, 0, 0.44), (0, 0.01, 0.10), (0, 0.01, 0.17), (0.08, 0.095, 0.09), 2),
    *_sided(+1, 3),
    *_sided(-1, 9),
)
PELVIS, CHEST, HEAD, UPPER_ARM, FOREARM, HAND, THIGH, SHIN, FOOT = range(9)
LEFT = 6  # add to a right limb's number
PELVIS_HEIGHT = 0.93
N_KINDS = 9  # of limbs; things take the numbers after

_PARENT = [limb.parent for limb in HUMAN]
_JOINT = np.array([limb.joint for limb in HUMAN], float)
# Anatomical angles are (flexion forward, abduction outward, twist outward), positive on both sides; knees flex
# backwards, trunk and head lean forward. These signs turn them into rotations about x, y, z.
_SIGN = np.ones((15, 3))
_SIGN[[CHEST, HEAD, SHIN, SHIN + LEFT], 0] = -1
_SIGN[3:9, 1:] = -1


def human(object: int, size: float = 1.0) -> Parts:
    """The limbs of one figure; ``size`` scales it."""
    start, end, radii = (
        size * np.array([getattr(limb, f) for limb in HUMAN], float) for f in ("start", "end", "radii")
    )
    rest = np.zeros((15, 3))
    rest[[UPPER_ARM, UPPER_ARM + LEFT], 1] = 0.9
    rest[[THIGH, THIGH + LEFT], 1] = 0.2
    R, p = forward_kinematics(rest[None], np.array([[0.0, 0.0, PELVIS_HEIGHT * size]]), np.zeros(1), size)
    n = len(HUMAN)
    return Parts(
        object=np.full(n, object),
        limb=np.arange(n),
        kind=np.array([limb.kind for limb in HUMAN]),
        figure=np.ones(n, bool),
        start=start,
        end=end,
        radii=radii,
        box=np.zeros(n, bool),
        rest_rotation=R[:, 0],
        rest_position=p[:, 0],
        weight=capsule_area(start, end, radii),
    )


def forward_kinematics(
    angles: Float[np.ndarray, "T 15 3"], root: Float[np.ndarray, "T 3"], yaw: Float[np.ndarray, " T"], size: float = 1.0
) -> tuple[Float[np.ndarray, "15 T 3 3"], Float[np.ndarray, "15 T 3"]]:
    """Rotation and position (of the hinge) of every limb in the world, from anatomical angles.

    ``root`` is the pelvis; ``yaw`` turns the figure about the vertical (0: it looks along +y).
    """
    local = euler(np.swapaxes(angles, 0, 1) * _SIGN[:, None])
    R = np.empty_like(local)
    p = np.empty((*local.shape[:2], 3))
    turn = np.zeros((len(yaw), 3))
    turn[:, 2] = yaw
    R[0], p[0] = euler(turn) @ local[0], root
    for j in range(1, len(HUMAN)):
        up = _PARENT[j]
        R[j] = R[up] @ local[j]
        p[j] = p[up] + R[up] @ (size * _JOINT[j])
    return R, p
