"""The command line of reconstruction: ``recon fit | render | eval | export | simulate | bench``, and what ``otsync run`` calls.

Exit codes: 0 done; 1 an answer is not to be trusted (it is written all the same); 2 bad arguments or files; 130
interrupted: the same command continues where it stopped.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from otsync.command_line import run_command
from otsync.progress import counted
from recon.commands_bench import Bench
from recon.density import Densify
from recon.export import Format
from recon.motion import ScaffoldOptions
from recon.seed import Seeding

if TYPE_CHECKING:
    from otsync.io import Scene
    from otsync.types import Offsets
    from recon.held_out import ViewScore
    from recon.pipeline import Outcome
    from recon.plan import Plan, Progress


@dataclass(frozen=True)
class FitOptions:
    """How a scene is fitted."""

    held_out: tuple[str, ...] = ()
    """Names of videos that the fit does not see: the finished scene is held against them."""
    width: int = 320
    """Working pixels of an image's width."""
    frames: tuple[int, int] | None = None
    """First and last (exclusive) frame of every video to use; default: all."""
    budget: float | None = None
    """Seconds for the fit, after everything is prepared; default: 300."""
    steps: int | None = None
    """Steps of the fit instead of seconds: the result is then the same on any machine of a kind."""
    freeze: tuple[str, ...] = ()
    """Parameter groups that stay as they are: offsets, gain, knots, ..."""
    batch: int = 2
    """Images a step, on a CPU each on a thread of its own."""
    device: str = "cpu"
    """cpu, or cuda for a GPU with gsplat: where the fits run."""
    backdrop_steps: int = 1500
    """Steps of the fit of the static part, before anything moves."""
    seed: int = 0
    densify: Densify | None = None
    """Split what is pulled hardest, drop what is faint; off unless asked for."""
    scaffold: ScaffoldOptions = field(default_factory=ScaffoldOptions)
    voxel: float = Seeding.voxel
    """Working pixels between the Gaussians that what moves begins with: finer is slower and shows more."""
    sh_degree: int = Seeding.sh_degree
    """Harmonics of the colours of what moves, 1 to 4 where they depend on the view (sheen); 0: they do not."""
    exposure: float = 0.0
    """Seconds that the shutters were open, where moving things are blurred; 0: sharp. Readouts are in the scene."""
    save_every: float = 60.0
    """Seconds between two savings of the fit, from the last of which a killed run continues."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""
    cache: Path | None = None
    """Folder where stages are kept; default: stages in --out."""
    workers: int = 0
    """Threads of the stages before the fit; 0: one per core."""

    def plan(self) -> Plan:
        """The pipeline's form of this."""
        from recon.effects import MotionBlur
        from recon.plan import Plan

        return Plan(
            effects=(MotionBlur(self.exposure),) if self.exposure else (),
            width=self.width, frames=self.frames, scaffold=self.scaffold, seeding=Seeding(self.voxel, sh_degree=self.sh_degree), densify=self.densify, freeze=self.freeze,
            batch=self.batch, seed=self.seed, backdrop_steps=self.backdrop_steps,
            save_every=self.save_every, device=self.device,
        )  # fmt: skip

    def length(self) -> dict[str, Any]:
        """Steps or budget, as :func:`recon.fit.fit` takes them."""
        if self.steps is not None and self.budget is not None:
            raise ValueError("--steps, --budget: expected one of them; found both.")
        if self.steps is not None:
            if self.steps < 0:
                raise ValueError(f"--steps: expected 0 or more; found {self.steps}.")
            return {"steps": self.steps}
        budget = 300.0 if self.budget is None else self.budget
        if not 0 < budget < math.inf:
            raise ValueError(f"--budget: expected seconds above 0; found {budget:g}.")
        return {"budget": budget}


@dataclass
class Fit:
    """Reconstruct a recording whose offsets are known, and refine them.

    Example: recon fit recording/ --offsets offsets.json --out result --held-out 0 --budget 300

    A quick look: recon fit recording/ --offsets offsets.json --out look --width 160 --frames 0 30 --steps 300

    The offsets as they are: recon fit recording/ --offsets offsets.json --out fixed --freeze offsets
    """

    scene: tyro.conf.Positional[Path]
    """A scene.json, or a folder that holds one, or a folder in Panoptic layout."""
    offsets: Path
    """offsets.json as otsync sync writes it."""
    out: Path = Path("recon")
    """Folder for scene.npz, offsets.json, metrics.json and report.html; a run that was stopped continues in it."""
    tracks: tuple[Path, ...] = ()
    """Track sets in space (.npz), one a video, that the motion begins with; default: tracked and lifted here."""
    truth: Path | None = None
    """truth.json of a simulated world: adds errors to table and report."""
    fit: Annotated[FitOptions, tyro.conf.arg(name="")] = field(default_factory=FitOptions)

    def run(self) -> int:
        from otsync.types import Offsets, TrackSet

        self.fit.length(), self.fit.plan()  # before the work, not after it
        scene = opened(self.scene, self.fit.allow_outside)
        offsets = Offsets.load(self.offsets)
        tracks = tuple(TrackSet.load(path) for path in self.tracks) or None
        return reconstructed(scene, offsets, self.out, self.fit, tracks=tracks, truth=self.truth)


