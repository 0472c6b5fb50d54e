"""Features of tracks by vision backbones: any of ``transformers`` (DINOv3, DINOv2, ...), and any ONNX model."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...files.arrays import read_json
from ...files.strict import nearest
from ..features import samples
from ..working import WorkingFrames, bilinear
from .loading import device_of, digest_of, package, pretrained, weights
from .tiles import Run, tiled

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet's colours: what backbones are trained on, where no file says otherwise."""

PATCHES = (14, 16, 8, 32, 4)
"""Sizes of patches that are tried where a model does not tell its own, in the order of how common they are."""

PROBE = 224
"""Pixels of the image that tells how far apart features lie: a multiple of all usual patches."""

MOST_PREFIX = 16
"""Tokens before those of patches: one of the class, and registers."""


@dataclass(frozen=True)
class Dense:
    """What backbones share: a map of features a frame, read at the tracks and averaged over their lives.

    Args:
        model: file or folder of weights: a path, or a name in the folder of weights.
        tile: pixels of the largest image that is seen at once: memory is bounded by it. overlap: pixels that tiles
            share. batch: tiles at once. scale: of the image before it is seen; 2 gives finer maps at four times the
            cost.
        every: frames between samples at 30 fps.
        device, dtype: where and in which numbers it is computed.
    """

    model: str = ""
    tile: int = 448
    overlap: int = 112
    batch: int = 1
    scale: float = 1.0
    every: int = 12
    device: str = "auto"
    dtype: str = "float32"

    def __post_init__(self) -> None:
        for name in ("tile", "batch", "every"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"{name}: expected 1 or more; found {getattr(self, name)}.")
        if not 0 <= self.overlap < self.tile:
            raise ValueError(f"overlap: expected 0 or more, below tile ({self.tile}); found {self.overlap}.")
        if not 0.05 <= self.scale <= 8:
            raise ValueError(f"scale: expected 0.05 to 8; found {self.scale:g}.")

    @abstractmethod
    def loaded(self) -> Loaded:
        """The model, made once a process."""

    @property
    def cache_key(self) -> Any:
        """Its fields, with the content of the weights in place of their name; where it computes does not count."""
        held = {k: v for k, v in vars(self).items() if k not in ("model", "device", "batch")}
        return (type(self).__name__, tuple(sorted(held.items())), digest_of(self.loaded().path))

    def dense(self, image: np.ndarray) -> Float[np.ndarray, "h w D"]:
        """The map of an image (H,W,3) uint8: a feature every patch, (h,w) about (H,W) * scale / patch."""
        import cv2

        model = self.loaded()
        height, width = (
            max(model.stride, round(n * self.scale / model.stride) * model.stride) for n in image.shape[:2]
        )
        side = max(model.stride, self.tile // model.stride * model.stride)
        tile = model.fixed or (side, side)
        height, width = (max(n, fixed) if model.fixed else n for n, fixed in zip((height, width), tile, strict=True))
        seen = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR)
        normal = (seen.astype(np.float32) / 255 - np.array(model.mean, np.float32)) / np.array(model.std, np.float32)
        return tiled(normal, model.run, tile=tile, overlap=self.overlap, stride=model.stride, batch=self.batch)

    def __call__(
        self, frames: WorkingFrames, masks: Sequence[np.ndarray], uv: Float[np.ndarray, "N T 2"], fps: float
    ) -> Float[np.ndarray, "N D"]:
        """Unit vectors; of a track that no frame was looked at for, equal entries."""
        total: np.ndarray | None = None
        for k, at in samples(np.isfinite(uv[..., 0]), self.every * fps / 30):
            cells = self.dense(frames[k])
            shrink = np.array([cells.shape[1] / frames.size[0], cells.shape[0] / frames.size[1]])
            if total is None:
                total = np.zeros((len(uv), cells.shape[-1]))
            if min(cells.shape[:2]) < 2:
                raise ValueError(
                    f"scale: expected a map of 2 x 2 and more; found {cells.shape[:2]}. Use a larger scale."
                )
            found = bilinear(cells, (uv[at, k] + 0.5) * shrink - 0.5)
            total[at] += found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)
        if total is None:
            return np.ones((len(uv), 1))
        norm = np.linalg.norm(total, axis=1, keepdims=True)
        return np.where(norm > 1e-6, total, 1.0) / np.where(norm > 1e-6, norm, np.sqrt(total.shape[1]))


