"""``recon bench``: offsets, held-out views and coherence of motion, for every configuration, on one recording.

The protocol is the paper's: the cameras of a truly synchronised recording get errors of their clocks put in. Camera c's
frame at its own time t is believed to be at t + d_c; its images, its tracks and its depth all move with it. Depth and
tracks are made from the synchronised frames, as the paper's were; so every row knows more than a user would, and all
rows know the same. ``otsync run`` on a recording whose clips begin at different frames has no such help.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro

from otsync.bench.record import table, write_rows
from otsync.compute.threads import pool_of
from otsync.files.arrays import atomic_write
from otsync.io import Scene
from otsync.metrics import offset_error
from otsync.progress import Progress
from otsync.types import Clock, Offsets, TrackSet
from otsync.types.checks import check_whole
from recon.backdrop.fit import StaticFit
from recon.bench.configurations import Configuration, check_heeded, configurations
from recon.bench.plot import plot
from recon.bench.rows import KEY, find, measured_before, paper_tables
from recon.evaluate.figures import FAINT, acceleration, coherence, following_error
from recon.evaluate.lpips import Lpips
from recon.evaluate.views import view
from recon.fit.options import FitOptions
from recon.fit.verb import Reconstruction, fit
from recon.observe.effects import Effect
from recon.observe.recorded import optics, with_declared
from recon.pipeline.plan import Plan
from recon.pipeline.prepare import Prepared, prepare
from recon.pipeline.readings import read_by
from recon.pipeline.starts import world_footprint
from recon.scene.device import device_of
from recon.scene.gaussians4d import Gaussians4D

Row = dict[str, Any]
FIGURES = 4
"""Version of what the figures mean: rows of another one are not continued. 2: tracks at their videos' own times. 3:
rows of several lengths. 4: a seed is the fit's, too; rows without a scaffold never had one."""

REACH = 5.0  # footprints within which a held-out track must have a Gaussian, to be followed
PUBLISHED = (
    "published, 30 cameras, offsets 0-30: .260 frame after refinement; PSNR 26.28 with true time, 25.23 unsynchronised "
    "(other cameras and masks: no claim is made by the difference)"
)


@dataclass(frozen=True)
class Protocol:
    """How rows are measured. ValueError for options that exclude each other, or that no row would heed."""

    plan: Annotated[Plan, tyro.conf.arg(name="")] = field(default_factory=lambda: Plan(views=16))
    """How every row is reconstructed, but for what it is about. Without --steps and --budget: 2500 steps. Knots reach
    at least a frame beyond the errors, whatever the scaffold's margin.
    """
    held_out: tuple[str, ...] = ()
    """Names of videos that no fit sees: every row is compared with them."""
    cameras: tuple[str, ...] | None = None
    """Names of the videos that train; default: all that are not held out. Depth, and with it the tracks' positions, and
    the static part always come from all of them: few cameras are few images of what moves, nothing else. A row that
    begins from images alone has those of the training videos."""
    amplitudes: tuple[float, ...] = (1.0,)
    """Frames: errors of the clocks are drawn uniformly within them."""
    seeds: tuple[int, ...] = (0,)
    """Of the draws of these errors, one row each; added to the seed of the fit, so that rows without errors have a
    spread, too."""
    lengths: tuple[int, ...] = ()
    """Several lengths of the fit, instead of --steps: every row is measured at each, to show what accuracy costs."""
    held_out_tracks: float = 0.1
    """Share of the tracks that no row begins from: the motion is compared with them."""

    def __post_init__(self) -> None:
        fit = self.plan.fit
        if self.lengths and (fit.steps is not None or fit.budget is not None):
            raise ValueError("lengths: expected without steps and budget, which say one length; found both.")
        for steps in self.lengths:
            check_whole("lengths", steps, 0)
        if fit.save_every != FitOptions.save_every:
            raise ValueError("save_every: expected in a single fit; a benchmark keeps whole rows, not parts of a fit.")
        if self.plan.features is not None and "features" not in read_by(fit.losses, self.plan.features):
            raise ValueError(
                f"features, losses: expected the loss feature beside {self.plan.features}, or no row would heed it. "
                "Add it to --losses, or leave --features out."
            )
        if not 0 <= self.held_out_tracks < 1:
            raise ValueError(f"held_out_tracks: expected a share in 0..1; found {self.held_out_tracks}.")

    @property
    def steps(self) -> tuple[int, ...]:
        """Steps of the fits; 0: as many as the budget allows."""
        if self.plan.fit.budget is not None:
            return (0,)
        return self.lengths or (STEPS if self.plan.fit.steps is None else self.plan.fit.steps,)


