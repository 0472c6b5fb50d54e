"""``otsync run``: from a recording to one synchronised 4D scene. What needs torch is imported when it runs."""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from otsync.cli.recordings import RecordingOptions


@dataclass
class Run:
    """Synchronise a recording, then reconstruct it and refine the offsets from its images.

    Example: otsync run recording/ --out result --held-out 0 --budget 300

    A quick look: otsync run recording/ --out look --width 160 --steps 300

    Stopped at any moment, the same command continues. Look at the scene with recon render and recon export.
    """

    scene: tyro.conf.Positional[Path]
    """A scene.json, or a folder that holds one, or a folder in Panoptic layout."""
    out: Path = Path("run")
    """Folder for offsets_coarse.json, offsets.json, scene.npz, metrics.json, report.html and sync.html."""
    held_out: tuple[str, ...] = ()
    """Names of videos that neither synchronisation nor fit sees: the finished scene is held against them."""
    reference: str | None = None
    """Name of the video whose clock is the world's; default: the first."""
    width: int = 320
    """Working pixels of an image's width in the reconstruction."""
    frames: tuple[int, int] | None = None
    """First and last (exclusive) frame of every video to use; default: all."""
    budget: float | None = None
    """Seconds for the fit, after everything is prepared; default: 300."""
    steps: int | None = None
    """Steps of the fit instead of seconds: the result is then the same on any machine of a kind."""
    exposure: float = 0.0
    """Seconds that the shutters were open, where moving things are blurred; 0: sharp. Readouts are in the scene."""
    device: str = "cpu"
    """cpu, or cuda for a GPU with gsplat: where the reconstruction is fitted."""
    seed: int = 0
    truth: Path | None = None
    """True offsets, where they are known: adds errors to tables and reports."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""
    recording: RecordingOptions = field(default_factory=RecordingOptions)

    def run(self) -> int:
        from otsync.cli.tables import table
        from otsync.files.arrays import write_json
        from otsync.files.cache import Cache
        from otsync.io.mend import cut
        from otsync.progress import Progress
        from otsync.recordings.routes import synchronize_scene
        from otsync.report.frames import write_recording_report
        from recon.cli.common import opened, reconstructed, tell
        from recon.cli.options import FitOptions
        from recon.fit.run import Diverged
        from recon.pipeline.intake import readable

        options = FitOptions(
            held_out=self.held_out,
            width=self.width,
            frames=self.frames,
            budget=self.budget,
            steps=self.steps,
            seed=self.seed,
            exposure=self.exposure,
            cache=self.recording.cache,
            workers=self.recording.workers,
            device=self.device,
        )
        options.length(), options.plan()  # before the work, not after it
        scene = opened(self.scene, self.allow_outside or self.recording.allow_outside)
        if self.recording.cameras:
            scene = scene.take(
                [*self.recording.cameras, *(n for n in self.held_out if n not in self.recording.cameras)]
            )
        scene.take(self.held_out)  # names that are not there
        cache, progress = Cache(self.recording.cache or self.out / "stages"), Progress(tell)
        with ThreadPoolExecutor(self.recording.workers or os.cpu_count() or 1) as pool:
            part = scene if self.frames is None else cut(scene, *self.frames)
            with progress.stage("reading"):  # the reconstruction cuts and reads again, from what is kept
                part = readable(part, cache, pool.map, progress)
            train = part.take([n for n in part.names if n not in self.held_out])
            if self.reference is not None and self.reference not in train.names:
                raise ValueError(f"--reference: expected one of {', '.join(train.names)}; found {self.reference!r}.")
            reference = 0 if self.reference is None else train.names.index(self.reference)
            found = synchronize_scene(
                train,
                route=self.recording.route,
                reference=reference,
                cache=cache,
                map=pool.map,
                tell=tell,
            )
        progress.seconds |= {f"synchronise: {stage}": s for stage, s in found.seconds.items()}
        print(table(found.offsets))
        found.offsets.save(self.out / "offsets_coarse.json")
        write_json(self.out / "sync.json", {"route": found.route, "why": list(found.why), "seconds": found.seconds})
        write_recording_report(self.out / "sync.html", train, found)
        for name, flags in zip(found.offsets.names, found.offsets.flags, strict=True):
            for flag in flags:
                print(f"{name}: {flag.code}: {flag}", file=sys.stderr)
        try:
            return reconstructed(scene, found.offsets, self.out, options, truth=self.truth, progress=progress)
        except (Diverged, FloatingPointError) as error:
            print(f"otsync: {error}", file=sys.stderr)
            return 1
