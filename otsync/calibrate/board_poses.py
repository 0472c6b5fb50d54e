"""Cameras from a board that is carried about and held still before them: no background is needed.

The phones stand where they film the scene, each films a clip of its own (``board left.mp4``), and nobody presses record
at once. Where the board rests, two cameras that see it know each other's pose, whatever their clocks say. Which rest of
the one is which of the other is told by the pose itself: wrong pairs of rests agree on none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix
from scipy.spatial.transform import Rotation

from ..compute.indices import evenly
from ..compute.threads import FEW, blas_for
from ..files.cache import Cache
from ..geometry import undistort
from ..progress import Tell
from ..types import Camera
from .boards import LEAST_CORNERS, Board
from .clips import Clip, Lens
from .found import Calibration, FoundCamera
from .stills import background, pictures_of
from .world import centres, degrees, upright

LOOKS_A_SECOND = 8.0
"""How often the board is looked for."""

STEADY, DRIFT = 1.0, 3.0
"""Pixels at 1000 of width that a resting board may seem to move from one look to the next, and in all."""

RESTS = 0.5
"""Seconds for which a board is still at the least."""

SAME_TURN, SAME_PLACE = 4.0, 0.06
"""Within which two places of the board tell of one pose: degrees, and shares of the distance to the board."""

LEAST_PLACES = 4
"""Places at which two cameras must see the board, and agree on each other: wrong pairs of rests agree at two."""

AGREEING = 0.6
"""Share of the rests that two cameras have at one time which must agree on their pose."""

WORST = 2.0
"""Pixels at 1000 of width that the corners of a camera may be off."""

LENS, NOISE = 0.005, 0.3
"""Share by which a focal length that a clip of the board told may be off, and pixels by which corners are."""

FREED, ANOTHER = 0.3, 0.012
"""Share by which a focal length may be off where it is asked anew, and from which on it is that of another lens."""

UNSURE = 2.0
"""Degrees: a camera that is not known better is doubted."""

MOVED = 0.004
"""Share of the width by which what a phone sees may differ between its two clips."""

LIKE_POINTS = 20
"""Matches of two backgrounds that tell whether a phone was moved; plain walls give fewer, and say nothing."""

HOLD = (
    "Hold the board still for a second at ten places and more, each in view of two neighbouring cameras, while all of "
    "them film it from where they will film the scene."
)
"""What makes cameras known by a board."""


@dataclass(frozen=True, eq=False)
class Rest:
    """A board that one camera sees at rest.

    Args:
        begin, end: seconds of the camera's clip.
        xyz: (N,3) corners on the board, in squares. uv: (N,2) their pixels, without the lens's distortion.
        poses: (S,4,4) the board's possible poses, to the camera: a flat board seen from afar has two, and one without
            markers looks alike when it is turned round.
    """

    begin: float
    end: float
    xyz: Float[np.ndarray, "N 3"]
    uv: Float[np.ndarray, "N 2"]
    poses: Float[np.ndarray, "S 4 4"]


@dataclass(frozen=True, eq=False)
class Relation:
    """How two cameras stand to each other.

    Args:
        pose: (4,4) from the first camera to the second one.
        rests: (M,2) which rests of the first and of the second are one place of the board.
    """

    pose: Float[np.ndarray, "4 4"]
    rests: Int[np.ndarray, "M 2"]


@dataclass(frozen=True, eq=False)
class Solved:
    """Cameras and places of the board after their adjustment.

    Args:
        w2c: (V,4,4) in the frame of one of them, lengths in squares; nan where a camera is linked to no other.
        boards: (P,4,4) the board's places, to the world.
        zoom: (V,) by what focal lengths were multiplied. sigma_zoom: (V,) its standard deviation, 0 where held.
        corners, places: (V,) how many corners, and places of the board, tell of each camera.
        off: (V,) their errors, rms, in pixels.
        sigma_degrees, sigma_position: (V,) standard deviations of the poses: degrees and squares.
    """

    w2c: Float[np.ndarray, "V 4 4"]
    boards: Float[np.ndarray, "P 4 4"]
    zoom: Float[np.ndarray, " V"]
    sigma_zoom: Float[np.ndarray, " V"]
    corners: Int[np.ndarray, " V"]
    places: Int[np.ndarray, " V"]
    off: Float[np.ndarray, " V"]
    sigma_degrees: Float[np.ndarray, " V"]
    sigma_position: Float[np.ndarray, " V"]


def cameras_by_board(
    clips: Sequence[Clip],
    shown: Mapping[str, Clip],
    board: Board,
    *,
    square: float | None = None,
    distance: tuple[str, str, float] | None = None,
    cache: Cache | None = None,
    tell: Tell = lambda text: None,
) -> Calibration | None:
    """The cameras of the scene's videos by their clips of one board; None where no two of them see it alike.

    Args:
        clips: of the scene, with known lenses. shown: by the name of a video the clip of the board that its phone
            filmed from the same place.
        square: side of a square, m. distance: two videos and the metres between them, as of ``calibrate``.
        cache: where corners are kept. tell: receives a line a clip.
    """
    cache = cache or Cache()
    used = [clip for clip in clips if clip.kind == "scene"]
    rests: list[list[Rest]] = []
    for clip in used:
        seen = shown.get(clip.name)
        fits = seen is not None and seen.size == clip.size and clip.lens.known
        rests.append(rests_of(seen, board, clip.lens, cache) if seen is not None and fits else [])
        if seen is not None and fits:
            tell(f"{seen.name}: the board rests at {len(rests[-1])} places")
    if sum(len(each) >= LEAST_PLACES for each in rests) < 2:
        return None
    solved = solve(rests, [clip.lens.K for clip in used], board, [clip.lens.source == "board" for clip in used])
    if solved is None:
        return None
    freed = solve(rests, [clip.lens.K for clip in used], board, [True] * len(used), within=FREED)
    known = np.flatnonzero(np.isfinite(solved.w2c).all((1, 2)))
    metres = None if square is None else (np.zeros(3), np.array([1.0, 0, 0]), square)
    if distance is not None:
        ends = [solved.w2c[n] for name in distance[:2] for n in known if used[n].name == name]
        if len(ends) == 2:
            metres = centres(ends[0]), centres(ends[1]), distance[2]
        else:
            tell("note: the board does not tell both cameras of --distance: lengths by it are arbitrary")
    world = upright([solved.w2c[n] for n in known], [used[n].turned for n in known], metres)
    cameras = []
    for v, clip in enumerate(used):
        camera = FoundCamera(clip.name, *clip.size, clip.lens.K, clip.lens.distortion, clip.lens.source)
        if v in known:
            camera = replace(
                camera,
                K=_zoomed(clip.lens.K, float(solved.zoom[v])),
                w2c=world.camera(solved.w2c[v]),
                sigma_degrees=float(solved.sigma_degrees[v]),
                sigma_position=float(world.scale * solved.sigma_position[v]),
                inliers=int(solved.corners[v]),
                points=int(solved.places[v]),
            )
        camera = _judged(camera, clip, shown.get(clip.name), len(rests[v]), float(solved.off[v]))
        if v in known and freed is not None and _other_lens(freed, v):
            focal = float(clip.lens.K[0, 0])
            camera = camera.doubted(
                f"the board's places say that the focal length of {clip.name} is {freed.zoom[v] * focal:.0f} pixels, "
                f"not {focal:.0f} ({clip.lens.source}).",
                "Film the board and the scene in one mode, and give the lens of that mode, or none.",
            )
        cameras.append(camera)
    corners = np.concatenate([_apply(pose, _grid(board)) for pose in solved.boards])
    return Calibration(
        tuple(cameras), "board", "arbitrary" if metres is None else "metres", (), world(corners), seconds={}
    )


def _judged(camera: FoundCamera, clip: Clip, shown: Clip | None, rests: int, off: float) -> FoundCamera:
    """The camera with the reason to doubt it, where there is one."""
    name = clip.name
    if shown is None:
        return camera.doubted(f"no clip shows the board to {name}.", f"Film one, called 'board {name}'. " + HOLD)
    if camera.w2c is None:
        return camera.doubted(
            f"{name} sees the board at rest {rests} times, and at fewer than {LEAST_PLACES} of these places another "
            "camera that is known sees it, too.",
            HOLD,
        )
    if off > WORST * max(clip.size) / 1000:
        camera = camera.doubted(
            f"the board's corners lie {off:.1f} pixels off in {name}: its lens is another one, or the board bends.",
            HOLD,
        )
    if not camera.sigma_degrees < UNSURE:
        camera = camera.doubted(
            f"the board tells how {name} is turned to {camera.sigma_degrees:.1f} degrees only.", HOLD
        )
    if _was_moved(shown, clip):
        camera = camera.doubted(
            f"{name} was moved: what it films behind the board and behind the scene lies elsewhere in the image.",
            "Leave the phones where they are from the one clip to the other. " + HOLD,
        )
    return camera


def _other_lens(freed: Solved, v: int) -> bool:
    """Whether the places of the board contradict a camera's focal length, where that is free."""
    off = abs(float(np.log(freed.zoom[v])))
    return off > ANOTHER and off > 3 * float(freed.sigma_zoom[v])


