"""Distances cannot tell a scene from its mirror image; the handedness of four landmarks can."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from .clouds import Cloud

QUADS = 2000
FRAMES = 8
ENOUGH = 20
FLAT = 0.03
"""Quads whose triple product of unit edges is below this in any frame are too flat to have a side."""


def chirality(a: Cloud, b: Cloud) -> float:
    """Share of random quads of matched landmarks with the same handedness in both videos.

    a and b hold the landmarks, the k-th of one matched to the k-th of the other. Only quads that keep their side in
    every frame looked at, in both videos, count. Flipped solutions score .10-.32, right ones .94-.99; nan when too few
    quads count (planar scenes).
    """
    if len(a) < 4:
        return float("nan")
    quads = np.random.default_rng(len(a)).integers(0, len(a), (QUADS, 4))
    side_a, side_b = side(a, quads), side(b, quads)
    counts = (side_a != 0) & (side_b != 0)
    return float((side_a == side_b)[counts].mean()) if counts.sum() >= ENOUGH else float("nan")


def side(cloud: Cloud, quads: np.ndarray) -> Float[np.ndarray, " Q"]:
    """+1 or -1 where the triple product of a quad's edges keeps its sign, 0 where it does not."""
    x = cloud.poses(FRAMES).reshape(len(cloud), -1, 3)[quads].astype(float)
    u, v, w = (x[:, k] - x[:, 0] for k in (1, 2, 3))
    volume = np.einsum("qtc,qtc->qt", np.cross(u, v), w)
    edges = np.linalg.norm(u, axis=2) * np.linalg.norm(v, axis=2) * np.linalg.norm(w, axis=2)
    relative = volume / np.maximum(edges, np.finfo(float).tiny)
    return np.where((relative > FLAT).all(1), 1.0, np.where((relative < -FLAT).all(1), -1.0, 0.0))