@dataclass
class Render:
    """Render a finished reconstruction: a camera that filmed it, or one that circles around it.

    Example: recon render result --camera 0 --out camera0.mp4

    Around the scene: recon render result --path orbit --frames 120 --out orbit.mp4

    A frozen moment from all sides: recon render result --path orbit --times 1.25 --frames 90 --out frozen.mp4

    Single images: recon render result --camera 5 --times 0.5 0.52 --out images
    """

    result: tyro.conf.Positional[Path]
    """Folder that recon fit or otsync run wrote."""
    camera: str | None = None
    """Name of a video: from its place, with its colours."""
    path: Literal["orbit"] | None = None
    """A camera that moves: around the scene, or to and fro where the scene was filmed from one side."""
    times: tuple[float, ...] = ()
    """World seconds; default: the whole span at --fps."""
    frames: int | None = None
    """Frames of a path: time runs through the span, or stands still at the one moment of --times."""
    turns: float = 1.0
    """How often the path goes around."""
    fps: float | None = None
    """Frames per second; default: the reference's."""
    width: int | None = None
    """Pixels; default: the working size of the fit."""
    out: Path = Path("render.mp4")
    """A video (.mp4, .mov, .mkv), or a folder for PNG frames."""

    def run(self) -> int:
        from recon.export import MAX_FRAMES, check_times, frame_times
        from recon.result import load_result
        from recon.showing import rendered, stretched
        from recon.video import check_target, write_images

        if (self.camera is None) == (self.path is None):
            raise ValueError("--camera, --path: expected one of them: the name of a video, or orbit.")
        if self.frames is not None and (self.path is None or len(self.times) > 1):
            raise ValueError("--frames: expected with --path, and with at most one moment in --times.")
        if self.frames is not None and not 1 <= self.frames <= MAX_FRAMES:
            raise ValueError(f"--frames: expected 1 to {MAX_FRAMES}; found {self.frames}.")
        if self.fps is not None and not 0 < self.fps <= 1000:
            raise ValueError(f"--fps: expected frames per second above 0, at most 1000; found {self.fps:g}.")
        check_target(self.out)
        result = load_result(self.result)
        fps = 1.0 / result.scene.frame_step if self.fps is None else self.fps
        times = list(self.times) or frame_times(result.scene, fps).tolist()
        if self.frames is not None:
            times = times * self.frames if len(self.times) == 1 else stretched(result.scene.span, self.frames)
        check_times(result.scene, times)
        images = rendered(result, times, self.camera, turns=self.turns, width=self.width)
        count = write_images(counted(images, "rendering", "image", len(times)), self.out, fps)
        print(f"wrote {count} images to {self.out}")
        return 0


