"""The command line: ``otsync demo | simulate | match | init | check | sync | run | bench``, over the same dataclasses as the library.

Exit codes: 0 done; 1 an answer was refused (its status is printed); 2 bad arguments or files; 130 interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from .align import DTW, ConstantShift, LikelihoodScan
from .anchored import AnchoredFGW
from .command_line import run_command
from .commands_recordings import Check, Init, RecordingOptions, sync_recording
from .commands_run import Run
from .graph import Graph
from .match import (
    EntropicFGW,
    FusedGromovWasserstein,
    GromovWasserstein,
    NearestNeighbor,
    OptimalTransport,
    PartialFGW,
    match,
)
from .progress import counted
from .refine import SplineRefine, Unrefined
from .sync import synchronize, unique_names
from .types import Offsets, Refused, Status, TrackSet

if TYPE_CHECKING:
    import numpy as np

Motion = Literal["boxes", "juggle", "softball", "tennis", "basketball", "football", "static"]
Preset = Literal["clean", "mid", "hard", "brutal"]
Matcher = (
    AnchoredFGW
    | FusedGromovWasserstein
    | PartialFGW
    | EntropicFGW
    | GromovWasserstein
    | OptimalTransport
    | NearestNeighbor
    | None
)
Aligner = LikelihoodScan | DTW | ConstantShift
Refiner = SplineRefine | Unrefined


@dataclass
class Demo:
    """Simulate a small unsynchronised world, match, synchronise, and show what came out.

    Example: otsync demo --motion tennis --videos 4 --out demo
    """

    out: Path = Path("demo")
    """Folder for offsets.json and report.html."""
    motion: Motion = "softball"
    preset: Preset = "mid"
    videos: int = 4
    seed: int = 1

    def run(self) -> int:
        from .simulate import simulate

        self.out.mkdir(parents=True, exist_ok=True)
        tracks, truth = simulate(self.motion, preset=self.preset, videos=self.videos, seed=self.seed)
        print(
            f"{self.videos} videos of a simulated scene ({self.motion}, {self.preset}), filmed without a common clock."
        )
        offsets = with_progress(tracks, "matching and synchronising")
        return report(offsets, tracks, truth.offsets, self.out, f"{self.motion}, {self.preset}: {self.videos} videos")


@dataclass
class Simulate:
    """Write the tracks of several unsynchronised videos of one simulated scene, and the truth.

    Example: otsync simulate world --motion juggle --preset mid --videos 6 --seed 3
    """

    out: tyro.conf.Positional[Path]
    """Folder for one .npz per video and truth.json (in the format of offsets.json)."""
    motion: str = "softball"
    """boxes, juggle, softball, tennis, basketball, football, static, or mocap:FILE (BVH, or AMC beside its ASF)."""
    preset: Preset = "mid"
    videos: int = 4
    frames: int = 150
    fps: float = 30.0
    max_offset: float = 30.0
    """Largest offset, in frames."""
    seed: int = 0

    def run(self) -> int:
        import numpy as np

        from .simulate import simulate

        tracks, truth = simulate(
            self.motion, preset=self.preset, videos=self.videos, frames=self.frames, fps=self.fps,
            max_offset=self.max_offset, seed=self.seed,
        )  # fmt: skip
        stale = sorted({p.name for p in self.out.glob("*.npz")} - {f"{t.name}.npz" for t in tracks})
        if stale:
            raise ValueError(
                f"{self.out}: expected a folder without track sets of another world; it holds {stale[0]}. Choose another."
            )
        for t in tracks:
            t.save(self.out / f"{t.name}.npz")
        known = np.zeros(len(tracks))
        Offsets(
            names=unique_names(tracks), fps=np.array([t.fps for t in tracks], float), seconds=truth.offsets,
            rates=truth.rates, sigma=known, reference=0, component=known.astype(int),
            status=(Status.OK,) * len(tracks), flags=((),) * len(tracks),
        ).save(self.out / "truth.json")  # fmt: skip
        print(f"{self.out}: {', '.join(t.name + '.npz' for t in tracks)}, truth.json")
        return 0


@dataclass
class Match:
    """Match the tracks of two videos.

    Example: otsync match a.npz b.npz --out matches.csv matcher:partial-fgw --matcher.mass 0.65
    """

    a: tyro.conf.Positional[Path]
    b: tyro.conf.Positional[Path]
    out: Path | None = None
    """CSV file for the pairs (index in a, index in b, score)."""
    budget: float | None = None
    """Seconds: takes the most accurate matcher that is predicted to fit."""
    matcher: Matcher = None
    """Default: by size, fused Gromov-Wasserstein below 200 tracks and its anchored form above."""

    def run(self) -> int:
        a, b = TrackSet.load(self.a), TrackSet.load(self.b)
        if sys.stderr.isatty():  # one solve has no steps to count
            print(f"matching {len(a)} x {len(b)} tracks ...", file=sys.stderr)
        found = match(a, b, self.matcher, budget=self.budget, throw=False)
        print(f"{len(found)} matches between {len(a)} and {len(b)} tracks")
        print("  ".join(f"{name} {value:.6g}" for name, value in found.stats.items()))
        if self.out is not None:
            from .files import atomic_write

            assert found.score is not None
            with atomic_write(self.out, "w") as stream:
                stream.write("a,b,score\n")
                stream.writelines(f"{i},{j},{s:.9g}\n" for (i, j), s in zip(found.pairs, found.score, strict=True))
            print(f"wrote {self.out}")
        return refusal("match", found.status, found.flags)


@dataclass
class Sync:
    """Synchronise a recording (scene.json or its folder), or videos from their track sets.

    Example: otsync sync world/*.npz --out result

    A recording: otsync sync recording/ --out result

    The paper's method: otsync sync world/*.npz --rematch 0 --graph.extra 0 matcher:fused-gromov-wasserstein aligner:dtw
    refiner:unrefined

    A recording's route brings its own matcher, aligner and refiner; --recording.route chooses another.
    """

    tracks: tyro.conf.Positional[tuple[Path, ...]]
    """A scene.json or a folder with one (also in Panoptic layout); or track sets (.npz written by otsync), one per
    video, in one world frame."""
    out: Path = Path("sync")
    """Folder for offsets.json and report.html, and the stages of a recording, from which a killed run continues."""
    reference: str | None = None
    """Name of the reference video, or "auto" for the one with the surest pairs; default: the first."""
    truth: Path | None = None
    """truth.json of a simulated world: adds errors to the table."""
    rate: Literal["fixed", "fit"] = "fixed"
    """Frame rates as declared, or fitted on long clips and kept where significant."""
    rematch: int = 1
    """How often trusted pairs are matched again at the synchronised times."""
    workers: int = 1
    """Processes that pairs are spread over; results do not depend on it."""
    graph: Graph = field(default_factory=Graph)
    matcher: Matcher = None
    """Default: by size, fused Gromov-Wasserstein below 200 tracks and its anchored form above."""
    aligner: Aligner = field(default_factory=LikelihoodScan)
    refiner: Refiner = field(default_factory=SplineRefine)
    recording: RecordingOptions = field(default_factory=RecordingOptions)

    def run(self) -> int:
        if len(self.tracks) == 1 and self.tracks[0].suffix != ".npz":
            return sync_recording(self.tracks[0], self.out, self.recording, reference=self.reference, truth=self.truth)
        if len(self.tracks) < 2:
            raise ValueError(f"tracks: expected at least two .npz files; found {len(self.tracks)}.")
        tracks = [TrackSet.load(path) for path in self.tracks]
        names = unique_names(tracks)
        reference: int | str = 0
        if self.reference is not None:
            if self.reference not in (*names, "auto"):
                raise ValueError(f"--reference: expected auto or one of {', '.join(names)}; found {self.reference!r}.")
            reference = "auto" if self.reference == "auto" else names.index(self.reference)
        known = None if self.truth is None else true_offsets(self.truth, names)
        self.out.mkdir(parents=True, exist_ok=True)  # before the work, not after it
        offsets = with_progress(
            tracks, "synchronising", self.workers, reference=reference, matcher=self.matcher, aligner=self.aligner,
            refiner=self.refiner, graph=self.graph, rematch=self.rematch, rate=self.rate,
        )  # fmt: skip
        truth = None if known is None else known - known[offsets.component]
        return report(offsets, tracks, truth, self.out, "Synchronisation report")


SUITES = {
    "core": "otsync.bench.core",
    "match": "otsync.bench.match",
    "sync": "otsync.bench.sync",
    "raster": "recon.bench_raster",
}


@dataclass
class Bench:
    """What accuracy costs in time: tables, CSV, JSON and plots, with machine and versions.

    Example: otsync bench sync --out bench/out --gate

    On a truly synchronised recording: otsync bench panoptic recording/ --json
    """

    suite: tyro.conf.Positional[Literal["core", "match", "sync", "raster", "panoptic", "all"]]
    scene: tyro.conf.Positional[Path | None] = None
    """For panoptic: a truly synchronised recording (its folder or scene.json). "all" leaves it out."""
    out: Path = Path("bench/out")
    """Folder for CSV, JSON and plots."""
    gate: bool = False
    """Compare with the committed baseline; exit code 1 when something got worse."""
    rebase: bool = False
    """Make the figures of this run the baseline that --gate compares with."""
    promises: bool = False
    """For sync and match: measure what is promised, on fresh seeds, instead of the tables."""
    first_seed: int | None = None
    """For core, match and sync: where the seeds begin; for panoptic: its seed; default: the suite's own."""
    seeds: int | None = None
    """For core, match and sync: how many seeds; default: the suite's own."""
    json: bool = False
    """For panoptic: one line of JSON on standard output instead of tables."""
    cache: Path | None = None
    """For panoptic: where tracks and depth are kept; default: stages in --out."""

    def run(self) -> int:
        import importlib

        if self.gate and self.rebase:
            raise ValueError("--gate, --rebase: expected one of them; a run is no judge of itself.")
        drawn = self._seeds()
        if self.suite == "panoptic":
            if self.scene is None:
                raise ValueError("scene: expected a recording: otsync bench panoptic SCENE.")
            from .bench import panoptic

            protocol = panoptic.Protocol() if self.first_seed is None else panoptic.Protocol(seed=self.first_seed)
            return panoptic.run(self.scene, self.out, json=self.json, cache=self.cache, protocol=protocol)
        if self.promises:
            from .bench import match_limits
            from .bench import sync as sync_bench

            if self.suite not in ("match", "sync"):
                raise ValueError(f"--promises: expected suite match or sync; found {self.suite}.")
            if self.suite == "match":
                return match_limits.run(self.out, **drawn)
            return sync_bench.run(self.out, promises=True, **drawn)
        suites = SUITES.values() if self.suite == "all" else [SUITES[self.suite]]
        modules = [importlib.import_module(name) for name in suites]
        return max(module.run(self.out, gate=self.gate, rebase=self.rebase, **drawn) for module in modules)

    def _seeds(self) -> dict[str, Any]:
        """The options that choose seeds, as far as they are given. ValueError where nothing would heed them."""
        drawn = {k: v for k, v in (("first_seed", self.first_seed), ("seeds", self.seeds)) if v is not None}
        for name, value in drawn.items():
            option, least = f"--{name.replace('_', '-')}", int(name == "seeds")
            heeded = ("core", "match", "sync", *(("panoptic",) if name == "first_seed" else ()))
            if self.suite not in heeded:
                raise ValueError(f"{option}: expected with suite {', '.join(heeded)}; found {self.suite}.")
            if self.gate or self.rebase:
                raise ValueError(
                    f"{option}: expected without --gate and --rebase: a baseline is of the suite's own seeds."
                )
            if value < least:
                raise ValueError(f"{option}: expected {least} or more; found {value}.")
        return drawn


COMMANDS: dict[str, Callable[..., Any]] = {
    "demo": Demo,
    "simulate": Simulate,
    "match": Match,
    "init": Init,
    "check": Check,
    "sync": Sync,
    "run": Run,
    "bench": Bench,
}


def true_offsets(path: Path, names: tuple[str, ...]) -> np.ndarray:
    """True offsets of the named videos; ValueError names what the file lacks."""
    import numpy as np

    known = Offsets.load(path)
    missing = [name for name in names if name not in known.names]
    if missing:
        raise ValueError(f"{path}: expected offsets of {', '.join(names)}; {', '.join(missing)} are not in it.")
    return np.array([known.seconds[known.names.index(name)] for name in names])


def with_progress(tracks: list[TrackSet], what: str, workers: int = 1, **options: Any) -> Offsets:
    """:func:`otsync.synchronize` on some processes, with a progress bar on a terminal."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    if workers < 1:
        raise ValueError(f"--workers: expected at least 1; found {workers}.")

    def progress(run: Callable[..., Iterable[Any]]) -> Callable[..., Iterable[Any]]:
        def mapped(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterable[Any]:
            items = list(items)
            return counted(run(function, items), what, "pair", len(items))

        return mapped

    if workers == 1:
        return synchronize(tracks, map=progress(map), **options)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        return synchronize(tracks, map=progress(pool.map), **options)


def report(offsets: Offsets, tracks: list[TrackSet], truth: Any, out: Path, title: str) -> int:
    """Print the table, write offsets.json and report.html; exit code 1 when an answer was refused."""
    from .report import write_report

    print(table(offsets, truth))
    offsets.save(out / "offsets.json")
    write_report(out / "report.html", offsets, tracks, truth=truth, title=title)
    print(f"wrote {out / 'offsets.json'} and {out / 'report.html'}")
    doubtful = [n for n, s in zip(offsets.names, offsets.status, strict=True) if not s.ok]
    for name, flags in zip(offsets.names, offsets.flags, strict=True):
        for flag in flags:
            print(f"{name}: {flag.code}: {flag}", file=sys.stderr)
    return 1 if doubtful else 0


def table(offsets: Offsets, truth: Any = None) -> str:
    """The answer as text, in frames of the reference."""
    import numpy as np

    fps = offsets.fps[offsets.component]
    true = np.full(len(offsets), np.nan) if truth is None else np.asarray(truth) * fps
    width = max(5, *map(len, offsets.names))
    lines = [
        f"{'video':{width}}  {'offset':>9} {'sigma':>8} {'true':>9} {'error':>8}  status   (frames of the reference)"
    ]
    for v, name in enumerate(offsets.names):
        values = (offsets.frames[v], offsets.sigma[v] * fps[v], true[v], offsets.frames[v] - true[v])
        cells = [f"{x:{w}.3f}" if np.isfinite(x) else "–".rjust(w) for x, w in zip(values, (9, 8, 9, 8), strict=True)]
        status = "reference" if v == offsets.reference else offsets.status[v].code
        lines.append(f"{name:{width}}  {' '.join(cells)}  {status}")
    return "\n".join(lines)


def refusal(verb: str, status: Status, flags: tuple[Status, ...]) -> int:
    if status.ok:
        return 0
    for flag in flags or (status,):
        print(f"{verb} refused: {flag.code}: {flag}", file=sys.stderr)
    return 1


def main(args: list[str] | None = None) -> int:
    """Entry point of the ``otsync`` command."""
    return run_command(
        "otsync", COMMANDS, args, description=__doc__, refused=(Refused,),
        interrupted="nothing half-written is left.",
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
