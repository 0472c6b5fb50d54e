"""A scene of moving and static Gaussians, at any instant of world time."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from otsync.files.arrays import read_npz, write_npz
from otsync.files.strict import in_words
from otsync.types import Camera
from recon.motion import Motion, motion_from_arrays
from recon.motion.arrays import numbers
from recon.raster import Rendering
from recon.scene.device import device_of
from recon.scene.gaussians import Gaussians

T = TypeVar("T")

FORMAT, VERSION = "otsync.scene4d", 1

UNSOUND = (
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    OverflowError,
    RecursionError,
    json.JSONDecodeError,
    UnicodeDecodeError,
)
"""Errors beside ValueError that a stranger's header raises: JSON of other types or lengths, too deep, too large."""


NEAR_OF_MOVING = 0.01
"""Near plane of what moves, as a share of that of what is static."""


@dataclass(frozen=True, eq=False, repr=False)
class Gaussians4D:
    """Dynamic Gaussians, which a motion carries, and static ones.

    Args:
        dynamic: N Gaussians; means and quats are those of the rest pose that the motion binds them to.
        motion: a Scaffold, PerGaussian or Static, which carries rest poses to any world time.
        footprint: world units that one working pixel covers at the median depth of what moves: the unit of every
            length in losses and learning rates, so that a scene in millimetres fits as one in metres does.
        frame_step: seconds of one frame of the reference.
        span: (first, last) world seconds that the videos cover.
        static: S Gaussians, or None.
        near: distance along z, world units, below which nothing static is drawn: a backdrop fitted to other cameras
            may stand just in front of this one and hide the scene.
        features: (N,D) time-invariant features of the dynamic Gaussians, or None.
    """

    dynamic: Gaussians
    motion: Motion
    footprint: float
    frame_step: float
    span: tuple[float, float]
    static: Gaussians | None = None
    near: float = 0.01
    features: Tensor | None = None

    def __post_init__(self) -> None:
        for name in ("footprint", "frame_step"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a number > 0; found {value}.")
        if not (math.isfinite(self.near) and self.near >= 0):
            raise ValueError(f"near: expected a distance of 0 or more; found {self.near}.")
        if not (len(self.span) == 2 and all(map(math.isfinite, self.span)) and self.span[0] <= self.span[1]):
            raise ValueError(f"span: expected (first, last) world seconds in order; found {self.span}.")

    def __len__(self) -> int:
        """Number of dynamic Gaussians."""
        return len(self.dynamic)

    def __repr__(self) -> str:
        static = 0 if self.static is None else len(self.static)
        first, last = self.span
        return (
            f"Gaussians4D({len(self)} moving, {static} static, {type(self.motion).__name__}, "
            f"{first:.3f} to {last:.3f} s, {self.dynamic.means.device})"
        )

    @property
    def moving_near(self) -> float:
        """Near plane of what moves. Unlike a backdrop it blocks no camera's view, so nearly all of it is drawn."""
        return NEAR_OF_MOVING * self.near

    def moving(self, t: Tensor | float, clocks: Tensor | None = None) -> Gaussians:
        """The dynamic Gaussians at world time ``t`` (seconds), differentiable in it."""
        means, quats = self.motion.warp(self.dynamic.means, self.dynamic.quats, as_time(t), clocks)
        return replace(self.dynamic, means=means, quats=quats)

    def at(self, t: Tensor | float, clocks: Tensor | None = None) -> Gaussians:
        """All Gaussians at world time ``t`` (seconds): dynamic first, then static."""
        moving = self.moving(t, clocks)
        return moving if self.static is None else join(moving, self.static)

    def to(self, device: torch.device | str) -> Gaussians4D:
        """The same scene on "cpu" or a GPU ("cuda"), where a fit of it then runs. ValueError where there is none."""
        device = device_of(device)
        return replace(
            self,
            dynamic=self.dynamic.to(device),
            motion=self.motion.to(device),
            static=None if self.static is None else self.static.to(device),
            features=None if self.features is None else self.features.to(device),
        )

    def tracks(self, times: Sequence[float] | np.ndarray, clocks: Tensor | None = None) -> np.ndarray:
        """Trajectories (N,T,3) of the dynamic Gaussians at world ``times`` (seconds), float32, world units."""
        with torch.no_grad():
            paths = [self.moving(float(t), clocks).means for t in times]
        return torch.stack(paths, 1).cpu().numpy() if paths else np.zeros((len(self), 0, 3), np.float32)

    def render(self, camera: Camera, t: Tensor | float, **options: Any) -> Rendering:
        """Render the scene at world time ``t`` for a static ``camera``; options: of :func:`recon.raster.render`."""
        if camera.w2c.ndim == 3:
            raise ValueError("camera: expected one pose; found one per frame. Take the pose of the frame you want.")
        options.setdefault("near_plane", self.near)
        return self.at(t).render(camera, **options)

    def seen_by(self, camera: Camera, t: float, *, layered: bool = True) -> Tensor:
        """The image [h,w,3] of a static camera at world second ``t``.

        layered: what moves is drawn over what is static, as in a fit over backgrounds, rather than together with it.
        """
        with torch.no_grad():
            if self.static is None or not layered:
                return self.render(camera, t, depth=None).colors[0]
            moving = self.moving(t).render(camera, depth=None, near_plane=self.moving_near)
            behind = self.static.render(camera, depth=None, near_plane=self.near)
            return moving.colors[0] + (1 - moving.alphas[0]) * behind.colors[0]

    def save(self, path: str | os.PathLike[str], extra: Mapping[str, np.ndarray] | None = None) -> None:
        """Write everything as plain arrays (``.npz``), atomically; NaN is refused."""
        write_npz(path, {**scene_arrays(self), **(extra or {})})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Gaussians4D:
        """Read what :meth:`save` wrote. ValueError names the file for anything else."""
        try:
            return scene_from_arrays(read_npz(path))
        except UNSOUND as error:
            raise ValueError(f"{path}: not a sound 4D scene; {in_words(error)}. Write it anew.") from None
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def as_time(t: Tensor | float) -> Tensor:
    """World seconds as a float64 scalar; float32 would round long recordings to tenths of a frame."""
    return t if isinstance(t, Tensor) else torch.tensor(float(t), dtype=torch.float64)


def join(a: Gaussians, b: Gaussians) -> Gaussians:
    """All Gaussians of a, then of b; the one with fewer spherical-harmonics coefficients is padded with zeros."""
    k = max(a.sh.shape[1], b.sh.shape[1])

    def padded(sh: Tensor) -> Tensor:
        return sh if sh.shape[1] == k else torch.cat([sh, sh.new_zeros(len(sh), k - sh.shape[1], 3)], 1)

    parts = {f.name: torch.cat([getattr(a, f.name), getattr(b, f.name)]) for f in fields(a) if f.name != "sh"}
    return Gaussians(**parts, sh=torch.cat([padded(a.sh), padded(b.sh)]))


def scene_arrays(scene: Gaussians4D) -> dict[str, np.ndarray]:
    """A scene as named plain arrays, without its graph."""
    about = {
        "format": FORMAT,
        "version": VERSION,
        "footprint": scene.footprint,
        "frame_step": scene.frame_step,
        "span": list(scene.span),
        "near": scene.near,
    }
    out = {"scene": np.frombuffer(json.dumps(about).encode(), np.uint8)}
    for part in ("dynamic", "static"):
        gaussians = getattr(scene, part)
        if gaussians is not None:
            flat = gaussians.detach().finite()
            out |= {f"{part}.{f.name}": getattr(flat, f.name).numpy() for f in fields(flat)}
    if scene.features is not None:
        out["features"] = scene.features.detach().cpu().numpy()
    return out | {f"motion.{k}": v for k, v in scene.motion.arrays().items()}


def scene_from_arrays(arrays: Mapping[str, np.ndarray]) -> Gaussians4D:
    """The scene that :func:`scene_arrays` took apart. ValueError, or one of :data:`UNSOUND`, where it is unsound."""
    about = json.loads(arrays["scene"].tobytes().decode())
    if not isinstance(about, dict) or about.get("format") != FORMAT or about.get("version") != VERSION:
        raise ValueError(f"expected a 4D scene (format {FORMAT!r}, version {VERSION}); found another. Write it anew.")
    dynamic = _gaussians(arrays, "dynamic")
    motion = {k[len("motion.") :]: v for k, v in arrays.items() if k.startswith("motion.")}
    for name, axis in (("binding_rest", 0), ("own_knots", 1), ("own_quats", 1), ("near", 0)):
        if name in motion and (motion[name].ndim <= axis or motion[name].shape[axis] != len(dynamic)):
            raise ValueError(
                f"motion.{name}: expected {len(dynamic)} Gaussians along axis {axis}; found shape {motion[name].shape}."
            )
    first, last = about["span"]
    return Gaussians4D(
        dynamic=dynamic,
        motion=_named("motion", lambda: motion_from_arrays(motion)),
        footprint=float(about["footprint"]),
        frame_step=float(about["frame_step"]),
        span=(float(first), float(last)),
        static=_gaussians(arrays, "static") if "static.means" in arrays else None,
        near=float(about["near"]),
        features=numbers(arrays, "features", (len(dynamic), None)) if "features" in arrays else None,
    )


def _named(part: str, make: Callable[[], T]) -> T:
    """What ``make`` makes of a part of a file; its ValueError or KeyError begins with the part's name."""
    try:
        return make()
    except KeyError as error:
        raise KeyError(f"{part}.{error.args[0]}") from None
    except ValueError as error:
        said = str(error)
        raise ValueError(said if said.startswith(part) else f"{part}.{said}") from None


def _gaussians(arrays: Mapping[str, np.ndarray], part: str) -> Gaussians:
    """The Gaussians whose arrays are named ``part.*``; shapes are checked by their own class."""
    names = [f"{part}.{f.name}" for f in fields(Gaussians)]
    means, *others = (numbers(arrays, n, (None,) * np.ndim(arrays[n])) for n in names)
    gaussians = _named(part, lambda: Gaussians(means, *others))
    for name, x in zip(names[1:], others, strict=True):
        if x.dtype != means.dtype:
            raise ValueError(f"{name}: expected {means.dtype} as {names[0]} has; found {x.dtype}. Save both alike.")
    return gaussians
