"""Costs of matching and aligning: functions of arrays, and objects for the matchers' ``costs`` slot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from ..compute.indices import blocks
from ..types import TrackSet

TRACK_BLOCK = 128

SMALL = 1e-150
"""Sums of squares from here on, up to its reciprocal, are exact to rounding."""


def binary_scale(x: np.ndarray, where: np.ndarray | None = None) -> float:
    """The power of two next to the largest finite magnitude of ``x``, of those ``where`` (1 when there is none).

    Dividing by it is exact, so results do not depend on the unit of length beyond rounding of the input itself.
    """
    known = np.isfinite(x)
    if where is not None:
        known &= where
    top = float(max(np.max(x, initial=0.0, where=known), -np.min(x, initial=0.0, where=known)))
    return float(2.0 ** np.clip(np.frexp(top)[1], -1000, 1000)) if top > 0 else 1.0


def unit_features(features: Float[np.ndarray, "N D"], *, center: bool = False) -> Float[np.ndarray, "N D"]:
    """Rows of unit norm in float64, after subtracting the set's mean when ``center``.

    Rows far from order one are brought there first: squares of 1e±200 neither overflow nor vanish. A row that centring
    makes zero (it equals the mean) stays zero: at cosine distance 1 from everything, it carries no information.
    """
    tiny = np.finfo(float).tiny
    f = np.array(features, float)
    with np.errstate(over="ignore", invalid="ignore"):  # whether features are numbers is checked by who takes them
        square = np.einsum("nd,nd->n", f, f)
        far = ~((square > SMALL) & (square < 1 / SMALL))
        if far.any():
            top = np.maximum(f[far].max(1, initial=0.0), -f[far].min(1, initial=0.0))
            f[far] /= np.maximum(top, tiny)[:, None]
            square[far] = np.einsum("nd,nd->n", f[far], f[far])
        f /= np.maximum(np.sqrt(square), tiny)[:, None]
    if center:
        f -= f.mean(0)
        norm = np.sqrt(np.einsum("nd,nd->n", f, f))
        # what is left of a set of equal rows is rounding; blown up to unit norm it would look like information
        f *= np.where(norm > 1e-7, 1 / np.maximum(norm, 1e-7), 0.0)[:, None]
    return f


def cosine_distance(fa: Float[np.ndarray, "N D"], fb: Float[np.ndarray, "M D"]) -> Float[np.ndarray, "N M"]:
    """``M_ij = 1 - f_i·f_j`` of unit features (paper, inter-video feature similarity), in [0, 2]."""
    return 1.0 - fa @ fb.T


def track_distance(
    xyz: Float[np.ndarray, "N T 3"],
    visible: Bool[np.ndarray, "N T"],
    other: Float[np.ndarray, "M T 3"] | None = None,
    other_visible: Bool[np.ndarray, "M T"] | None = None,
) -> Float[np.ndarray, "N M"]:
    """``D_track(τ_i, τ_j) = max_t ‖τ_i,t - τ_j,t‖`` over frames in which both are visible (paper, Sec. 3.3).

    Within one set, or between two sets of one video. nan where two tracks are never seen together; see
    :func:`fill_unseen`. Exact differences in the precision of the input, no N²T buffer: about 0.3 CPU-s at
    N = 5000, T = 150 in float32.
    """
    from ..compute.threads import for_each
    from .kernels import max_distance_block

    same = other is None
    if other is None:
        other, other_visible = xyz, visible
    elif other_visible is None:
        other_visible = np.ones(other.shape[:2], bool)
    for name, x, seen in (("xyz", xyz, visible), ("other", other, other_visible)):
        if x.ndim != 3 or x.shape[2] != 3 or seen.shape != x.shape[:2] or x.shape[1] != xyz.shape[1]:
            raise ValueError(
                f"{name}: expected (N,{xyz.shape[1]},3) positions with visibility (N,{xyz.shape[1]}); found {x.shape} "
                f"and {seen.shape}."
            )
        if (seen & ~np.isfinite(x).all(2)).any():
            raise ValueError(f"{name}: expected finite positions in visible samples; found nan or infinity.")
    dtype = np.dtype(np.float32 if xyz.dtype == other.dtype == np.float32 else np.float64)
    gaps = not (visible.all() and other_visible.all())
    scale = dtype.type(max(binary_scale(x, seen[..., None]) for x, seen in ((xyz, visible), (other, other_visible))))

    def columns(x: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = np.empty((3, *x.shape[1::-1]), dtype)
        for d in range(3):
            np.divide(np.where(seen, x[..., d], 0).T, scale, out=at[d], dtype=dtype)
        return at, np.ascontiguousarray(seen.T).astype(dtype)

    out = np.full((len(xyz), len(other)), np.nan, dtype)
    tiles = [
        (i, min(i + TRACK_BLOCK, out.shape[0]), j, min(j + TRACK_BLOCK, out.shape[1]))
        for i in range(0, out.shape[0], TRACK_BLOCK)
        for j in range(i if same else 0, out.shape[1], TRACK_BLOCK)
    ]

    def work(i0: int, i1: int, j0: int, j1: int, *columns_and_out: np.ndarray) -> None:
        *arrays, into = columns_and_out
        max_distance_block(*arrays, gaps, i0, i1, j0, j1, into)

    # a long clip in pieces: columns are copies
    for part in blocks(xyz.shape[1], max(len(xyz), len(other))):
        a, wa = columns(xyz[:, part], visible[:, part])
        b, wb = (a, wa) if same else columns(other[:, part], other_visible[:, part])
        largest = np.empty_like(out)
        for_each(work, tiles, a, b, wa, wb, largest)
        np.fmax(out, largest, out=out)
    if same:
        for i0, i1, j0, j1 in tiles:
            out[j0:j1, i0:i1] = out[i0:i1, j0:j1].T
    return out * scale


def fill_unseen(distance: Float[np.ndarray, "N N"]) -> Float[np.ndarray, "N N"]:
    """Distances of pairs never seen together become the median of the known ones: neither near nor far.

    (MoSca's 1e10 would make them the strongest structure of all.) Zero when nothing is known.
    """
    unseen = np.isnan(distance)
    if not unseen.any():
        return distance
    off_diagonal = ~unseen & ~np.eye(len(distance), dtype=bool)
    fill = float(np.median(distance[off_diagonal])) if off_diagonal.any() else 0.0
    filled = np.where(unseen, fill, distance)
    np.fill_diagonal(filled, 0.0)
    return filled


def frame_cost(
    a: Float[np.ndarray, "M Ta 3"], b: Float[np.ndarray, "M Tb 3"]
) -> tuple[Float[np.ndarray, "Ta Tb"], Int[np.ndarray, "Ta Tb"]]:
    """``D_geo``: mean over matches of the L1 distance between frame i of a and frame j of b (paper, Sec. 3.4).

    Matches unseen (nan) in either frame are left out of that cell's mean. Returns the cost, nan where no match is
    seen in both, and the number of matches behind each cell.
    """
    from scipy.spatial.distance import cdist

    total = np.zeros((a.shape[1], b.shape[1]))
    count = np.zeros(total.shape, int)
    for x, y in zip(a, b, strict=True):
        seen = np.isfinite(x[:, 0])[:, None] & np.isfinite(y[:, 0])[None]
        total += np.where(seen, cdist(np.nan_to_num(x), np.nan_to_num(y), "cityblock"), 0.0)
        count += seen
    with np.errstate(invalid="ignore"):
        return np.where(count > 0, total / np.maximum(count, 1), np.nan), count


def velocity(x: Float[np.ndarray, "M T 3"], half: int) -> Float[np.ndarray, "M T 3"]:
    """Slope per frame of a line fitted over ±``half`` frames; nan where any of them is unobserved.

    v(t) = Σ_q q x(t+q) / Σ_q q²: what is constant in a track (depth bias, another surface point) drops out.
    """
    q = np.arange(-half, half + 1)
    out = np.full_like(x, np.nan)
    T = x.shape[1]
    if 2 * half + 1 <= T:
        for some in blocks(len(x), T):
            windows = np.lib.stride_tricks.sliding_window_view(x[some], 2 * half + 1, axis=1)
            out[some, half : T - half] = windows @ (q / (q @ q))
    return out


class Cost(Protocol):
    """One linear term of the matching objective: an item of the ``costs`` tuple.

    The dense solvers read ``matrix``; :class:`otsync.AnchoredFGW`, which never looks at all pairs, reads the matrix of
    a few means of groups and ``pairs`` of the candidates. Groups have all frames of their video, unless all costs are
    :class:`Factored`.
    """

    @property
    def weight(self) -> float: ...

    def matrix(self, a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"]:
        """Cost of matching every track of a to every track of b, of order one."""
        ...

    def pairs(
        self, a: TrackSet, b: TrackSet, i: Int[np.ndarray, " P"], j: Int[np.ndarray, " P"]
    ) -> Float[np.ndarray, " P"]:
        """``matrix(a, b)[i, j]`` without the matrix."""
        ...


@runtime_checkable
class Factored(Protocol):
    """A cost whose matrix is ``1 - U Vᵀ`` with few columns: compiled loops evaluate it wherever they like.

    It looks at features and labels alone: groups of tracks that it is asked about may have fewer frames than their
    video, and no camera.
    """

    def factors(self, a: TrackSet, b: TrackSet) -> tuple[Float[np.ndarray, "Na D"], Float[np.ndarray, "Nb D"]]: ...


@dataclass(frozen=True)
class Cosine:
    """Feature distance ``1 - f_i·f_j``, the paper's M.

    Args:
        weight: factor of this term.
        center: subtract each video's mean feature first (it removes what a camera does to all its features).
    """

    weight: float = 1.0
    center: bool = True

    def matrix(self, a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"]:
        return cosine_distance(*self.factors(a, b))

    def pairs(self, a: TrackSet, b: TrackSet, i: np.ndarray, j: np.ndarray) -> Float[np.ndarray, " P"]:
        return factored_pairs(*self.factors(a, b), i, j)

    def factors(self, a: TrackSet, b: TrackSet) -> tuple[Float[np.ndarray, "Na D"], Float[np.ndarray, "Nb D"]]:
        """Unit features, after checks."""
        a.check("a", xyz=False, features=True)
        b.check("b", xyz=False, features=True)
        assert a.features is not None and b.features is not None
        if a.features.shape[1] != b.features.shape[1]:
            raise ValueError(
                f"b.features: expected {a.features.shape[1]} dimensions as a has; found {b.features.shape[1]}. "
                "Use the same descriptor for both videos."
            )
        return unit_features(a.features, center=self.center), unit_features(b.features, center=self.center)


@dataclass(frozen=True)
class Labels:
    """Instance or class labels that both videos share: 0 where they agree, 1 where they differ (the paper's outlook).

    ``1 - Σ_l p_il q_jl`` with the tracks' memberships p, q: the chance that the labels differ. Integer labels are
    certain, -1 means unlabelled; soft ones are (N,L) weights >= 0 (rows are normalised, zeros mean unlabelled). An
    unlabelled track costs 1/2 with everything.
    """

    weight: float = 1.0

    def matrix(self, a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"]:
        return cosine_distance(*self.factors(a, b))

    def pairs(self, a: TrackSet, b: TrackSet, i: np.ndarray, j: np.ndarray) -> Float[np.ndarray, " P"]:
        return factored_pairs(*self.factors(a, b), i, j)

    def factors(self, a: TrackSet, b: TrackSet) -> tuple[Float[np.ndarray, "Na D"], Float[np.ndarray, "Nb D"]]:
        """Memberships, and two columns that make the unlabelled neutral."""
        p, q = memberships(a, b)
        u, v = (x.sum(1, keepdims=True) == 0 for x in (p, q))
        return np.hstack([p, 0.5 * u, 0.5 * ~u]), np.hstack([q, np.ones_like(v), v]).astype(float)


def memberships(a: TrackSet, b: TrackSet) -> tuple[Float[np.ndarray, "Na L"], Float[np.ndarray, "Nb L"]]:
    """Labels of both sets as weights over their common classes, rows summing to one, or to zero when unlabelled."""
    for name, tracks in (("a", a), ("b", b)):
        if tracks.labels is None:
            raise ValueError(
                f"{name}.labels: expected (N,) integers or (N,L) weights; found none. Add them to both sets."
            )
        if tracks.labels.ndim == 1 and tracks.labels.dtype.kind == "f":
            raise ValueError(f"{name}.labels: expected integers, or (N,L) weights; found {tracks.labels.dtype}.")
    assert a.labels is not None and b.labels is not None
    if a.labels.ndim != b.labels.ndim or (a.labels.ndim == 2 and a.labels.shape[1] != b.labels.shape[1]):
        raise ValueError(f"b.labels: expected the classes that a has ({a.labels.shape}); found {b.labels.shape}.")
    if a.labels.ndim == 1:
        classes = np.unique(np.concatenate([a.labels, b.labels]))
        classes = classes[classes >= 0]
        p, q = ((x[:, None] == classes).astype(float) for x in (a.labels, b.labels))
        return p, q
    rows = []
    for name, tracks in (("a", a), ("b", b)):
        weights = np.asarray(tracks.labels, float)
        if not np.isfinite(weights).all() or (weights < 0).any():
            raise ValueError(f"{name}.labels: expected finite weights >= 0; some are not.")
        top = weights.max(1, keepdims=True, initial=0.0)
        weights = weights / np.where(top > 0, top, 1.0)
        total = weights.sum(1, keepdims=True)
        rows.append(weights / np.where(total > 0, total, 1.0))
    return rows[0], rows[1]


def factored_pairs(
    u: Float[np.ndarray, "Na D"], v: Float[np.ndarray, "Nb D"], i: Int[np.ndarray, " P"], j: Int[np.ndarray, " P"]
) -> Float[np.ndarray, " P"]:
    """``1 - u_i·v_j`` of the pairs, in pieces of a few megabytes."""
    out = np.empty(len(i))
    step = max(1, 2**20 // max(1, u.shape[1]))
    for s in range(0, len(i), step):
        out[s : s + step] = 1.0 - np.einsum("pd,pd->p", u[i[s : s + step]], v[j[s : s + step]])
    return out


def total_cost(costs: tuple[Cost, ...], a: TrackSet, b: TrackSet) -> Float[np.ndarray, "Na Nb"]:
    """Weighted sum of the cost objects' matrices; zeros for an empty tuple."""
    total = np.zeros((len(a), len(b)))
    for cost in costs:
        if not (np.isfinite(cost.weight) and cost.weight >= 0):
            raise ValueError(f"costs: expected weights >= 0; found {cost}. Give a weight of 0 to leave a cost out.")
        total += cost.weight * cost.matrix(a, b)
    return total
