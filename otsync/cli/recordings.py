"""Commands on recordings: ``otsync init``, ``otsync check``, and ``otsync sync`` on a scene instead of track sets."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ..compute.threads import pool_of
from ..io import READERS
from ..plugins import available
from ..progress import tell
from .slots import one_of

if TYPE_CHECKING:
    from ..recordings.stages import Stages
    from ..recordings.synchronized import Synchronized
    from ..sync.method import Method
    from ..sync.own_frames import Frames


@dataclass
class Init:
    """Write scene.json for a folder of recordings, naming what is missing.

    Example: otsync init recording/
    """

    folder: tyro.conf.Positional[Path]
    """Video files, one folder of images per camera, a dataset's layout (docs/recording.md lists them), or a layout that
    a plugin reads."""
    out: Path | None = None
    """Where to write; default: scene.json in the folder."""
    reader: one_of("readers", READERS) | None = None
    """Name of the reader; default: the first that claims the folder."""
    fps: float | None = None
    """Frames per second of images, which carry no clock."""
    order: tuple[str, ...] = ()
    """Names of the videos in the order of the calibration's cameras, where their names do not tell."""
    timestamps: Path | None = None
    """A CSV with the time of every frame: a column seconds (or milliseconds, microseconds, nanoseconds), and video
    where there are several."""
    force: bool = False
    """Replace an existing scene.json."""

    def run(self) -> int:
        from ..files.arrays import write_json
        from ..io import describe_folder, find_reader
        from ..io.readers import claiming
        from ..io.timestamps import with_timestamps
        from ..recordings.check import looking_wrong

        if self.fps is not None and not 0 < self.fps < 1e6:
            raise ValueError(f"--fps: expected frames per second above 0; found {self.fps:g}.")
        out = self.out or self.folder / "scene.json"
        if out.exists() and not self.force:
            raise ValueError(f"{out}: exists already. Pass --force to replace it, or --out for another place.")
        if out.parent.resolve() != self.folder.resolve():
            print(f"note: paths in {out} are relative to {self.folder}; keep it there to use it", file=sys.stderr)
        name, _ = find_reader(self.folder, self.reader)
        document = describe_folder(self.folder, reader=name, fps=self.fps, order=self.order or None)
        if any("file" in video and (video.get("camera") or {}).get("K") is None for video in document["videos"]):
            from ..calibrate.clips import fill_lenses
            from ..io.document import missing_fields

            document = fill_lenses(document, self.folder)
            if document.get("missing"):
                document["missing"] = missing_fields(document["videos"])
        if self.timestamps is not None:
            document = with_timestamps(document, self.folder, self.timestamps)
        write_json(out, document)
        print(f"wrote {out}: {len(document['videos'])} videos (reader: {name})")
        others = [other for other in claiming(self.folder) if other != name]
        if self.reader is None and others:
            print(f"note: these could read the folder too: {', '.join(others)} (--reader)")
        for note in document.get("notes", ()):
            print(f"note: {note}")
        for finding in looking_wrong(document):
            print(f"{finding.severity}: {finding.video or 'scene'}: {finding.what} {finding.remedy}", file=sys.stderr)
        for item in document.get("missing", ()):
            print(f"missing: {item}", file=sys.stderr)
        return 1 if document.get("missing") else 0


@dataclass
class Check:
    """Look for what commonly goes wrong in a recording: poses, intrinsics, clocks, files, depth units.

    Example: otsync check recording/
    """

    scene: tyro.conf.Positional[Path]
    """A scene.json, a folder that holds one, or a calibrated folder that a reader knows (Panoptic, COLMAP, ...)."""
    every_frame: bool = True
    """Decode every image; off: the first, the middle and the last."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""

    def run(self) -> int:
        from ..recordings.check import check_scene

        findings = check_scene(self.scene, every_frame=self.every_frame, allow_outside=self.allow_outside)
        for finding in findings:
            print(f"{finding.severity}: {finding.video or 'scene'}: {finding.what} {finding.remedy}")
        errors = sum(f.severity == "error" for f in findings)
        print(f"{errors} errors, {len(findings) - errors} warnings")
        return 1 if errors else 0


def prior(option: str) -> Any:
    """The type of a slot of priors: a name, with fields where it has some; the names there are stand in the help."""
    from ..recordings.stages import PRIORS

    _, group, own = PRIORS[option]
    names = "|".join(available(group, own))
    return Annotated[str | None, tyro.conf.arg(metavar=f"{names}[:FIELD=VALUE,...]")]


@dataclass(frozen=True)
class PriorOptions:
    """What finds masks and tracks in the images."""

    masks: prior("masks") = None
    """What moves, where the scene has no masks."""
    points: prior("points") = None
    """The tracker of points."""
    flow: prior("flow") = None
    """Optical flow that the tracker follows."""
    depth: prior("depth") = None
    """What estimates depth, tied to the poses by points of the background; it goes before depth that came along."""
    width: int | None = None
    """Pixels of width that videos are tracked at; default: 640. More of it sees smaller things, and takes longer."""

    def priors(self) -> dict[str, Any]:
        """Those that were named, as the shell spells them: arguments of ``stages_from``."""
        from ..recordings.stages import PRIORS

        return {n: value for n in (*PRIORS, "width") if (value := getattr(self, n, None)) is not None}


@dataclass(frozen=True)
class RecordingOptions(PriorOptions):
    """How ``otsync sync`` treats a recording."""

    route: Literal["auto", "tracks", "epipolar", "stereo"] = "auto"
    """tracks needs depth, stereo a static rig of five and more, epipolar nothing but calibration; auto decides."""
    cameras: tuple[str, ...] = ()
    """Names of the videos to use; default: all."""
    cache: Path | None = None
    """Folder where stages are kept; default: stages in --out."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""
    features: prior("features") = None
    """What describes a track."""
    selection: Annotated[str | None, tyro.conf.arg(metavar="FIELD=VALUE,...")] = None
    """Which tracks are kept: count, min_life (frames at 30 fps), extent and apart (pixels at 640 of width), enough
    (tracks, below which the limits are lowered)."""
    workers: int = 0
    """Threads, and processes that many pairs are spread over; 0: one per core."""

    def stages(self) -> Stages:
        """The objects of every stage. ValueError names a prior that there is not."""
        from ..recordings.stages import stages_from

        return stages_from(**self.priors(), selection=self.selection)

    def threads(self) -> int:
        """How many threads. ValueError for fewer than none."""
        if self.workers < 0:
            raise ValueError(f"--recording.workers: expected 0 (one per core) or more; found {self.workers}.")
        return self.workers or os.cpu_count() or 1


