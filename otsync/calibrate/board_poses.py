"""Cameras from a board that is carried about and held still before them: no background is needed.

The phones stand where they film the scene, each films a clip of its own (``board left.mp4``), and nobody presses record
at once. Where the board rests, two cameras that see it know each other's pose, whatever their clocks say. Which rest of
the one is which of the other is told by the pose itself, where the board is tilted in many ways: wrong pairs of rests
agree on none then, and where they do (even steps, one tilt) no camera is believed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ..compute.indices import evenly
from ..compute.threads import MapLike
from ..files.cache import Cache
from ..progress import Tell
from .board_rests import Rest, carried, grid_of, rests_of
from .board_solve import LEAST_PLACES, Linked, Solved, linked, solve
from .boards import Board
from .clips import Clip
from .found import Calibration, FoundCamera
from .stills import background, pictures_of
from .world import Similar, centres, upright

WORST = 2.0
"""Pixels at 1000 of width that the corners of a camera may be off."""

OF_BOARD, GIVEN, FREED = 0.007, 0.003, 0.3
"""Share by which a focal length may be off: as a clip of the board told it, as it was given, and where it is free."""

ANOTHER = 0.006
"""Share from which on a given focal length is that of another lens, where the board's places say so."""

PRINTED = 0.003
"""Share by which squares may be wider than high before that is told."""

UNSURE = 2.0
"""Degrees: a camera that is not known better is doubted."""

MOVED = 0.002
"""Share of the width by which what a phone sees may differ between its two clips."""

LIKE_POINTS = 20
"""Matches of two backgrounds that tell whether a phone was moved; plain walls give fewer, and say nothing."""

HOLD = (
    "Hold the board still for a second at ten places and more, each in view of two neighbouring cameras, while all of "
    "them film it from where they will film the scene."
)
"""What makes cameras known by a board."""


def cameras_by_board(
    clips: Sequence[Clip],
    shown: Mapping[str, Clip],
    board: Board,
    *,
    square: float | None = None,
    distance: tuple[str, str, float] | None = None,
    cache: Cache | None = None,
    map: MapLike = map,
    tell: Tell = lambda text: None,
) -> Calibration:
    """The cameras of the scene's videos by their clips of one board; those that it does not tell have no pose.

    Args:
        clips: of the scene. shown: by the name of a video the clip of the board that its phone filmed from the same
            place. Only cameras with a known lens are looked for.
        square: side of a square, m. distance: two videos and the metres between them, as of ``calibrate``.
        cache: where corners are kept. map: calls the pairs of cameras. tell: receives lines of progress.
    """
    used = [clip for clip in clips if clip.kind == "scene"]
    rests: list[list[Rest]] = []
    for clip in used:
        usable = _unusable(clip, shown.get(clip.name)) is None
        rests.append(rests_of(shown[clip.name], board, clip.lens, cache, tell) if usable else [])
        if usable:
            tell(f"{shown[clip.name].name}: the board rests at {len(rests[-1])} places")
    lenses = [clip.lens.K for clip in used]
    loose = [OF_BOARD if clip.lens.source == "board" else 0.0 for clip in used]
    links = linked(rests, lenses, board, map)
    solved = solve(links, lenses, loose)
    # of a lens that is held, too, nobody knows all; and the places tell whether it is another one
    sure = solved if all(loose) else solve(links, lenses, [each or GIVEN for each in loose])
    freed = solve(links, lenses, [FREED] * len(used))
    cameras = [FoundCamera(c.name, *c.size, c.lens.K, c.lens.distortion, c.lens.source) for c in used]
    if solved is None or sure is None or freed is None:
        lost = [_without(cameras[v], clip, shown.get(clip.name), links, v) for v, clip in enumerate(used)]
        return Calibration(tuple(lost), "board")
    world, unit = _world(used, solved, sorted(links.poses), square, distance, tell)
    # of squares that are not square nobody knows which side was measured
    unknown = 0.0 if square is None else abs(solved.wider) / 2
    if abs(solved.wider) > PRINTED:
        how = "wider than high" if solved.wider > 0 else "higher than wide"
        tell(f"note: the board's squares are {100 * abs(solved.wider):.1f} % {how}; lengths are by the mean of both")
    for v, clip in enumerate(used):
        if v not in links.poses:
            cameras[v] = _without(cameras[v], clip, shown.get(clip.name), links, v)
            continue
        shift = moved_by(shown[clip.name], clip)
        if shift is None:
            tell(f"note: nothing behind the board tells whether {clip.name} was moved before it filmed the scene")
        w2c = world.camera(solved.w2c[v])
        away = unknown * float(np.linalg.norm(centres(w2c)))
        camera = replace(
            cameras[v],
            K=_zoomed(clip.lens.K, float(solved.zoom[v])),
            distortion=_bent(clip.lens.distortion, float(solved.zoom[v]), float(solved.bend[v])),
            w2c=w2c,
            sigma_degrees=float(np.hypot(sure.sigma_degrees[v], _turn(shift, clip))),
            sigma_position=float(
                np.hypot(away, world.scale * np.hypot(sure.sigma_position[v], _way(shift, clip, solved, v)))
            ),
            inliers=int(solved.corners[v]),
            points=int(solved.places[v]),
        )
        cameras[v] = _judged(camera, clip, float(solved.off[v]), shift, freed, v)
    corners = np.concatenate([carried(pose, grid_of(board)) for pose in solved.boards])
    return Calibration(tuple(cameras), "board", unit, (), world(corners))


