"""Detections of single frames joined to tracks: by constant velocity, one to one, over short gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

USUAL = 9
"""Detections of a track that its area is taken from, the last ones."""


@dataclass(frozen=True)
class Linker:
    """Joins detections that move steadily; things that look alike are told apart by where their motion leads.

    A track begins with three detections in a row whose velocity hardly changes. From then on it takes, one to one over
    all tracks (least sum of distances), the detection nearest to where its velocity leads.

    Args:
        gate: pixels by which a detection may miss where a velocity leads. fastest: pixels a frame of a beginning track.
        max_gap: frames that a track may go undetected; the gap stays unobserved.
        alike: factor by which a detection's area may differ from that of its track: two things that meet are one
            component for a while, which belongs to neither.
    """

    gate: float
    fastest: float
    max_gap: int = 4
    alike: float = 1.6

    def __call__(
        self,
        detections: Sequence[Float[np.ndarray, "n 2"]],
        areas: Sequence[Float[np.ndarray, " n"]] | None = None,
    ) -> Float[np.ndarray, "N T 2"]:
        """Tracks of the detections of T frames, nan where a track has none; each detection is in one track at most.

        ``areas``: of every detection; None: they do not tell.
        """
        T = len(detections)
        sizes = [np.log(a) for a in areas] if areas is not None else [np.zeros(len(d)) for d in detections]
        large: list[list[float]] = []
        tracks: list[dict[int, np.ndarray]] = []
        alive: list[int] = []
        free: list[np.ndarray] = [np.ones(len(d), bool) for d in detections]
        for t, found in enumerate(detections):
            alive = [n for n in alive if t - max(tracks[n]) <= self.max_gap + 1]
            if len(alive) and len(found):
                own = np.array([np.median(large[n][-USUAL:]) for n in alive])
                unlike = np.abs(own[:, None] - sizes[t][None]) > np.log(self.alike)
                rows, columns = self._continued(tracks, alive, t, found, unlike)
                for r, c in zip(rows, columns, strict=True):
                    tracks[alive[r]][t] = found[c]
                    large[alive[r]].append(float(sizes[t][c]))
                    free[t][c] = False
            if t >= 2:
                for a, b, c in self._begun(detections[t - 2 : t + 1], free[t - 2 : t + 1]):
                    three = [float(sizes[t - 2][a]), float(sizes[t - 1][b]), float(sizes[t][c])]
                    if max(three) - min(three) > np.log(self.alike):
                        continue
                    alive.append(len(tracks))
                    large.append(three)
                    tracks.append({t - 2: detections[t - 2][a], t - 1: detections[t - 1][b], t: found[c]})
                    free[t - 2][a] = free[t - 1][b] = free[t][c] = False
        uv = np.full((len(tracks), T, 2), np.nan, np.float32)
        for n, track in enumerate(tracks):
            uv[n, list(track)] = np.array(list(track.values()))
        return uv

    def _continued(
        self,
        tracks: list[dict[int, np.ndarray]],
        alive: list[int],
        t: int,
        found: Float[np.ndarray, "n 2"],
        unlike: np.ndarray,
    ) -> tuple[Int[np.ndarray, " K"], Int[np.ndarray, " K"]]:
        """(places in ``alive``, detections) that go together at t."""
        from scipy.optimize import linear_sum_assignment

        leads, gates = np.zeros((len(alive), 2)), np.zeros(len(alive))
        for n, index in enumerate(alive):
            last = sorted(tracks[index])[-3:]
            x = np.array([tracks[index][k] for k in last])
            velocity = (x[-1] - x[0]) / (last[-1] - last[0])
            ahead = t - last[-1]
            leads[n], gates[n] = x[-1] + ahead * velocity, self.gate * ahead
        cost = np.linalg.norm(leads[:, None] - found[None], axis=2)
        possible = (cost <= gates[:, None]) & ~unlike
        # what is impossible costs more than all that is possible together
        rows, columns = linear_sum_assignment(np.where(possible, cost, 1e3 * (gates.max() + 1) * len(cost)))
        kept = possible[rows, columns]
        return rows[kept], columns[kept]

    def _begun(
        self, three: Sequence[Float[np.ndarray, "n 2"]], free: Sequence[np.ndarray]
    ) -> list[tuple[int, int, int]]:
        """Triples of free detections, one of each frame, that move steadily; the steadiest first, each used once."""
        from scipy.spatial import cKDTree

        index = [np.flatnonzero(f) for f in free]
        if any(len(i) == 0 for i in index):
            return []
        a, b, c = (x[i] for x, i in zip(three, index, strict=True))
        later = cKDTree(c)
        triples = []
        near = cKDTree(b).query_ball_point(a, self.fastest)
        for i, partners in enumerate(near):
            for j in partners:
                leads = 2 * b[j] - a[i]
                for k in later.query_ball_point(leads, self.gate):
                    # of equally steady ones the slower
                    price = np.linalg.norm(c[k] - leads) + 0.1 * np.linalg.norm(b[j] - a[i])
                    triples.append((float(price), i, j, k))
        used: tuple[set[int], set[int], set[int]] = (set(), set(), set())
        chosen = []
        for _, i, j, k in sorted(triples):
            if i not in used[0] and j not in used[1] and k not in used[2]:
                for taken, at in zip(used, (i, j, k), strict=True):
                    taken.add(at)
                chosen.append((int(index[0][i]), int(index[1][j]), int(index[2][k])))
        return chosen
