"""From a recording and its offsets to a 4D scene: every stage in order, each kept on disk so that a run continues.

    masks, tracks    otsync's own stages, shared with the synchronisation that came before
    depth            given maps; else visual hull and stereo of a static rig at the offsets
    footage          frames at working size, masked median backgrounds
    initial scene    static backdrop; scaffold through the lifted tracks; Gaussians seeded from depth
    fit              everything refined from the images, the offsets with it
    views            the finished scene against cameras that it has not seen

This is the one module of ``recon`` that calls otsync's algorithms; it imports them when it runs.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from otsync.files import write_json
from otsync.io import Scene
from otsync.io.mend import cut, keep_frames, unreadable
from otsync.types import Offsets, TrackSet, Video
from recon.backdrop import Backdrop
from recon.density import Densify
from recon.effects import Effect, Gain
from recon.fit import LOSSES, Loss, Reconstruction, fit
from recon.footage import Footage, footage_of, working_depth
from recon.gaussians4d import Gaussians4D, scene_arrays, scene_from_arrays
from recon.held_out import Clock, ViewScore, view
from recon.lpips import Lpips
from recon.motion import ScaffoldOptions, build_scaffold
from recon.optimize import RATES, without
from recon.result import FilmedBy, metrics_of, save_run

log = logging.getLogger("recon")

Tell = Callable[[str], None]
MapLike = Callable[..., Any]


@dataclass(frozen=True)
class Plan:
    """What is done with a recording.

    Args:
        width: working pixels. frames: first and last (exclusive) frame of every video; None: all.
        scaffold: how the motion is built. losses, effects, densify: of the fit; effects get the gains of the backdrop
            by themselves.
        freeze: parameter groups that the fit holds, "offsets" for instance.
        batch: images a step, each on a thread of its own.
        views: frames of every camera that are compared at the end.
    """

    width: int = 320
    frames: tuple[int, int] | None = None
    scaffold: ScaffoldOptions = field(default_factory=ScaffoldOptions)
    losses: tuple[Loss, ...] = LOSSES
    effects: tuple[Effect, ...] = ()
    densify: Densify | None = None
    freeze: tuple[str, ...] = ()
    batch: int = 2
    seed: int = 0
    views: int = 50


@dataclass(frozen=True, eq=False)
class Prepared:
    """What a fit of a recording begins with.

    Args:
        footage: of the training videos, in the order of ``offsets``. held_out: of the others.
        clocks: of the held-out videos, where the given offsets tell.
        offsets: of the training videos alone.
        initial: scene before any refinement. gains: (V,3) factors from its colours to each video's.
        notes: what was lacking, in words.
    """

    footage: tuple[Footage, ...]
    held_out: tuple[Footage, ...]
    clocks: dict[str, Clock]
    offsets: Offsets
    tracks: tuple[TrackSet, ...]
    initial: Gaussians4D
    gains: np.ndarray
    frame: str
    notes: tuple[str, ...] = ()


class Progress:
    """Says what happens, remembers what was lacking, and times the stages."""

    def __init__(self, tell: Tell = lambda text: None):
        self.tell, self.notes, self.seconds = tell, [], {}  # type: Tell, list[str], dict[str, float]

    def note(self, text: str) -> None:
        """Something that the user should know when reading the result."""
        self.notes.append(text)
        self.tell(f"note: {text}")

    @contextmanager
    def stage(self, name: str):
        """Time what happens inside."""
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started
        self.tell(f"{name}: {self.seconds[name]:.1f} s")