def _world(
    used: Sequence[Clip],
    solved: Solved,
    known: Sequence[int],
    square: float | None,
    distance: tuple[str, str, float] | None,
    tell: Tell,
) -> tuple[Similar, str]:
    """From squares to an upright world, and its unit."""
    metres = None if square is None else (np.zeros(3), np.array([1.0, 0, 0]), square)
    if distance is not None:
        ends = [solved.w2c[n] for name in distance[:2] for n in known if used[n].name == name]
        if len(ends) == 2:
            metres = centres(ends[0]), centres(ends[1]), distance[2]
        else:
            tell("note: --distance is not used, and lengths are arbitrary: the board leaves out one of the two cameras")
    world = upright([solved.w2c[n] for n in known], [used[n].turned for n in known], metres)
    return world, "arbitrary" if metres is None else "metres"


def _unusable(clip: Clip, shown: Clip | None) -> str | None:
    """Why a camera's clip of the board tells nothing of where it stands."""
    name = clip.name
    if shown is None:
        return f"no clip shows the board to {name}."
    if shown.size != clip.size:
        sizes = " and ".join(f"{w} x {h}" for w, h in (shown.size, clip.size))
        return f"{name} films the board and the scene in images of different sizes: {sizes} pixels."
    if not clip.lens.known:
        return f"the lens of {name} is not known: its clip of the board does not tell it."
    return None


def _without(camera: FoundCamera, clip: Clip, shown: Clip | None, links: Linked, v: int) -> FoundCamera:
    """A camera that the board does not tell, with the reason."""
    why = _unusable(clip, shown)
    if why is not None:
        return camera.doubted(why, f"Film the board with it, too, in the scene's mode: 'board {clip.name}'. " + HOLD)
    if v in links.alike:
        return camera.doubted(
            f"the board rests at places that look alike to {clip.name}: they can be paired with those of another "
            "camera in two ways.",
            "Tilt the board differently each time, and carry it by uneven steps. " + HOLD,
        )
    return camera.doubted(
        f"{clip.name} sees the board at rest at fewer than {LEAST_PLACES} places that another camera sees, too.", HOLD
    )


def _judged(camera: FoundCamera, clip: Clip, off: float, shift: float | None, freed: Solved, v: int) -> FoundCamera:
    """The camera with the reason to doubt it, where there is one."""
    name, focal, zoom = clip.name, float(clip.lens.K[0, 0]), float(freed.zoom[v])
    another = abs(np.log(zoom))
    if clip.lens.source != "board" and another > max(ANOTHER, 3 * float(freed.sigma_zoom[v])):
        camera = camera.doubted(
            f"the board's places say that the focal length of {name} is {zoom * focal:.0f} pixels, not {focal:.0f} "
            f"({clip.lens.source}).",
            "Film the board and the scene in one mode, and give the lens of that mode, or none.",
        )
    if off > WORST * max(clip.size) / 1000:
        camera = camera.doubted(
            f"the board's corners lie {off:.1f} pixels off in {name}: the lens is another one, the board bends, or a "
            "phone was moved meanwhile.",
            HOLD,
        )
    if camera.points < LEAST_PLACES:
        camera = camera.doubted(f"{name} sees the board at rest at {camera.points} places, which are too few.", HOLD)
    if not camera.sigma_degrees < UNSURE:
        camera = camera.doubted(f"the board tells how {name} is turned to {camera.sigma_degrees:.1f}° only.", HOLD)
    if shift is not None and shift > MOVED:
        camera = camera.doubted(
            f"{name} was moved: what it films behind the board and behind the scene lies elsewhere in the image.",
            "Leave the phones where they are from the one clip to the other. " + HOLD,
        )
    return camera


def _turn(shift: float | None, clip: Clip) -> float:
    """Degrees by which a shift of the background, as a share of the width, turns a camera."""
    return 0.0 if shift is None else float(np.degrees(shift * clip.size[0] / clip.lens.K[0, 0]))


def _way(shift: float | None, clip: Clip, solved: Solved, v: int) -> float:
    """Squares by which a camera would have to be moved for such a shift of what is as far away as the board."""
    far = np.linalg.norm(solved.boards[:, :3, 3] - centres(solved.w2c[v]), axis=1)
    return 0.0 if shift is None else float(shift * clip.size[0] / clip.lens.K[0, 0] * np.median(far))


def moved_by(shown: Clip, clip: Clip) -> float | None:
    """By what share of the width the background lies elsewhere in the clip of the scene than in that of the board.

    The most of three frames; None where they show too little to say.
    """
    behind = background(pictures_of(shown.frames, shown.size, 1000)).image
    frames = pictures_of(clip.frames, clip.size, 1000)
    shifts = [shift_of(behind, frames[int(k)]) for k in evenly(len(frames), 3)]
    return max((shift for shift in shifts if shift is not None), default=None)


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


def _zoomed(K: Float[np.ndarray, "3 3"], zoom: float) -> Float[np.ndarray, "3 3"]:
    out = np.array(K, float)
    out[:2, :2] *= zoom
    return out


def _bent(distortion: Float[np.ndarray, " D"] | None, zoom: float, bend: float) -> Float[np.ndarray, " D"] | None:
    """Coefficients of a lens whose focal length changed while its pixels stay, with more of the first one."""
    if distortion is None or (zoom == 1 and not bend):
        return distortion
    out = np.array(distortion, float)
    out[0] = out[0] * zoom**2 + bend
    if len(out) > 1:
        out[1] *= zoom**4
    return out
