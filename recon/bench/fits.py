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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from otsync.bench.record import table, write_rows
from otsync.files.arrays import atomic_write
from otsync.io import Scene
from otsync.progress import Progress
from otsync.types import Clock, Offsets, TrackSet
from otsync.types.checks import check_number, check_whole
from recon.backdrop.fit import StaticFit
from recon.bench.configurations import CONFIGURATIONS, Configuration
from recon.bench.plot import plot
from recon.bench.rows import KEY, find, measured_before, paper_tables
from recon.evaluate.figures import acceleration, coherence, following_error, offset_error
from recon.evaluate.lpips import Lpips
from recon.evaluate.views import view
from recon.fit.verb import fit
from recon.observe.effects import Gain, with_declared
from recon.pipeline.plan import Plan
from recon.pipeline.prepare import Prepared, prepare
from recon.scene.device import device_of
from recon.scene.gaussians4d import Gaussians4D
from recon.scene.seed import Seeding

Row = dict[str, Any]
FIGURES = 3
"""Version of what the figures mean: rows of another one are not continued. 2: tracks at their videos' own times. 3: rows of
several lengths."""

REACH = 5.0  # footprints within which a held-out track must have a Gaussian, to be followed
PUBLISHED = (
    "published, 30 cameras, offsets 0-30: .260 frame after refinement; PSNR 26.28 with true time, 25.23 unsynchronised "
    "(other cameras and masks: no claim is made by the difference)"
)


@dataclass(frozen=True)
class Protocol:
    """What is measured.

    Args:
        frames: first and last (exclusive) frame of the window.
        cameras: that train; None: all that are not held out. Depth, and with it the tracks' positions, and the static
            part always come from all of them: few cameras are few images of what moves, nothing else.
        amplitudes: frames; errors are drawn uniformly within them, one seed after another.
        seeds: of the draws.
        steps: of the fit, of ``batch`` images each; several give every row several times: what accuracy costs.
        budget: wall seconds instead.
        width: working pixels. voxel, sh_degree: see :class:`recon.seed.Seeding`.
        held_out_tracks: share of the tracks that no scaffold sees.
        device: where the fits run, "cpu" or "cuda"; on a GPU rows tell the most memory that the fit held there.
    """

    frames: tuple[int, int] | None = None
    cameras: tuple[str, ...] | None = None
    held_out: tuple[str, ...] = ()
    amplitudes: tuple[float, ...] = (1.0,)
    seeds: tuple[int, ...] = (0,)
    steps: tuple[int, ...] = (2500,)
    budget: float | None = None
    batch: int = 2
    width: int = 320
    voxel: float = Seeding.voxel
    sh_degree: int = Seeding.sh_degree
    held_out_tracks: float = 0.1
    backdrop_steps: int = 1500
    device: str = "cpu"

    def plan(self, **more: Any) -> Plan:
        """What is done with the recording, as far as all rows agree, and what ``more`` says of one."""
        return Plan(
            width=self.width,
            seeding=Seeding(voxel=self.voxel, sh_degree=self.sh_degree),
            batch=self.batch,
            backdrop_steps=self.backdrop_steps,
            device=self.device,
            **more,
        )

    @property
    def lengths(self) -> tuple[int, ...]:
        """Steps of the fits; 0: as many as the budget allows."""
        return (0,) if self.budget is not None else self.steps


