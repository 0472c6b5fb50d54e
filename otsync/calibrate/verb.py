"""From a folder of videos to their cameras."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ..compute.threads import pool_of
from ..files.cache import Cache
from ..progress import Progress, Tell
from .adjusted import adjusted
from .board_poses import cameras_by_board
from .boards import Board, with_boards
from .clips import Clip, Lens, read_clips
from .found import Calibration, FoundCamera
from .left_out import with_left_out
from .mapping import Mapper, Model, Pictures, lenses_found, map_pictures
from .poses import every_pose, key_pictures
from .stills import (
    LOOKS,
    RESIDUAL,
    SAMPLES,
    SPARE,
    STAYING,
    STILL,
    Picture,
    background,
    key_frames,
    pictures_of,
    stands_still,
)
from .verdict import MOVING_PICTURES, agreement, judged, spread, support
from .world import Similar, centres, upright

SHARED, FEWEST = 3, 8
"""Key frames of all clips together, in those of one, and the fewest of one: time grows with the square of them all."""

FLOW_SECONDS = 1 / 15
"""Between the frames whose flow tells what moves before a moving camera."""

Matches = Mapping[tuple[int, int], np.ndarray]
"""Verified matches by pair of pictures."""


def _told_on_the_shell() -> Any:
    """How the shell reads ``--distance``: two names and a number, and what is wrong in words."""
    from tyro.constructors import PrimitiveConstructorSpec

    def read(texts: list[str]) -> tuple[str, str, float]:
        first, second, metres = texts
        try:
            return first, second, float(metres)
        except ValueError:
            raise ValueError(f"expected two videos and the metres between them; found {' '.join(texts)}") from None

    return PrimitiveConstructorSpec(
        nargs=3,
        metavar="VIDEO VIDEO METRES",
        instance_from_str=read,
        is_instance=lambda given: given is None or isinstance(given, tuple),
        str_from_instance=lambda given: ["None"] if given is None else [str(x) for x in given],
    )


@dataclass(frozen=True)
class CalibrateOptions:
    """How cameras are looked for."""

    intrinsics: Path | None = None
    """JSON with K and distortion by video, or another scene.json; held fixed. "*" stands for every video."""
    board: str | None = None
    """Which board clips called board... show: 9x6 (inner corners of a checkerboard) or 5x7:DICT_4X4_50 (ChArUco)."""
    square: float | None = None
    """Metres of a side of the board's squares: cameras that are found by the board are in metres."""
    distance: Annotated[tuple[str, str, float] | None, _told_on_the_shell()] = None
    """Two videos of static cameras, and the metres between them: the scene is in metres."""
    key_frames: int = 24
    """Frames of a clip whose camera moves that the mapping uses; of many clips fewer each, but of walk clips."""
    width: int = 1000
    """Pixels of the longer side of the pictures that the mapping uses."""
    seed: int = 0
    """Of the mappers' random numbers."""

    def __post_init__(self) -> None:
        if self.key_frames < 2:
            raise ValueError(f"--key-frames: expected 2 and more; found {self.key_frames}.")
        if self.board is not None:
            Board.parse(self.board)
        if self.square is not None and not (np.isfinite(self.square) and self.square > 0):
            raise ValueError(f"--square: expected metres above 0; found {self.square}.")
        if self.square is not None and (self.board is None or self.distance is not None):
            raise ValueError("--square: expected --board beside it, and no --distance, which tells lengths too.")
        if self.width < 160:
            raise ValueError(f"--width: expected 160 pixels and more; found {self.width}.")
        if self.seed < 0:
            raise ValueError(f"--seed: expected 0 or more; found {self.seed}.")
        if self.distance is not None and not (np.isfinite(self.distance[2]) and self.distance[2] > 0):
            raise ValueError(f"--distance: expected metres above 0; found {self.distance[2]}.")

    def pictures_of(self, clip: Clip, clips: int) -> int:
        """How many key frames a clip of so many gives, if its camera moves."""
        shared = SHARED * self.key_frames // clips
        return self.key_frames if clip.kind == "walk" else min(self.key_frames, max(FEWEST, shared))


@dataclass(frozen=True, eq=False)
class Filmed:
    """A clip and its pictures for the mapping."""

    clip: Clip
    moves: bool
    pictures: tuple[Picture, ...]
    scale: float


