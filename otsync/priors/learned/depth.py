"""Depth of single images by any estimator of ``transformers``: Depth Anything, DPT (MiDaS), ZoeDepth, Depth Pro, ..."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from ...files.arrays import read_json
from ...types import Camera
from ..depth_scale import Gives, brought
from .backbones import MEAN, STD
from .loading import device_of, digest_of, package, pretrained, weights
from .tiles import tiled

SAYS: dict[str, Gives] = {
    "dpt": "relative",
    "depth_pro": "inverse",
    "zoedepth": "depth",
    "glpn": "depth",
    "tipsv2_dpt": "depth",
}
"""What the values of transformers' models are, by type; Depth Anything says it in its configuration."""

LEAST = 32
"""Pixels that the sides of an image are made multiples of, where a model tells nothing."""

Run = Callable[[Float[np.ndarray, "B h w 3"]], Float[np.ndarray, "B h w"]]


@dataclass(frozen=True, eq=False)
class Estimator:
    """A model that runs: its file, what it gives, what sides are multiples of, its only size (h, w) or None."""

    path: Path
    run: Run
    gives: Gives | None
    stride: int
    fixed: tuple[int, int] | None
    mean: tuple[float, ...]
    std: tuple[float, ...]
    kind: str


@dataclass(frozen=True)
class TransformersDepth:
    """Any depth estimator of transformers, from a local folder (safetensors).

    Args:
        model: folder of weights: a path, or a name in the folder of weights.
        output: what its values are, where the model's type does not tell: "relative" (inverse depth up to scale and
            shift), "inverse" (inverse depth up to scale) or "depth" (up to scale).
        tile: pixels of the longer side of what is seen at once: memory is bounded by it. It should be near to what the
            model was trained on.
        detail: longer side of the image that is looked at, in tiles. 1: it is seen as a whole. 2: then also in parts
            of twice the size, each brought to the whole and blended into its neighbours, for five times the cost.
        overlap: share of a tile that it has in common with the next one.
        batch: images or tiles at once. device, dtype: where and in which numbers it is computed.
    """

    model: str = "depth-anything-v2-small"
    output: Literal["auto", "relative", "inverse", "depth"] = "auto"
    tile: int = 518
    detail: float = 1.0
    overlap: float = 0.25
    batch: int = 1
    device: str = "auto"
    dtype: str = "float32"

    def __post_init__(self) -> None:
        if self.output not in ("auto", "relative", "inverse", "depth"):
            raise ValueError(f"output: expected auto, relative, inverse or depth; found {self.output!r}.")
        for name, least in (("tile", LEAST), ("batch", 1)):
            if not getattr(self, name) >= least:
                raise ValueError(f"{name}: expected {least} or more; found {getattr(self, name)}.")
        if not 1 <= self.detail <= 8:
            raise ValueError(f"detail: expected 1 to 8; found {self.detail:g}.")
        if not 0.05 <= self.overlap <= 0.75:
            raise ValueError(f"overlap: expected a share of the tile, .05 to .75; found {self.overlap:g}.")

    def loaded(self) -> Estimator:
        """The model, made once a process."""
        said = (
            "Save an estimator there: AutoModelForDepthEstimation.from_pretrained(NAME).save_pretrained(FOLDER), with "
            "its preprocessor."
        )
        path = weights(self.model, f"depth: {type(self).__name__}", said)
        return _estimator(path, device_of(self.device), self.dtype)

    @property
    def gives(self) -> Gives:
        """What its values are. ValueError where neither the model nor ``output`` says it."""
        if self.output != "auto":
            return self.output
        model = self.loaded()
        if model.gives is None:
            raise ValueError(
                f"output: expected relative, inverse or depth for {model.path}, since a model of type {model.kind!r} "
                "does not tell what its values are; found auto. Name one (output=depth)."
            )
        return model.gives

    @property
    def cache_key(self) -> Any:
        """Its fields, with the content of the weights in place of their name; where it computes does not count."""
        held = {k: v for k, v in vars(self).items() if k not in ("model", "device", "batch")}
        return (type(self).__name__, tuple(sorted(held.items())), digest_of(self.loaded().path))

    def __call__(
        self, images: Sequence[UInt8[np.ndarray, "H W 3"]], cameras: Sequence[Camera] = ()
    ) -> Float[np.ndarray, "B h w"]:
        """Maps as the model gives them, the longer side about ``detail * tile``; cameras are not looked at."""
        model = self.loaded()
        if model.fixed and self.tile != TransformersDepth.tile:
            raise ValueError(
                f"tile: expected none for {model.path}, which sees {model.fixed[1]} x {model.fixed[0]} pixels; found "
                f"{self.tile}. Leave it out."
            )
        out = []
        for first in range(0, len(images), self.batch):
            some = images[first : first + self.batch]
            whole = model.run(np.stack([self._seen(model, image, 1.0) for image in some]))
            out += [
                w if self.detail == 1 else self._in_tiles(model, image, w) for image, w in zip(some, whole, strict=True)
            ]
        return np.stack(out).astype(np.float32)

    def _in_tiles(self, model: Estimator, image: np.ndarray, whole: np.ndarray) -> Float[np.ndarray, "h w"]:
        """Tiles of a larger image, each with the scale and shift that bring it to the whole one's."""
        import cv2

        rgb = self._seen(model, image, self.detail)
        rough = cv2.resize(whole.astype(np.float32), rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        side = max(model.stride, self.tile // model.stride * model.stride)
        h, w = (min(n, most) for n, most in zip(rgb.shape[:2], model.fixed or (side, side), strict=True))
        shift = self.gives == "relative"

        def run(batch: Float[np.ndarray, "B h w 4"]) -> Float[np.ndarray, "B h w 1"]:
            found = model.run(np.ascontiguousarray(batch[..., :3]))
            return np.stack([agreeing(d, like, shift) for d, like in zip(found, batch[..., 3], strict=True)])[..., None]

        seen = np.concatenate([rgb, rough[..., None]], -1)
        overlap = max(1, round(self.overlap * min(h, w)))
        return tiled(seen, run, tile=(h, w), overlap=overlap, stride=1, batch=self.batch)[..., 0]

    def _seen(self, model: Estimator, image: np.ndarray, detail: float) -> Float[np.ndarray, "h w 3"]:
        """The image as the model sees it: its longer side ``detail * tile``, both sides multiples of its stride."""
        import cv2

        if model.fixed:
            height, width = (round(n * detail) for n in model.fixed)
        else:
            scale = detail * self.tile / max(image.shape[:2])
            height, width = (max(model.stride, round(n * scale / model.stride) * model.stride) for n in image.shape[:2])
        shrinks = width < image.shape[1]
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        return (small.astype(np.float32) / 255 - np.array(model.mean, np.float32)) / np.array(model.std, np.float32)


@dataclass(frozen=True)
class DepthAnything2(TransformersDepth):
    """Depth Anything V2 (Yang et al., NeurIPS 2024): the small one by default."""


def agreeing(d: Float[np.ndarray, "h w"], like: Float[np.ndarray, "h w"], shift: bool) -> Float[np.ndarray, "h w"]:
    """``d`` with the scale and shift that bring it to ``like``; where the two contradict each other ``like`` itself."""
    ok = np.isfinite(d) & np.isfinite(like)
    if ok.sum() < 16:
        return like
    every = max(1, int(ok.sum()) // 4000)
    a, b = brought(d[ok][::every].astype(float), like[ok][::every].astype(float), shift=shift)
    return (a * d + b).astype(np.float32) if a > 0 else like


@cache
def _estimator(path: Path, device: str, dtype: str) -> Estimator:
    torch = package("torch", "learned")
    model = pretrained("AutoModelForDepthEstimation", path, device, dtype, "a depth estimator")
    config = model.config
    told: dict[str, Any] = {}
    if (path / "preprocessor_config.json").is_file():
        told = read_json(path / "preprocessor_config.json")

    def run(batch: np.ndarray) -> np.ndarray:
        pixels = torch.from_numpy(np.ascontiguousarray(batch.transpose(0, 3, 1, 2)))
        with torch.inference_mode():
            out = model(pixel_values=pixels.to(device, model.dtype)).predicted_depth.float()
            if out.shape[-2:] != batch.shape[1:3]:
                size = tuple(batch.shape[1:3])
                out = torch.nn.functional.interpolate(out[:, None], size, mode="bilinear", align_corners=False)[:, 0]
        return out.cpu().numpy()

    kind = str(config.model_type)
    gives = SAYS.get(kind)
    if kind == "depth_anything":
        gives = "depth" if getattr(config, "depth_estimation_type", "relative") == "metric" else "relative"
    fixed = None
    if kind == "depth_pro":  # it looks at one size, in patches of its own
        fixed = (round(config.patch_size / min(config.scaled_images_ratios)),) * 2
    elif kind == "dpt" and (config.is_hybrid or config.backbone_config is None):  # its neck knows squares alone
        fixed = (int(config.image_size),) * 2
    mean, std = tuple(told.get("image_mean", MEAN)), tuple(told.get("image_std", STD))
    if not told.get("do_normalize", True):
        mean, std = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    return Estimator(path, run, gives, _stride(config, told), fixed, mean, std, kind)


def _stride(config: Any, told: dict[str, Any]) -> int:
    """What the sides of an image are multiples of: as the preprocessor says, else the backbone's patch."""
    backbone = getattr(config, "backbone_config", None)
    sizes = [told.get("ensure_multiple_of"), told.get("size_divisor")]
    sizes += [getattr(c, "patch_size", None) for c in (backbone, config)]
    return next((int(n) for n in sizes if isinstance(n, int) and n > 1), LEAST)
