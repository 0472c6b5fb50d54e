"""RAFT (Teed and Deng, ECCV 2020) of torchvision: optical flow for :class:`otsync.priors.ChainedFlow`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from .loading import device_of, digest_of, package, weights

LEAST = 128
"""Pixels of a side: RAFT halves an image thrice and correlates four levels of that."""


@dataclass(frozen=True)
class Raft:
    """RAFT with weights of torchvision's, from a local file (a state dict).

    Args:
        model: file of weights. size: which network they are of. updates: of the flow; fewer are faster and coarser.
        largest: pixels of the longer side that is seen; larger images are reduced, so that memory is bounded: the
            correlation takes (H W / 64)² numbers, 1.3 GB at 960 x 544.
        device: where it is computed.
    """

    model: str = "raft-small.pth"
    size: Literal["small", "large"] = "small"
    updates: int = 12
    largest: int = 640
    device: str = "auto"

    colour = True
    """It sees colours where others see grey."""

    def __post_init__(self) -> None:
        if self.size not in ("small", "large"):
            raise ValueError(f"size: expected small or large; found {self.size!r}.")
        for name, least in (("updates", 1), ("largest", LEAST)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected {least} or more; found {getattr(self, name)}.")

    @property
    def cache_key(self) -> Any:
        """Its fields, with the content of the weights in place of their name."""
        return ("Raft", self.size, self.updates, self.largest, digest_of(self._path()))

    def pair(
        self, before: UInt8[np.ndarray, "H W 3"], after: UInt8[np.ndarray, "H W 3"]
    ) -> tuple[Float[np.ndarray, "H W 2"], Float[np.ndarray, "H W 2"]]:
        """Pixels that each point moves by, from ``before`` to ``after`` and from ``after`` back, in one batch."""
        import cv2

        torch = package("torch", "learned")
        device = device_of(self.device)
        net = _network(self._path(), self.size, device)
        height, width = before.shape[:2]
        shrink = min(1.0, self.largest / max(height, width))
        h, w = (max(LEAST, -(-round(n * shrink) // 8) * 8) for n in (height, width))

        def seen(image: np.ndarray) -> Any:
            rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, -1)
            small = cv2.resize(rgb, (w, h), interpolation=cv2.INTER_AREA if shrink < 1 else cv2.INTER_LINEAR)
            return torch.from_numpy(small.transpose(2, 0, 1).astype(np.float32) / 127.5 - 1)

        first, second = seen(before), seen(after)
        with torch.inference_mode():
            flows = net(
                torch.stack([first, second]).to(device),
                torch.stack([second, first]).to(device),
                num_flow_updates=self.updates,
            )[-1]
        both = flows.float().cpu().numpy().transpose(0, 2, 3, 1)
        scale = np.array([width / w, height / h], np.float32)
        there, back = (cv2.resize(f, (width, height), interpolation=cv2.INTER_LINEAR) * scale for f in both)
        return there, back

    def _path(self) -> Path:
        return weights(self.model, "flow: raft", f"torchvision publishes them (Raft_{self.size.title()}_Weights).")


@cache
def _network(path: Path, size: str, device: str) -> Any:
    flow = package("torchvision.models.optical_flow", "learned")
    torch = package("torch", "learned")
    net = flow.raft_small(weights=None) if size == "small" else flow.raft_large(weights=None)
    try:
        net.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # unpickling errors, missing keys, shapes
        said = " ".join(str(error).split())[:200]
        raise ValueError(
            f"{path}: expected the state dict of torchvision's raft_{size}, without pickled objects; {said}. Choose "
            "size=large, or another file."
        ) from None
    return net.eval().to(device)
