"""What is done with a recording, and what is said while it happens."""

from __future__ import annotations

from dataclasses import dataclass, field

from otsync.types.checks import check_whole
from recon.fit.densify import Densify
from recon.fit.problem import Loss
from recon.fit.verb import LOSSES
from recon.motion import ScaffoldOptions
from recon.observe.effects import Effect
from recon.scene.device import device_of
from recon.scene.seed import Seeding


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