@dataclass(frozen=True, eq=False)
class Loaded:
    """A model that runs: its file, how far apart its features lie (pixels), the only size that it takes or None."""

    path: Path
    run: Run
    stride: int
    fixed: tuple[int, int] | None = None
    mean: tuple[float, ...] = MEAN
    std: tuple[float, ...] = STD


@dataclass(frozen=True)
class Transformers(Dense):
    """Any vision backbone of transformers, from a local folder: DINOv3, DINOv2, ViT, ConvNeXt, ... (safetensors)."""

    def loaded(self) -> Loaded:
        said = "Save a backbone there: AutoModel.from_pretrained(NAME).save_pretrained(FOLDER), with its preprocessor."
        path = weights(self.model, f"features: {type(self).__name__}", said)
        return _transformers(path, device_of(self.device), self.dtype)


@dataclass(frozen=True)
class Dinov3(Transformers):
    """DINOv3 (Siméoni et al., 2025), the paper's features: ViT-S/16 by default."""

    model: str = "dinov3-vits16"


@dataclass(frozen=True)
class Dinov2(Transformers):
    """DINOv2 (Oquab et al., 2023): ViT-S/14 by default."""

    model: str = "dinov2-small"


@dataclass(frozen=True)
class Onnx(Dense):
    """Any ONNX model from images (B,3,H,W) to patches (B,N,D) or maps (B,D,h,w), by onnxruntime."""

    model: str = "features.onnx"
    output: str = ""
    """Name of the output that holds the features, or of any tensor inside; default: the first one of three or four
    dimensions."""

    def loaded(self) -> Loaded:
        path = weights(self.model, "features: onnx", "Export a backbone to ONNX (model.onnx).")
        if self.dtype != "float32":
            raise ValueError(
                f"dtype: expected float32, since an ONNX model has its own; found {self.dtype}. Leave it out."
            )
        return _onnx(path, "cpu" if self.device == "cpu" else "auto", self.output, self.tile)


