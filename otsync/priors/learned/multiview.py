"""Depth of several images at once by a feed-forward model: Depth Anything 3 (Lin et al., 2025).

Its package asks for versions of others that ours does not go with, so it is installed without them: of it the network
alone is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from ...files.arrays import read_json
from ...types import Camera
from ..depth_scale import Gives
from .backbones import MEAN, STD
from .loading import device_of, digest_of, dtype_of, package, weights

PATCH = 14
"""Pixels that the sides of an image are multiples of."""

INSTALL = (
    "Install it without the packages that it names, whose versions exclude ours: pip install --no-deps "
    "depth-anything-3, then pip install einops omegaconf addict safetensors."
)


@dataclass(frozen=True)
class DepthAnything3:
    """Depth Anything 3 on neighbouring frames of a video, whose depth then agrees; it is told the poses of a camera
    that moves.

    Args:
        model: folder of weights (model.safetensors, and config.json that names the network).
        network: what the weights are of, where no config.json says so: da3-small, da3-base, da3-large, da3-giant,
            da3mono-large or da3metric-large.
        views: frames that are looked at together. largest: pixels of their longer side. Memory is bounded by both: a
            network's attention grows with the square of views x pixels.
        poses: tell the network the cameras' poses, where it takes them and the camera moves.
        device, dtype: where and in which numbers it is computed.
    """

    model: str = "da3-small"
    network: str = "da3-small"
    views: int = 8
    largest: int = 504
    poses: bool = True
    device: str = "auto"
    dtype: str = "float32"

    def __post_init__(self) -> None:
        for name, least in (("views", 1), ("largest", 4 * PATCH)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected {least} or more; found {getattr(self, name)}.")

    @property
    def gives(self) -> Gives:
        """Depth up to a scale."""
        return "depth"

    @property
    def together(self) -> int:
        """What it says of a frame depends on those beside it."""
        return self.views

    @property
    def cache_key(self) -> Any:
        """Its fields, with the content of the weights in place of their name; where it computes does not count."""
        held = {k: v for k, v in vars(self).items() if k not in ("model", "device")}
        return ("DepthAnything3", tuple(sorted(held.items())), digest_of(self._path()))

    def __call__(
        self, images: Sequence[UInt8[np.ndarray, "H W 3"]], cameras: Sequence[Camera]
    ) -> Float[np.ndarray, "B h w"]:
        """Maps of the images, their longer side about ``largest``, all in one unit."""
        import cv2

        torch = package("torch", "learned")
        device = device_of(self.device)
        net = _network(self._path(), self.network, device)
        scale = self.largest / max(images[0].shape[:2])
        h, w = (max(PATCH, round(n * scale / PATCH) * PATCH) for n in images[0].shape[:2])
        shrinks = w < images[0].shape[1]
        seen = [cv2.resize(i, (w, h), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC) for i in images]
        normal = (np.stack(seen).astype(np.float32) / 255 - np.array(MEAN, np.float32)) / np.array(STD, np.float32)
        told: tuple[Any, ...] = ()
        if self.poses and net.cam_enc is not None and (poses := told_poses(cameras)) is not None:
            K = np.stack([c.K * [[w / c.width], [h / c.height], [1.0]] for c in cameras])
            told = tuple(torch.from_numpy(x[None].astype(np.float32)).to(device) for x in (poses, K))
        kind = device.partition(":")[0]
        with torch.inference_mode(), torch.autocast(kind, dtype=dtype_of(self.dtype), enabled=self.dtype != "float32"):
            pixels = torch.from_numpy(np.ascontiguousarray(normal.transpose(0, 3, 1, 2)))[None].to(device)
            depth = net(pixels, *told).depth.float()
        return depth.reshape(len(images), *depth.shape[-2:]).cpu().numpy()

    def _path(self) -> Path:
        said = "Download a folder of weights (model.safetensors, config.json) from the model's page, such as DA3-SMALL."
        return weights(self.model, "depth: depth-anything3", said)


def told_poses(cameras: Sequence[Camera]) -> Float[np.ndarray, "B 4 4"] | None:
    """World to camera, in the first one's axes and in units of the median distance to it; None where all stand alike.

    The network was trained on poses of this form.
    """
    w2c = np.stack([c.w2c for c in cameras])
    relative = w2c @ np.linalg.inv(w2c[0])
    away = np.linalg.norm(np.linalg.inv(relative)[:, :3, 3], axis=1)
    if len(cameras) < 2 or away.max() < 1e-9:
        return None
    relative[:, :3, 3] /= np.median(away) if np.median(away) > 1e-9 else away.max()
    return relative


@cache
def _network(path: Path, network: str, device: str) -> Any:
    cfg, registry = (package(f"depth_anything_3.{n}", remedy=INSTALL) for n in ("cfg", "registry"))
    package("depth_anything_3.model.da3", remedy=INSTALL)
    tensors = package("safetensors.torch", remedy=INSTALL)
    package("depth_anything_3.utils.logger", remedy=INSTALL).logger.level = 0  # it writes to stdout, where results go
    file = path / "model.safetensors" if path.is_dir() else path
    if not file.is_file():
        raise FileNotFoundError(f"{path}: expected model.safetensors in it; found none. Put the file there.")
    if path.is_dir() and (path / "config.json").is_file():
        network = str(read_json(path / "config.json").get("model_name", network))
    known = [name for name in registry.MODEL_REGISTRY if "nested" not in name]
    if network not in known:
        raise ValueError(f"{path}: network: expected one of {', '.join(known)}; found {network!r}. Choose one.")
    net = cfg.create_object(cfg.load_config(registry.MODEL_REGISTRY[network]))
    try:
        state = {name.removeprefix("model."): value for name, value in tensors.load_file(str(file)).items()}
        missing, _ = net.load_state_dict(state, strict=False)
        # of layers that share their numbers a file holds one
        own = net.state_dict()
        held = {value.data_ptr() for name, value in own.items() if name in state}
        wanted = [n for n in missing if own[n].data_ptr() not in held and not n.startswith(("gs_head", "gs_adapter"))]
    except Exception as error:  # the format's own errors, and shapes that do not fit
        wanted = [" ".join(str(error).split())[:160]]
    if wanted:
        raise ValueError(
            f"{path}: expected the weights of {network}; {wanted[0]} is not as it should be. Choose network=, or "
            "another file."
        )
    return net.eval().to(device)
