"""``otsync simulate``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from ..files.claim import claimed
from ..sync.verb import unique_names
from ..types import Offsets

Preset = Literal["clean", "mid", "hard", "brutal"]


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
    own_frames: bool = False
    """Every video in a rotation, translation and scale of its own, for otsync sync --frames own."""
    seed: int = 0

    def run(self) -> int:
        with claimed(self.out, "otsync simulate"):
            return self._run()

    def _run(self) -> int:
        from ..simulate import simulate

        tracks, truth = simulate(
            self.motion,
            preset=self.preset,
            videos=self.videos,
            frames=self.frames,
            fps=self.fps,
            max_offset=self.max_offset,
            own_frames=self.own_frames,
            seed=self.seed,
        )
        stale = sorted({p.name for p in self.out.glob("*.npz")} - {f"{t.name}.npz" for t in tracks})
        if stale:
            raise ValueError(
                f"{self.out}: expected a folder without track sets of another world; it holds {stale[0]}. "
                "Choose another."
            )
        for t in tracks:
            t.save(self.out / f"{t.name}.npz")
        transforms = [truth.transform(0, v) for v in range(len(tracks))] if self.own_frames else []
        known = Offsets.known(unique_names(tracks), truth.offsets, self.fps, truth.rates, transforms)
        known.save(self.out / "truth.json")
        print(f"{self.out}: {', '.join(t.name + '.npz' for t in tracks)}, truth.json")
        return 0
