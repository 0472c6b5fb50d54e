"""``otsync sync``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..clocks.common import LONG, narrowed
from ..compute.memory import give_back_large_arrays
from ..files.claim import claimed
from ..io.footage import VIDEO_SUFFIXES
from ..sync.graph import Graph
from ..sync.own_frames import COMPLETE, Frames
from ..sync.verb import unique_names
from ..types import TrackSet
from .method import MethodOptions
from .recordings import RecordingOptions, reference_among, sync_recording
from .tables import naming_files, refuse_unused, report, true_offsets, with_progress


@dataclass
class Sync:
    """Synchronise a recording (scene.json or its folder), or videos from their track sets.

    Example: otsync sync world/*.npz --out result

    A recording: otsync sync recording/ --out result

    The paper's method: otsync sync recording/ --method paper

    Videos that nobody calibrated: otsync sync holiday/ finds their cameras first (otsync calibrate)

    Videos without a common frame of reference: otsync sync world/*.npz --frames own

    An ablation: otsync sync recording/ matcher:optimal-transport aligner:dtw refiner:unrefined
    """

    tracks: tyro.conf.Positional[tuple[Path, ...]]
    """A scene.json, a folder with one (also in Panoptic layout), or a folder of videos; or track sets (.npz
    written by otsync), one per video, in one world frame."""
    out: Path = Path("sync")
    """Folder for offsets.json and report.html, and the stages of a recording, from which a killed run continues."""
    reference: str | None = None
    """Name of the reference video, or "auto" for the one with the surest pairs; default: the first."""
    truth: Path | None = None
    """truth.json of a simulated world: adds errors to the table."""
    frames: Frames = "common"
    """own: every video has a frame of reference and a unit of its own; rotation, translation and scale are found beside
    the offsets. For track sets, and for recordings with depth whose cameras have no pose."""
    workers: int = 1
    """Processes that pairs are spread over; results do not depend on it."""
    slots: Annotated[MethodOptions, tyro.conf.arg(name="")] = field(default_factory=MethodOptions)
    recording: RecordingOptions = field(default_factory=RecordingOptions)

    json: bool = False
    """Print the content of offsets.json instead of the table."""

    def run(self) -> int:
        with claimed(self.out, "otsync sync"):
            return self._run()

    def _run(self) -> int:
        method = self.slots.chosen(Graph(complete=COMPLETE) if self.frames == "own" else None)
        if len(self.tracks) == 1 and self.tracks[0].suffix != ".npz":
            refuse_unused(self, ("workers",), f"a recording ({self.tracks[0]}), which has --recording.workers,")
            doubts = 0
            if self.frames == "common":
                from .calibrate import prepared

                self.recording.stages(), self.recording.threads()  # options first: finding cameras takes minutes
                given = [] if self.reference in (None, "auto") else [self.reference]
                doubts = prepared(
                    self.tracks[0],
                    allow_outside=self.recording.allow_outside,
                    named={"--reference": given, "--recording.cameras": self.recording.cameras},
                    truth=self.truth,
                )
            code = sync_recording(
                self.tracks[0],
                self.out,
                self.recording,
                frames=self.frames,
                method=method,
                reference=self.reference,
                truth=self.truth,
                as_json=self.json,
            )
            return max(code, doubts)
        refuse_unused(self, ("recording",), "synchronising track sets")
        if len(self.tracks) < 2:
            raise ValueError(f"tracks: expected at least two .npz files; found {len(self.tracks)}.")
        words = [str(path) for path in self.tracks if str(path).startswith(("matcher:", "aligner:", "refiner:"))]
        if words:
            raise ValueError(
                f"{words[0]}: expected an algorithm that there is, after the options; otsync sync --help lists them."
            )
        videos = [path for path in self.tracks if path.suffix.lower() in VIDEO_SUFFIXES]
        if videos:
            raise ValueError(
                f"{videos[0]}: expected one folder that holds all videos, or two and more .npz of tracks; found a "
                "video file. Put the videos into a folder, and run otsync sync FOLDER."
            )
        tracks = [narrowed(TrackSet.load(path)) for path in self.tracks]
        if max(t.n_frames for t in tracks) >= LONG:
            give_back_large_arrays()
        names = unique_names(tracks)
        reference = reference_among(names, self.reference)
        known = None if self.truth is None else true_offsets(self.truth, names)
        with naming_files(self.tracks):
            offsets = with_progress(
                tracks,
                "synchronising",
                self.workers,
                reference=reference,
                method=method,
                frames=self.frames,
            )
        truth = None if known is None else known - known[offsets.component]
        return report(offsets, tracks, truth, self.out, "Synchronisation report", as_json=self.json)
