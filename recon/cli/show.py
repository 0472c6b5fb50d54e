"""``recon render``, ``recon eval`` and ``recon export``."""

from __future__ import annotations

import os
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from otsync.cli.slots import one_of
from otsync.compute.threads import pool_of
from otsync.files.claim import claimed, refuse_parts_of_a_result
from otsync.plugins import available, made
from otsync.progress import counted, tell
from recon.cli.common import opened, print_json
from recon.cli.tables import view_table
from recon.result import EXPORTERS

CAMERA = "{camera}"
"""In a path: the name of a camera."""


@dataclass
class Render:
    """Render a finished reconstruction: a camera that filmed it, or one that circles around it.

    Example: recon render result --camera 0 --out camera0.mp4

    Around the scene: recon render result --path orbit --frames 120 --out orbit.mp4

    A frozen moment from all sides: recon render result --path orbit --times 1.25 --frames 90 --out frozen.mp4

    Single images: recon render result --camera 5 --times 0.5 0.52 --out images

    What all cameras would have filmed at the same moments: recon render result --every-camera --out synced/{camera}.mp4
    """

    result: tyro.conf.Positional[Path]
    """Folder that recon fit or otsync run wrote."""
    camera: str | None = None
    """Name of a video: from its place, with its colours."""
    every_camera: bool = False
    """From the places of all videos, one after the other, all at the same moments of the world's clock, between the
    frames of their files: {camera} in --out stands for the name of each."""
    path: Literal["orbit"] | None = None
    """A camera that moves: around the scene, or to and fro where the scene was filmed from one side."""
    times: tuple[float, ...] = ()
    """World seconds; default: the whole span at --fps."""
    frames: int | None = None
    """Frames of a path: time runs through the span, or stands still at the one moment of --times."""
    turns: float | None = None
    """How often the path goes around; default: once."""
    fps: float | None = None
    """Frames per second of the world's clock, and of a video; default: the reference's."""
    width: int | None = None
    """Pixels; default: the working size of the fit."""
    out: Path = Path("render.mp4")
    """A video (.mp4, .mov, .mkv), or a folder for PNG frames."""

    def run(self) -> int:
        from otsync.export.slot import file_names
        from recon.result.export import MAX_FRAMES, check_times, frame_times
        from recon.result.folder import load_result
        from recon.result.images import rendered, stretched
        from recon.result.video import check_target, refuse_longer, write_images

        if (self.camera is not None) + (self.path is not None) + self.every_camera != 1:
            raise ValueError(
                "--camera, --every-camera, --path: expected one of them: a video's name, all, or an orbit."
            )
        if self.every_camera != (CAMERA in str(self.out)):
            raise ValueError(f"--out: expected {CAMERA} in it with --every-camera, and only then; found {self.out}.")
        if self.frames is not None and (self.path is None or len(self.times) > 1):
            raise ValueError("--frames: expected with --path, and with at most one moment in --times.")
        if self.frames is not None and not 1 <= self.frames <= MAX_FRAMES:
            raise ValueError(f"--frames: expected 1 to {MAX_FRAMES}; found {self.frames}.")
        if self.turns is not None and self.path is None:
            found = "--camera" if self.camera is not None else "--every-camera"
            raise ValueError(f"--turns: expected with --path; found {found}.")
        if self.fps is not None and not self.out.suffix and (self.times or self.frames is not None):
            raise ValueError(
                "--fps: expected with a video in --out, or to choose the times of images; found a folder of images "
                f"whose times {'--times' if self.times else '--frames'} chooses."
            )
        if self.fps is not None and not 0 < self.fps <= 1000:
            raise ValueError(f"--fps: expected frames per second above 0, at most 1000; found {self.fps:g}.")
        check_target(self.out)
        result = load_result(self.result)
        fps = 1.0 / result.scene.frame_step if self.fps is None else self.fps
        times = list(self.times) or frame_times(result.scene, fps).tolist()
        if self.frames is not None:
            times = times * self.frames if len(self.times) == 1 else stretched(result.scene.span, self.frames)
        check_times(result.scene, times)
        turns = 1.0 if self.turns is None else self.turns
        cameras = [v.name for v in result.videos] if self.every_camera else [self.camera]
        files = file_names([c or "" for c in cameras], "") if self.every_camera else [""]
        targets = [Path(str(self.out).replace(CAMERA, name)) for name in files]
        for out in targets:
            refuse_parts_of_a_result(out)
            refuse_longer(out, len(times))
        for camera, out in zip(cameras, targets, strict=True):
            images = rendered(result, times, camera, turns=turns, width=self.width)
            with nullcontext() if out.suffix else claimed(out, "recon render", keep=False):
                count = write_images(counted(images, "rendering", "image", len(times)), out, fps)
            print(f"wrote {count} images to {out}")
        return 0