def calibrate(
    folder: str | os.PathLike[str],
    options: CalibrateOptions | None = None,
    *,
    cache: Cache | None = None,
    tell: Tell = lambda text: None,
) -> Calibration:
    """Find the cameras of a folder of videos.

    Videos called ``walk...`` only help: a phone that is carried past all others. So do those called ``board...``, which
    show a board to one lens or to all (see :mod:`otsync.calibrate.boards`); where several phones saw it at rest from
    their places, it tells these, too (:mod:`otsync.calibrate.board_poses`), and the background is asked only where it
    leaves a camera out. Of both ways the one that more cameras are to be trusted by is taken. Static cameras are found
    by the median of their frames, moving ones by key frames without what moves, then frame by frame.

    Args:
        cache: where stages are kept; a run that was killed continues from there, with the same result.
        tell: receives one line a stage.

    The result names every camera that is not to be trusted, with the reason and what to film. ValueError for what
    does not read. Needs the extra ``calibrate``.
    """
    options, cache = options or CalibrateOptions(), cache or Cache()
    clips, _ = read_clips(folder, options.intrinsics)
    clips, shown = with_boards(clips, options.board, cache, tell)
    if not shown:
        _told_of_square(options, "no clip of a board has the name of a video", tell)
        return calibrate_clips(clips, options, cache=cache, tell=tell)
    progress, options = Progress(tell), _with_distance(options, clips)
    with progress.stage("board"), pool_of(os.cpu_count() or 1) as pool:
        by_board = cameras_by_board(
            clips,
            shown,
            Board.parse(str(options.board)),
            square=options.square,
            distance=options.distance,
            cache=cache,
            map=pool.map,
            tell=tell,
        )
    walks = [clip for clip in clips if clip.kind == "walk"]
    helpers = tuple(FoundCamera(c.name, *c.size, c.lens.K, c.lens.distortion, c.lens.source) for c in walks)
    by_board = replace(by_board, helpers=helpers, seconds=dict(progress.seconds))
    if by_board.ok:
        if walks:
            tell(f"the board tells all cameras; not used: {', '.join(clip.name for clip in walks)}")
        return by_board
    for camera in by_board.cameras:
        if not camera.ok:
            tell(f"by the board: {camera.doubt}")
    tell("what the board leaves out is looked for by the background")
    try:
        found = calibrate_clips(clips, options, cache=cache, tell=tell)
    except ValueError as error:
        if _worth(by_board)[0] < 2:
            raise
        tell(f"note: the background does not help: {error}")
        return by_board
    seconds = dict(progress.seconds) | found.seconds
    if _worth(by_board) > _worth(found):
        return replace(by_board, helpers=found.helpers, seconds=seconds)
    _told_of_square(options, "the board tells no more cameras than the background", tell)
    return replace(found, seconds=seconds)


def _worth(found: Calibration) -> tuple[int, bool, int]:
    """How many cameras are to be trusted, whether in metres, and how many have a pose."""
    return sum(camera.ok for camera in found.cameras), found.unit == "metres", len(found.found)


