"""Reconstruct a scene from depth cameras whose clocks and poses nobody knows, beside the same with the true poses.

python examples/10_scene_without_poses.py --out out/unposed

On a truly synchronised, calibrated recording, whose poses are forgotten and whose clips are cut apart:
python examples/10_scene_without_poses.py --recording recording/ --held-out 0 --shift 20 --out out/unposed
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro

from otsync.files.cache import Cache
from otsync.io import open_scene
from otsync.io.mend import cut, keep_frames
from otsync.io.scene import Scene
from otsync.progress import Progress
from otsync.recordings.dense_depth import depth_maps
from otsync.recordings.own_frames import synchronize_own_scene
from otsync.recordings.routes import synchronize_scene
from otsync.types import Offsets, Similarity, Video
from recon.fit import FitOptions
from recon.pipeline.plan import Plan
from recon.pipeline.verb import reconstruct
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture


def main(
    out: Path = Path("out/unposed"),
    recording: Path | None = None,
    cameras: tuple[str, ...] = (),
    held_out: str = "held0",
    shift: int = 8,
    frames: int = 60,
    width: int = 320,
    steps: int = 1500,
    seed: int = 5,
) -> None:
    """Args:
    recording: truly synchronised and calibrated; default: a simulated one. cameras: of it; default: all.
    held_out: a camera that only the comparison sees. shift: frames by which clips begin apart, at most.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        if recording is None:
            posed, held, true = filmed(out / "world", shift, frames, width, seed)
        else:
            posed, held, true = cut_apart(recording, cameras, held_out, shift, frames, width, out, seed, pool.map)

        # Forget the poses: each camera is at the origin of a frame of its own.
        nowhere = [replace(v, camera=replace(v.camera, w2c=np.eye(4))) for v in posed.videos]
        unposed = replace(posed, videos=tuple(nowhere))
        own = synchronize_own_scene(unposed, cache=Cache(out / "stages"), map=pool.map, tell=print)
        moved = [at(v, S) for v, S in zip(unposed.videos, own.offsets.transforms, strict=True)]
        # The held-out camera, in the frame that was found: where it stood in the reference's.
        reference = posed.videos[own.offsets.reference].camera
        there = replace(held, camera=replace(held.camera, w2c=held.camera.w2c @ np.linalg.inv(reference.w2c)))

        given = synchronize_scene(posed, cache=Cache(out / "stages"), map=pool.map, tell=print)
        # A fit holds cameras still: what is left of a pose's error would go into the clock, so found poses keep theirs.
        for what, scene, view, offsets, freeze in (
            ("given poses", posed, held, given.offsets, ()),
            ("found poses", replace(unposed, videos=tuple(moved)), there, own.offsets, ("offsets",)),
        ):
            whole = replace(scene, videos=(*scene.videos, view), masks=(*scene.masks, None), labels=())
            folder = out / what.replace(" ", "_")
            outcome = reconstruct(
                whole,
                offsets,
                folder,
                plan=Plan(width=width, fit=FitOptions(steps=steps, freeze=freeze)),
                held_out=(view.name,),
                map=pool.map,
                progress=Progress(print),
            )
            for name, found in (("geometry", offsets), ("fit", outcome.fitted.offsets)):
                error = np.abs(late(found) - true)[1:]
                print(f"{what}, {name}: offsets off by {error.mean():.3f} frames on average, {error.max():.3f} at most")
            seen = next(view for view in outcome.views if view.held_out).mean
            print(f"{what}: held out {seen['psnr']:.2f} dB, {seen['mask_psnr']:.2f} dB where things move")
        print(f"wrote {out / 'given_poses'} and {out / 'found_poses'}")


def at(video: Video, transform: Similarity | None) -> Video:
    """The video with its camera where it was found, and its depth in the unit of the reference."""
    if transform is None:
        raise SystemExit(f"{video.name}: its pose was not found")
    depth = [None if z is None else transform.scale * np.asarray(z, np.float32) for z in video.depth or ()]
    return replace(video, camera=transform.camera(video.camera), depth=depth)


def late(offsets: Offsets) -> np.ndarray:
    """Frames by which each video began later than the first."""
    return offsets.frames - offsets.frames[0]


def filmed(world: Path, shift: int, frames: int, width: int, seed: int) -> tuple[Scene, Video, np.ndarray]:
    """A simulated recording: (videos with depth, the held-out one, true offsets in frames)."""
    if not world.exists():
        size = (width, 3 * width // 5)
        write_capture(synthetic(seed, cameras=6, frames=frames, size=size, offsets=float(shift)), world)
    scene, truth = open_scene(world), Offsets.load(world / "truth.json")
    return scene.take(scene.names[:-1]), scene.videos[-1], late(truth)[:-1]


def cut_apart(
    recording: Path,
    cameras: tuple[str, ...],
    held_out: str,
    shift: int,
    frames: int,
    width: int,
    out: Path,
    seed: int,
    map,
) -> tuple[Scene, Video, np.ndarray]:
    """The same of a synchronised recording: clips begin up to ``shift`` frames apart; depth is measured first."""
    scene = cut(open_scene(recording), 0, frames + shift)
    names = [n for n in cameras or scene.names if n != held_out]
    rig, held = scene.take(names), scene.take([held_out]).videos[0]
    fps = rig.videos[0].fps or 30.0
    known = Offsets.known(rig.names, np.zeros(len(names)), fps)
    every = [range(len(v.frames)) for v in rig.videos]
    maps = depth_maps(rig, known, every, width=width, cache=Cache(out / "stages"), map=map)
    rig = replace(rig, videos=tuple(replace(v, depth=list(z)) for v, z in zip(rig.videos, maps, strict=True)))
    starts = np.random.default_rng(seed).integers(0, shift + 1, len(names))
    clips = keep_frames(rig, [range(s, s + frames) for s in starts])
    restarted = tuple(replace(v, fps=fps, timestamps=None) for v in clips.videos)  # each on a clock of its own
    return replace(clips, videos=restarted), held, (starts - starts[0]).astype(float)


if __name__ == "__main__":
    tyro.cli(main)