def _was_moved(shown: Clip, clip: Clip) -> bool:
    """Whether the background of either clip says that the camera moved; plain walls say nothing."""
    behind = background(pictures_of(shown.frames, shown.size, 1000)).image
    frames = pictures_of(clip.frames, clip.size, 1000)
    shifts = [shift_of(behind, frames[int(k)]) for k in evenly(len(frames), 3)]
    return any(shift is not None and shift > MOVED for shift in shifts)


def shift_of(one: np.ndarray, two: np.ndarray) -> float | None:
    """By what share of the width two backgrounds are shifted, in the median; None where they show too little to say."""
    import cv2

    sift = cv2.SIFT.create(800)
    (at, a), (there, b) = (sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None) for image in (one, two))
    if a is None or b is None or len(b) < 2:
        return None
    near = [
        pair
        for pair in cv2.BFMatcher().knnMatch(a, b, 2)
        if len(pair) == 2 and pair[0].distance < 0.75 * pair[1].distance
    ]
    if len(near) < LIKE_POINTS:
        return None
    moves = [np.subtract(at[m.queryIdx].pt, there[m.trainIdx].pt) for m, _ in near]
    return float(np.median(np.linalg.norm(moves, axis=1)) / one.shape[1])


def rests_of(clip: Clip, board: Board, lens: Lens, cache: Cache | None = None) -> list[Rest]:
    """Where a clip shows the board at rest, in order of time."""
    step = max(1, round(clip.fps / LOOKS_A_SECOND))

    def look() -> dict[str, np.ndarray]:
        frames, xyz, uv = [], [], []
        for k in range(0, len(clip.frames), step):
            found = board.corners(clip.frames[k])
            if found is not None:
                frames.append(np.full(len(found[0]), k))
                xyz.append(found[0])
                uv.append(found[1])
        if not frames:
            return {"frame": np.zeros(0, int), "xyz": np.zeros((0, 3)), "uv": np.zeros((0, 2))}
        return {"frame": np.concatenate(frames), "xyz": np.concatenate(xyz), "uv": np.concatenate(uv)}

    kept = (cache or Cache()).arrays("corners", (clip.key, board, step), look)
    looks = [
        (int(k), kept["xyz"][kept["frame"] == k], kept["uv"][kept["frame"] == k]) for k in np.unique(kept["frame"])
    ]
    unit = max(clip.size) / 1000
    camera = Camera(lens.K, np.eye(4), *clip.size, lens.distortion)
    out = []
    for group in _steady(looks, step, unit):
        seconds = (group[-1][0] - group[0][0]) / clip.fps
        if seconds < RESTS:
            continue
        xyz, uv = _mean_corners(group)
        if len(xyz) < LEAST_CORNERS:
            continue
        ideal = undistort(camera, uv)
        poses = _poses(xyz, ideal, lens.K, board)
        if len(poses):
            out.append(Rest(group[0][0] / clip.fps, group[-1][0] / clip.fps, xyz, ideal, poses))
    return out


