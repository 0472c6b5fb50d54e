"""Whether matches deserve trust: handedness, and what the features of matched tracks say against chance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from ..clocks.common import readable
from ..compute.indices import evenly
from ..compute.medians import known_quantiles
from ..costs.linear import Cosine, Cost, binary_scale, total_cost, track_distance
from ..types import Clock, Matches, Status, TrackSet

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


UNTOLD = 0.6
"""What features that tell nothing count: structure alone must then agree, to .9 and better. (At .4 it never failed.)"""

FEW = 4
"""Matches below which nothing vouches for them: any three tracks resemble some other three."""

CHANCE = 256
"""Tracks of each video that random pairs are made of, at most."""

SAMPLE, RIVALS = 128, 400
"""Matches, and tracks of b, that a second answer is looked for among."""

QUANTILES = tuple(np.linspace(0.05, 0.95, 16))

SAME_PLACE = 0.3
"""Tracks of b less than this apart are one place (unit: the median distance), so that neighbours are no rivals."""

AS_LIKE = 0.15
"""A second answer is about as like when it costs at most so much more, in units of a random pair's cost: noisy copies
.00 to .02, other tracks .4 and more on clean scenes."""

TIE = 1e-9
"""Share of a random pair's cost below which two costs are equal."""

SECOND_AGREES, AS_GOOD, SLACK = 0.75, 1.1, 0.05
"""Disagreement of distances up to which a second answer is one, and by how much it may exceed the found one's.
Measured: exchanged copies .04 to .53, at most .02 above the found answer; the likest other tracks in scenes without
copies .80 to .98 (simulated presets mid to brutal, like people, 14 pairs of real cameras; 5 matchers)."""

LEAD, COMMON = 1.2, 0.1
"""Of :func:`unlike`: lead of the matched over the next likest, and correlation of distances, below which nothing speaks
for a match. Unrelated videos: 1.04 to 1.08, -.12 to .07; related ones, brutal: 1.0 to 1.2, but .2 to .98."""

NO_STRUCTURE = 0.8
"""Disagreement of distances above which structure says nothing for the found answer."""

CLEARLY, STRANGE, FORCED_SHARE = 0.2, 0.7, 0.1
"""Matches were forced when more than this share of the better half costs more than STRANGE of a random pair, although
a fifth of it costs less than CLEARLY."""

STEP, SOLID, SHARED = 3, 0.15, 0.1
"""Of :func:`moves_mirrored`: frames of a step; least ratio of the smallest to the largest singular value (motion in all
three directions), and least share of the motion that matched tracks have in common."""


def vouch(found: Matches, a: TrackSet, b: TrackSet, costs: tuple[Cost, ...], clock: Clock | None = None) -> Matches:
    """``found`` with flags added where its better half looks unrelated, mirrored, forced, or like one of several.

    Solvers do not say so themselves: between unrelated videos they are as confident as ever, and of two like objects
    they take one.

    Args:
        costs: what the matcher minimised; a matcher of structure alone is judged by the features that are there.
        clock: of b against a, where it was known.
    """
    if not found.status.ok:
        return found
    i, j = better_half(found).T
    if len(i) < FEW:
        return replace(found, flags=(Status.FEW_MATCHES,))
    costs = costs or features_of(a, b)
    features = Likeness.of(costs, a, b, i, j)
    structure, looks = geometry(a, b, i, j), features.relative
    doubt = (0.5 if np.isnan(structure) else structure) + (UNTOLD if np.isnan(looks) else looks)
    flags = set(found.flags)
    if doubt > BY_CHANCE or (structure > NO_STRUCTURE and unlike(a, b, i, j, features)):
        flags.add(Status.NO_MATCH)
    elif (
        chirality_of(a, b, i, j) < MIRRORED
        or moves_mirrored(a, b, i, j, clock)
        or one_of_several(a, b, i, j, features, structure)
        or one_of_several_of_a(a, b, i, j, costs, features, structure)
    ):
        flags.add(Status.AMBIGUOUS)
    if not flags and forced(a, b, i, j, features):
        flags.add(Status.FORCED)
    return replace(found, flags=tuple(flags))