@cache
def _transformers(path: Path, device: str, dtype: str) -> Loaded:
    torch = package("torch", "learned")
    model = pretrained("AutoModel", path, device, dtype, "a backbone")
    takes = inspect.signature(model.forward).parameters
    more = {"interpolate_pos_encoding": True} if "interpolate_pos_encoding" in takes else {}
    patch = getattr(model.config, "patch_size", None)

    def cells(pixels: Any) -> Any:
        with torch.inference_mode():
            out = model(pixel_values=pixels.to(device, model.dtype), **more).last_hidden_state
        return out.float().cpu()

    # what becomes of a known size tells more than the configuration, whose patch may be the first step alone
    out = cells(torch.zeros(1, 3, PROBE, PROBE))
    if out.ndim != 4 and not (out.ndim == 3 and isinstance(patch, int) and patch > 0):
        raise ValueError(f"{path}: expected a backbone with patches or a map; found {tuple(out.shape)}. Take another.")
    stride = PROBE // int(out.shape[-1]) if out.ndim == 4 else int(patch or 0)

    def run(batch: np.ndarray) -> np.ndarray:
        pixels = torch.from_numpy(np.ascontiguousarray(batch.transpose(0, 3, 1, 2)))
        return as_cells(cells(pixels).numpy(), batch.shape[1] // stride, batch.shape[2] // stride, str(path))

    mean, std = MEAN, STD
    if (path / "preprocessor_config.json").is_file():
        told = read_json(path / "preprocessor_config.json")
        mean, std = tuple(told.get("image_mean", MEAN)), tuple(told.get("image_std", STD))
    return Loaded(path, run, stride, None, mean, std)


@cache
def _onnx(path: Path, device: str, output: str, tile: int) -> Loaded:
    runtime = package("onnxruntime", "learned")
    known = runtime.get_available_providers()
    wanted = [p for p in ("CUDAExecutionProvider",) if p in known and device != "cpu"]
    options = runtime.SessionOptions()
    options.log_severity_level = 3

    def session_of(model: str | bytes) -> Any:
        return runtime.InferenceSession(model, options, providers=[*wanted, "CPUExecutionProvider"])

    try:
        session = session_of(str(path))
        if output and output not in [o.name for o in session.get_outputs()]:
            session = session_of(_with_output(path, output))
    except FileNotFoundError:
        raise
    except Exception as error:  # onnxruntime has classes of its own for every fault
        said = " ".join(str(error).split())[:200]
        raise ValueError(f"{path}: expected an ONNX model; {type(error).__name__}: {said}. Export it again.") from None
    entry = session.get_inputs()[0]
    if len(entry.shape) != 4 or entry.type != "tensor(float)":
        raise ValueError(
            f"{path}: expected one input of images (B,3,H,W) in float32; found {entry.type} {entry.shape}. Export "
            "it so."
        )
    fixed = tuple(entry.shape[2:]) if all(isinstance(n, int) for n in entry.shape[2:]) else None
    names = [o.name for o in session.get_outputs()]
    chosen = output or next((o.name for o in session.get_outputs() if len(o.shape or ()) in (3, 4)), names[0])
    if chosen not in names:
        raise ValueError(f"output: expected one of {', '.join(names)}; found {chosen!r}.")
    alone = isinstance(entry.shape[0], int)

    def raw(pixels: np.ndarray) -> np.ndarray:
        parts = [pixels[k : k + 1] for k in range(len(pixels))] if alone and entry.shape[0] == 1 else [pixels]
        return np.concatenate([session.run([chosen], {entry.name: part})[0] for part in parts])

    side = fixed or (224, 224)
    stride = _stride(raw(np.zeros((1, 3, *side), np.float32)).shape, side, str(path))

    def run(batch: np.ndarray) -> np.ndarray:
        out = raw(np.ascontiguousarray(batch.transpose(0, 3, 1, 2)))
        return as_cells(out, batch.shape[1] // stride, batch.shape[2] // stride, str(path))

    return Loaded(path, run, stride, fixed)


def _with_output(path: Path, name: str) -> bytes:
    """The model with a tensor of its inside as a further output. ValueError for one that there is not."""
    onnx = package("onnx", "learned")
    model = onnx.load(str(path))
    inside = {tensor for node in model.graph.node for tensor in node.output}
    if name not in inside:
        close = nearest(name, inside)
        meant = f" Did you mean {close!r}?" if close else ""
        raise ValueError(f"output: expected an output or a tensor inside the model; found {name!r}.{meant}")
    model.graph.output.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None))
    return model.SerializeToString()


def _stride(shape: tuple[int, ...], side: tuple[int, int], where: str) -> int:
    """Pixels between features, of the shape that an image of a known size becomes."""
    if len(shape) == 4:
        return side[0] // shape[2]
    for patch in PATCHES if len(shape) == 3 else ():
        prefix = shape[1] - (side[0] // patch) * (side[1] // patch)
        if 0 <= prefix <= MOST_PREFIX and side[0] % patch == 0:
            return patch
    raise ValueError(f"{where}: expected patches (B,N,D) or a map (B,D,h,w); found {shape}. Choose another output.")


def as_cells(out: np.ndarray, rows: int, columns: int, where: str) -> Float[np.ndarray, "B h w D"]:
    """Patches behind their prefix, or a map, as (B,h,w,D). ValueError where there are too few."""
    if out.ndim == 4:
        return out.transpose(0, 2, 3, 1)[:, :rows, :columns]
    prefix = out.shape[1] - rows * columns if out.ndim == 3 else -1
    if not 0 <= prefix <= MOST_PREFIX:
        raise ValueError(
            f"{where}: expected {rows} x {columns} patches and at most {MOST_PREFIX} tokens before them; found "
            f"{out.shape}. Choose another output."
        )
    return out[:, prefix:].reshape(len(out), rows, columns, -1)
