"""``recon fit``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from recon.cli.common import opened, reconstructed
from recon.cli.options import FitOptions

if TYPE_CHECKING:
    pass


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
