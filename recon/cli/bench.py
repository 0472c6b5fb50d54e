"""``recon bench``: configurations of the field, and ablations, on one recording whose clocks are known."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from recon.bench.fits import Protocol
from recon.bench.lifting import Lifting


@dataclass
class Bench:
    """Measure offsets, held-out views and coherence of motion on a synchronised recording with errors put in.

    Example: recon bench recording/ --held-out 0 --frames 20 68 --rows ours fixed "true time" --out bench

    On a simulated recording: recon bench world --truth world/truth.json --held-out held0 --width 160

    On a GPU, with the time and the most memory that it took: recon bench recording/ --held-out 0 --frames 0 150
    --width 640 --rows ours --steps 10000 --batch 8 --device cuda --out bench

    Lifted features against averaged ones, for the matcher: recon bench recording/ --suite lifting --frames 50 98
    """

    scene: tyro.conf.Positional[Path]
    """A scene.json, or a folder that holds one, or a folder in Panoptic layout."""
    suite: Literal["fit", "lifting"] = "fit"
    """fit: offsets and views by configuration. lifting: precision of matching with lifted features, and their cost."""
    truth: Path | None = None
    """True offsets; default: all zero, a recording that is truly synchronised."""
    rows: tuple[str, ...] = ("ours", "fixed", "true time")
    """Configurations: see recon/configurations.py."""
    out: Path = Path("bench/out")
    """Folder for recon.csv, .json and .md (lifting.csv and .json), and the stages; rows that it holds already are kept."""
    cache: Path | None = None
    """Folder where stages are kept; default: stages in --out."""
    name: str | None = None
    """Of the recording in the tables; one of the paper's scenes stands beside its figures; default: its folder's."""
    lpips_weights: Path | None = None
    """torchvision's weights of AlexNet; without them the LPIPS column says so."""
    protocol: tyro.conf.OmitArgPrefixes[Protocol] = field(default_factory=Protocol)
    lifting: Lifting = field(default_factory=Lifting)
    allow_outside: bool = False
    """Let the scene name files outside its folder."""

    def run(self) -> int:
        from otsync.io import open_scene
        from otsync.types import Offsets
        from recon.bench import lifting as bench_lifting
        from recon.bench.fits import run
        from recon.bench.rows import paper_tables
        from recon.evaluate.lpips import Lpips

        scene = open_scene(self.scene, allow_outside=self.allow_outside)
        if self.truth is None:  # the first is the reference, which must not be held out
            held = self.protocol.held_out
            scene = scene.take([n for n in scene.names if n not in held] + [n for n in scene.names if n in held])
            truth = Offsets.known(scene.names, np.zeros(len(scene.names)), scene.videos[0].fps or 30.0)
        else:
            truth = Offsets.load(self.truth)
        if self.suite == "lifting":
            bench_lifting.run(
                scene, truth, self.out, protocol=self.protocol, lifting=self.lifting, cache=self.cache, tell=tell
            )
            print(f"wrote {self.out / 'lifting.csv'} and {self.out / 'lifting.json'}")
            return 0
        path, lpips = self.scene.resolve(), Lpips.load(self.lpips_weights)
        name = self.name or (path if path.is_dir() else path.parent).name
        found = run(
            scene,
            truth,
            self.out,
            protocol=self.protocol,
            rows=self.rows,
            cache=self.cache,
            tell=tell,
            name=name,
            lpips=lpips,
        )
        print(paper_tables(found, name, lpips.reason))
        print(f"wrote {self.out / 'recon.csv'}, {self.out / 'recon.json'} and {self.out / 'recon.md'}")
        return 0


def tell(text: str) -> None:
    """A line of progress."""
    print(text, file=sys.stderr, flush=True)
