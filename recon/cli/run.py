"""``otsync run``: from a recording to one synchronised 4D scene."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from otsync.cli.method import MethodOptions
from otsync.cli.recordings import RecordingOptions
from otsync.compute.threads import pool_of
from recon.pipeline.plan import Plan

if TYPE_CHECKING:
    from otsync.files.cache import Cache
    from otsync.io.scene import Scene
    from otsync.progress import Deadline, Progress
    from otsync.recordings.stages import Stages
    from otsync.recordings.synchronized import Synchronized
    from otsync.sync.method import Method

WORTH_TELLING = 1.0
"""Seconds of a budget from which on it is said where they went."""

FINE_ENOUGH = 0.25
"""Frames of sigma of the pixels' offsets, below which stereo is left out, since the fit goes on from them as well. It
takes a fifth of a run. Of the Panoptic basketball scene (.16) its answer was no surer than the pixels'; of simulated
limbs (.37; `recon simulate --cameras 14`, seed 7105), over which tracks slide, it was half as far off."""

LONG = 1000
"""Steps of a fit from which on little of its start's error is left."""


def fine_enough(plan: Plan) -> float | None:
    """Frames of sigma below which a run needs no stereo; None where it does: clocks are not fitted, or not for long, or
    dense tracks want its depth.
    """
    steps = plan.fit.steps
    refines = "offsets" in plan.fit.active_rates() and (steps is None or steps >= LONG)
    return FINE_ENOUGH if refines and plan.features is None else None


