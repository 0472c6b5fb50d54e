"""``recon bench`` and ``recon lifting``: on one recording whose clocks are known."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from otsync.progress import tell
from recon.bench.configurations import configurations
from recon.bench.fits import Protocol
from recon.bench.lifting import Lifting
from recon.cli.common import opened, print_json

if TYPE_CHECKING:
    from otsync.io import Scene
    from otsync.types import Offsets


def row_names() -> Any:
    """Tells the help which configurations there are, plugins' among them."""
    return tyro.conf.arg(metavar=f"[{{{'|'.join(configurations())}}} ...]")


@dataclass
class Bench:
    """Measure offsets, held-out views and coherence of motion on a synchronised recording with errors put in.

    Example: recon bench recording/ --held-out 0 --frames 20 68 --rows ours fixed "true time" --out bench

    On a simulated recording: recon bench world --truth world/truth.json --held-out held0 --width 160

    On a GPU, with the time and the most memory that it took: recon bench recording/ --held-out 0 --frames 0 150
    --width 640 --rows ours --steps 10000 --batch 8 --device cuda --out bench

    Whether anything got worse, on a small recording that is simulated: recon bench --gate

    Every option of a fit holds for all rows, but for what a row is about.
    """

    scene: tyro.conf.Positional[Path | None] = None
    """A scene.json, or a folder that holds one, or a folder in Panoptic layout; none for --gate and --rebase."""
    truth: Path | None = None
    """True offsets; default: all zero, a recording that is truly synchronised."""
    rows: Annotated[tuple[str, ...], row_names()] = ("ours", "fixed", "true time")
    """Configurations: see recon/bench/configurations.py."""
    out: Path = Path("bench/out")
    """Folder for recon.csv, .json and .md, and the stages; rows that it holds already are kept."""
    cache: Path | None = None
    """Folder where stages are kept; default: stages in --out."""
    name: str | None = None
    """Of the recording in the tables; one of the paper's scenes stands beside its figures; default: its folder's."""
    lpips_weights: Path | None = None
    """torchvision's weights of AlexNet; without them the LPIPS column says so."""
    protocol: Annotated[Protocol, tyro.conf.arg(name="")] = field(default_factory=Protocol)
    json: bool = False
    """Print the rows as one JSON document instead of tables."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""
    gate: bool = False
    """Measure a small simulated recording instead, and exit with 1 where it is worse than the committed baseline."""
    rebase: bool = False
    """Make the figures of the small simulated recording the baseline."""

    def run(self) -> int:
        from recon.bench.fits import run
        from recon.bench.gate import run as on_a_small_world
        from recon.bench.rows import paper_tables
        from recon.evaluate.lpips import Lpips

        if self.gate or self.rebase:
            self._check_alone()
            return on_a_small_world(self.out, gate=self.gate, rebase=self.rebase)
        if self.scene is None:
            raise ValueError("scene: expected a recording; found none. Name one, or measure a simulated one (--gate).")
        scene, truth = known_scene(self.scene, self.truth, self.protocol.held_out, self.allow_outside)
        path, lpips = self.scene.resolve(), Lpips.load(self.lpips_weights)
        name = self.name or (path if path.is_dir() else path.parent).name
        rows = run(
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
        wrote = f"wrote {self.out / 'recon.csv'}, {self.out / 'recon.json'} and {self.out / 'recon.md'}"
        if self.json:
            print_json({"recording": name, "rows": rows})
            tell(wrote)
        else:
            print(paper_tables(rows, name, lpips.reason))
            print(wrote)
        return 0

    def _check_alone(self) -> None:
        """ValueError for options that say how another recording is measured."""
        usual = {f.name: f.default if f.default_factory is MISSING else f.default_factory() for f in fields(self)}
        own = ("gate", "rebase", "out")
        others = [name for name, value in usual.items() if name not in own and getattr(self, name) != value]
        if others:
            raise ValueError(
                f"gate, rebase: expected no other option than out, since recording and protocol are the baseline's; "
                f"found {', '.join(others)}. Leave them out."
            )


@dataclass
class LiftingBench:
    """Measure the precision of matching with lifted features against averaged ones, and the cost of lifting.

    Example: recon lifting recording/ --frames 50 98 --held-out 0
    """

    scene: tyro.conf.Positional[Path]
    """A truly synchronised recording in metres: a scene.json, its folder, or a folder in Panoptic layout."""
    out: Path = Path("bench/out")
    """Folder for lifting.csv and lifting.json, and the stages."""
    cache: Path | None = None
    """Folder where stages are kept; default: stages in --out."""
    lifting: Annotated[Lifting, tyro.conf.arg(name="")] = field(default_factory=Lifting)
    json: bool = False
    """Print the figures as one JSON document instead of tables."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""

    def run(self) -> int:
        from recon.bench.lifting import run, tables

        scene, truth = known_scene(self.scene, None, self.lifting.held_out, self.allow_outside)
        rows, cost = run(scene, truth, self.out, lifting=self.lifting, cache=self.cache, tell=tell)
        wrote = f"wrote {self.out / 'lifting.csv'} and {self.out / 'lifting.json'}"
        if self.json:
            print_json({"rows": rows, "cost": cost})
            tell(wrote)
        else:
            print(tables(rows, cost))
            print(wrote)
        return 0


def known_scene(
    path: Path, truth: Path | None, held_out: tuple[str, ...], allow_outside: bool
) -> tuple[Scene, Offsets]:
    """A recording and its true offsets: those of a file, or all zero."""
    from otsync.types import Offsets

    scene = opened(path, allow_outside)
    if truth is not None:
        return scene, Offsets.load(truth)
    # the first is the reference, which must not be held out
    scene = scene.take([n for n in scene.names if n not in held_out] + [n for n in scene.names if n in held_out])
    return scene, Offsets.known(scene.names, np.zeros(len(scene.names)), scene.videos[0].fps or 30.0)
