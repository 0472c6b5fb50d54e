"""Options of a fit, for the shell."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon.fit.densify import Densify
from recon.motion import ScaffoldOptions
from recon.scene.seed import Seeding

if TYPE_CHECKING:
    from recon.pipeline.plan import Plan


@dataclass(frozen=True)
class FitOptions:
    """How a scene is fitted."""

    held_out: tuple[str, ...] = ()
    """Names of videos that the fit does not see: the finished scene is held against them."""
    width: int = 320
    """Working pixels of an image's width."""
    frames: tuple[int, int] | None = None
    """First and last (exclusive) frame of every video to use; default: all."""
    budget: float | None = None
    """Seconds for the fit, after everything is prepared; default: 300."""
    steps: int | None = None
    """Steps of the fit instead of seconds: the result is then the same on any machine of a kind."""
    freeze: tuple[str, ...] = ()
    """Parameter groups that stay as they are: offsets, gain, knots, ..."""
    batch: int = 2
    """Images a step, on a CPU each on a thread of its own."""
    device: str = "cpu"
    """cpu, or cuda for a GPU with gsplat: where the fits run."""
    backdrop_steps: int = 1500
    """Steps of the fit of the static part, before anything moves."""
    seed: int = 0
    densify: Densify | None = None
    """Split what is pulled hardest, drop what is faint; off unless asked for."""
    scaffold: ScaffoldOptions = field(default_factory=ScaffoldOptions)
    voxel: float = Seeding.voxel
    """Working pixels between the Gaussians that what moves begins with: finer is slower and shows more."""
    sh_degree: int = Seeding.sh_degree
    """Harmonics of the colours of what moves, 1 to 4 where they depend on the view (sheen); 0: they do not."""
    exposure: float = 0.0
    """Seconds that the shutters were open, where moving things are blurred; 0: sharp. Readouts are in the scene."""
    save_every: float = 60.0
    """Seconds between two savings of the fit, from the last of which a killed run continues."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""
    cache: Path | None = None
    """Folder where stages are kept; default: stages in --out."""
    workers: int = 0
    """Threads of the stages before the fit; 0: one per core."""

    def plan(self) -> Plan:
        """The pipeline's form of this."""
        from recon.observe.effects import MotionBlur
        from recon.pipeline.plan import Plan

        return Plan(
            effects=(MotionBlur(self.exposure),) if self.exposure else (),
            width=self.width,
            frames=self.frames,
            scaffold=self.scaffold,
            seeding=Seeding(self.voxel, sh_degree=self.sh_degree),
            densify=self.densify,
            freeze=self.freeze,
            batch=self.batch,
            seed=self.seed,
            backdrop_steps=self.backdrop_steps,
            save_every=self.save_every,
            device=self.device,
        )

    def length(self) -> dict[str, Any]:
        """Steps or budget, as :func:`recon.fit.fit` takes them."""
        if self.steps is not None and self.budget is not None:
            raise ValueError("--steps, --budget: expected one of them; found both.")
        if self.steps is not None:
            if self.steps < 0:
                raise ValueError(f"--steps: expected 0 or more; found {self.steps}.")
            return {"steps": self.steps}
        budget = 300.0 if self.budget is None else self.budget
        if not 0 < budget < math.inf:
            raise ValueError(f"--budget: expected seconds above 0; found {budget:g}.")
        return {"budget": budget}
