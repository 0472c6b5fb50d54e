"""``recon simulate``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro


@dataclass
class Simulate:
    """Film a small simulated scene with unsynchronised cameras, and write it as a recording with its truth.

    Example: recon simulate world --cameras 5 --seed 3

    As a Blender scene of Sync-NeRF: recon simulate walkers --layout sync-nerf --cameras 13 --max-offset 10
    """

    out: tyro.conf.Positional[Path]
    """Folder for scene.json, images, masks, depth, tracks and truth.json."""
    layout: Literal["scene", "sync-nerf"] = "scene"
    """scene: ours, with all that was measured; sync-nerf: videos and transforms.json, as Sync-NeRF's Blender scenes
    come, and the truth; cameras that are held out come first there."""
    cameras: int = 5
    held_out: int = 1
    """Cameras between the others, for evaluation: they film at true world time."""
    frames: int = 48
    """Frames of every camera; fewer than 40 are few to synchronise by."""
    width: int = 320
    height: int = 192
    max_offset: float = 1.0
    """Largest offset, in frames."""
    gain: float = 0.0
    """Cameras differ in exposure and white balance: standard deviation of the logarithm. 0, like all below: absent."""
    vignetting: float = 0.0
    """Share of light that the corners of images lose, below 1."""
    noise: float = 0.0
    """White noise beyond the usual 1 %, in 0..1."""
    exposure: float = 0.0
    """Seconds that shutters are open: motion blur."""
    readout: float = 0.0
    """Seconds from the first to the last row: rolling shutter, which scene.json then declares."""
    sheen: float = 0.0
    """Strength of a lamp that what moves reflects, in 0..1: colours depend on the view."""
    pace: float = 1.0
    """How many times as fast as usual the bodies move; a limb swings about once a second."""
    seed: int = 0

    def run(self) -> int:
        from otsync.files.claim import claimed
        from otsync.progress import tell

        tell(f"filming {self.cameras + self.held_out} cameras, {self.frames} frames of each ...")
        with claimed(self.out, "recon simulate"):
            return self._run()

    def _run(self) -> int:
        from recon.simulate.capture import synthetic
        from recon.simulate.effects import Blur, DarkCorners, Exposure, MoreNoise, Rolling, Sheen
        from recon.simulate.recording import write_capture
        from recon.simulate.sync_nerf import write_sync_nerf

        wanted = (
            (Sheen, self.sheen),
            (Blur, self.exposure),
            (Rolling, self.readout),
            (Exposure, self.gain),
            (DarkCorners, self.vignetting),
            (MoreNoise, self.noise),
        )
        if not 0 <= self.vignetting < 1:
            raise ValueError(f"--vignetting: expected a share of 0 or more, below 1; found {self.vignetting:g}.")
        if not all(0 <= size < math.inf for _, size in wanted):
            raise ValueError("--gain, --noise, --exposure, --readout, --sheen: expected numbers of 0 or more.")
        if not 0 < self.pace < math.inf:
            raise ValueError(f"--pace: expected a number > 0; found {self.pace:g}.")
        capture = synthetic(
            self.seed,
            cameras=self.cameras,
            held_out=self.held_out,
            frames=self.frames,
            size=(self.width, self.height),
            offsets=self.max_offset,
            effects=tuple(effect(size) for effect, size in wanted if size),
            pace=self.pace,
        )
        if self.layout == "sync-nerf":
            names = write_sync_nerf(capture, self.out)
            first = " ".join(names[: self.held_out])
            print(f"{self.out}: {len(names)} videos, held out: {first or 'none'}; truth.json, start.json")
            print(f"try: otsync sync {self.out} --truth {self.out}/truth.json --out synchronised")
            return 0
        write_capture(capture, self.out)
        held = " ".join(f.name for f in capture.held_out)
        print(f"{self.out}: {len(capture.footage)} cameras, held out: {held or 'none'}; truth.json, start.json")
        print(f"try: otsync sync {self.out} --truth {self.out}/truth.json --out synchronised")
        print(
            f"or:  recon fit {self.out} --offsets {self.out}/start.json --tracks {self.out}/tracks/*.npz "
            f"--truth {self.out}/truth.json --width {self.width} --steps 1500 --out result"
            + (f" --held-out {held}" if held else "")
        )
        return 0