@dataclass
class Run:
    """Synchronise a recording, then reconstruct it and refine the offsets from its images.

    Example: otsync run recording/ --out result --held-out 0 --budget 300

    A quick look: otsync run recording/ --out look --width 160 --steps 300

    The paper's method, refined from the images: otsync run recording/ --method paper

    Its first stage, too, dense feature tracks of every video: otsync run recording/ --method paper --features dinov3

    Stopped at any moment, the same command continues. Look at the scene with recon render and recon export.
    """

    scene: tyro.conf.Positional[Path]
    """A scene.json, a folder that holds one (also in Panoptic layout), or a folder of videos, whose cameras are then
    found first (otsync calibrate)."""
    out: Path = Path("run")
    """Folder for offsets_coarse.json, offsets.json, scene.npz, metrics.json, report.html and sync.html."""
    held_out: tuple[str, ...] = ()
    """Names of videos that neither synchronisation nor fit sees: the finished scene is held against them."""
    reference: str | None = None
    """Name of the video whose clock is the world's; default: the first."""
    plan: Annotated[Plan, tyro.conf.arg(name="")] = field(default_factory=Plan)
    """How it is reconstructed: without --steps and --budget the fit takes 300 seconds."""
    truth: Path | None = None
    """True offsets, where they are known: adds errors to tables and reports."""
    json: bool = False
    """Print one JSON document instead of tables."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""
    slots: Annotated[MethodOptions, tyro.conf.arg(name="")] = field(default_factory=MethodOptions)
    recording: RecordingOptions = field(default_factory=RecordingOptions)

    def run(self) -> int:
        from otsync.files.claim import claimed

        with claimed(self.out, "otsync run"):
            return self._run()

    def _run(self) -> int:
        from otsync.cli.calibrate import prepared
        from otsync.files.cache import Cache
        from otsync.progress import Progress, tell
        from recon.cli.common import deadline_of

        work = Work(
            stages=self.recording.stages(),  # before the work, not after it
            threads=self.recording.threads(),
            method=self.slots.chosen(),
            deadline=deadline_of(self.plan),
            cache=Cache(self.recording.cache or self.out / "stages"),
            progress=Progress(tell),
        )
        doubts = prepared(
            self.scene,
            allow_outside=self.allow_outside or self.recording.allow_outside,
            named={
                "--held-out": self.held_out,
                "--reference": [] if self.reference is None else [self.reference],
                "--recording.cameras": self.recording.cameras,
            },
            truth=self.truth,
        )
        work.tell_what_is_spent()
        scene = self._chosen()
        train, coarse = self._synchronised(scene, work)
        self._told(train, coarse)
        if not self._linked(coarse):
            return 1
        return self._reconstructed(scene, coarse, work, doubts)

    def _chosen(self) -> Scene:
        """The scene's videos that are asked for; ValueError for options that do not fit it, before any work."""
        from otsync.cli.tables import true_offsets
        from recon.cli.common import opened
        from recon.pipeline.verb import check_effects_of

        scene = opened(self.scene, self.allow_outside or self.recording.allow_outside)
        if self.recording.cameras:
            scene = scene.take(
                [*self.recording.cameras, *(n for n in self.held_out if n not in self.recording.cameras)]
            )
        scene.take(self.held_out)  # names that are not there
        names = [n for n in scene.names if n not in self.held_out]
        if len(names) < 2:
            raise ValueError(
                f"--held-out: expected at least two videos; found {len(names)} that are not held out. Hold out fewer."
            )
        if self.reference is not None and self.reference not in names:
            raise ValueError(f"--reference: expected one of {', '.join(names)}; found {self.reference!r}.")
        if self.truth is not None:
            true_offsets(self.truth, tuple(names))  # names the videos that it lacks
        check_effects_of(self.plan, [v.camera.readout for v in scene.videos if v.name in names])
        return scene

    def _synchronised(self, scene: Scene, work: Work) -> tuple[Scene, Synchronized]:
        """The videos that are not held out, and their clocks from motion alone."""
        from otsync.io.mend import cut
        from otsync.priors.stereo import EmptyHull
        from otsync.progress import tell
        from otsync.recordings.routes import synchronize_scene
        from otsync.recordings.stages import with_method
        from recon.pipeline.dense_tracks import NoDenseTracks, synchronized_by_features
        from recon.pipeline.feature_maps import maps_from
        from recon.pipeline.intake import readable
        from recon.pipeline.stages import NoDepth

        stages, method, progress = work.stages, work.method, work.progress
        with pool_of(work.threads) as pool:
            part = scene if self.plan.frames is None else cut(scene, *self.plan.frames)
            with progress.stage("reading"):  # the reconstruction cuts and reads again, from what is kept
                part = readable(part, work.cache, pool.map, progress)
            train = part.take([n for n in part.names if n not in self.held_out])
            reference = 0 if self.reference is None else train.names.index(self.reference)
            coarse = synchronize_scene(
                train,
                route=self.recording.route,
                method=method,
                stages=stages,
                reference=reference,
                cache=work.cache,
                map=pool.map,
                processes=work.threads,
                tell=tell,
                deadline=work.deadline,
                fine_enough=fine_enough(self.plan),
            )
            progress.seconds |= {f"synchronise: {stage}": s for stage, s in coarse.seconds.items()}
            if self.plan.features is None:
                return train, coarse
            try:
                dense = synchronized_by_features(
                    train,
                    coarse,
                    maps_from(self.plan.features),
                    width=self.plan.width,
                    reference=reference,
                    stages=stages if method is None else with_method(stages, "tracks", method),
                    cache=work.cache,
                    map=pool.map,
                    progress=progress,
                )
            except (NoDepth, NoDenseTracks, EmptyHull) as error:
                if method is not None and method.slots():
                    raise
                progress.note(f"no dense tracks: {error} The answer of sparse ones stands")
                return train, coarse
        return train, dense

    def _told(self, train: Scene, coarse: Synchronized) -> None:
        """The clocks from motion alone are printed and kept: whatever comes, they stand."""
        from otsync.cli.tables import table
        from otsync.files.arrays import write_json
        from otsync.report.frames import write_recording_report

        if not self.json:
            print(table(coarse.offsets))
        coarse.offsets.save(self.out / "offsets_coarse.json")
        write_json(self.out / "sync.json", {"route": coarse.route, "why": list(coarse.why), "seconds": coarse.seconds})
        write_recording_report(self.out / "sync.html", train, coarse)
        for name, flags in zip(coarse.offsets.names, coarse.offsets.flags, strict=True):
            for flag in flags:
                print(f"{name}: {flag.code}: {flag}", file=sys.stderr)

    def _linked(self, coarse: Synchronized) -> bool:
        """Whether two videos share a clock; where not, a line says so."""
        from recon.pipeline.intake import given_clocks

        linked = given_clocks(coarse.offsets)
        if len(linked) < 2:
            print(
                f"otsync: expected two videos and more on one clock; found {len(linked)} of {len(coarse.offsets)}, so "
                f"nothing is reconstructed. Look at {self.out / 'sync.html'}; otsync check may find the cause.",
                file=sys.stderr,
            )
        return len(linked) >= 2

    def _reconstructed(self, scene: Scene, coarse: Synchronized, work: Work, doubts: int) -> int:
        """The exit code: ``doubts``, or 1 where the reconstruction has some of its own or fails."""
        from otsync.priors.stereo import EmptyHull
        from recon.cli.common import reconstructed, with_length
        from recon.fit.run import Diverged

        try:
            code = reconstructed(
                scene,
                coarse.offsets,
                self.out,
                with_length(self.plan),
                held_out=self.held_out,
                truth=self.truth,
                priors=self.recording.priors(),
                cache=self.recording.cache,
                workers=self.recording.workers,
                as_json=self.json,
                progress=work.progress,
                deadline=work.deadline,
            )
            return max(code, doubts)
        except EmptyHull as error:
            print(
                f"otsync: nothing is reconstructed: {error} The offsets stand: {self.out / 'offsets_coarse.json'}.",
                file=sys.stderr,
            )
        except (Diverged, FloatingPointError) as error:
            print(f"otsync: {error}", file=sys.stderr)
        return 1


@dataclass(frozen=True)
class Work:
    """What the stages of one run share."""

    stages: Stages
    threads: int
    method: Method | None
    deadline: Deadline | None
    cache: Cache
    progress: Progress

    def tell_what_is_spent(self) -> None:
        """Of the budget, by what came before the stages: cameras that were not given."""
        from otsync.progress import tell

        if self.deadline is None:
            return
        total, left = self.deadline.seconds, self.deadline.left
        if total - left > WORTH_TELLING:
            spent = f"finding cameras took {total - left:.0f} s of the budget"
            tell(f"{spent} of {total:g} s; {left:.0f} s are left for all else")