STEPS = 2500
"""Steps of a fit that the protocol tells no length of."""


@dataclass(frozen=True, eq=False)
class Material:
    """A recording with its depth, tracks and truth, before errors are put in.

    Args:
        scene: training and held-out videos; the training ones with depth. tracks: that rows begin from. kept: tracks
            that none does. truth: offsets of every video.
        backdrop: the static part, where cameras that do not train have a share in it; its gains are those of ``train``.
            None: every row fits one to its training videos.
    """

    scene: Scene
    tracks: tuple[TrackSet, ...]
    kept: tuple[TrackSet, ...]
    truth: Offsets
    held_out: tuple[str, ...]
    backdrop: StaticFit | None = None

    @property
    def train(self) -> tuple[str, ...]:
        return tuple(n for n in self.scene.names if n not in self.held_out)

    def believed(self, amplitude: float, seed: int) -> Offsets:
        """The truth with errors of up to ``amplitude`` frames; the reference's has none."""
        names = list(self.truth.names)
        error = np.zeros(len(names))
        rng = np.random.default_rng([seed, 7])
        for n in self.train:
            error[names.index(n)] = rng.uniform(-amplitude, amplitude)
        error[self.truth.reference] = 0
        return replace(self.truth, seconds=self.truth.seconds + error / self.truth.fps[self.truth.reference])


def material_of(
    scene: Scene, truth: Offsets, protocol: Protocol, cache: Any, map: Callable[..., Any], progress: Progress
) -> Material:
    """Depth of every frame and tracks of every training video, from the synchronised recording; kept in ``cache``."""
    from otsync.io.mend import cut
    from otsync.recordings.dense_depth import depth_maps
    from recon.pipeline.intake import only
    from recon.pipeline.stages import backdrop_of_scene, lifted_tracks, read_footage

    if protocol.plan.frames is not None:
        scene = cut(scene, *protocol.plan.frames)
    rig = scene.take([n for n in scene.names if n not in protocol.held_out])
    known = only(truth, rig.names)
    with progress.stage("tracks"):
        tracks = lifted_tracks(rig, known, cache, map, progress)
    if any(v.depth is None for v in rig.videos):
        with progress.stage("depth"):
            every = [range(len(v.frames)) for v in rig.videos]
            maps = depth_maps(rig, known, every, width=protocol.plan.width, cache=cache, map=map)
            rig = replace(rig, videos=tuple(replace(v, depth=list(z)) for v, z in zip(rig.videos, maps, strict=True)))
    train, backdrop = rig, None
    if protocol.cameras is not None:
        train = rig.take(protocol.cameras)
        with progress.stage("backdrop"):
            footage = read_footage(rig, protocol.plan.width, cache, map, progress)
            backdrop = backdrop_of_scene(rig, tracks, footage, protocol.plan, cache, progress)
            if backdrop is None:
                progress.note("the whole rig gave no static part: every row makes one from its training cameras alone")
            else:
                at = [rig.names.index(n) for n in train.names]
                backdrop = replace(backdrop, gains=backdrop.gains[at], psnr=backdrop.psnr[at])
        tracks = tuple(t for t in tracks if t.name in train.names)
    held = scene.take(protocol.held_out) if protocol.held_out else None
    if held is not None:
        train = replace(
            train,
            videos=(*train.videos, *held.videos),
            masks=(*train.masks, *held.masks),
            labels=(),
            tracks=(*train.tracks, *held.tracks),
            points=(*train.points, *held.points),
        )
    rng = np.random.default_rng(5)
    out = [rng.random(len(t)) < protocol.held_out_tracks for t in tracks]
    return Material(
        train,
        tuple(t.take(np.flatnonzero(~o)) for t, o in zip(tracks, out, strict=True)),
        tuple(t.take(np.flatnonzero(o)) for t, o in zip(tracks, out, strict=True)),
        only(truth, train.names),
        protocol.held_out,
        backdrop,
    )


