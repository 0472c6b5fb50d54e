"""LPIPS by torchmetrics' code, with weights that the user has; nothing is ever downloaded.

The metric (Zhang et al. 2018) needs the backbone of a classifier, about 10 MB (SqueezeNet) to 550 MB (VGG), which
torchvision publishes as a state dict, and small linear heads, which come with torchmetrics. Without either there is no
figure, and tables say why.
"""

from __future__ import annotations

import importlib.util
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

MAX_BYTES = 2 * 2**30  # no published backbone comes near
SMALLEST = 64  # pixels on a side: the backbones halve an image several times


@dataclass(frozen=True, eq=False)
class Lpips:
    """The distance where there is a network, else the reason why there is none.

    Args:
        network: maps two batches [1,3,h,w] in -1..1 to their distance, or None.
        reason: what is missing; "" when nothing is.
    """

    network: Any = None
    reason: str = "no weights given"

    @classmethod
    def load(cls, weights: str | os.PathLike[str] | None, net: Literal["alex", "vgg", "squeeze"] = "alex") -> Lpips:
        """From a file of torchvision's backbone weights (``alexnet``, ``vgg16``, ``squeezenet1_1``).

        Without a path, or without torchmetrics and torchvision, the result has a reason instead of a network. A file
        that does not fit is a ValueError.
        """
        if weights is None:
            return cls()
        missing = [name for name in ("torchmetrics", "torchvision") if importlib.util.find_spec(name) is None]
        if missing:
            return cls(reason=f"no {' and no '.join(missing)}")
        backbone = _read(Path(weights))
        try:
            module = importlib.import_module("torchmetrics.functional.image.lpips")
        except (ImportError, RuntimeError, OSError) as error:  # a torchvision that was built for another torch
            return cls(reason=f"torchmetrics cannot be imported ({error})")
        # heads from torchmetrics' own folder; a random backbone, so that nothing is fetched
        network = module._LPIPS(pretrained=True, net=net, pnet_rand=True)
        own = {key: "features." + re.sub(r"^slices?\.?\d+\.", "", key) for key in network.net.state_dict()}
        absent = sorted(set(own.values()) - backbone.keys())
        if absent:
            raise ValueError(
                f"{weights}: expected torchvision's weights of the {net} backbone; found no {absent[0]}. "
                "Give the file of that network."
            )
        try:
            network.net.load_state_dict({key: backbone[theirs] for key, theirs in own.items()})
        except RuntimeError as error:
            raise ValueError(f"{weights}: expected the weights of the {net} backbone; found others: {error}") from None
        return cls(network.eval(), "")

    def __call__(self, image: Tensor, reference: Tensor) -> float:
        """Distance of two images [h,w,3] in 0..1; nan without a network, and below 64 pixels on a side."""
        if self.network is None or min(image.shape[:2]) < SMALLEST:
            return float("nan")
        with torch.no_grad():
            x, y = (2 * t.detach().float().cpu().movedim(-1, 0)[None] - 1 for t in (image, reference))
            return float(self.network(x, y).squeeze())


def _read(path: Path) -> dict[str, Tensor]:
    """A state dict of tensors. ValueError for anything else."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a file of backbone weights; found none.")
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path}: expected a backbone of at most {MAX_BYTES >> 30} GiB; found more.")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds
        raise ValueError(
            f"{path}: expected a state dict of tensors; found a file that does not load ({error})."
        ) from None
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise ValueError(f"{path}: expected a state dict of tensors, as torchvision publishes; found something else.")
    return state