@dataclass
class Eval:
    """Hold a finished reconstruction against cameras that it has not seen.

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
    """offsets.json that tells the clocks of held-out videos; default: found on the frozen scene."""
    truth: Path | None = None
    """True offsets: adds the offset errors of the reconstruction."""
    views: int = 50
    """Frames of every camera that are compared."""
    lpips_weights: Path | None = None
    """torchvision's weights of AlexNet; without them LPIPS is left out."""
    out: Path | None = None
    """Where to write the figures; default: eval.json in the result."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""

    def run(self) -> int:
        from otsync.files import write_json
        from otsync.priors.cache import Cache
        from otsync.types import Offsets
        from recon.pipeline import evaluate, offset_figures, true_seconds
        from recon.plan import Progress
        from recon.result import load_result, metrics_of

        if self.views < 1:
            raise ValueError(f"--views: expected at least 1; found {self.views}.")
        result = load_result(self.result)
        scene = opened(self.scene, self.allow_outside)
        given = None if self.offsets is None else Offsets.load(self.offsets)
        names = self.held_out or tuple(v.name for v in result.videos if v.held_out)
        if not names:
            raise ValueError("--held-out: expected names of videos; none was held out of this fit.")
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            views, reason = evaluate(
                result, scene, names, given, most=self.views, lpips_weights=self.lpips_weights,
                cache=Cache(self.result / "stages"), map=pool.map, progress=Progress(tell),
            )  # fmt: skip
        print(view_table(views, reason))
        document = metrics_of(views, {}, reason)
        if self.truth is not None:
            error = offset_figures(result.offsets, true_seconds(Offsets.load(self.truth), result.offsets))
            if error["mean_frames"] is None:
                print("offset error: none, for there is one video only")
            else:
                print(f"offset error: mean {error['mean_frames']:.3f}, max {error['max_frames']:.3f} frames")
            document["offset_error"] = error
        out = self.out or self.result / "eval.json"
        write_json(out, document)
        print(f"wrote {out}")
        return 0


@dataclass
class Export:
    """Write a finished reconstruction for other tools.

    Example: recon export result --format ply --at 1.25 --out moment.ply

    Every frame: recon export result --format ply-sequence --out sequence

    Dense trajectories: recon export result --format tracks --out tracks.npz
    """

    result: tyro.conf.Positional[Path]
    """Folder that recon fit or otsync run wrote."""
    format: Format = "ply"
    """ply and splat hold a moment, ply-sequence every frame; checkpoint is the whole scene, tracks an otsync track set."""
    at: float | None = None
    """World second of the moment; default: the middle."""
    fps: float | None = None
    """Frames per second of a sequence or of tracks; default: the reference's."""
    out: Path | None = None
    """File or folder; default: named by the format, in the result."""

    def run(self) -> int:
        from recon.export import export, frame_times
        from recon.result import load_result

        result = load_result(self.result)
        single = self.format in ("ply", "splat")
        if self.at is not None and not single:
            raise ValueError(f"--at: expected with ply or splat; found {self.format}, which holds all times.")
        low, high = result.scene.span
        middle = 0.5 * (low + high) if self.at is None else self.at
        times = [middle] if single else frame_times(result.scene, self.fps).tolist()
        names = {"ply": "scene.ply", "splat": "scene.splat", "ply-sequence": "sequence", "checkpoint": "scene4d.npz",
                 "tracks": "tracks.npz"}  # fmt: skip
        out = self.out or self.result / names[self.format]
        export(result.scene, self.format, out, times, result.frame)
        print(f"wrote {out}")
        return 0


@dataclass
class Simulate:
    """Film a small simulated scene with unsynchronised cameras, and write it as a recording with its truth.

    Example: recon simulate world --cameras 5 --seed 3
    """

    out: tyro.conf.Positional[Path]
    """Folder for scene.json, images, masks, depth, tracks and truth.json."""
    cameras: int = 5
    held_out: int = 1
    """Cameras between the others, for evaluation: they film at true world time."""
    frames: int = 24
    width: int = 160
    height: int = 96
    max_offset: float = 1.0
    """Largest offset, in frames."""
    gain: float = 0.0
    """Cameras differ in exposure and white balance: standard deviation of the logarithm. 0, like all below: absent."""
    noise: float = 0.0
    """White noise beyond the usual 1 %, in 0..1."""
    exposure: float = 0.0
    """Seconds that shutters are open: motion blur."""
    readout: float = 0.0
    """Seconds from the first to the last row: rolling shutter, which scene.json then declares."""
    sheen: float = 0.0
    """Strength of a lamp that what moves reflects, in 0..1: colours depend on the view."""
    seed: int = 0

    def run(self) -> int:
        from recon.capture import write_capture
        from recon.simulate import Blur, Exposure, MoreNoise, Rolling, Sheen, synthetic

        wanted = ((Sheen, self.sheen), (Blur, self.exposure), (Rolling, self.readout), (Exposure, self.gain),
                  (MoreNoise, self.noise))  # fmt: skip
        if not all(0 <= size < math.inf for _, size in wanted):
            raise ValueError("--gain, --noise, --exposure, --readout, --sheen: expected numbers of 0 or more.")
        capture = synthetic(
            self.seed, cameras=self.cameras, held_out=self.held_out, frames=self.frames,
            size=(self.width, self.height), offsets=self.max_offset,
            effects=tuple(effect(size) for effect, size in wanted if size),
        )  # fmt: skip
        write_capture(capture, self.out)
        held = " ".join(f.name for f in capture.held_out)
        print(f"{self.out}: {len(capture.footage)} cameras, held out: {held or 'none'}; truth.json, start.json")
        print(
            f"try: recon fit {self.out} --offsets {self.out}/start.json --tracks {self.out}/tracks/*.npz "
            f"--truth {self.out}/truth.json --width {self.width} --steps 1500 --out result"
            + (f" --held-out {held}" if held else "")
        )
        return 0