Look = tuple[int, np.ndarray, np.ndarray]
"""Frame, corners on the board, and their pixels."""


def _steady(looks: Sequence[Look], step: int, unit: float) -> list[list[Look]]:
    """Runs of looks between which the board does not move."""
    groups: list[list[Look]] = []
    for look in looks:
        last = groups[-1] if groups else []
        near = bool(last) and look[0] - last[-1][0] <= step
        near = near and _moved(last[-1], look) < STEADY * unit and _moved(last[0], look) < DRIFT * unit
        if near:
            last.append(look)
        else:
            groups.append([look])
    return groups


def _moved(one: Look, two: Look) -> float:
    """Pixels that the corners which both looks have moved by, in the median; infinity where they share too few."""
    _, i, j = np.intersect1d(_names(one[1]), _names(two[1]), return_indices=True)
    if len(i) < LEAST_CORNERS:
        return float("inf")
    return float(np.median(np.linalg.norm(one[2][i] - two[2][j], axis=1)))


def _names(xyz: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
    """One number a corner of the board."""
    at = np.round(xyz).astype(int)
    return 1000 * at[:, 0] + at[:, 1]


def _mean_corners(group: Sequence[Look]) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 2"]]:
    """The corners that most looks have, and the mean of their pixels."""
    xyz, uv = (np.concatenate([look[n] for look in group]) for n in (1, 2))
    names, first, inverse, count = np.unique(_names(xyz), return_index=True, return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(inverse, uv[:, axis], len(names)) for axis in (0, 1)], 1)
    often = count > len(group) / 2
    return xyz[first[often]], total[often] / count[often, None]