def calibrate_clips(
    clips: Sequence[Clip],
    options: CalibrateOptions | None = None,
    *,
    cache: Cache | None = None,
    tell: Tell = lambda text: None,
) -> Calibration:
    """The same by the background alone, for clips that are already described, walk clips among them."""
    options, cache, progress = options or CalibrateOptions(), cache or Cache(), Progress(tell)
    options = _with_distance(options, clips)
    with progress.stage("pictures"):
        filmed = [_filmed(clip, options, options.pictures_of(clip, len(clips)), cache) for clip in clips]
        for each in filmed:
            how = f"moves, {len(each.pictures)} key frames" if each.moves else "stands still: the median of its frames"
            tell(f"{each.clip.name}: {how}")
    mapped = Pictures(
        tuple(each.clip.name for each in filmed),
        np.repeat(np.arange(len(filmed)), [len(each.pictures) for each in filmed]),
        tuple(picture for each in filmed for picture in each.pictures),
        tuple(each.clip.lens.scaled(each.scale) for each in filmed),
        tuple(each.moves for each in filmed),
        cache.root,
    )
    with progress.stage("features and matches"):
        mapped.database(tell)
    with progress.stage("mapping"):
        matches = mapped.matches()
        models = _models(mapped, matches, options.seed, cache)
    method, model, other = chosen(models, mapped, matches)
    if model is None:
        helped = any(clip.kind == "walk" for clip in clips)
        lost = [judged(_camera(each, each.clip.lens), helped=helped) for each in filmed]
        return _split(lost, clips, method, "arbitrary", progress)
    agreed = agreement(model, other, mapped.of, len(filmed))
    with progress.stage("poses"):
        model = with_left_out(model, matches, mapped)
        if mapped.kind == "stills":
            model = adjusted(model, matches, mapped)
        cameras, world = _placed(filmed, mapped, model, options, cache)
    backed = support(model, matches, mapped.of, mapped.lenses)
    helped = any(clip.kind == "walk" for clip in clips)
    seen = mapped.of[model.pictures[model.seen[:, 0]]]
    turns, moves = spread(model, mapped.of, len(filmed))
    size = float(np.median(np.linalg.norm(centres(world.camera(model.w2c)), axis=1)))
    cameras = [
        judged(
            replace(
                camera,
                inliers=int(backed.nearest[v]),
                points=len(np.unique(model.seen[seen == v, 1])),
                sigma_degrees=float(np.hypot(turns[v], agreed.turn[v])),
                sigma_position=float(np.hypot(world.scale * moves[v], agreed.move[v] * size)),
            ),
            turn=float(agreed.turn[v]),
            move=float(agreed.move[v]),
            whole=agreed.whole,
            checked=other is not None,
            health=float(backed.health[v]),
            helped=helped,
        )
        for v, camera in enumerate(cameras)
    ]
    unit = "arbitrary" if options.distance is None else "metres"
    return replace(_split(cameras, clips, method, unit, progress), points=world(model.points))


def chosen(
    models: dict[Mapper, Model | None], mapped: Pictures, matches: Matches
) -> tuple[Mapper, Model | None, Model | None]:
    """(mapper, its model, the other's model): the one that knows more of the videos; of equals the better one.

    Along clips the global mapper was the more accurate one; of stills the one that more matches obey.
    """

    def worth(mapper: Mapper) -> tuple[int, int, int]:
        model = models[mapper]
        if model is None:
            return 0, 0, 0
        backed = support(model, matches, mapped.of, mapped.lenses).worth
        if mapped.kind == "stills":
            return backed, len(model.pictures), 0
        return len(set(mapped.of[model.pictures].tolist())), len(model.pictures), int(mapper == "global")

    first: Mapper = max(models, key=worth)
    second: Mapper = "incremental" if first == "global" else "global"
    return first, models[first], models[second]


def _filmed(clip: Clip, options: CalibrateOptions, count: int, cache: Cache) -> Filmed:
    """Whether the camera moves, and its pictures, at most ``count``; kept, because decoding takes long."""
    frames = pictures_of(clip.frames, clip.size, options.width)

    def look() -> dict[str, np.ndarray]:
        if stands_still(frames):
            return {"moves": np.array(False), "frames": np.array([-1]), "images": background(frames).image[None]}
        found = key_frames(frames, count, max(1, round(clip.fps * FLOW_SECONDS)))
        return {
            "moves": np.array(True),
            "frames": np.array([picture.frame for picture in found]),
            "images": np.stack([picture.image for picture in found]),
            "use": np.stack([picture.use for picture in found if picture.use is not None]),
        }

    constants = (STILL, STAYING, LOOKS, SAMPLES, RESIDUAL, SPARE, FLOW_SECONDS)
    kept = cache.arrays("pictures", (clip.key, options.width, count, *constants), look)
    use = kept.get("use", [None] * len(kept["frames"]))
    pictures = tuple(Picture(int(k), i, u) for k, i, u in zip(kept["frames"], kept["images"], use, strict=True))
    return Filmed(clip, bool(kept["moves"]), pictures, frames.scale)


def _models(mapped: Pictures, matches: Matches, seed: int, cache: Cache) -> dict[Mapper, Model | None]:
    """What both mappers make of the pictures; lenses are found too where enough pictures move.

    Of the models that a mapper makes of pairs with more and with fewer matches, the one that more matches obey.
    """
    refine = sum(mapped.moving[int(v)] for v in mapped.of) >= MOVING_PICTURES
    models: dict[Mapper, Model | None] = {}
    mappers: tuple[Mapper, ...] = ("incremental", "global")
    for mapper in mappers:
        made = []
        for least in mapped.thresholds.matches:

            def make(mapper: Mapper = mapper, least: int = least) -> dict[str, np.ndarray]:
                model = map_pictures(mapped, mapper, least=least, refine=refine, seed=seed)
                return {} if model is None else model.arrays()

            arrays = cache.arrays("model", ("halves", mapped.key, mapped.thresholds, mapper, least, refine, seed), make)
            if arrays:
                made.append(Model.of(arrays))
        models[mapper] = max(made, key=lambda m: support(m, matches, mapped.of, mapped.lenses).worth, default=None)
    return models