def measure(
    name: str,
    configuration: Configuration,
    material: Material,
    protocol: Protocol,
    amplitude: float,
    seed: int,
    steps: int,
    cache: Any,
    map: Callable[..., Any],
    lpips: Lpips | None = None,
) -> Row:
    """One row: build from the believed offsets, fit (``steps`` as of Protocol.steps), and hold against the truth."""
    believed = material.believed(amplitude, seed)
    built_from = believed if configuration.clocks == "given" else material.truth
    plan = replace(configuration.plan(protocol.plan), frames=None)  # the material is cut already
    margin = max(plan.scaffold.margin, (amplitude + 1) / float(believed.fps[believed.reference]))
    plan = replace(plan, scaffold=replace(plan.scaffold, margin=margin))
    ready = prepare(
        material.scene,
        built_from,
        material.tracks,
        plan=plan,
        held_out=material.held_out,
        backdrop=material.backdrop if configuration.start.reads_geometry else None,
        start=configuration.start,
        cache=cache,
        map=map,
    )
    device = device_of(plan.device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    effects = with_declared(plan.effects, [f.readout for f in ready.footage], ready.gains, ready.falloff)
    options = replace(plan.fit, effects=effects, seed=plan.fit.seed + seed)
    options = options if options.budget is not None else replace(options, steps=steps)
    began = time.perf_counter(), time.process_time()
    fitted = fit(configuration.motion(ready.initial).to(device), ready.footage, ready.offsets, options)
    seconds, cpu = time.perf_counter() - began[0], time.process_time() - began[1]
    at = [material.truth.names.index(n) for n in fitted.offsets.names]
    true, reference = material.truth.seconds[at], fitted.offsets.reference
    fps = float(fitted.offsets.fps[reference])
    start = offset_error(ready.offsets.seconds, true, fps, reference=reference)
    error = offset_error(fitted.offsets.seconds, true, fps, reference=reference)
    free = offset_error(fitted.offsets.seconds, true, fps, gauge="median")
    row: Row = {
        "configuration": name,
        "amplitude": amplitude,
        "seed": seed,
        "steps": steps,
        "start": start.mean,
        "mean": error.mean,
        "max": error.max,
        "gauge_free": free.mean,
        "sigma": float(np.nanmedian(fitted.offsets.sigma) * fps),
        **held_out_figures(fitted, effects, ready, plan.views, lpips),
        **motion_figures(fitted.scene, ready, material.kept, world_footprint(material.tracks, ready.footage)),
        "images": fitted.stats["images"],
        "seconds": seconds,
        "cpu_seconds": cpu,
        "gaussians": len(fitted.scene),
    }
    if device.type == "cuda":
        row["gpu_gb"] = torch.cuda.max_memory_allocated(device) / 1e9
    return {k: _rounded(v) for k, v in row.items()}


def held_out_figures(
    fitted: Reconstruction, effects: Sequence[Effect], ready: Prepared, views: int, lpips: Lpips | None = None
) -> Row:
    """PSNR, SSIM, LPIPS of cameras that no fit has seen, at their true time: whole images, and where things move."""
    scores = []
    for f in ready.held_out:
        through = optics(effects, f.readout, None, fitted.parameters)
        clock = ready.clocks.get(f.name, Clock(0.0))
        looking = view(fitted.scene, f, clock, layered=ready.layered, optics=through)
        scores.append(looking.score(most=views, pictures=0, lpips=lpips).mean)
    keys = ("psnr", "ssim", "lpips", "mask_psnr", "mask_ssim")
    return {k: float(np.mean([s.get(k, math.nan) for s in scores])) if scores else math.nan for k in keys}


def motion_figures(scene: Gaussians4D, ready: Prepared, kept: Sequence[TrackSet], unit: float) -> Row:
    """Coherence, following error and acceleration: what a scaffold is for.

    kept: tracks that no row was built from, on the clocks of ``ready.offsets``. unit: footprint, alike for all rows.
    """
    seen = scene.dynamic.opacities.detach() > FAINT
    times = np.arange(math.ceil(scene.span[0] / scene.frame_step), scene.span[1] / scene.frame_step) * scene.frame_step
    tracks = scene.tracks(times)[seen.numpy()]
    errors = []
    for t in kept:
        at = ready.offsets.names.index(t.name)
        errors.append(positions_at(t, (times - ready.offsets.seconds[at]) / ready.offsets.rates[at]))
    follow = following_error(np.concatenate(errors), tracks, REACH * unit, horizons=(20,)) if errors else {}
    return {
        "neighbour_change": coherence(tracks) / unit,
        "follow_20": follow[20].median / unit if follow else math.nan,
        "acceleration": acceleration(tracks) / unit,
    }


def positions_at(tracks: TrackSet, times: np.ndarray) -> np.ndarray:
    """(N,T,3) at seconds of the video's own clock: between two neighbouring frames on the line; nan where not seen."""
    frame_times, held = tracks.times, np.full((len(tracks), len(times), 3), np.nan)
    if len(frame_times) < 2:
        return held
    positions = tracks.positions()
    after = np.searchsorted(frame_times, times).clip(1, len(frame_times) - 1)
    gap = frame_times[after] - frame_times[after - 1]
    share = (times - frame_times[after - 1]) / gap
    on_one = np.minimum(np.abs(share), np.abs(1 - share)) < ON_FRAME
    inside = on_one | (share > 0) & (share < 1) & (gap < 1.5 * np.median(np.diff(frame_times)))
    before, behind, share = positions[:, after - 1], positions[:, after], share[None, :, None]
    # on a frame its neighbour does not matter, which may not have seen the point
    between = np.where(
        share < ON_FRAME, before, np.where(share > 1 - ON_FRAME, behind, before + share * (behind - before))
    )
    held[:, inside] = between[:, inside]
    return held


ON_FRAME = 1e-4
"""Share of a frame below which a time is the frame's."""


def run(
    scene: Scene,
    truth: Offsets,
    out: Path,
    *,
    protocol: Protocol,
    rows: Sequence[str] = ("ours", "fixed", "true time"),
    cache: Path | None = None,
    tell: Callable[[str], None] = print,
    name: str = "recording",
    lpips: Lpips | None = None,
) -> list[Row]:
    """Measure the named configurations; write ``recon.csv`` and ``recon.json`` to ``out`` row by row.

    Rows that an earlier run into ``out`` has measured by the same protocol are kept. At the end ``recon.md`` holds the
    longest fits in the paper's layout, and ``recon.svg`` shows what accuracy costs in time. Returns all rows of the
    file.

    Args:
        name: of the recording in the tables; one of the paper's scenes stands beside its figures.
        lpips: the metric; default: none, and the tables say why.
    """
    from otsync.files.cache import Cache

    choices = configurations()
    unknown = [r for r in rows if r not in choices]
    if unknown:
        raise ValueError(f"rows: expected some of {', '.join(choices)}; found {', '.join(unknown)}.")
    for name_of_row in rows:
        choices[name_of_row].plan(protocol.plan)  # says what is wrong before the work, not after it
    check_heeded([choices[row] for row in rows], protocol.plan)
    kept, progress, lpips = Cache(cache or out / "stages"), Progress(tell), lpips or Lpips()
    description = about(protocol, scene, truth)
    known = measured_before(out, description)
    wanted = [
        (row, amplitude, seed, steps)
        for amplitude in protocol.amplitudes
        for seed in protocol.seeds
        for row in rows
        for steps in protocol.steps
        if find(known, (row, amplitude, seed, steps), lpips.network is not None) is None
    ]
    if known:
        tell(f"{len(known)} rows are kept from an earlier run; {len(wanted)} are to be measured")
    if wanted:
        with pool_of(os.cpu_count() or 1) as pool:
            material = material_of(scene, truth, protocol, kept, pool.map, progress)
            for which in wanted:
                row = measure(which[0], choices[which[0]], material, protocol, *which[1:], kept, pool.map, lpips)
                known = [r for r in known if tuple(r[k] for k in KEY) != which] + [row]
                tell(table([row]))
                write_rows(out, "recon", known, description)
    with atomic_write(out / "recon.md", "w") as stream:
        stream.write(paper_tables(known, name, lpips.reason, "markdown") + "\n")
    plot(known, out / "recon.svg")
    tell(f"{table(known)}\n{PUBLISHED}")
    return known


def about(protocol: Protocol, scene: Scene, truth: Offsets) -> Mapping[str, Any]:
    """What the figures were made with; rows are continued where all of it agrees."""
    clips = [[v.name, len(v.frames), v.camera.width, v.camera.height] for v in scene.videos]
    true = {n: round(float(s), 6) for n, s in zip(truth.names, truth.seconds, strict=True)}
    return {
        "protocol": described(protocol),
        "figures": FIGURES,
        "recording": {"videos": clips, "truth": true},
        "published": PUBLISHED,
        "unit": "frames, dB, footprints",
    }


def described(options: Any) -> dict[str, Any]:
    """Options as JSON takes them, those of parts beside those of the whole; objects as Python would spell them."""
    out: dict[str, Any] = {}
    for name, value in vars(options).items():
        if isinstance(value, Plan | FitOptions):
            out |= described(value)
        else:
            plain = isinstance(value, int | float | str | None) or _plain(value)
            out[name] = value if plain else repr(value)
    return out


def _plain(value: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(x, int | float | str) for x in value)


def _rounded(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return round(value, 4) if math.isfinite(value) else None