def turns_of(board: Board) -> Float[np.ndarray, "R 4 4"]:
    """The motions of the board after which it may look the same: of one with markers none but the identity."""
    if board.dictionary:
        return np.eye(4)[None]
    out = []
    for quarter in range(0, 4, 1 if board.columns == board.rows else 2):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", 90 * quarter, degrees=True).as_matrix()
        middle = np.array([(board.columns - 1) / 2, (board.rows - 1) / 2, 0])
        turn[:3, 3] = middle - turn[:3, :3] @ middle
        out.append(turn)
    return np.stack(out)


def _poses(
    xyz: Float[np.ndarray, "N 3"], uv: Float[np.ndarray, "N 2"], K: Float[np.ndarray, "3 3"], board: Board
) -> Float[np.ndarray, "S 4 4"]:
    """The board's possible poses; the second of a flat thing's two where it suits the pixels nearly as well."""
    import cv2

    solve_pnp: Any = cv2.solvePnPGeneric
    try:
        _, turns, moves, errors = solve_pnp(xyz, uv, K, None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:  # corners on one line
        return np.zeros((0, 4, 4))
    best, out = float(np.min(errors)), []
    for turn, move, error in zip(turns, moves, np.ravel(errors), strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(move)
        if np.isfinite(pose).all() and error < 3 * best + 0.2:
            out += [pose @ around for around in turns_of(board)]
    return np.array(out).reshape(-1, 4, 4)


def related(one: Sequence[Rest], two: Sequence[Rest]) -> Relation | None:
    """How the second camera stands to the first one; None where too few places say so, or other poses suit as many.

    Each pair of rests, as one place of the board, tells of a difference of the clocks, and with each of the board's
    possible poses of one of the cameras. The right one is told by all pairs of rests at one time.
    """
    best: tuple[int, float, Relation] | None = None
    rivals: list[tuple[int, np.ndarray]] = []
    for first in one:
        for second in two:
            later = (second.begin + second.end - first.begin - first.end) / 2
            pairs = _at_one_time(one, two, later)
            told = [
                np.einsum("tij,sjk->stik", two[j].poses, np.linalg.inv(one[i].poses)).reshape(-1, 4, 4)
                for i, j in pairs
            ]
            if len(pairs) < LEAST_PLACES:
                continue
            for pose in np.einsum("tij,sjk->stik", second.poses, np.linalg.inv(first.poses)).reshape(-1, 4, 4):
                agree = [_alike(pose, each, _reach(two[j])) for each, (_, j) in zip(told, pairs, strict=True)]
                count = sum(bool(each.any()) for each in agree)
                if count < LEAST_PLACES or count < AGREEING * len(pairs):
                    continue
                apart = float(
                    np.mean([_apart(pose, each[some]) for each, some in zip(told, agree, strict=True) if some.any()])
                )
                rivals.append((count, pose))
                if best is None or (count, -apart) > (best[0], -best[1]):
                    held = np.array([pair for pair, some in zip(pairs, agree, strict=True) if some.any()])
                    best = count, apart, Relation(pose, held)
    if best is None:
        return None
    other = [count for count, pose in rivals if float(degrees(pose[:3, :3] @ best[2].pose[:3, :3].T)) > 3 * SAME_TURN]
    return None if other and 2 * max(other) > best[0] else best[2]


def _at_one_time(one: Sequence[Rest], two: Sequence[Rest], later: float) -> list[tuple[int, int]]:
    """Pairs of rests that share most of the shorter one's time, where the second clip shows things so much later."""
    out = []
    for i, a in enumerate(one):
        shared = [min(a.end, b.end - later) - max(a.begin, b.begin - later) for b in two]
        j = int(np.argmax(shared))
        if shared[j] > 0.5 * min(a.end - a.begin, two[j].end - two[j].begin):
            out.append((i, j))
    return out


def _reach(rest: Rest) -> float:
    """How far a camera of the same place may be off, in squares."""
    return SAME_PLACE * float(np.linalg.norm(_apply(rest.poses[0], rest.xyz.mean(0)[None])[0]))


def _alike(pose: Float[np.ndarray, "4 4"], others: Float[np.ndarray, "S 4 4"], reach: float) -> Bool[np.ndarray, " S"]:
    turned = degrees(others[:, :3, :3] @ pose[:3, :3].T) < SAME_TURN
    return turned & (np.linalg.norm(centres(others) - centres(pose), axis=1) < reach)


def _apart(pose: Float[np.ndarray, "4 4"], others: Float[np.ndarray, "S 4 4"]) -> float:
    return float(degrees(others[:, :3, :3] @ pose[:3, :3].T).min())


def solve(
    rests: Sequence[Sequence[Rest]],
    K: Sequence[Float[np.ndarray, "3 3"]],
    board: Board,
    loose: Sequence[bool] | None = None,
    within: float = LENS,
) -> Solved | None:
    """Poses of the cameras that are linked, and places of the board, adjusted together; None where no two are linked.

    Args:
        rests: by camera. K: intrinsics of each. loose: whose focal length is adjusted, too; default: none's.
        within: the share by which a loose one may be off: what a clip of the board told is right to half a per cent.
    """
    links = {}
    for a in range(len(rests)):
        for b in range(a + 1, len(rests)):
            relation = related(rests[a], rests[b])
            if relation is not None:
                links[a, b] = relation
    poses = _chained(links, len(rests))
    if len(poses) < 2:
        return None
    views = _views(rests, links, poses, K, board)
    return _adjusted(views, poses, K, [False] * len(rests) if loose is None else loose, within)


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


@dataclass(frozen=True, eq=False)
class _Views:
    """What is adjusted: all corners of all cameras.

    Args:
        camera, place: (N,) whose corner it is. xyz: (N,3) on the board. uv: (N,2) pixels. boards: (P,4,4).
    """

    camera: Int[np.ndarray, " N"]
    place: Int[np.ndarray, " N"]
    xyz: Float[np.ndarray, "N 3"]
    uv: Float[np.ndarray, "N 2"]
    boards: Float[np.ndarray, "P 4 4"]


def _views(
    rests: Sequence[Sequence[Rest]],
    links: Mapping[tuple[int, int], Relation],
    poses: Mapping[int, np.ndarray],
    K: Sequence[np.ndarray],
    board: Board,
) -> _Views:
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
                    each = [_apply(turn, rest.xyz) for turn in around]
                    off = [
                        np.linalg.norm(_pixels(K[w], _apply(poses[w] @ pose, xyz)) - rest.uv, axis=1) for xyz in each
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
    return _Views(camera, at, xyz, uv, np.stack(boards))


def _adjusted(
    views: _Views, poses: Mapping[int, np.ndarray], K: Sequence[np.ndarray], loose: Sequence[bool], within: float
) -> Solved:
    """Least squares over poses, places and loose lenses (robust); standard deviations from how places disagree."""
    cameras = len(K)
    fixed, *free = sorted(poses, key=lambda v: -int((views.camera == v).sum()))
    zoomed = [v for v in sorted(poses) if loose[v]]
    w2c = np.stack([poses.get(v, np.eye(4)) for v in range(cameras)])
    lens = np.stack([np.asarray(k, float) for k in K])[views.camera]
    count, places = 6 * len(free), len(views.boards)
    stop = count + 6 * places

    def moved(x: Float[np.ndarray, " X"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        out, zoom = w2c.copy(), np.ones(cameras)
        out[free] = _nudged(w2c[free], x[:count].reshape(-1, 6))
        zoom[zoomed] = np.exp(x[stop:])
        return out, _nudged(views.boards, x[count:stop].reshape(-1, 6)), zoom

    def residuals(x: Float[np.ndarray, " X"]) -> Float[np.ndarray, " R"]:
        out, boards, zoom = moved(x)
        both = out[views.camera] @ boards[views.place]
        local = np.einsum("nij,nj->ni", both[:, :3, :3], views.xyz) + both[:, :3, 3]
        at = np.stack([lens[:, 0, 0] * local[:, 0] + lens[:, 0, 1] * local[:, 1], lens[:, 1, 1] * local[:, 1]], 1)
        uv = zoom[views.camera, None] * at / np.maximum(local[:, 2:], 1e-6) + lens[:, :2, 2]
        return np.concatenate([(uv - views.uv).ravel(), NOISE / within * x[stop:]])

    sparsity = _sparsity(views, free, zoomed)
    with blas_for(FEW):  # trf with many threads of BLAS stalls
        done = least_squares(
            residuals, np.zeros(stop + len(zoomed)), jac_sparsity=sparsity, loss="soft_l1", x_scale="jac", max_nfev=100
        )
    out, boards, zoom = moved(done.x)
    off = residuals(done.x)[: 2 * len(views.uv)].reshape(-1, 2)
    variances = np.diagonal(_covariances(np.asarray(done.jac.todense()), done.fun, views, count), axis1=1, axis2=2)
    turn, move = np.full(cameras, np.nan), np.full(cameras, np.nan)
    for n, v in enumerate(free):
        own = variances[:, 6 * n :][:, :6]
        turn[v] = np.degrees(np.sqrt(own[:, :3].sum(1).max()))
        move[v] = np.sqrt(own[:, 3:].sum(1).max())  # a step's turn is about the centre, which it leaves where it is
    unsure = np.zeros(cameras)
    unsure[zoomed] = np.sqrt(variances[:, stop:].max(0))
    turn[fixed], move[fixed] = np.nanmin(turn), np.nanmin(move)  # poses are relative: no camera is surer than all
    out[[v not in poses for v in range(cameras)]] = np.nan
    seen = [views.camera == v for v in range(cameras)]
    return Solved(
        out,
        boards,
        zoom,
        unsure,
        np.array([int(s.sum()) for s in seen]),
        np.array([len(np.unique(views.place[s])) for s in seen]),
        np.array([float(np.sqrt(np.mean(np.sum(off[s] ** 2, 1)))) if s.any() else np.nan for s in seen]),
        turn,
        move,
    )


def _covariances(J: np.ndarray, f: np.ndarray, views: _Views, free: int) -> Float[np.ndarray, "2 X X"]:
    """Of the parameters, twice: from what single corners scatter, and from what whole places pull.

    A place's corners may err together, which a sandwich over places tells; of few places it tells too little.
    ``free``: parameters of cameras, which come first.
    """
    groups = len(views.boards)
    group = np.append(np.repeat(views.place, 2), np.arange(groups, groups + len(f) - 2 * len(views.uv)))
    H = np.linalg.pinv(J.T @ J, hermitian=True)
    plain = H * float(f @ f) / max(len(f) - J.shape[1], 1)
    pulls = np.stack([J[group == g].T @ f[group == g] for g in range(int(group.max()) + 1)])
    sandwich = H @ (pulls.T @ pulls) @ H * groups / max(groups - free / 6, 1)
    return np.stack([plain, sandwich])


def _sparsity(views: _Views, free: Sequence[int], zoomed: Sequence[int]) -> Any:
    """Which parameters each residual depends on: the camera's six, the place's six, and the lens's one."""
    stop = 6 * (len(free) + len(views.boards))
    camera, lens = (
        np.array([list(of).index(int(v)) if v in of else -1 for v in views.camera]) for of in (free, zoomed)
    )
    n, last = np.arange(len(views.uv)), 2 * len(views.uv)
    columns = [np.where(camera >= 0, 6 * camera + k, -1) for k in range(6)]
    columns += [6 * (len(free) + views.place) + k for k in range(6)]
    columns.append(np.where(lens >= 0, stop + lens, -1))
    rows = np.concatenate([2 * n + axis for _ in columns for axis in (0, 1)])
    cols = np.concatenate([column for column in columns for _ in (0, 1)])
    priors = np.arange(len(zoomed))
    rows, cols = np.append(rows[cols >= 0], last + priors), np.append(cols[cols >= 0], stop + priors)
    return coo_matrix((np.ones(len(rows)), (rows, cols)), (last + len(zoomed), stop + len(zoomed)))


def _nudged(poses: Float[np.ndarray, "P 4 4"], steps: Float[np.ndarray, "P 6"]) -> Float[np.ndarray, "P 4 4"]:
    """Poses turned by rotation vectors, and moved, in the axes that they lead to."""
    more = np.tile(np.eye(4), (len(poses), 1, 1))
    more[:, :3, :3] = Rotation.from_rotvec(steps[:, :3]).as_matrix()
    more[:, :3, 3] = steps[:, 3:]
    return more @ poses


def _zoomed(K: Float[np.ndarray, "3 3"], zoom: float) -> Float[np.ndarray, "3 3"]:
    out = np.array(K, float)
    out[:2, :2] *= zoom
    return out


def _apply(pose: Float[np.ndarray, "4 4"], xyz: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    return xyz @ pose[:3, :3].T + pose[:3, 3]


def _pixels(K: Float[np.ndarray, "3 3"], local: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
    """Pixels of points before a camera; nan behind it."""
    z = np.where(local[:, 2:] > 1e-6, local[:, 2:], np.nan)
    return (local @ np.asarray(K).T)[:, :2] / z


def _grid(board: Board) -> Float[np.ndarray, "N 3"]:
    """The board's corners, in squares."""
    inner = (board.columns - 1, board.rows - 1) if board.dictionary else (board.columns, board.rows)
    grid = np.mgrid[: inner[0], : inner[1]].T.reshape(-1, 2).astype(float)
    return np.pad(grid + (1.0 if board.dictionary else 0.0), ((0, 0), (0, 1)))
