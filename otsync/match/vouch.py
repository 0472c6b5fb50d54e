"""Whether matches deserve trust: handedness, and what the features of matched tracks say against chance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from ..compute.indices import evenly
from ..costs.linear import Cost, total_cost, track_distance
from ..types import Matches, Status, TrackSet

QUADS, FRAMES, ENOUGH = 2000, 8, 20

FLAT = 0.03
"""Quads whose triple product of unit edges is below this in any frame are too flat to have a side."""

MIRRORED = 0.33
"""Chirality below which an answer looks like a mirror image: flipped ones score .0-.32, right ones .94-1 (cameras up to
90° apart; between opposite views of a thin body right ones may look mirrored, too)."""

BY_CHANCE = 1.5
"""Geometry plus relative cost of the better half of the matches above which the videos do not show the same scene.
Measured for nearest neighbours, EMD, FGW and partial FGW with features of 128 dimensions: related videos .05 to 1.47,
unrelated ones 1.64 to 1.8. (In few dimensions features of unrelated videos agree by chance: 1.36 in 24 for nearest
neighbours, which is not noticed.)"""


def vouch(found: Matches, a: TrackSet, b: TrackSet, costs: tuple[Cost, ...]) -> Matches:
    """``found`` with NO_MATCH or AMBIGUOUS added where its better half looks unrelated or mirrored.

    Solvers do not say so themselves: between unrelated videos they are as confident as ever.
    """
    if not found.status.ok or len(found) < 8:
        return found
    i, j = found.best((len(found) + 1) // 2).pairs.T
    flags = set(found.flags)
    structure, features = geometry(a, b, i, j), relative_cost(costs, a, b, i, j)
    if (0.5 if np.isnan(structure) else structure) + features > BY_CHANCE:
        flags.add(Status.NO_MATCH)
    elif chirality_of(a, b, i, j) < MIRRORED:
        flags.add(Status.AMBIGUOUS)
    return replace(found, flags=tuple(flags))


def geometry(a: TrackSet, b: TrackSet, i: Int[np.ndarray, " M"], j: Int[np.ndarray, " M"]) -> float:
    """How badly distances among matched tracks agree: 0 the same, 1 nowhere within 5 % of their median.

    ``mean min((d_a - d_b)² / τ², 1)`` over pairs of up to 128 matched tracks, d their D_track over the common median,
    τ = .05; nan without 3D positions or where nothing is known.
    """
    if a.xyz is None or b.xyz is None:
        return float("nan")
    some = np.random.default_rng(len(i)).permutation(len(i))[:128]
    pairs = ((a.xyz, a.seen, i[some]), (b.xyz, b.seen, j[some]))
    d = [track_distance(xyz[k], seen[k]).astype(float) for xyz, seen, k in pairs]
    known = np.isfinite(d[0]) & np.isfinite(d[1]) & ~np.eye(len(some), dtype=bool)
    unit = np.mean([np.median(x[known]) for x in d]) if known.any() else 0.0
    if not unit > 0:
        return float("nan")
    return float(np.minimum(((d[0] - d[1])[known] / unit / 0.05) ** 2, 1).mean())


def relative_cost(
    costs: tuple[Cost, ...], a: TrackSet, b: TrackSet, i: Int[np.ndarray, " M"], j: Int[np.ndarray, " M"]
) -> float:
    """Mean cost of the pairs over the mean cost of random ones; 0.4, as of related videos, where it tells nothing."""
    if not costs:
        return 0.4
    rng = np.random.default_rng(0)
    M = total_cost(costs, a.take(rng.permutation(len(a))[:256]), b.take(rng.permutation(len(b))[:256]))
    if np.ptp(M) <= 1e-9 * max(1.0, float(np.abs(M).max())) or M.mean() <= 0:
        return 0.4
    matched = sum((c.weight * c.pairs(a, b, i, j) for c in costs), start=np.zeros(len(i)))
    return float(matched.mean() / M.mean())


def chirality_of(a: TrackSet, b: TrackSet, i: Int[np.ndarray, " M"], j: Int[np.ndarray, " M"]) -> float:
    """:func:`chirality` of matched tracks; nan without 3D positions."""
    if a.xyz is None or b.xyz is None:
        return float("nan")
    return chirality(poses(a.xyz[i], a.seen[i], FRAMES), poses(b.xyz[j], b.seen[j], FRAMES))


def chirality(a: Float[np.ndarray, "M F 3"], b: Float[np.ndarray, "M G 3"]) -> float:
    """Share of random quads of matched points with the same handedness in both videos.

    The k-th point of a is matched to the k-th of b; frames of a and b need not correspond. Only quads that keep their
    side in every frame, in both videos, count; nan when too few do (planar scenes, few matches).
    """
    if len(a) < 4:
        return float("nan")
    quads = np.random.default_rng(len(a)).integers(0, len(a), (QUADS, 4))
    side_a, side_b = side(a, quads), side(b, quads)
    counts = (side_a != 0) & (side_b != 0)
    return float((side_a == side_b)[counts].mean()) if counts.sum() >= ENOUGH else float("nan")


def side(points: Float[np.ndarray, "M F 3"], quads: Int[np.ndarray, "Q 4"]) -> Int[np.ndarray, " Q"]:
    """+1 or -1 where the triple product of a quad's edges keeps its sign over the frames, 0 where it does not."""
    x = points[quads].astype(float)
    edges = x[:, 1:] - x[:, :1]
    length = np.linalg.norm(edges, axis=-1, keepdims=True)
    u, v, w = (edges / np.maximum(length, np.finfo(float).tiny)).swapaxes(0, 1)
    volume = np.einsum("qtc,qtc->qt", np.cross(u, v), w)
    return (volume > FLAT).all(1).astype(int) - (volume < -FLAT).all(1).astype(int)


def poses(xyz: Float[np.ndarray, "M T 3"], seen: Bool[np.ndarray, "M T"], frames: int) -> Float[np.ndarray, "M F 3"]:
    """Positions at some frames, of each track at the nearest one where it is seen."""
    T = seen.shape[1]
    at = evenly(T, frames)
    away = np.abs(np.arange(T)[None] - at[:, None])
    nearest = np.where(seen[:, None], away[None], 2 * T).argmin(2)
    return np.take_along_axis(xyz, nearest[..., None], 1)
