"""From the similarities of pairs to one frame of reference: where each video's frame lies, and which pairs disagree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ..types import Similarity
from ..types.similarity import IDENTITY, adjoint, cross_matrix
from .graph import CAUCHY, components

INFLATION = 1.5
"""Sigmas of the solution take pairs as independent; they share tracks and their errors."""

CYCLE_TURN, CYCLE_PLACE = 8.0, 0.15
"""Degrees, and shares of the scene's extent, by which three pairs around a triangle may fail to close."""

ASTRAY = 4.0
"""Sigmas (per degree of freedom) beyond which a pair contradicts the solution."""

LEAST_TURN, LEAST_SCALE, LEAST_PLACE = np.radians(0.3), 0.003, 0.005
"""Errors that no pair is believed to stay below: radians, a share, shares of the scene's extent."""

STEPS, CONVERGED = 50, 1e-9


@dataclass(frozen=True, eq=False)
class Link:
    """One pair's similarity, as the graph sees it.

    Args:
        a, b: videos. transform: from b's frame to a's, with its covariance. trusted: whether the pair vouches for it.
        middle: (3,) of the scene, in b's frame. extent: of the scene, in a's units.
    """

    a: int
    b: int
    transform: Similarity
    trusted: bool
    middle: Float[np.ndarray, " 3"]
    extent: float

    def away(self, predicted: Similarity) -> Float[np.ndarray, " 7"]:
        """Turn (rad), relative scale, and displacement of the scene's middle (extents) from the pair's answer."""
        d = self.transform.difference(predicted)
        y = self.transform(self.middle)
        return np.concatenate([d[:4], (d[4:] + np.cross(d[:3], y) + d[3] * y) / self.extent])

    @property
    def whitening(self) -> Float[np.ndarray, "7 7"]:
        """L with L' L the inverse covariance of :meth:`away`."""
        y = self.transform(self.middle)
        J = np.eye(7)
        J[4:, :3], J[4:, 3], J[4:, 4:] = -cross_matrix(y) / self.extent, y / self.extent, np.eye(3) / self.extent
        floor = np.diag([LEAST_TURN**2] * 3 + [LEAST_SCALE**2] + [LEAST_PLACE**2] * 3)
        assert self.transform.covariance is not None
        return np.linalg.cholesky(np.linalg.inv(J @ self.transform.covariance @ J.T + floor)).T

    def lever(self, frame: Similarity) -> Float[np.ndarray, "7 7"]:
        """d away / d (small change of b's frame in the world), a's frame lying at ``frame``; a's is minus that."""
        y = self.transform(self.middle)
        J = np.eye(7)
        J[4:, :3], J[4:, 3], J[4:, 4:] = -cross_matrix(y) / self.extent, y / self.extent, np.eye(3) / self.extent
        return J @ adjoint(frame.inverse())


@dataclass(frozen=True, eq=False)
class Poses:
    """Frames of V videos. frames: from each video's frame to its reference's, None where no pair leads there.

    errors: (L,) how far each link is from the solution, sigmas per degree of freedom; nan for links that were not used.
    closed: (L,) whether triangles of pairs through the link close, as far as there are any.
    """

    frames: tuple[Similarity | None, ...]
    errors: Float[np.ndarray, " L"]
    closed: Bool[np.ndarray, " L"]

    def between(self, a: int, b: int) -> Similarity | None:
        """From b's frame to a's."""
        one, other = self.frames[a], self.frames[b]
        if one is None or other is None:
            return None
        return Similarity(one.scale, one.R, one.t).inverse().after(Similarity(other.scale, other.R, other.t))


def place(n: int, links: Sequence[Link], references: Sequence[int]) -> Poses:
    """Robust averaging of rotations, scales and translations over the graph.

    Links that triangles contradict are left out of the beginning: the frames are first laid out along the tree of the
    links that most triangles confirm, then moved together until the weighted errors of all links are least, those far
    off counting for little (Cauchy). Each group of linked videos is solved around the reference among its members.

    Args:
        references: (V,) for each video the index of the one whose frame its own is to be given in.

    References: Chatterjee and Govindu, Robust relative rotation averaging, 2018; Zach et al., Disambiguating visual
    relations using loop constraints, 2010.
    """
    closed, votes = triangles(links)
    frames: list[Similarity | None] = [None] * n
    errors = np.full(len(links), np.nan)
    for root in sorted(set(references)):
        if references[root] != root:
            continue
        frames[root] = IDENTITY.with_covariance(np.zeros((7, 7)))
        usable = [k for k, l in enumerate(links) if l.trusted and references[l.a] == references[l.b] == root]
        sound = [k for k in usable if closed[k]]
        own = along_tree({root: IDENTITY}, links, sound, votes)
        own = along_tree(own, links, usable, votes)  # a video that hangs on links that do not close still gets a frame
        kept = [k for k in usable if links[k].a in own and links[k].b in own]
        own, covariances, found = relax(own, [links[k] for k in kept], root)
        errors[kept] = found
        for v, frame in own.items():
            frames[v] = frame.with_covariance(covariances[v])
    return Poses(tuple(frames), errors, closed)


