"""Reconstruct a small simulated scene from unsynchronised cameras, and refine their clocks from the images.

python examples/06_reconstruct.py --out out/reconstruct
"""

from pathlib import Path

import tyro

from otsync.io import open_scene
from otsync.progress import Progress
from otsync.types import Offsets, TrackSet
from recon.fit import FitOptions
from recon.pipeline.plan import Plan
from recon.pipeline.verb import reconstruct
from recon.result.export import Ply, Tracks, export, frame_times
from recon.result.folder import load_result
from recon.result.images import rendered
from recon.result.video import write_images
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture


def main(out: Path = Path("out/reconstruct"), steps: int = 700, seed: int = 1) -> None:
    # Two people, five cameras and one between them that nothing sees but the evaluation; offsets up to a frame.
    world = out / "world"
    if not world.exists():
        write_capture(synthetic(seed), world)

    # In your own work: a folder with scene.json (otsync init), and offsets.json from otsync sync.
    scene, start, truth = open_scene(world), Offsets.load(world / "start.json"), Offsets.load(world / "truth.json")
    tracks = [TrackSet.load(path) for path in sorted((world / "tracks").glob("*.npz"))]  # or None: tracked for you

    # Every choice is an object in a slot: Plan(scaffold=..., fit=FitOptions(losses=..., effects=..., densify=...))
    outcome = reconstruct(
        scene,
        start,
        out / "result",
        plan=Plan(width=160, backdrop_steps=300, fit=FitOptions(steps=steps)),
        tracks=tracks,
        held_out=("held0",),
        truth=truth,
        progress=Progress(print),
    )
    offsets = outcome.fitted.offsets
    for name, before, after, true in zip(
        offsets.names, outcome.coarse.frames, offsets.frames, outcome.truth, strict=True
    ):
        print(f"{name}: {before:6.3f} -> {after:6.3f} frames (true {true * 30:6.3f})")
    for view in outcome.views:
        print(f"{view.name}: {view.mean['psnr']:.2f} dB, {view.mean['mask_psnr']:.2f} dB where things move")

    # The scene can be asked for any time and from anywhere; its trajectories are an ordinary track set.
    result = load_result(out / "result")
    times = frame_times(result.scene, fps=30)
    write_images(rendered(result, times, "held0"), out / "held0.mp4")
    write_images(rendered(result, [0.4] * 60, width=240), out / "orbit.mp4")  # a frozen moment from all sides
    export(result.scene, Tracks(), out / "tracks.npz", times)
    export(result.scene, Ply(), out / "moment.ply", [0.4])
    print(f"wrote {out / 'orbit.mp4'}, {out / 'tracks.npz'}, {out / 'moment.ply'}, {out / 'result' / 'report.html'}")


if __name__ == "__main__":
    tyro.cli(main)
