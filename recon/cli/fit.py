"""``recon fit``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from otsync.cli.recordings import PriorOptions
from recon.cli.common import deadline_of, opened, reconstructed, with_length
from recon.pipeline.plan import Plan


@dataclass
class Fit:
    """Reconstruct a recording whose offsets are known, and refine them.

    Example: recon fit recording/ --offsets offsets.json --out result --held-out 0 --budget 300

    A quick look: recon fit recording/ --offsets offsets.json --out look --width 160 --frames 0 30 --steps 300

    The offsets as they are: recon fit recording/ --offsets offsets.json --out fixed --freeze offsets

    Other losses: recon fit recording/ --offsets offsets.json --out deep --losses photometric mask depth:weight=0.05
    """

    scene: tyro.conf.Positional[Path]
    """A scene.json, or a folder that holds one, or a folder in Panoptic layout."""
    offsets: Path
    """offsets.json as otsync sync writes it."""
    out: Path = Path("recon")
    """Folder for scene.npz, offsets.json, metrics.json and report.html; a run that was stopped continues in it."""
    held_out: tuple[str, ...] = ()
    """Names of videos that the fit does not see: the finished scene is compared with them."""
    tracks: tuple[Path, ...] = ()
    """Track sets in space (.npz), one a video, that the motion begins with; default: tracked and lifted here."""
    truth: Path | None = None
    """truth.json of a simulated world: adds errors to table and report."""
    plan: Annotated[Plan, tyro.conf.arg(name="")] = field(default_factory=Plan)
    """How it is reconstructed: without --steps and --budget the fit takes 300 seconds."""
    recording: PriorOptions = field(default_factory=PriorOptions)
    """What finds masks and tracks in the images."""
    view: bool = False
    """Show the fit as it goes on in a browser on this machine (extra view). It ends with the fit."""
    cache: Path | None = None
    """Folder where stages are kept; default: stages in --out."""
    workers: int = 0
    """Threads of the stages before the fit; 0: one per core."""
    json: bool = False
    """Print one JSON document instead of tables."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""

    def run(self) -> int:
        from otsync.files.claim import claimed

        with claimed(self.out, "recon fit"):
            return self._run()

    def _run(self) -> int:
        from otsync.types import Offsets, TrackSet

        named = [f"--recording.{name}" for name in ("points", "flow") if getattr(self.recording, name) is not None]
        if self.tracks and named:
            raise ValueError(
                f"{named[0]}, --tracks: expected one of them, since tracks that are given are not tracked; found both. "
                "Leave one out."
            )
        deadline = deadline_of(self.plan)
        scene = opened(self.scene, self.allow_outside)
        offsets = Offsets.load(self.offsets)
        tracks = tuple(TrackSet.load(path) for path in self.tracks) or None
        watcher = None
        if self.view:
            from recon.view.window import Watcher

            watcher = Watcher({v.name: v.camera for v in scene.videos})
        try:
            return reconstructed(
                scene,
                offsets,
                self.out,
                with_length(self.plan),
                held_out=self.held_out,
                tracks=tracks,
                truth=self.truth,
                priors=self.recording.priors(),
                cache=self.cache,
                workers=self.workers,
                as_json=self.json,
                deadline=deadline,
                watch=watcher,
            )
        finally:
            if watcher is not None:
                watcher.stop()