@dataclass(frozen=True, eq=False)
class Material:
    """A recording with its depth, tracks and truth, before errors are put in.

    Args:
        scene: training and held-out videos; the training ones with depth. tracks: that scaffolds are built from.
        kept: tracks that none is. truth: offsets of every video.
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

    if protocol.frames is not None:
        scene = cut(scene, *protocol.frames)
    rig = scene.take([n for n in scene.names if n not in protocol.held_out])
    known = only(truth, rig.names)
    with progress.stage("tracks"):
        tracks = lifted_tracks(rig, known, cache, map, progress)
    if any(v.depth is None for v in rig.videos):
        with progress.stage("depth"):
            every = [range(len(v.frames)) for v in rig.videos]
            maps = depth_maps(rig, known, every, width=protocol.width, cache=cache, map=map)
            rig = replace(rig, videos=tuple(replace(v, depth=list(z)) for v, z in zip(rig.videos, maps, strict=True)))
    train, backdrop = rig, None
    if protocol.cameras is not None:
        train = rig.take(protocol.cameras)
        with progress.stage("backdrop"):
            footage = read_footage(rig, protocol.width, cache, map, progress)
            backdrop = backdrop_of_scene(rig, tracks, footage, protocol.plan(), cache, progress)
            if backdrop is None:
                progress.note("the whole rig gave no static part: every row makes one from its training cameras alone")
            else:
                at = [rig.names.index(n) for n in train.names]
                backdrop = replace(backdrop, gains=backdrop.gains[at], psnr=backdrop.psnr[at])
        tracks = tuple(t for t in tracks if t.name in train.names)
    held = scene.take(protocol.held_out) if protocol.held_out else None
    if held is not None:
        train = replace(train, videos=(*train.videos, *held.videos), masks=(*train.masks, *held.masks), labels=())
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
    """One row: build from the believed offsets, fit (``steps`` as of Protocol.lengths), and hold against the truth."""
    believed = material.believed(amplitude, seed)
    built_from = believed if configuration.start == "given" else material.truth
    margin = max(configuration.scaffold.margin, (amplitude + 1) / float(believed.fps[believed.reference]))
    plan = protocol.plan(scaffold=replace(configuration.scaffold, margin=margin), losses=configuration.losses)
    ready = prepare(
        material.scene,
        built_from,
        material.tracks,
        plan=plan,
        held_out=material.held_out,
        backdrop=material.backdrop,
        cache=cache,
        map=map,
    )
    device = device_of(protocol.device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    began = time.perf_counter(), time.process_time()
    found = fit(
        configuration.motion(ready.initial).to(device),
        ready.footage,
        ready.offsets,
        losses=plan.losses,
        effects=(*with_declared((), [f.readout for f in ready.footage]), Gain(start=ready.gains)),
        rates=configuration.rates,
        steps=None if protocol.budget is not None else steps,
        budget=protocol.budget,
        batch=protocol.batch,
    )
    seconds, cpu = time.perf_counter() - began[0], time.process_time() - began[1]
    step, at = found.scene.frame_step, [material.truth.names.index(n) for n in found.offsets.names]
    true, reference = material.truth.seconds[at], found.offsets.reference
    start = offset_error(ready.offsets.seconds, true, step, reference=reference)
    error = offset_error(found.offsets.seconds, true, step, reference=reference)
    free = offset_error(found.offsets.seconds, true, step, gauge="median")
    row: Row = {
        "configuration": name,
        "amplitude": amplitude,
        "seed": seed,
        "steps": steps,
        "start": start.mean,
        "mean": error.mean,
        "max": error.max,
        "gauge_free": free.mean,
        "sigma": float(np.nanmedian(found.offsets.sigma) / step),
        **held_out_figures(found.scene, ready, lpips),
        **motion_figures(found.scene, ready, material.kept),
        "images": found.stats["images"],
        "seconds": seconds,
        "cpu_seconds": cpu,
        "gaussians": len(found.scene),
    }
    if device.type == "cuda":
        row["gpu_gb"] = torch.cuda.max_memory_allocated(device) / 1e9
    return {k: _rounded(v) for k, v in row.items()}


def held_out_figures(scene: Gaussians4D, ready: Prepared, lpips: Lpips | None = None) -> Row:
    """PSNR, SSIM, LPIPS of cameras that no fit has seen, at their true time: whole images, and where things move."""
    scores = []
    for f in ready.held_out:
        looking = view(scene, f, ready.clocks.get(f.name, Clock(0.0)), layered=ready.layered)
        scores.append(looking.score(most=16, pictures=0, lpips=lpips).mean)
    keys = ("psnr", "ssim", "lpips", "mask_psnr", "mask_ssim")
    return {k: float(np.mean([s.get(k, math.nan) for s in scores])) if scores else math.nan for k in keys}


def motion_figures(scene: Gaussians4D, ready: Prepared, kept: Sequence[TrackSet]) -> Row:
    """Coherence, following error and acceleration, in footprints: what a scaffold is for.

    kept: tracks that no scaffold was built from, on the clocks of ``ready.offsets``.
    """
    seen = scene.dynamic.opacities.detach() > 0.1
    times = np.arange(math.ceil(scene.span[0] / scene.frame_step), scene.span[1] / scene.frame_step) * scene.frame_step
    tracks = scene.tracks(times)[seen.numpy()]
    unit = scene.footprint
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
    on_one = np.minimum(np.abs(share), np.abs(1 - share)) < NEAR
    inside = on_one | (share > 0) & (share < 1) & (gap < 1.5 * np.median(np.diff(frame_times)))
    before, behind, share = positions[:, after - 1], positions[:, after], share[None, :, None]
    # on a frame its neighbour does not matter, which may not have seen the point
    between = np.where(share < NEAR, before, np.where(share > 1 - NEAR, behind, before + share * (behind - before)))
    held[:, inside] = between[:, inside]
    return held


NEAR = 1e-4
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
    longest fits in the paper's layout, and ``recon.svg`` shows what accuracy costs in time. Returns all rows of the file.

    Args:
        name: of the recording in the tables; one of the paper's scenes stands beside its figures.
        lpips: the metric; default: none, and the tables say why.
    """
    from otsync.files.cache import Cache

    unknown = [r for r in rows if r not in CONFIGURATIONS]
    if unknown:
        raise ValueError(f"rows: expected some of {', '.join(CONFIGURATIONS)}; found {', '.join(unknown)}.")
    protocol.plan()  # says what is wrong before the work, not after it
    for steps in protocol.steps:
        check_whole("steps", steps, 0)
    if protocol.budget is not None:
        check_number("budget", protocol.budget)
    kept, progress, lpips = Cache(cache or out / "stages"), Progress(tell), lpips or Lpips()
    description = about(protocol, scene, truth)
    found = measured_before(out, description)
    wanted = [
        (row, amplitude, seed, steps)
        for amplitude in protocol.amplitudes
        for seed in protocol.seeds
        for row in rows
        for steps in protocol.lengths
        if find(found, (row, amplitude, seed, steps), lpips.network is not None) is None
    ]
    if found:
        tell(f"{len(found)} rows are kept from an earlier run; {len(wanted)} are to be measured")
    if wanted:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            material = material_of(scene, truth, protocol, kept, pool.map, progress)
            for which in wanted:
                row = measure(which[0], CONFIGURATIONS[which[0]], material, protocol, *which[1:], kept, pool.map, lpips)
                found = [r for r in found if tuple(r[k] for k in KEY) != which] + [row]
                tell(table([row]))
                write_rows(out, "recon", found, description)
    with atomic_write(out / "recon.md", "w") as stream:
        stream.write(paper_tables(found, name, lpips.reason, "markdown") + "\n")
    plot(found, out / "recon.svg")
    tell(f"{table(found)}\n{PUBLISHED}")
    return found


def about(protocol: Protocol, scene: Scene, truth: Offsets) -> Mapping[str, Any]:
    """What the figures were made with; rows are continued where all of it agrees."""
    clips = [[v.name, len(v.frames), v.camera.width, v.camera.height] for v in scene.videos]
    true = {n: round(float(s), 6) for n, s in zip(truth.names, truth.seconds, strict=True)}
    return {
        "protocol": dict(vars(protocol)),
        "figures": FIGURES,
        "recording": {"videos": clips, "truth": true},
        "published": PUBLISHED,
        "unit": "frames, dB, footprints",
    }


def _rounded(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return round(value, 4) if math.isfinite(value) else None