def triangles(links: Sequence[Link]) -> tuple[Bool[np.ndarray, " L"], Float[np.ndarray, " L"]]:
    """Which links are closed by at least as many triangles as contradict them; and how many more confirm each."""
    step: dict[tuple[int, int], tuple[int, Similarity]] = {}
    for k, l in enumerate(links):
        if l.trusted:
            step[l.a, l.b], step[l.b, l.a] = (k, l.transform), (k, l.transform.inverse())
    good, bad = np.zeros(len(links)), np.zeros(len(links))
    videos = sorted({v for pair in step for v in pair})
    for a in videos:
        for b in (v for v in videos if v > a and (a, v) in step):
            for c in (v for v in videos if v > b and (a, v) in step and (b, v) in step):
                k, _ = step[a, c]
                (i, first), (j, second) = step[a, b], step[b, c]
                link = links[k] if links[k].a == a else _turned(links[k])
                away = link.away(first.after(second))
                fits = np.degrees(np.linalg.norm(away[:3])) <= CYCLE_TURN and np.linalg.norm(away[4:]) <= CYCLE_PLACE
                for edge in (i, j, k):
                    (good if fits else bad)[edge] += 1
    return good >= bad, good - bad


def _turned(link: Link) -> Link:
    back = link.transform.inverse()
    return Link(link.b, link.a, back, link.trusted, link.transform(link.middle), link.extent / link.transform.scale)


def along_tree(
    known: dict[int, Similarity], links: Sequence[Link], usable: Sequence[int], votes: np.ndarray
) -> dict[int, Similarity]:
    """Frames along the links from those that are known, the best confirmed first; ties by the smaller sigma of
    rotation.
    """
    frames = dict(known)
    order = sorted(usable, key=lambda k: (-votes[k], links[k].transform.rotation_sigma, k))
    growing = True
    while growing:
        growing = False
        for k in order:
            l = links[k]
            if (l.a in frames) != (l.b in frames):
                _extend(frames, l)
                growing = True
                break
    return frames


def _extend(frames: dict[int, Similarity], link: Link) -> None:
    plain = link.transform.with_covariance(None)
    if link.a in frames:
        frames[link.b] = frames[link.a].after(plain)
    else:
        frames[link.a] = frames[link.b].after(plain.inverse())


def relax(
    frames: dict[int, Similarity], links: Sequence[Link], root: int
) -> tuple[dict[int, Similarity], dict[int, np.ndarray], Float[np.ndarray, " L"]]:
    """Gauss-Newton with Cauchy weights from ``frames``; the frames, their covariances, and the links' errors."""
    free = [v for v in sorted(frames) if v != root]
    column = {v: 7 * i for i, v in enumerate(free)}
    white = [l.whitening for l in links]
    covariances: dict[int, np.ndarray] = {root: np.zeros((7, 7))}
    frames = dict(frames)
    H = np.zeros((7 * len(free), 7 * len(free)))
    errors = np.zeros(len(links))
    for step in range(STEPS):
        H[:], g = 0.0, np.zeros(len(H))
        for k, (l, L) in enumerate(zip(links, white, strict=True)):
            A = frames[l.a]
            r = L @ l.away(A.inverse().after(frames[l.b]))
            errors[k] = np.sqrt(r @ r / 7)
            w = 1 / (1 + (errors[k] / CAUCHY) ** 2)
            J = L @ l.lever(A)
            ends = [(column[v], s) for v, s in ((l.b, 1.0), (l.a, -1.0)) if v in column]
            for i, si in ends:
                g[i : i + 7] += w * si * J.T @ r
                for j, sj in ends:
                    H[i : i + 7, j : j + 7] += w * si * sj * J.T @ J
        if not len(free):
            break
        change = -np.linalg.solve(H + np.diag(1e-12 * np.diag(H) + 1e-300), g)
        for v in free:
            frames[v] = frames[v].moved(change[column[v] : column[v] + 7])
        if np.abs(change).max() < CONVERGED and step > 2:
            break
    if len(free):
        inverse = INFLATION**2 * np.linalg.inv(H + np.diag(1e-12 * np.diag(H) + 1e-300))
        covariances |= {v: inverse[i : i + 7, i : i + 7] for v, i in column.items()}
    return frames, covariances, errors


def linked(n: int, links: Sequence[Link]) -> list[int]:
    """For each video the smallest index among those that links lead to."""
    return components(n, [(l.a, l.b) for l in links]).tolist() if links else list(range(n))
