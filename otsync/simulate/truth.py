"""The answers a simulated world is born with: offsets, who is who, right and wrong matches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from ..types import Matches
from .observation import Similarity, Surface, stream
from .scenes import Scene

#: m; the nearest point of the same limb counts as its match only up to here
REACH = 0.15


@dataclass(frozen=True, eq=False)
class Truth:
    """Exact answers about V simulated videos.

    Args:
        offsets: (V,) seconds; ``t_world = rates[v] * t_v + offsets[v]``.
        rates: (V,).
        surfaces: who the tracks of every video are.
        frames: world coordinates -> the frame in which video v reports positions.
        scene: the world itself, at every real time.
        size: of the scene, m.
        wrong, n_matches: the preset's, for :meth:`matches`.
        seed: of the world.
        shown: per video (T,) what its frames show, in seconds of the world: where an effect freezes or cuts a video,
            ``rate * t + offset`` is not the whole truth.
    """

    offsets: Float[np.ndarray, " V"]
    rates: Float[np.ndarray, " V"]
    surfaces: tuple[Surface, ...]
    frames: tuple[Similarity, ...]
    scene: Scene
    size: float
    wrong: float
    n_matches: int
    seed: int
    shown: tuple[Float[np.ndarray, " T"], ...] = ()

    def offset(self, a: int, b: int) -> float:
        """Seconds by which video b started after video a: ``offset_b - offset_a``."""
        return float(self.offsets[b] - self.offsets[a])

    def transform(self, a: int, b: int) -> Similarity:
        """From the frame in which video b reports positions to that of video a: ``x_b -> x_a``."""
        return self.frames[a].after(self.frames[b].inverse())

    def positions(self, video: int, world_times: Float[np.ndarray, " T"]) -> Float[np.ndarray, "N T 3"]:
        """Exact world positions of the points that ``video``'s tracks follow; nan for outliers."""
        s = self.surfaces[video]
        R, p = self.scene.pose(np.asarray(world_times, float))
        xyz = np.einsum("ntij,nj->nti", R[s.part], s.local) + p[s.part]
        xyz[s.part < 0] = np.nan
        return xyz

    def matches(
        self, a: int, b: int, wrong: float | None = None, n: int | None = None, *, seed: int | None = None
    ) -> Matches:
        """``n`` matches of two videos, a share ``wrong`` of which is wrong; all scores are equal.

        The right match of a track of a is the nearest surface point of the same limb in b, up to 15 cm away on the
        body. A wrong one is any track of b of another limb. Tracks of a are drawn at most once; there are fewer than
        ``n`` when a has fewer that can be matched. ``matches(b, a)`` are the same with the columns exchanged.

        Args:
            wrong, n: None: the preset's.
            seed: for another draw of the same world; None: the world's.
        """
        share = self.wrong if wrong is None else float(wrong)
        if not 0 <= share <= 1:
            raise ValueError(f"wrong: expected a share in [0, 1]; found {wrong}.")
        if n is not None and n < 0:
            raise ValueError(f"n: expected a number of matches >= 0; found {n}.")
        if a == b:
            raise ValueError(f"a, b: expected two videos; found {a} twice.")
        if a > b:
            return self.matches(b, a, wrong, n, seed=seed).swapped()
        rng = stream(self.seed if seed is None else seed, a, b, "matches")
        nearest = self.nearest(a, b)
        usable = rng.permutation(np.flatnonzero(nearest >= 0))[: self.n_matches if n is None else n]
        right = nearest[usable]
        parts_a, parts_b = self.surfaces[a].part, self.surfaces[b].part
        known = np.flatnonzero(parts_b >= 0)
        for i in range(round(share * len(usable))):
            others = known[parts_b[known] != parts_a[usable[i]]]
            if len(others):
                right[i] = rng.choice(others)
        order = np.argsort(usable, kind="stable")
        return Matches(np.stack([usable, right], 1)[order])

    def nearest(self, a: int, b: int) -> np.ndarray:
        """(Na,) the track of b nearest to each of a's on the same limb of the same object; -1: none within 15 cm."""
        sa, sb = self.surfaces[a], self.surfaces[b]
        known_a, known_b = np.flatnonzero(sa.part >= 0), np.flatnonzero(sb.part >= 0)
        match = np.full(len(sa), -1)
        if len(known_a) and len(known_b):
            # the part as a fourth coordinate, far apart
            where_a, where_b = (np.c_[s.position, 1e3 * s.part][k] for s, k in ((sa, known_a), (sb, known_b)))
            distance, index = cKDTree(where_b).query(where_a, distance_upper_bound=REACH)
            match[known_a[np.isfinite(distance)]] = known_b[index[np.isfinite(distance)]]
        return match

    def match_errors(self, matches: Matches, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
        """(M,) distance on the body between matched points, and from the mirror image of a's to b's, m.

        Infinite between different objects and for outliers.
        """
        i, j = matches.pairs.T
        sa, sb = self.surfaces[a], self.surfaces[b]
        same = (sa.object[i] == sb.object[j]) & (sa.object[i] >= 0)
        direct = np.linalg.norm(sa.position[i] - sb.position[j], axis=1)
        mirror = np.linalg.norm(sa.mirrored[i] - sb.position[j], axis=1)
        return np.where(same, direct, np.inf), np.where(same, mirror, np.inf)

    def matchable(self, a: int, b: int, tolerance: float) -> np.ndarray:
        """(Na,) whether some track of b lies within ``tolerance`` m on the same object."""
        sa, sb = self.surfaces[a], self.surfaces[b]
        known_a, known_b = sa.object >= 0, sb.object >= 0
        has_partner = np.zeros(len(sa), bool)
        if known_a.any() and known_b.any():
            where_a, where_b = (np.c_[s.position, 1e3 * s.object][k] for s, k in ((sa, known_a), (sb, known_b)))
            has_partner[known_a] = np.isfinite(cKDTree(where_b).query(where_a, distance_upper_bound=tolerance)[0])
        return has_partner
