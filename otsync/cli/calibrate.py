"""``otsync calibrate`` and ``otsync film``."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ..calibrate.verb import CalibrateOptions
from ..compute.interrupts import uninterrupted
from ..files.strict import nearest
from ..progress import tell

if TYPE_CHECKING:
    from ..calibrate import Calibration

Way = Literal["auto", "background", "motion"]


@dataclass
class Calibrate:
    """Find the cameras of a folder of videos, and write them to its scene.json.

    Example: otsync calibrate holiday/

    Beside the videos may lie walk.mp4, a clip for which one phone was carried past all cameras: where cameras stand far
    apart, nothing else links them. Videos with depth of their own need no background: what moves tells. A camera that
    is not to be trusted is named with the reason and what to film; what was found is written all the same, and the exit
    code is 1.
    """

    folder: tyro.conf.Positional[Path]
    """Video files, folders of images, or a scene.json whose cameras are still missing."""
    out: Path | None = None
    """Folder for calibration.html and the stages, from which a killed run continues; default: FOLDER/calibration."""
    force: bool = False
    """Replace cameras that scene.json has from elsewhere. Those that otsync calibrate found are always found anew."""
    way: Way = "auto"
    """background: by what stands still. motion: by what moves, where scene.json gives every video depth and intrinsics.
    auto: by motion where it does so, and no option below asks for anything of the background."""
    options: Annotated[CalibrateOptions, tyro.conf.arg(name="")] = field(default_factory=CalibrateOptions)

    json: bool = False
    """Print what was found as JSON instead of a table."""

    def run(self) -> int:
        from ..files.claim import claimed

        if not self.folder.is_dir():
            near = self.folder.parent
            there = sorted(p.name for p in near.iterdir() if p.is_dir()) if near.is_dir() else []
            close = nearest(self.folder.name, there)
            meant = f" Did you mean {close!r}?" if close else ""
            found = "a file" if self.folder.exists() else "nothing of that name"
            raise ValueError(f"{self.folder}: expected a folder of videos; found {found}.{meant} Check the path.")
        with claimed(self.out or self.folder / "calibration", "otsync calibrate") as out:
            return self._run(out)

    def _run(self, out: Path) -> int:
        found = calibrate_folder(self.folder, out, self.options, force=self.force, way=self.way)
        if self.json:
            from ..calibrate.document import told_of
            from .tables import print_json

            print_json(told_of(found))
        else:
            print(camera_table(found))
            print(f"wrote {self.folder / 'scene.json'} and {out / 'calibration.html'}")
        return told_doubts(found, self.folder)


def calibrate_folder(
    folder: Path, out: Path, options: CalibrateOptions, *, force: bool = False, way: Way = "auto"
) -> Calibration:
    """Calibrate a folder and write its scene.json; stages and pages go to ``out``."""
    from ..calibrate import calibrate
    from ..calibrate.clips import uncalibrated
    from ..calibrate.document import calibrated_document
    from ..files.arrays import write_json
    from ..files.cache import Cache
    from ..io.scene import read_document
    from ..recordings.by_motion import calibrate_by_motion, has_depth
    from ..report.cameras import write_cameras
    from .tables import refuse_unused

    document, cache = uncalibrated(folder), Cache(out / "stages")
    if has_poses(document) and not force:
        raise ValueError(
            f"{folder / 'scene.json'}: has cameras that otsync calibrate did not find. Use them as they are, or pass "
            "--force to replace them."
        )
    as_it_was, _ = read_document(folder)
    if way == "motion" or (way == "auto" and options == CalibrateOptions() and has_depth(as_it_was)):
        refuse_unused(options, [f.name for f in fields(options)], "--way motion")
        if way == "auto":
            tell("every video has depth: cameras by what moves (--way motion)")
        found, made = calibrate_by_motion(folder, cache=cache, tell=tell)
        _keep_what_is_lost(folder, as_it_was, found)
    else:
        found = calibrate(folder, options, cache=cache, tell=tell)
        before = as_it_was.get("calibration")
        if found.found and found.unit != "metres" and isinstance(before, dict) and before.get("unit") == "metres":
            tell("note: the cameras were in metres; without --distance A B METRES their unit is arbitrary")
        made = calibrated_document(document, found)
    if found.found:
        write_json(folder / "scene.json", made)
    write_cameras(out / "calibration.html", found)
    return found


def _keep_what_is_lost(folder: Path, before: dict[str, Any], found: Calibration) -> None:
    """Where a video without a camera leaves scene.json, what that file said of its depth stays beside it."""
    from ..files.arrays import write_json

    kept = folder / "scene.before.json"
    if found.found and len(found.found) < len(found.cameras) and not kept.exists():
        write_json(kept, before)
        tell(f"scene.json leaves out what was not found; as it was before: {kept}")


def prepared(
    path: Path,
    *,
    allow_outside: bool = False,
    named: Mapping[str, Sequence[str]] | None = None,
    truth: Path | None = None,
) -> int:
    """Make a folder of videos that nobody calibrated ready to be synchronised: init, calibrate, check; 1 for doubts.

    A folder with a scene.json, or whose reader knows the cameras, stays as it is: 0. What is done is printed on stderr.

    Args:
        named: videos that options name. truth: a file that must be read later. Both are looked at before the work.

    ValueError where fewer than two cameras can be found, or an option names what is not there.
    """
    if not path.is_dir():
        return 0
    if (path / "scene.json").exists():
        _told_of_late_clips(path)
        return 0
    from ..calibrate.clips import kind_of
    from ..files.claim import claimed
    from ..io.scene import read_document
    from ..recordings.check import check_scene
    from ..types import Offsets

    document, _ = read_document(path)
    if all((video.get("camera") or {}).get("w2c") is not None for video in document["videos"]):
        return 0
    clockless = [item for item in document.get("missing") or () if "fps" in item]
    if clockless:
        raise ValueError(
            f"{path}: still missing: {'; '.join(clockless)}. Give it first: otsync init {quoted(path)} --fps 30."
        )
    there = [video["name"] for video in document["videos"]]
    for option, names in (named or {}).items():
        if absent := [name for name in names if name not in there]:
            raise ValueError(f"{option}: expected some of {', '.join(there)}; found {absent[0]!r}.")
    if truth is not None:
        Offsets.load(truth)
    if boards := [name for name in there if kind_of(name) == "board"]:
        raise ValueError(
            f"{path}: {', '.join(boards)}: expected to know which board they show. Say so first: otsync calibrate "
            f"{quoted(path)} --board 9x6 (or 5x7:DICT_4X4_50 ...) --square METRES; then give this command again."
        )
    tell(f"{path}: no scene.json and no cameras: looking for them (otsync calibrate {quoted(path)})")
    with claimed(path / "calibration", "otsync calibrate") as out:
        found = calibrate_folder(path, out, CalibrateOptions())
    tell(camera_table(found))
    doubts = told_doubts(found, path)
    if len(found.found) < 2:
        raise ValueError(
            f"{path}: expected cameras of two videos and more; found {len(found.found)}. {found.cameras[0].remedy}"
        )
    for finding in check_scene(path, every_frame=False, allow_outside=allow_outside):
        print(f"{finding.severity}: {finding.video or 'scene'}: {finding.what} {finding.remedy}", file=sys.stderr)
    tell(f"wrote {path / 'scene.json'}; synchronising (otsync sync {quoted(path)})")
    return doubts


def has_poses(document: dict[str, Any]) -> bool:
    """Whether a scene document has the pose of a camera."""
    return any((video.get("camera") or {}).get("w2c") is not None for video in document["videos"])


def camera_table(found: Calibration) -> str:
    """The cameras as text."""
    width = max(5, *(len(c.name) for c in found.cameras))
    unit = {"metres": "m", "arbitrary": "units"}[found.unit]
    lines = [
        f"{'video':{width}}  {'focal':>7} {'lens':>7} {'turn':>8} {'place':>10} {'matches':>7} {'points':>6}  status"
    ]
    for c in found.cameras:
        turn = f"±{c.sigma_degrees:.2f}°" if c.sigma_degrees == c.sigma_degrees else "–"
        place = f"±{c.sigma_position:.3f} {unit}" if c.sigma_position == c.sigma_position else "–"
        status = "ok" if c.ok else "doubtful" if c.w2c is not None else "not found"
        moves = ", moves" if c.w2c is not None and c.w2c.ndim == 3 else ""
        lines.append(
            f"{c.name:{width}}  {c.K[0, 0]:7.1f} {c.lens:>7} {turn:>8} {place:>10} {c.inliers:7d} {c.points:6d}  "
            f"{status}{moves}"
        )
    return "\n".join(lines)


def quoted(path: Path) -> str:
    """A path as a shell takes it."""
    return shlex.quote(str(path))


def _told_of_late_clips(folder: Path) -> None:
    """Say which clips lie beside a calibrated scene.json and had no part in it: a walk that was filmed since."""
    from ..calibrate.document import came_later

    late = came_later(folder)
    if late:
        tell(
            f"{folder}: {', '.join(late)} came after the cameras were found and had no part in it. To find them anew: "
            f"otsync calibrate {quoted(folder)}"
        )


def told_doubts(found: Calibration, folder: Path) -> int:
    """Say which cameras are not to be trusted, why, and what to film, on stderr; 1 where there are any, else 0."""
    remedies = []
    for camera in found.cameras:
        if not camera.ok:
            print(f"{camera.name}: {camera.doubt}", file=sys.stderr)
            remedies.append(camera.remedy)
    for remedy in dict.fromkeys(remedies):
        print(f"what to do: {remedy}", file=sys.stderr)
    if remedies:
        print(f"then: otsync calibrate {quoted(folder)}", file=sys.stderr)
    return 0 if found.ok else 1


@dataclass
class Film:
    """Film a simulated room with phones that nobody calibrated: video files, and the truth beside them.

    Example: otsync film room/ --seed 3

    Then: otsync calibrate room/ and otsync sync room/ --truth room/truth.json
    """

    out: tyro.conf.Positional[Path]
    """Folder for phone0.mp4, phone1.mp4, ..., walk.mp4, truth.json (their offsets) and cameras.json (their cameras)."""
    phones: int = 4
    """How many film at once."""
    gap: float = 80.0
    """Degrees between neighbours."""
    handheld: bool = False
    """Phones sway in hands; off: they stand on tripods."""
    walk: int = 600
    """Frames of the clip that is carried past all phones; 0: none is filmed."""
    board: int = 0
    """Places where a board is held before the phones on their tripods, which film it: board phone0.mp4, ...; 0: none.
    Then: otsync calibrate FOLDER --board 5x7:DICT_4X4_50 --square 0.08"""
    frames: int = 150
    """Of each phone."""
    fps: float = 30.0
    """Frames a second."""
    width: int = 640
    """Pixels."""
    height: int = 360
    """Pixels."""
    max_offset: float = 20.0
    """Largest offset, in frames."""
    contrast: float = 1.0
    """Of what the walls carry, from 0 to 1."""
    seed: int = 0
    """Of the room, what moves, where the phones stand and when they begin: the same seed films the same."""

    def run(self) -> int:
        from ..files.claim import claimed

        if self.board < 0 or (self.board and self.handheld):
            found = "--handheld" if self.board > 0 else str(self.board)
            raise ValueError(
                f"--board: expected 0 places and more, and phones on tripods; found {found}. Leave it out."
            )
        with claimed(self.out, "otsync film"):
            return self._run()

    def _run(self) -> int:
        if any(self.out.glob("*.mp4")):
            raise ValueError(f"{self.out}: expected a folder without videos; it holds some. Choose another.")
        # clips without their truth would be taken for a recording: all is moved to its place once it is complete
        part = self.out / ".film"
        shutil.rmtree(part, ignore_errors=True)  # of one that was killed
        try:
            self._film(part)
            files = sorted(path.name for path in part.iterdir())
            with uninterrupted():
                for name in files:
                    os.replace(part / name, self.out / name)
        finally:
            shutil.rmtree(part, ignore_errors=True)
        print(f"{self.out}: {', '.join(files)}")
        return 0

    def _film(self, folder: Path) -> None:
        from ..io.document import write_document
        from ..simulate.phones import Hand, Tripod, film
        from ..simulate.room import draw_room
        from ..types import Offsets

        truth = film(
            folder,
            self.seed,
            phones=self.phones,
            gap=self.gap,
            held=Hand() if self.handheld else Tripod(),
            walk=self.walk,
            frames=self.frames,
            fps=self.fps,
            size=(self.width, self.height),
            max_offset=self.max_offset,
            room=draw_room(self.seed, contrast=self.contrast),
            board=self.board,
            tell=tell,
        )
        cameras = [(name, camera) for name, camera in zip(truth.names, truth.cameras, strict=True)]
        if truth.walk is not None:
            cameras.append(("walk", truth.walk))
        videos: list[dict[str, Any]] = [
            {
                "name": name,
                "file": f"{name}.mp4",
                "camera": {"K": c.K.tolist(), "w2c": c.w2c.tolist(), "width": c.width, "height": c.height},
            }
            for name, c in cameras
        ]
        write_document(folder / "cameras.json", videos)
        Offsets.known(truth.names, truth.offsets, truth.fps).save(folder / "truth.json")