def sync_recording(
    path: Path,
    out: Path,
    options: RecordingOptions,
    *,
    frames: Frames = "common",
    method: Method | None = None,
    reference: str | None = None,
    truth: Path | None = None,
    as_json: bool = False,
) -> int:
    """``otsync sync SCENE``: offsets.json, sync.json and report.html in ``out``.

    With frames "own" also scene.json, with the cameras that were found. Exit code 1 when an answer is flagged.
    """
    from ..files.arrays import write_json
    from ..files.cache import Cache
    from ..io import open_scene
    from ..recordings.own_frames import found_document, open_without_poses, synchronize_own_scene
    from ..recordings.routes import synchronize_scene
    from ..report.frames import write_recording_report
    from .tables import flagged, print_json, refuse_unused, table, true_offsets, with_errors

    own = frames == "own"
    if own:
        refuse_unused(options, ("route",), "a recording with --frames own, which has one route,")
        refuse_unused(options, ("depth",), "a recording with --frames own, without poses to tie it to,")
    stages, threads = options.stages(), options.threads()  # before the work, not after it
    if options.depth is not None and options.route in ("epipolar", "stereo"):
        raise ValueError(
            f"--recording.depth: expected a route that reads it (auto, tracks); found --recording.route "
            f"{options.route}. Leave one of both out."
        )
    solve: Callable[..., Synchronized]
    if own:
        scene, document = open_without_poses(path, allow_outside=options.allow_outside)
        solve = synchronize_own_scene
    else:
        scene = open_scene(path, allow_outside=options.allow_outside)
        solve = partial(synchronize_scene, route=options.route)
    if own and (out / "scene.json").exists() and out.resolve() == scene.root.resolve():
        raise ValueError(
            f"--out: expected another folder than the recording's, whose scene.json it would replace: {out}."
        )
    lost = {name: why for name, why in scene.doubtful.items() if name not in scene.names}
    if options.cameras:
        scene = scene.take(options.cameras)
    chosen = reference_among(scene.names, reference)
    known = None if truth is None else true_offsets(truth, scene.names)
    for note in scene.notes:
        tell(f"note: {note}")
    with pool_of(threads) as pool:
        found = solve(
            scene,
            method=method,
            stages=stages,
            reference=chosen,
            cache=Cache(options.cache or out / "stages"),
            map=pool.map,
            processes=threads,
            tell=tell,
        )
    if known is not None:
        known = known - known[found.offsets.component]
    wrote = [out / "offsets.json", out / "sync.json", out / "report.html"]
    found.offsets.save(wrote[0])
    write_json(wrote[1], {"route": found.route, "why": list(found.why), "seconds": found.seconds})
    write_recording_report(wrote[2], scene, found, truth=None if known is None else list(known))
    if own:
        wrote.append(out / "scene.json")
        write_json(wrote[-1], found_document(document, found.offsets))
    if as_json:
        more = {"left_out": lost} if lost else {}
        print_json({"route": found.route, "why": list(found.why), **with_errors(found.offsets, known), **more})
    else:
        print(table(found.offsets, known))
        for name, why in lost.items():
            print(f"{name} is left out, it has no camera: {why}")
        print(f"route {found.route}; wrote {', '.join(map(str, wrote[:-1]))} and {wrote[-1]}")
        if own:
            print(f"scene.json has the cameras that were found; its paths are relative to {scene.root}: copy it there")
    return flagged(found.offsets)


def reference_among(names: Sequence[str], wanted: str | None) -> int | Literal["auto"]:
    """The index of the video that ``--reference`` names; the first one by default. ValueError for one there is not."""
    if wanted is None:
        return 0
    if wanted == "auto":
        return "auto"
    if wanted not in names:
        raise ValueError(f"--reference: expected auto or one of {', '.join(names)}; found {wanted!r}.")
    return list(names).index(wanted)
