"""Poses of cameras that see one board at rest here and there, adjusted together with the board's places.

Clocks are not known: which rest of one camera is which of another is told by the pose on which most pairs agree. A
board that comes back, or is carried by even steps with one tilt, can be paired in several ways: then none is believed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares

from ..compute.threads import FEW, MapLike, blas_for
from .board_adjust import Problem, Views
from .board_rests import Rest, carried, turns_of
from .boards import Board
from .world import centres, degrees

SAME_TURN, SAME_PLACE = 4.0, 0.06
"""Within which two places of the board tell of one pose: degrees, and shares of the distance to the board."""

LEAST_PLACES = 4
"""Places at which two cameras must see the board, and agree on each other: wrong pairs of rests agree at two."""

NEAR_TURN, NEAR_PLACE = 2.0, 0.02
"""Within which one camera sees the board at one place: degrees, and a share of its distance."""

AGREEING = 0.6
"""Share of the rests that two cameras have at one time which must agree on their pose."""

BEND, WIDER = 0.02, 0.01
"""By what the first radial coefficient of a lens may be off, and a share by which a printer makes squares wider: half a
per cent that nobody asks about puts cameras three sigmas off."""

EXACT = 2e6
"""Numbers of a Jacobian from which on its steps are found by iteration."""

NOISE, LEAST_NOISE, OUTLYING = 0.3, 0.02, 3.0
"""Pixels by which corners are off, to begin with and at the least, and how many of that make an outlier."""


@dataclass(frozen=True, eq=False)
class Relation:
    """How two cameras stand to each other.

    Args:
        pose: (4,4) from the first camera to the second one.
        rests: (M,2) which rests of the first and of the second are one place of the board; each place once.
        alone: whether no other pairing of rests, and no other pose, suits nearly as many places.
    """

    pose: Float[np.ndarray, "4 4"]
    rests: Int[np.ndarray, "M 2"]
    alone: bool


@dataclass(frozen=True, eq=False)
class Linked:
    """Cameras that are linked by places which they share, before they are adjusted.

    Args:
        poses: world to camera of those that are linked, in the frame of one of them.
        alike: cameras with a link that another pairing of rests suits as well.
    """

    poses: dict[int, np.ndarray]
    views: Views
    alike: frozenset[int]


@dataclass(frozen=True, eq=False)
class Solved:
    """Cameras and places of the board after their adjustment.

    Args:
        w2c: (V,4,4) in the frame of one of them, lengths in squares; nan where a camera is linked to no other.
        boards: (P,4,4) the board's places, to the world.
        zoom: (V,) by what focal lengths were multiplied. sigma_zoom: (V,) its standard deviation, 0 where held.
        bend: (V,) what was added to the first radial coefficient. wider: share by which squares are wider than high.
        corners: (V,) how many corners tell of each camera. places: (V,) at how many places of the board.
        off: (V,) their errors, rms, in pixels.
        sigma_degrees, sigma_position: (V,) standard deviations of the poses: degrees and squares.
    """

    w2c: Float[np.ndarray, "V 4 4"]
    boards: Float[np.ndarray, "P 4 4"]
    zoom: Float[np.ndarray, " V"]
    sigma_zoom: Float[np.ndarray, " V"]
    bend: Float[np.ndarray, " V"]
    wider: float
    corners: Int[np.ndarray, " V"]
    places: Int[np.ndarray, " V"]
    off: Float[np.ndarray, " V"]
    sigma_degrees: Float[np.ndarray, " V"]
    sigma_position: Float[np.ndarray, " V"]


def linked(
    rests: Sequence[Sequence[Rest]],
    K: Sequence[Float[np.ndarray, "3 3"]],
    board: Board,
    map: MapLike = map,
) -> Linked:
    """Which cameras see the board at the same places, and how they stand to each other; ``map`` calls the pairs.

    Args:
        rests: by camera. K: intrinsics of each.
    """
    pairs = [(a, b) for a in range(len(rests)) for b in range(a + 1, len(rests)) if rests[a] and rests[b]]
    found = list(map(lambda pair: related(rests[pair[0]], rests[pair[1]]), pairs))
    links = {pair: relation for pair, relation in zip(pairs, found, strict=True) if relation is not None}
    sure = {pair: relation for pair, relation in links.items() if relation.alone}
    poses = _chained(sure, len(rests))
    alike = frozenset(v for pair, relation in links.items() if not relation.alone for v in pair)
    return Linked(poses, _views(rests, sure, poses, K, board) if len(poses) > 1 else NOTHING, alike)


def related(one: Sequence[Rest], two: Sequence[Rest]) -> Relation | None:
    """How the second camera stands to the first one; None where too few places say so.

    Each pairing of rests by time, at some difference of the clocks, tells of poses: one a pair, times the board's
    possible poses. At the right difference all pairs tell of one.
    """
    poses = _relative(one, two)
    reach = np.array([SAME_PLACE * float(np.linalg.norm(rest.poses[0, :3, 3])) for rest in two])
    best, others = None, []
    for pairing in _pairings(one, two):
        most = 0 if best is None else best.count
        if len(pairing) < max(LEAST_PLACES, most / 2):
            break  # pairings come by size: no other one is better, or a rival
        support = _supported(poses, np.array(pairing), reach)
        if support is None:
            continue
        better = best is None or (support.count, -support.apart) > (best.count, -best.apart)
        others.append(best if better else support)
        best = support if better else best
    if best is None:
        return None
    rival = max((other.count for other in others if other is not None and other.differs(best)), default=0)
    rival = max(rival, best.otherwise)
    return Relation(best.pose, best.pairs, 2 * rival <= best.count)


@dataclass(frozen=True, eq=False)
class _Support:
    """What a pairing of rests says.

    Args:
        pose: on which most pairs agree. pairs: (M,2) those. apart: degrees by which they differ from it, in the mean.
        otherwise: how many pairs agree on quite another pose.
    """

    pose: Float[np.ndarray, "4 4"]
    pairs: Int[np.ndarray, "M 2"]
    apart: float
    otherwise: int

    @property
    def count(self) -> int:
        return len(self.pairs)

    def differs(self, other: _Support) -> bool:
        """Whether most of the pairs are others."""
        mine, yours = ({tuple(pair) for pair in each.pairs.tolist()} for each in (self, other))
        return 2 * len(mine & yours) <= min(len(mine), len(yours))


def _relative(one: Sequence[Rest], two: Sequence[Rest]) -> list[list[Float[np.ndarray, "S 4 4"]]]:
    """[first rest][second rest] possible poses from the first camera to the second one, if both are of one place."""
    # a board that looks alike in both cameras when it is turned round tells each pose once: so one of them is turned
    back = [np.linalg.inv(rest.poses[:: rest.around]) for rest in one]
    return [[np.einsum("tij,sjk->stik", rest.poses, inverse).reshape(-1, 4, 4) for rest in two] for inverse in back]


def _pairings(one: Sequence[Rest], two: Sequence[Rest]) -> list[tuple[tuple[int, int], ...]]:
    """Pairs of rests that are at one time for some difference of the clocks; each place once; the longest first."""
    places = [_places(rests) for rests in (one, two)]
    begin, end = np.array([rest.begin for rest in two]), np.array([rest.end for rest in two])
    found: dict[tuple[tuple[int, int], ...], None] = {}
    for first in one:
        for second in two:
            later = (second.begin + second.end - first.begin - first.end) / 2
            shared = np.stack([np.minimum(a.end, end - later) - np.maximum(a.begin, begin - later) for a in one])
            least = 0.5 * np.minimum(np.array([[a.end - a.begin] for a in one]), (end - begin)[None])
            pairs: list[tuple[int, int]] = []
            used: tuple[set[int], set[int]] = set(), set()
            for n in np.argsort(-shared, axis=None, kind="stable").tolist():
                i, j = divmod(n, len(two))
                if shared[i, j] <= 0:
                    break
                at = places[0][i], places[1][j]
                if shared[i, j] > least[i, j] and at[0] not in used[0] and at[1] not in used[1]:
                    pairs.append((i, j))
                    used[0].add(at[0])
                    used[1].add(at[1])
            if len(pairs) >= LEAST_PLACES:
                found[tuple(sorted(pairs))] = None
    return sorted(found, key=lambda pairing: (-len(pairing), pairing))


def _places(rests: Sequence[Rest]) -> list[int]:
    """Number of the place of each rest: the board may lie still for long, be lost for a look, or come back."""
    leaders: list[tuple[int, Rest]] = []
    out = []
    for rest in rests:
        near = NEAR_PLACE * float(np.linalg.norm(rest.poses[0, :3, 3]))
        for number, leader in leaders:
            turned = degrees(rest.poses[:, :3, :3] @ leader.poses[0, :3, :3].T)
            middle = leader.xyz.mean(0)
            moved = [carried(pose, middle[None])[0] - carried(leader.poses[0], middle[None])[0] for pose in rest.poses]
            if ((turned < NEAR_TURN) & (np.linalg.norm(moved, axis=1) < near)).any():
                out.append(number)
                break
        else:
            out.append(len(leaders))
            leaders.append((len(leaders), rest))
    return out


def _supported(
    poses: Sequence[Sequence[Float[np.ndarray, "S 4 4"]]],
    pairing: Int[np.ndarray, "K 2"],
    reach: Float[np.ndarray, " N"],
) -> _Support | None:
    """The pose on which most pairs of a pairing agree; None where too few do."""
    told = [poses[i][j] for i, j in pairing.tolist()]
    of = np.repeat(np.arange(len(told)), [len(each) for each in told])
    every = np.concatenate(told)
    turned = degrees(every[:, None, :3, :3] @ np.swapaxes(every[None, :, :3, :3], 2, 3))
    moved = np.linalg.norm(centres(every)[:, None] - centres(every)[None], axis=-1)
    agree = (turned < SAME_TURN) & (moved < reach[pairing[:, 1]][of][None])
    held = np.stack([agree[:, of == k].any(1) for k in range(len(told))], 1)
    count = held.sum(1)
    if count.max() < max(LEAST_PLACES, AGREEING * len(told)):
        return None
    spread = np.array([turned[n][agree[n]].mean() for n in range(len(every))])
    n = int(np.lexsort((spread, -count))[0])
    other = (turned[n] > 3 * SAME_TURN) | (moved[n] > 3 * reach[pairing[:, 1]].max())
    return _Support(every[n], pairing[held[n]], float(spread[n]), int(count[other].max(initial=0)))


def solve(
    linked: Linked, K: Sequence[Float[np.ndarray, "3 3"]], within: Sequence[float] | None = None
) -> Solved | None:
    """Poses of the cameras that are linked, and places of the board, adjusted together; None where no two are linked.

    Args:
        K: intrinsics of each camera.
        within: the share by which the focal length of each may be off, 0 where it is held; default: all are.
    """
    if len(linked.poses) < 2:
        return None
    within = [0.0] * len(K) if within is None else within
    first = _adjusted(linked, K, within, NOISE)
    noise = float(np.sqrt(np.nanmean(first.off**2) / 2))  # what a lens is known to counts as much as corners do
    return _adjusted(linked, K, within, max(noise, LEAST_NOISE))


def _chained(links: Mapping[tuple[int, int], Relation], cameras: int) -> dict[int, np.ndarray]:
    """Poses of the largest group of linked cameras, in the frame of one of them; the surest links first."""
    best: dict[int, np.ndarray] = {}
    seen = np.zeros(cameras, int)
    for (a, b), relation in links.items():
        seen[[a, b]] += len(relation.rests)
    for start in np.argsort(-seen, kind="stable").tolist():
        poses = {start: np.eye(4)}
        while True:
            ends = [(len(r.rests), a, b) for (a, b), r in links.items() if (a in poses) != (b in poses)]
            if not ends:
                break
            _, a, b = max(ends, key=lambda end: (end[0], -end[1], -end[2]))
            step = links[a, b].pose
            if a in poses:
                poses[b] = step @ poses[a]
            else:
                poses[a] = np.linalg.inv(step) @ poses[b]
        if len(poses) > len(best):
            best = poses
    return best


NOTHING = Views(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 4, 4)))


def _views(
    rests: Sequence[Sequence[Rest]],
    links: Mapping[tuple[int, int], Relation],
    poses: Mapping[int, np.ndarray],
    K: Sequence[np.ndarray],
    board: Board,
) -> Views:
    """The places that cameras share, each with the pose that suits all who see it, and corners as each of them sees."""
    place: dict[tuple[int, int], set[tuple[int, int]]] = {}
    for (a, b), relation in sorted(links.items(), key=lambda item: -len(item[1].rests)):
        if a not in poses or b not in poses:
            continue
        for i, j in relation.rests.tolist():
            one, two = (place.setdefault(rest, {rest}) for rest in ((a, i), (b, j)))
            if one is not two and not {v for v, _ in one} & {v for v, _ in two}:
                one |= two
                place |= dict.fromkeys(two, one)
    groups = {id(group): sorted(group) for group in place.values() if len(group) > 1}
    around, rows = turns_of(board), []
    boards: list[np.ndarray] = []
    for group in sorted(groups.values()):
        best: tuple[float, np.ndarray, list[np.ndarray]] | None = None
        for v, n in group:
            for pose in np.linalg.inv(poses[v]) @ rests[v][n].poses:
                error, turned = 0.0, []
                for w, m in group:
                    rest = rests[w][m]
                    each = [carried(turn, rest.xyz) for turn in around]
                    off = [
                        np.linalg.norm(_pixels(K[w], carried(poses[w] @ pose, xyz)) - rest.uv, axis=1) for xyz in each
                    ]
                    sums = [float(np.minimum(np.where(np.isfinite(o), o, 50), 50).mean()) for o in off]
                    error += min(sums)
                    turned.append(each[int(np.argmin(sums))])
                if best is None or error < best[0]:
                    best = error, pose, turned
        assert best is not None
        for (v, n), xyz in zip(group, best[2], strict=True):
            size = len(xyz)
            rows.append((np.full(size, v), np.full(size, len(boards)), xyz, rests[v][n].uv))
        boards.append(best[1])
    camera, at, xyz, uv = (np.concatenate(column) for column in zip(*rows, strict=True))
    return Views(camera, at, xyz, uv, np.stack(boards))


def _adjusted(linked: Linked, K: Sequence[np.ndarray], within: Sequence[float], noise: float) -> Solved:
    """Least squares over poses, places and loose lenses (robust); standard deviations from how places disagree.

    ``noise``: pixels by which corners are taken to be off, against which lenses count.
    """
    views, poses, cameras = linked.views, linked.poses, len(K)
    fixed, *free = sorted(poses, key=lambda v: -int((views.camera == v).sum()))
    loose = [v for v in sorted(poses) if within[v]]
    problem = Problem(
        views,
        np.stack([poses.get(v, np.eye(4)) for v in range(cameras)]),
        np.stack([np.asarray(k, float) for k in K]),
        free,
        loose,
        noise / np.array([*(x for v in loose for x in (within[v], BEND)), WIDER]),
    )
    with blas_for(FEW):
        done = least_squares(
            problem.residuals,
            np.zeros(problem.size),
            problem.jacobian,
            loss="soft_l1",
            f_scale=OUTLYING * noise,
            x_scale="jac",
            tr_solver="exact" if 2 * len(views.uv) * problem.size < EXACT else "lsmr",
            max_nfev=100,
        )
    out, boards, zoom, bend = problem.at(done.x)
    stop = problem.poses
    off = done.fun[: 2 * len(views.uv)].reshape(-1, 2)
    pulls = done.fun * (1 + (done.fun / (OUTLYING * noise)) ** 2) ** 0.25  # as scipy scaled the Jacobian for its loss
    variances = _variances(np.asarray(done.jac), pulls, views, problem.cameras, noise)
    turn, move, unsure = (np.full(cameras, np.nan) for _ in range(3))
    for n, v in enumerate(free):
        own = variances[:, 6 * n :][:, :6]
        turn[v] = np.degrees(np.sqrt(own[:, :3].sum(1).max()))
        move[v] = np.sqrt(own[:, 3:].sum(1).max())  # a step's turn is about the centre, which it leaves where it is
    unsure[loose] = np.sqrt(variances[:, stop:-1:2].max(0))
    turn[fixed], move[fixed] = np.nanmin(turn), np.nanmin(move)  # poses are relative: no camera is surer than all
    out[[v not in poses for v in range(cameras)]] = np.nan
    seen = [views.camera == v for v in range(cameras)]
    return Solved(
        out,
        boards,
        zoom,
        unsure,
        bend,
        float(np.expm1(done.x[-1])),
        np.array([int(s.sum()) for s in seen]),
        np.array([len(np.unique(views.place[s])) for s in seen]),
        np.array([float(np.sqrt(np.mean(np.sum(off[s] ** 2, 1)))) if s.any() else np.nan for s in seen]),
        turn,
        move,
    )


def _variances(J: np.ndarray, f: np.ndarray, views: Views, free: int, noise: float) -> Float[np.ndarray, "2 X"]:
    """Of the parameters, twice: from what single corners scatter, and from what whole places pull.

    A place's corners may err together, which a sandwich over places tells; of few places it tells too little. What is
    known of lenses counts with what it is known to, not with how far they went.

    Args:
        J, f: Jacobian and residuals, those of the lenses last. free: parameters of cameras, which come first.
    """
    corners, groups = 2 * len(views.uv), len(views.boards)
    group = np.repeat(views.place, 2)
    H = np.linalg.pinv(J.T @ J, hermitian=True)
    scatter = max(float(f[:corners] @ f[:corners]) / max(corners - J.shape[1], 1), noise**2)
    pulls = np.stack([J[:corners][group == g].T @ f[:corners][group == g] for g in range(groups)])
    known = noise**2 * J[corners:].T @ J[corners:]
    sandwich = H @ (pulls.T @ pulls * groups / max(groups - free / 6, 1) + known) @ H
    return np.stack([np.diag(H) * scatter, np.diag(sandwich)])


def _pixels(K: Float[np.ndarray, "3 3"], local: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
    """Pixels of points before a camera; nan behind it."""
    z = np.where(local[:, 2:] > 1e-6, local[:, 2:], np.nan)
    return (local @ np.asarray(K).T)[:, :2] / z
