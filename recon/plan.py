"""What is done with a recording, and what is said while it happens."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from recon.checks import check_whole
from recon.density import Densify
from recon.device import device_of
from recon.effects import Effect
from recon.fit import LOSSES, Loss
from recon.motion import ScaffoldOptions
from recon.seed import Seeding

Tell = Callable[[str], None]
MapLike = Callable[..., Any]


@dataclass(frozen=True)
class Plan:
    """What is done with a recording.

    Args:
        width: working pixels. frames: first and last (exclusive) frame of every video; None: all.
        scaffold: how the motion is built. seeding: how densely Gaussians begin.
        losses, effects, densify: of the fit. The rolling shutters that cameras declare and the gains of the backdrop
            are added to the effects by themselves.
        freeze: parameter groups that the fit holds, "offsets" for instance.
        batch: images a step. On a CPU each is rendered on a thread of its own; on a GPU all are one rendering, unless
            a shutter or an exposure is modelled or the scene is drawn together with its static part.
        views: frames of every camera that are compared at the end. backdrop_steps: of the fit of the static part.
        save_every: seconds between savings of the fit.
        device: where static part and motion are fitted: "cpu", or "cuda" for a GPU; the rest is done on the CPU.

    ValueError names a number that makes no sense, and a device that is not there.
    """

    width: int = 320
    frames: tuple[int, int] | None = None
    scaffold: ScaffoldOptions = field(default_factory=ScaffoldOptions)
    seeding: Seeding = field(default_factory=Seeding)
    losses: tuple[Loss, ...] = LOSSES
    effects: tuple[Effect, ...] = ()
    densify: Densify | None = None
    freeze: tuple[str, ...] = ()
    batch: int = 2
    seed: int = 0
    views: int = 50
    backdrop_steps: int = 1500
    save_every: float = 60.0
    device: str = "cpu"

    def __post_init__(self) -> None:
        for name, least in (("width", 1), ("batch", 1), ("views", 1), ("backdrop_steps", 0)):
            check_whole(name, getattr(self, name), least)
        device_of(self.device)


class Progress:
    """Says what happens, remembers what was lacking, and times the stages."""

    def __init__(self, tell: Tell = lambda text: None):
        self.tell, self.notes, self.seconds = tell, [], {}  # type: Tell, list[str], dict[str, float]

    def note(self, text: str) -> None:
        """Something that the user should know when reading the result; said once, however often it is found."""
        if text not in self.notes:
            self.notes.append(text)
            self.tell(f"note: {text}")

    @contextmanager
    def stage(self, name: str):
        """Time what happens inside."""
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started
        self.tell(f"{name}: {self.seconds[name]:.1f} s")