COMMANDS: dict[str, Callable[..., Any]] = {
    "fit": Fit,
    "render": Render,
    "eval": Eval,
    "export": Export,
    "simulate": Simulate,
    "bench": Bench,
}


def tell(text: str) -> None:
    """A line of progress."""
    print(text, file=sys.stderr, flush=True)


def opened(path: Path, allow_outside: bool) -> Scene:
    """The scene at ``path``; what its reader assumed goes to stderr."""
    from otsync.io import open_scene

    scene = open_scene(path, allow_outside=allow_outside)
    for note in scene.notes:
        tell(f"note: {note}")
    return scene


def reconstructed(
    scene: Scene, offsets: Offsets, out: Path, options: FitOptions, *, tracks: Any = None, truth: Path | None = None,
    progress: Progress | None = None,
) -> int:  # fmt: skip
    """Prepare, fit, evaluate, write, and print what came out; the exit code."""
    from otsync.priors.cache import Cache
    from otsync.types import Offsets
    from recon.pipeline import reconstruct
    from recon.plan import Progress

    known = None if truth is None else Offsets.load(truth)
    with ThreadPoolExecutor(options.workers or os.cpu_count() or 1) as pool:
        outcome = reconstruct(
            scene, offsets, out, plan=options.plan(), tracks=tracks, held_out=options.held_out, truth=known,
            cache=Cache(options.cache or out / "stages"), map=pool.map, progress=progress or Progress(tell),
            **options.length(),
        )  # fmt: skip
    print(offset_table(outcome))
    print(view_table(outcome.views, outcome.lpips_reason))
    print(f"wrote {out / 'scene.npz'}, {out / 'offsets.json'}, {out / 'metrics.json'} and {out / 'report.html'}")
    doubtful = [n for n, s in zip(outcome.coarse.names, outcome.coarse.status, strict=True) if not s.ok]
    if doubtful:
        print(f"begun from offsets that are not to be trusted: {', '.join(doubtful)}", file=sys.stderr)
    return 1 if doubtful or outcome.left_out else 0


def offset_table(outcome: Outcome) -> str:
    """Offsets before and after, in frames of the reference."""
    import numpy as np

    offsets, coarse, true = outcome.found.offsets, outcome.coarse, outcome.truth
    fps, width = offsets.fps[offsets.reference], max(5, *map(len, offsets.names))
    head = f"{'video':{width}}  {'before':>9} {'after':>9} {'sigma':>8}"
    head += f" {'true':>9} {'error':>8}" if true is not None else ""
    lines = [head + "   (frames of the reference)"]
    for v, name in enumerate(offsets.names):
        values = [coarse.frames[v], offsets.frames[v], offsets.sigma[v] * fps]
        values += [true[v] * fps, offsets.frames[v] - true[v] * fps] if true is not None else []
        cells = [
            f"{x:{w}.3f}" if np.isfinite(x) else "–".rjust(w) for x, w in zip(values, (9, 9, 8, 9, 8), strict=False)
        ]
        lines.append(f"{name:{width}}  {' '.join(cells)}" + ("  reference" if v == offsets.reference else ""))
    return "\n".join(lines)


def view_table(views: tuple[ViewScore, ...], lpips_reason: str = "") -> str:
    """Figures of every camera that was compared."""
    import numpy as np

    keys = [("psnr", 2), ("ssim", 4), ("lpips", 4), ("mask_psnr", 2), ("mask_ssim", 4)]
    if lpips_reason:
        keys = [k for k in keys if k[0] != "lpips"]
    width = max(6, *(len(v.name) for v in views)) if views else 6
    lines = [f"{'camera':{width}}  {'role':9}" + "".join(f" {key:>10}" for key, _ in keys) + "  clock"]
    for v in views:
        cells = "".join(f" {v.mean[k]:10.{d}f}" if np.isfinite(v.mean[k]) else f" {'–':>10}" for k, d in keys)
        lines.append(f"{v.name:{width}}  {'held out' if v.held_out else 'training':9}{cells}  {v.clock.how}")
    return "\n".join(lines + ([f"LPIPS is left out: {lpips_reason}"] if lpips_reason else []))


def main(args: list[str] | None = None) -> int:
    """Entry point of the ``recon`` command."""
    from recon.running import Diverged

    return run_command(
        "recon", COMMANDS, args, description=__doc__, refused=(Diverged, FloatingPointError),
        interrupted="the same command continues from here.",
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