@dataclass
class Eval:
    """Compare a finished reconstruction with cameras that it has not seen.

    Example: recon eval result recording/ --held-out 0

    With LPIPS, from weights that you have: recon eval result recording/ --lpips-weights alexnet.pth
    """

    result: tyro.conf.Positional[Path]
    """Folder that recon fit or otsync run wrote."""
    scene: tyro.conf.Positional[Path]
    """The recording it was made from."""
    held_out: tuple[str, ...] = ()
    """Names of videos to compare with; default: those that were held out. Trained ones are allowed, and marked."""
    offsets: Path | None = None
    """offsets.json with the clocks of these videos; default: the fit's own, or found on the frozen scene."""
    truth: Path | None = None
    """True offsets: adds the offset errors of the reconstruction."""
    views: int = 50
    """Frames of every camera that are compared."""
    lpips_weights: Path | None = None
    """torchvision's weights of AlexNet; without them LPIPS is left out."""
    out: Path | None = None
    """Where to write the figures; default: eval.json in the result."""
    json: bool = False
    """Print the figures as one JSON document instead of a table."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""

    def run(self) -> int:
        from otsync.files.arrays import write_json
        from otsync.files.cache import Cache
        from otsync.progress import Progress
        from otsync.types import Offsets
        from recon.evaluate.figures import WINDOW, coherence_of
        from recon.pipeline.verb import evaluate, offset_figures, true_seconds
        from recon.result.folder import load_result, metrics_of

        if self.views < 1:
            raise ValueError(f"--views: expected at least 1; found {self.views}.")
        result = load_result(self.result)
        scene = opened(self.scene, self.allow_outside)
        given = None if self.offsets is None else Offsets.load(self.offsets)
        out = self.out or self.result / "eval.json"
        refuse_parts_of_a_result(out)
        if self.truth is not None:
            Offsets.load(self.truth)  # before the work, not after it
        names = self.held_out or tuple(v.name for v in result.videos if v.held_out)
        if not names:
            raise ValueError("--held-out: expected names of videos; none was held out of this fit.")
        with pool_of(os.cpu_count() or 1) as pool:
            views, reason = evaluate(
                result,
                scene,
                names,
                given,
                most=self.views,
                lpips_weights=self.lpips_weights,
                cache=Cache(self.result / "stages"),
                map=pool.map,
                progress=Progress(tell),
            )
        document, lines = metrics_of(views, {}, reason), [view_table(views, reason)]
        changed = coherence_of(result.scene)
        document["motion"] = {"neighbour_change_pixels": changed, "window_seconds": WINDOW}
        if changed is not None:
            lines.append(f"motion: within {WINDOW:g} s distances of neighbours change by {changed:.2f} working pixels")
        if self.truth is not None:
            error = offset_figures(result.offsets, true_seconds(Offsets.load(self.truth), result.offsets))
            if error["mean_frames"] is None:
                lines.append("offset error: none, for there is one video only")
            else:
                lines.append(
                    f"offset error: mean {error['mean_frames']:.3f}, max {error['max_frames']:.3f} frames; without "
                    f"what all videos have in common: mean {error['mean_apart_frames']:.3f}"
                )
            document["offset_error"] = error
        write_json(out, document)
        if self.json:
            print_json(document)
            tell(f"wrote {out}")
        else:
            print("\n".join([*lines, f"wrote {out}"]))
        return 0


@dataclass
class Export:
    """Write a finished reconstruction for other tools.

    Example: recon export result --format ply --at 1.25 --out moment.ply

    Every frame: recon export result --format ply-sequence --out sequence

    Dense trajectories: recon export result --format tracks --out tracks.npz

    To fly round the scene in a browser: recon export result --format page --out scene.html
    """

    result: tyro.conf.Positional[Path]
    """Folder that recon fit or otsync run wrote."""
    format: one_of("exporters", EXPORTERS) = "ply"
    """ply, supersplat (upright there) and splat hold a moment, ply-sequence every frame, checkpoint the whole scene,
    tracks an otsync track set, tapvid3d the same as TAPVid-3D, dynamic3dgs params.npz of Dynamic3DGaussians, 4dgs
    the span as .4dgs (extra 4dgs), page an HTML file that plays the scene in a browser."""
    at: float | None = None
    """World second of the moment; default: the middle."""
    fps: float | None = None
    """Frames per second of a sequence or of tracks; default: the reference's."""
    out: Path | None = None
    """File or folder; default: named by the format, in the result."""

    def run(self) -> int:
        from recon.result.export import export_result, frame_times
        from recon.result.folder import load_result

        exporter = made(self.format, available("exporters", EXPORTERS), "--format")
        if self.at is not None and exporter.holds != "moment":
            raise ValueError(
                f"--at: expected with a format that holds one moment; found {self.format}, which does not."
            )
        if self.fps is not None and exporter.holds != "frames":
            raise ValueError(f"--fps: expected with a format that holds frames; found {self.format}, which does not.")
        result = load_result(self.result)
        low, high = result.scene.span
        times: list[float] = []
        if exporter.holds == "moment":
            times = [0.5 * (low + high) if self.at is None else self.at]
        elif exporter.holds == "frames":
            times = frame_times(result.scene, self.fps).tolist()
        out = self.out or self.result / exporter.file
        refuse_parts_of_a_result(out)
        with claimed(out, "recon export", keep=False) if exporter.name == "ply-sequence" else nullcontext():
            export_result(result, exporter, out, times)
        print(f"wrote {out}")
        return 0
