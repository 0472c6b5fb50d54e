"""A set in Sync-NeRF's Blender layout, filmed by unsynchronised cameras: read, synchronised, fitted, and the tables.

python examples/12_sync_nerf.py --out out/sync-nerf
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro

from otsync.files.cache import Cache
from otsync.io import open_scene
from otsync.metrics import offset_error
from otsync.recordings import synchronize_scene
from otsync.types import Offsets
from recon.bench.paper_table import layout, number
from recon.fit import FitOptions
from recon.pipeline.plan import Plan
from recon.pipeline.verb import reconstruct
from recon.simulate import synthetic
from recon.simulate.sync_nerf import write_sync_nerf


def main(
    out: Path = Path("out/sync-nerf"),
    cameras: int = 6,
    frames: int = 60,
    width: int = 160,
    max_offset: float = 10.0,
    steps: int = 1200,
    backdrop_steps: int = 1000,
    seed: int = 4101,
) -> None:
    """Args:
    cameras: that are fitted; one more is held out. max_offset: frames. steps, backdrop_steps: of what moves and not.
    """
    folder, size = out / "walkers", (width, 3 * width // 5)
    if not (folder / "transforms.json").exists():  # as recon simulate walkers --layout sync-nerf does
        write_sync_nerf(synthetic(seed, cameras=cameras, frames=frames, size=size, offsets=max_offset), folder)
    scene, truth = open_scene(folder, reader="sync-nerf-blender"), Offsets.load(folder / "truth.json")
    held, fps, cache = scene.names[0], float(truth.fps[0]), Cache(out / "stages")

    unknown = replace(truth, seconds=np.zeros(len(truth)))
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        found = synchronize_scene(scene, reference=1, cache=cache, map=pool.map, tell=print).offsets
        settings = {"true time": truth, "clocks left at 0": unknown, "otsync": found}
        views, refined = {}, found
        for name, offsets in settings.items():
            fit = FitOptions(steps=steps, freeze=() if name == "otsync" else ("offsets",))
            plan = Plan(width=width, backdrop_steps=backdrop_steps, fit=fit)
            place = out / name.replace(" ", "-")
            done = reconstruct(scene, offsets, place, plan=plan, held_out=(held,), cache=cache, map=pool.map)
            views[name] = next((v.mean for v in done.views if v.name == held), {})
            refined = done.fitted.offsets if name == "otsync" else refined

    def error(offsets: Offsets) -> list[str]:
        """Mean and largest error in frames, of the videos that are fitted."""
        names = [n for n in offsets.names if n != held]
        own, true = (np.array([o.seconds[o.names.index(n)] for n in names]) for o in (offsets, truth))
        told = offset_error(own, true, fps, reference=0)
        return [number(told.mean, 3), number(told.max, 3)]

    rows = [[n, *error(o)] for n, o in (("initial", unknown), ("otsync sync", found), ("refined", refined))]
    print(layout(["dt error, frames", "mean", "largest"], rows, "markdown"))
    figures = {"PSNR": ("psnr", 2), "SSIM": ("ssim", 3), "PSNR where things move": ("mask_psnr", 2)}
    lines = [[k, *(number(v.get(key), digits) for v in views.values())] for k, (key, digits) in figures.items()]
    print(layout(["novel view", *views], lines, "markdown"))


if __name__ == "__main__":
    tyro.cli(main)
