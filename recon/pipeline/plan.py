"""How a recording is reconstructed: one dataclass for Python, ``recon fit``, ``otsync run`` and ``recon bench``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from otsync.types.checks import check_whole, positive
from recon.fit.options import FitOptions
from recon.motion import ScaffoldOptions
from recon.observe import Effect, MotionBlur
from recon.pipeline.feature_maps import maps_from
from recon.pipeline.readings import read_by
from recon.scene.device import device_of
from recon.scene.seed import Seeding


@dataclass(frozen=True)
class Plan:
    """How a recording is reconstructed. ValueError names an option that makes no sense, and a missing device."""

    width: int = 320
    """Working pixels of an image's width."""
    frames: tuple[int, int] | None = None
    """First and last (exclusive) frame of every video to use; default: all."""
    fit: Annotated[FitOptions, tyro.conf.arg(name="")] = field(default_factory=FitOptions)
    """How the scene is fitted to its videos."""
    exposure: float = 0.0
    """Seconds that the shutters were open, where moving things are blurred: short for --effects
    motion-blur:exposure=S.
    """
    bend: float = 0.2
    """Frames, at the most, by which clocks are bent before the fit: what it leaves of that tells how much of the
    clocks' own error it leaves. 0: none are bent, and sigma counts on what fits of such a length usually leave.
    """
    scaffold: ScaffoldOptions = field(default_factory=ScaffoldOptions)
    """How the motion is built."""
    seeding: Seeding = field(default_factory=Seeding)
    """How densely Gaussians begin."""
    features: str | None = None
    """Feature maps, lifted into the Gaussians: lab, daisy, a backbone (dinov3, dinov2, transformers, onnx), each with
    :FIELD=VALUE,... where needed. The loss feature trains what is lifted; otsync run matches dense tracks by it.
    """
    backdrop_steps: int = 1500
    """Steps of the fit of the static part, before anything moves."""
    views: int = 50
    """Frames of every held-out camera that are compared at the end; of two others a quarter as many."""
    device: str = "cpu"
    """cpu, or cuda for a GPU with gsplat: where static part and motion are fitted; the rest is done on the CPU."""

    def __post_init__(self) -> None:
        for name, least in (("width", 1), ("views", 1), ("backdrop_steps", 0)):
            check_whole(name, getattr(self, name), least)
        positive("bend", self.bend, zero=True)
        if self.frames is not None and not 0 <= self.frames[0] < self.frames[1]:
            raise ValueError(f"frames: expected first < stop, from 0; found {self.frames[0]} {self.frames[1]}.")
        if self.exposure and any(isinstance(effect, MotionBlur) for effect in self.fit.effects):
            raise ValueError("exposure, effects: expected motion blur from one of them; found it in both.")
        if "bends" in self.fit.freeze:
            raise ValueError(
                "freeze: expected no bends, which only a fit takes out again; found bends. Give bend 0 to go without."
            )
        read_by(self.fit.losses, self.features)
        if self.features is not None:
            maps_from(self.features)
        device_of(self.device)
        _ = self.effects

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects that were asked for: those of the fit, and the blur of ``exposure`` before them."""
        return (MotionBlur(self.exposure), *self.fit.effects) if self.exposure else self.fit.effects