def _placed(
    filmed: Sequence[Filmed], mapped: Pictures, model: Model, options: CalibrateOptions, cache: Cache
) -> tuple[list[FoundCamera], Similar]:
    """The cameras in the world's frame, every frame of those that move; and how that follows from the mapper's."""
    lenses = lenses_found(model, mapped.lenses)
    frames_of = [picture.frame for picture in mapped.pictures]
    cameras = []
    for v, each in enumerate(filmed):
        camera = _camera(each, lenses[v].scaled(1 / each.scale))
        at, pictures = key_pictures(mapped.of, frames_of, model, v)
        if len(at) and not each.moves:
            camera = replace(camera, w2c=model.w2c[pictures[0]])
        elif len(at):

            def follow(v: int = v, each: Filmed = each, at: np.ndarray = at, pictures: np.ndarray = pictures) -> dict:
                frames = pictures_of(each.clip.frames, each.clip.size, options.width)
                return vars(every_pose(frames, lenses[v], at, model, pictures))

            if each.clip.kind == "walk":  # it helps by its key frames alone
                camera = replace(camera, w2c=model.w2c[pictures])
            else:
                key = (each.clip.key, options.width, model.w2c, model.uv, lenses[v].K, lenses[v].distortion)
                kept = cache.arrays("poses", key, follow)
                camera = replace(camera, w2c=kept["w2c"], bridged=1 - float(kept["found"].mean()))
        cameras.append(camera)
    known = [(camera.w2c, each.clip.turned) for camera, each in zip(cameras, filmed, strict=True)]
    poses = [(w2c, turned) for w2c, turned in known if w2c is not None]
    metres = None
    if options.distance is not None:
        a, b, length = options.distance
        ends = [camera.w2c for name in (a, b) for camera in cameras if camera.name == name]
        static = [w2c for w2c in ends if w2c is not None and w2c.ndim == 2]
        if len(static) == 2:
            metres = (centres(static[0]), centres(static[1]), length)
        else:
            raise ValueError(
                f"--distance: expected two static cameras that were found; found {a} and {b} otherwise. Name others, "
                "or leave it out."
            )
    world = upright([w2c for w2c, _ in poses], [turned for _, turned in poses], metres)
    return [c if c.w2c is None else replace(c, w2c=world.camera(c.w2c)) for c in cameras], world


def _camera(each: Filmed, lens: Lens) -> FoundCamera:
    return FoundCamera(each.clip.name, *each.clip.size, lens.K, lens.distortion, lens.source)


def _split(
    cameras: Sequence[FoundCamera], clips: Sequence[Clip], method: str, unit: str, progress: Progress
) -> Calibration:
    """The cameras of the scene, and those that only helped."""
    kinds = {clip.name: clip.kind for clip in clips}
    scene = tuple(camera for camera in cameras if kinds[camera.name] == "scene")
    helpers = tuple(camera for camera in cameras if kinds[camera.name] != "scene")
    return Calibration(scene, method, unit, helpers, seconds=dict(progress.seconds))


def _told_of_square(options: CalibrateOptions, why: str, tell: Tell) -> None:
    """Say that a square's side was given in vain, where it was."""
    if options.square is not None:
        tell(f"note: --square is not used, and lengths are arbitrary: {why}")


def _with_distance(options: CalibrateOptions, clips: Sequence[Clip]) -> CalibrateOptions:
    """The options with a distance between names of videos, which may be told by their files' names."""
    if options.distance is None:
        return options
    names = [clip.name for clip in clips if clip.kind == "scene"]
    a, b = (told if told in names else Path(told).stem for told in options.distance[:2])
    if a not in names or b not in names or a == b:
        raise ValueError(f"--distance: expected two of {', '.join(names)}; found {a} and {b}.")
    return replace(options, distance=(a, b, options.distance[2]))