def better_half(found: Matches) -> Int[np.ndarray, "H 2"]:
    """The best matches, half as many as can be one to one: matchers with several partners are judged by their best."""
    alone = min(len(np.unique(column)) for column in found.pairs.T)
    return found.best(max((alone + 1) // 2, min(FEW, alone))).pairs


def features_of(a: TrackSet, b: TrackSet) -> tuple[Cost, ...]:
    """Feature distance, where both sets have features that it can compare: what structure is checked by."""
    if a.features is None or b.features is None or a.features.shape[1] != b.features.shape[1]:
        return ()
    for features in (a.features, b.features):
        if not (np.isfinite(features).all() and np.any(features, axis=1).all()):
            return ()
    return (Cosine(),)


@dataclass(frozen=True, eq=False)
class Likeness:
    """What the costs of matched pairs say, in units of what random pairs cost.

    Args:
        pairs: (H,) of the matches. table: (H,P) of their tracks of a with the tracks ``others`` of b; None for both
            where the costs do not tell tracks apart. chance: what a random pair costs; None there.
    """

    pairs: Float[np.ndarray, " H"] | None
    table: Float[np.ndarray, "H P"] | None
    others: Int[np.ndarray, " P"]
    chance: float | None = None

    @classmethod
    def of(
        cls, costs: tuple[Cost, ...], a: TrackSet, b: TrackSet, i: Int[np.ndarray, " H"], j: Int[np.ndarray, " H"]
    ) -> Likeness:
        others = np.union1d(evenly(len(b), RIVALS), j)
        if not costs:
            return cls(None, None, others)
        chance = random_cost(costs, a, b)
        if chance is None:
            return cls(None, None, others)
        matched = sum((c.weight * c.pairs(a, b, i, j) for c in costs), start=np.zeros(len(i)))
        return cls(matched / chance, total_cost(costs, a.take(i), taken(b, others)) / chance, others, chance)

    def exchanged(
        self,
        costs: tuple[Cost, ...],
        a: TrackSet,
        b: TrackSet,
        i: Int[np.ndarray, " S"],
        j: Int[np.ndarray, " S"],
        some: Int[np.ndarray, " S"],
    ) -> Likeness:
        """The same of ``some`` matches (i, j) with the videos exchanged: rows are tracks of b, ``others`` are of a.

        Costs may have a direction, as times have: they are asked from a to b all the same.
        """
        others = np.union1d(evenly(len(a), RIVALS), i)
        if self.pairs is None or self.chance is None:
            return Likeness(None, None, others)
        table = total_cost(costs, taken(a, others), b.take(j)).T / self.chance
        return Likeness(self.pairs[some], table, others, self.chance)

    @property
    def relative(self) -> float:
        """Mean cost of the matches: 1 by chance; nan where costs tell nothing."""
        return float("nan") if self.pairs is None else float(self.pairs.mean())


def relative_cost(
    costs: tuple[Cost, ...], a: TrackSet, b: TrackSet, i: Int[np.ndarray, " M"], j: Int[np.ndarray, " M"]
) -> float:
    """Mean cost of the pairs over the mean cost of random ones; nan where costs tell nothing."""
    return Likeness.of(costs, a, b, i, j).relative


def random_cost(costs: tuple[Cost, ...], a: TrackSet, b: TrackSet) -> float | None:
    """Mean cost of random pairs; None where all cost the same."""
    rng, many = np.random.default_rng(0), readable(CHANCE, a, b)
    M = total_cost(costs, a.take(rng.permutation(len(a))[:many]), b.take(rng.permutation(len(b))[:many]))
    if np.ptp(M) <= 1e-9 * max(1.0, float(np.abs(M).max())) or M.mean() <= 0:
        return None
    return float(M.mean())


def taken(tracks: TrackSet, index: Int[np.ndarray, " n"]) -> TrackSet:
    """The tracks at ``index``; all of them without a copy."""
    return tracks if np.array_equal(index, np.arange(len(tracks))) else tracks.take(index)


def unlike(a: TrackSet, b: TrackSet, i: Int[np.ndarray, " H"], j: Int[np.ndarray, " H"], features: Likeness) -> bool:
    """Whether matched tracks are hardly liker than the next likest, and distances among them have nothing in common.

    Between unrelated videos, too, every track has a likest partner: what tells is by how much it leads. Distances that
    a matcher compared agree by construction; this asks those that looked at costs alone.
    """
    if features.table is None or features.pairs is None:
        return False
    next_likest = np.partition(features.table, 1, axis=1)[:, 1]
    if np.median(next_likest) > LEAD * np.median(features.pairs) + TIE:
        return False
    apart = distances_among(a, b, i, j)
    if apart is None:
        return False
    x, y = (d - d.mean() for d in apart)
    return float(x @ y) <= COMMON * float(np.sqrt((x @ x) * (y @ y)))


def one_of_several_of_a(
    a: TrackSet,
    b: TrackSet,
    i: Int[np.ndarray, " H"],
    j: Int[np.ndarray, " H"],
    costs: tuple[Cost, ...],
    features: Likeness,
    structure: float,
) -> bool:
    """:func:`one_of_several` of the tracks of a that are matched: b may show one of two like objects."""
    if b.xyz is None or a.xyz is None:
        return False
    some = np.sort(np.random.default_rng(len(i)).permutation(len(i))[:SAMPLE])
    i, j = i[some], j[some]
    return one_of_several(b, a, j, i, features.exchanged(costs, a, b, i, j, some), structure)


def one_of_several(
    a: TrackSet,
    b: TrackSet,
    i: Int[np.ndarray, " H"],
    j: Int[np.ndarray, " H"],
    features: Likeness,
    structure: float,
) -> bool:
    """Whether a second, different answer is about as good: of two like objects either may be the other's image.

    The second answer takes, for every matched track, the partner elsewhere that is likest to it by costs and by its
    distances to all others. It is as good when it costs about as much and distances among its tracks agree as well.
    Where neither costs nor distances tell the found partners from others, several are as good, too.
    """
    if b.xyz is None or a.xyz is None:
        return False
    some = np.sort(np.random.default_rng(len(i)).permutation(len(i))[:SAMPLE])
    i, j = i[some], j[some]
    rest = taken(b, features.others)
    assert rest.xyz is not None
    away = track_distance(b.xyz[j], b.seen[j], rest.xyz, rest.seen).astype(float)
    if not (away > 0).any():
        return False
    unit = float(np.median(away[away > 0]))
    elsewhere = away > SAME_PLACE * unit
    profile = np.abs(profiles(a, i)[:, None] - profiles(b, features.others)[None])
    known = np.isfinite(profile).all(2)
    profile_cost = np.where(known, np.where(np.isfinite(profile), profile, 0.0).mean(2) / unit, 1.0)
    looks = None if features.table is None else features.table[some]
    by_place = profile_cost / max(float(profile_cost.mean()), 1e-12)
    if looks is None or features.pairs is None:
        return explains(a, b, i, features.others, np.where(elsewhere, by_place, np.inf), structure)
    here = features.pairs[some]
    tied = float((np.where(elsewhere, np.abs(looks - here[:, None]), np.inf).min(1) < TIE).mean()) > 0.5
    if tied and structure > NO_STRUCTURE and elsewhere.any(1).sum() >= FEW:
        return True
    # where one video shows more than the other, profiles of one track differ as well: then looks alone find its like
    for price in (by_place + looks, looks):
        price = np.where(elsewhere, price, np.inf)
        can = np.isfinite(price.min(1))
        there = looks[np.arange(len(i)), price.argmin(1)]
        if (
            can.any()
            and np.median(there[can]) <= np.median(here[can]) + AS_LIKE
            and explains(a, b, i, features.others, price, structure)
        ):
            return True
    return False


def explains(
    a: TrackSet,
    b: TrackSet,
    i: Int[np.ndarray, " H"],
    others: Int[np.ndarray, " P"],
    price: Float[np.ndarray, "H P"],
    structure: float,
) -> bool:
    """Whether distances among the cheapest of ``others`` agree about as well as among the found partners of ``i``."""
    can = np.isfinite(price.min(1))
    if can.sum() < FEW:
        return False
    i, there = i[can], others[price.argmin(1)[can]]
    second = geometry(a, b, i, there)
    return second < SECOND_AGREES and second <= AS_GOOD * structure + SLACK


def profiles(tracks: TrackSet, index: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n Q"]:
    """Quantiles of the distances from each track to the others: the same wherever an isometry puts it."""
    assert tracks.xyz is not None
    pool = taken(tracks, evenly(len(tracks), RIVALS))
    own = taken(tracks, index)
    assert own.xyz is not None and pool.xyz is not None
    D = track_distance(own.xyz, own.seen, pool.xyz, pool.seen).astype(float)
    return known_quantiles(D, QUANTILES, 1).T


def forced(a: TrackSet, b: TrackSet, i: Int[np.ndarray, " H"], j: Int[np.ndarray, " H"], features: Likeness) -> bool:
    """Whether part of the better half joins strangers while the rest is clearly right.

    By the costs, or by each match's disagreement with the distances to the others.
    """
    told = (features.pairs, disagreement(a, b, i, j))
    return any(
        cost is not None and np.quantile(cost, 0.2) < CLEARLY and (cost > STRANGE).mean() > FORCED_SHARE
        for cost in told
    )


def moves_mirrored(
    a: TrackSet, b: TrackSet, i: Int[np.ndarray, " H"], j: Int[np.ndarray, " H"], clock: Clock | None
) -> bool:
    """Whether matched tracks move at equal times as mirror images do; handedness that needs no solid quads.

    By the sign of det Σ v_a v_bᵀ, which wrong matches do not turn: they add about nothing.
    """
    if clock is None or a.xyz is None or b.xyz is None:
        return False
    t = a.times
    at = np.clip(np.round(np.interp(clock.own(t), b.times, np.arange(len(b.times)))).astype(int), 0, b.n_frames - 1)
    inside = (clock.own(t) >= b.times[0]) & (clock.own(t) <= b.times[-1])
    if inside.sum() <= STEP:
        return False
    x, y = a.positions(i, inside), b.positions(j, at[inside])
    scale = max(binary_scale(x), binary_scale(y))
    u, v = (np.diff(z[:, ::STEP] / scale, axis=1).reshape(-1, 3) for z in (x, y))
    known = np.isfinite(u[:, 0]) & np.isfinite(v[:, 0])
    if known.sum() < ENOUGH:
        return False
    H = u[known].T @ v[known]
    sizes = np.linalg.svd(H, compute_uv=False)
    reach = np.sqrt((u[known] ** 2).sum() * (v[known] ** 2).sum())
    return bool(np.linalg.det(H) < 0 and sizes[2] > SOLID * sizes[0] and sizes[0] > SHARED * reach)


def geometry(a: TrackSet, b: TrackSet, i: Int[np.ndarray, " M"], j: Int[np.ndarray, " M"]) -> float:
    """How badly distances among matched tracks agree: 0 the same, 1 nowhere within 5 % of their median.

    ``mean min((d_a - d_b)² / τ², 1)`` over pairs of up to 128 matched tracks, d their D_track over the common median,
    τ = .05; nan without 3D positions or where nothing is known.
    """
    apart = differences(a, b, i, j)
    return float("nan") if apart is None else float(apart[np.isfinite(apart)].mean())


def disagreement(
    a: TrackSet, b: TrackSet, i: Int[np.ndarray, " M"], j: Int[np.ndarray, " M"]
) -> Float[np.ndarray, " M"] | None:
    """The same of every match against the others; None where nothing is known."""
    apart = differences(a, b, i, j)
    if apart is None:
        return None
    return np.nanmean(apart[np.isfinite(apart).any(1)], axis=1)


def differences(
    a: TrackSet, b: TrackSet, i: Int[np.ndarray, " M"], j: Int[np.ndarray, " M"]
) -> Float[np.ndarray, "S S"] | None:
    """``min((d_a - d_b)² / τ², 1)`` among up to 128 matches, nan on the diagonal and where unknown."""
    if a.xyz is None or b.xyz is None:
        return None
    some = np.random.default_rng(len(i)).permutation(len(i))[:SAMPLE]
    pairs = ((a.xyz, a.seen, i[some]), (b.xyz, b.seen, j[some]))
    d = [track_distance(xyz[k], seen[k]).astype(float) for xyz, seen, k in pairs]
    known = np.isfinite(d[0]) & np.isfinite(d[1]) & ~np.eye(len(some), dtype=bool)
    unit = np.mean([np.median(x[known]) for x in d]) if known.any() else 0.0
    if not unit > 0:
        return None
    return np.where(known, np.minimum(((d[0] - d[1]) / unit / 0.05) ** 2, 1), np.nan)


def distances_among(
    a: TrackSet, b: TrackSet, i: Int[np.ndarray, " M"], j: Int[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]] | None:
    """Distances among up to 128 matched tracks in a and in b, where both are known; None without any."""
    if a.xyz is None or b.xyz is None:
        return None
    some = np.random.default_rng(len(i)).permutation(len(i))[:SAMPLE]
    pairs = ((a.xyz, a.seen, i[some]), (b.xyz, b.seen, j[some]))
    d = [track_distance(xyz[k], seen[k]).astype(float) for xyz, seen, k in pairs]
    known = np.isfinite(d[0]) & np.isfinite(d[1]) & ~np.eye(len(some), dtype=bool)
    unit = max(np.median(d[0][known]), np.median(d[1][known])) if known.any() else 0.0
    return (d[0][known] / unit, d[1][known] / unit) if unit > 0 else None


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
    first, *others = (points[quads[:, k]].astype(float).transpose(2, 0, 1) for k in range(4))
    u, v, w = (unit_vectors(other - first) for other in others)
    across = (v[1] * w[2] - v[2] * w[1], v[2] * w[0] - v[0] * w[2], v[0] * w[1] - v[1] * w[0])
    volume = u[0] * across[0] + u[1] * across[1] + u[2] * across[2]
    return (volume > FLAT).all(1).astype(int) - (volume < -FLAT).all(1).astype(int)


def unit_vectors(x: Float[np.ndarray, 3 * N]) -> Float[np.ndarray, 3 * N]:
    """Each of length one; 0 of nothing. Each is brought near one first: no square overflows or vanishes."""
    x = x / np.maximum(np.abs(x).max(0), np.finfo(float).tiny)
    return x / np.maximum(np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2), np.finfo(float).tiny)


def poses(xyz: Float[np.ndarray, "M T 3"], seen: Bool[np.ndarray, "M T"], frames: int) -> Float[np.ndarray, "M F 3"]:
    """Positions at some frames, of each track at the nearest one where it is seen."""
    T = seen.shape[1]
    at = evenly(T, frames)
    away = np.abs(np.arange(T)[None] - at[:, None])
    nearest = np.array([np.where(own, away, 2 * T).argmin(1) for own in seen], int).reshape(len(seen), len(at))
    return np.take_along_axis(xyz, nearest[..., None], 1)
