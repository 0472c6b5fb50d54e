"""More Gaussians where the images ask for detail, fewer where none is seen (after Kerbl et al. 2023, sec. 5)."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from recon.motion import Scaffold
from recon.motion.density import grow, prune
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D

SPLIT_SHRINK = 1.6


@dataclass(frozen=True)
class Densify:
    """At some moments of the fit: split or clone the Gaussians whose 2-D means are pulled hardest, drop faint ones.

    Args:
        at: moments, as shares of all steps.
        share: of the Gaussians, that are split (larger than the median) or cloned (smaller).
        min_opacity: fainter ones are dropped.
        nodes: most nodes that a scaffold gains each time, where its Gaussians are pulled hardest; nodes that carry
            nothing go. 0: the scaffold keeps its nodes.
    """

    at: tuple[float, ...] = (0.3, 0.5)
    share: float = 0.1
    min_opacity: float = 0.05
    nodes: int = 0

    def __post_init__(self) -> None:
        if not all(0 < a < 1 for a in self.at):
            raise ValueError(f"Densify.at: expected shares of the fit strictly between 0 and 1; found {self.at}.")
        if not 0 <= self.share <= 1 or not 0 <= self.min_opacity < 1:
            raise ValueError(
                f"Densify: expected share in 0..1 and min_opacity in 0..1; found {self.share}, {self.min_opacity}."
            )

    def steps(self, steps: int) -> frozenset[int]:
        """The steps after which it is due."""
        return frozenset(max(1, round(a * steps)) for a in self.at)

    def __call__(self, scene: Gaussians4D, pull: Tensor) -> tuple[Gaussians4D, Tensor, Tensor]:
        """The denser scene, the old row of each of its Gaussians, and which of them are new.

        Args:
            pull: [N] mean length of the loss gradient with respect to the 2-D mean, over the images that drew it.
        """
        g = scene.dynamic
        alive = g.opacities >= self.min_opacity
        if not alive.any():
            raise ValueError("densify: every Gaussian has faded; expected some that are seen. Lower the rates.")
        wanted = torch.zeros_like(alive)
        count = int(self.share * int(alive.sum()))
        if count:
            wanted[torch.where(alive, pull, -torch.inf).topk(count).indices] = True
            wanted &= alive & (pull > 0)
        size = g.scales.amax(1)
        split = wanted & (size > size[alive].median())
        old = torch.cat([torch.nonzero(alive)[:, 0], torch.nonzero(wanted)[:, 0]])
        new = torch.arange(len(old), device=old.device) >= int(alive.sum())
        # a split replaces its parent: the kept row is one half, the new row the other
        side = torch.where(new, 1.0, -1.0) * split[old]
        halves = _moved(Gaussians(*(getattr(g, f.name)[old] for f in fields(g))), side, split[old])
        features = None if scene.features is None else scene.features[old]
        motion = scene.motion.take(old)
        return replace(scene, dynamic=halves, motion=motion, features=features), old, new | split[old]

    def scaffold(self, scene: Gaussians4D, pull: Tensor) -> tuple[Gaussians4D, Tensor | None]:
        """The scene on a scaffold with other nodes, and the old node of each (-1: new); None: the nodes stay.

        Args:
            pull: [N] as above, of the scene's Gaussians.
        """
        if not self.nodes or not isinstance(scene.motion, Scaffold):
            return scene, None
        grown = grow(scene.motion, scene.dynamic.means, pull, most=self.nodes)
        kept = prune(grown.scaffold)
        return replace(scene, motion=kept.scaffold), grown.source[kept.source]


def _moved(g: Gaussians, side: Tensor, split: Tensor) -> Gaussians:
    """Halves of split Gaussians: half a standard deviation along their longest axis, and smaller."""
    axis = torch.nn.functional.one_hot(g.scales.argmax(1), 3).to(g.means)
    q = torch.nn.functional.normalize(g.quats, dim=-1)
    w, v = q[:, :1], q[:, 1:]
    turned = axis + 2 * torch.linalg.cross(v, torch.linalg.cross(v, axis, dim=1) + w * axis, dim=1)
    shift = 0.5 * side[:, None] * g.scales.amax(1, keepdim=True) * turned
    smaller = g.log_scales - split[:, None] * torch.log(torch.tensor(SPLIT_SHRINK, device=split.device))
    return replace(g, means=g.means + shift, log_scales=smaller)
