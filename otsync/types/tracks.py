"""4D feature tracks of one video: the paper's ({τ_t}, f), and what a tracker knows besides."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ..compute.indices import blocks
from ..files.arrays import MAX_BYTES, read_npz, write_npz
from ..files.strict import nearest, on_one_line, shown
from . import drawing
from .camera import Camera, clock, frame_times
from .drawing import short

FORMAT, VERSION = "otsync.tracks", 1

CAMERA = ("camera_K", "camera_w2c", "camera_width", "camera_height")
"""What a file tells of a camera, at least."""

ARRAYS = (
    *("format", "version", "name", "frame", "xyz", "visible", "features", "fps", "timestamps", "uv", "sigma", "labels"),
    *(*CAMERA, "camera_distortion", "camera_readout"),
)
"""All that a file may hold."""


@dataclass(frozen=True, eq=False)
class TrackSet:
    """N tracks over the T frames of one video.

    Args:
        xyz: positions in world units, or None when only ``uv`` is known. Read only where ``visible``.
        visible: where a track was observed; (N,T). None: everywhere.
        features: time-invariant descriptors, any scale but not zero (verbs normalise them).
        fps: frames per second of the video's own clock; or
        timestamps: seconds of every frame on that clock, strictly increasing (variable frame rate, dropped frames).
        name: of the video, for tables and files.
        uv: pixels, (N,T,2), of the ideal pinhole: without lens distortion.
        sigma: one standard deviation of position, world units, (N,T).
        labels: (N,) integer instance or class, or (N,L) soft memberships.
        camera: who filmed. Where it declares a ``readout``, samples are at their rows' times until the verbs bring
            them to the frames' (:func:`otsync.shutter.at_frame_times`).
        frame: name of the world frame of ``xyz``. Two sets that declare different ones are never aligned; position
            costs of a matcher ask both to declare the same.

    Shapes and the clock are checked here; contents (nan in visible samples, zero features) by the verbs, which
    name their argument. Integer and half-precision positions become float64 and float32.
    """

    xyz: Float[np.ndarray, "N T 3"] | None
    visible: Bool[np.ndarray, "N T"] | None = None
    features: Float[np.ndarray, "N D"] | None = None
    fps: float | None = None
    timestamps: Float[np.ndarray, " T"] | None = None
    name: str = ""
    uv: Float[np.ndarray, "N T 2"] | None = None
    sigma: Float[np.ndarray, "N T"] | None = None
    labels: np.ndarray | None = None
    camera: Camera | None = None
    frame: str | None = None

    def __post_init__(self) -> None:
        def put(field: str, value: Any) -> None:
            object.__setattr__(self, field, value)

        lead = self.xyz if self.xyz is not None else self.uv
        if lead is None:
            raise ValueError("TrackSet.xyz: expected positions (N,T,3), or uv (N,T,2); found neither.")
        shape = np.shape(lead)[:2]
        for field, tail in (("xyz", (3,)), ("uv", (2,)), ("sigma", ())):
            value = getattr(self, field)
            if value is not None:
                put(field, _real(value, (*shape, *tail), f"TrackSet.{field}"))
        put("visible", _visible(self.visible, shape))
        if self.features is not None:
            put("features", _real(self.features, (shape[0], None), "TrackSet.features"))
        if self.labels is not None:
            labels = np.asarray(self.labels)
            if labels.ndim not in (1, 2) or len(labels) != shape[0] or labels.dtype.kind not in "iuf":
                raise ValueError(
                    f"TrackSet.labels: expected numbers of shape ({shape[0]},) or ({shape[0]},L); "
                    f"found {labels.dtype} of shape {labels.shape}."
                )
            put("labels", labels)
        fps, timestamps = clock(self.fps, self.timestamps, shape[1], "TrackSet")
        put("fps", fps)
        put("timestamps", timestamps)

    def __len__(self) -> int:
        return len(self.seen)

    def __repr__(self) -> str:
        what = [f for f in ("xyz", "uv", "features", "sigma", "labels", "camera") if getattr(self, f) is not None]
        size, rate = f"{len(self)} tracks x {self.n_frames} frames", "" if self.fps is None else f", {self.fps:.5g} fps"
        return f"TrackSet({short(self.name)}, {size}{rate}, {'+'.join(what)})"

    def plot(self, *, most: int = 200, ax: Any = None) -> Any:
        """Draw the paths of the longest tracks, in space or in pixels; the matplotlib axes.

        Args:
            most: tracks that are drawn. ax: axes to draw on, three-dimensional ones for positions; default: new ones.
        """
        longest = np.argsort(-self.seen.sum(1), kind="stable")[:most]
        if self.xyz is not None:
            ax = drawing.new_axes(4.6, 4.0, solid=True) if ax is None else ax
            drawing.draw_paths_in_space(ax, self.positions()[longest])
        else:
            assert self.uv is not None
            ax = drawing.new_axes(4.6, 3.2) if ax is None else ax
            drawing.draw_paths_in_pixels(ax, np.where(self.seen[longest][..., None], self.uv[longest], np.nan))
        drawing.plain(ax)
        return ax

    @property
    def n_frames(self) -> int:
        return self.seen.shape[1]

    @property
    def times(self) -> Float[np.ndarray, " T"]:
        """Seconds of every frame on the video's own clock."""
        return frame_times(self.fps, self.timestamps, self.n_frames)

    @property
    def seen(self) -> Bool[np.ndarray, "N T"]:
        """``visible``, which is never None once constructed."""
        assert self.visible is not None
        return self.visible

    def positions(self, tracks: Any = slice(None), frames: Any = slice(None)) -> Float[np.ndarray, "n t 3"]:
        """``xyz`` as float64 with nan where not visible, of some tracks and frames; a copy."""
        if self.xyz is None:
            raise ValueError("xyz: expected 3D positions; this track set holds pixels only. Lift it with depth first.")
        seen, xyz = (x[:, frames][tracks] for x in (self.seen, self.xyz))
        return np.where(seen[..., None], xyz, np.nan).astype(float, copy=False)

    def take(self, index: Any) -> TrackSet:
        """The tracks at ``index`` (integers, a slice or a mask), in that order."""
        fields = ("xyz", "visible", "features", "uv", "sigma", "labels")
        return replace(self, **{f: v[index] for f in fields if (v := getattr(self, f)) is not None})

    def check(self, name: str, *, xyz: bool = True, features: bool = False) -> None:
        """Raise ValueError, naming the argument ``name``, unless the contents are fit for use.

        Asked of every set: at least one track, a pose for every frame of a camera that moves, finite visible samples.
        ``xyz``/``features``: that they are there; features must be finite and not zero.
        """
        if len(self) == 0 or self.n_frames == 0:
            raise ValueError(f"{name}: expected at least one track and one frame; found {len(self)} x {self.n_frames}.")
        if xyz and self.xyz is None:
            raise ValueError(f"{name}.xyz: expected 3D positions; found pixels only. Lift the tracks with depth first.")
        if self.camera is not None and self.camera.w2c.ndim == 3 and len(self.camera.w2c) != self.n_frames:
            raise ValueError(
                f"{name}.camera.w2c: expected one pose, or one for each of {self.n_frames} frames; found "
                f"{len(self.camera.w2c)}."
            )
        for field in ("xyz", "uv", "sigma"):
            value = getattr(self, field)
            if value is None:
                continue
            bad = self._unfit(value)
            if bad.any():
                n, t = np.argwhere(bad)[0]
                raise ValueError(
                    f"{name}.{field}: expected finite values in visible samples; {int(bad.sum())} are not, the "
                    f"first in track {n}, frame {t}. Mark unobserved samples in visible."
                )
        if features:
            if self.features is None:
                raise ValueError(
                    f"{name}.features: expected (N,D) descriptors; found none. Add them, or match by hand."
                )
            _check_features(self.features, name)

    def _unfit(self, value: np.ndarray) -> Bool[np.ndarray, "N T"]:
        """Which visible samples of a field are not finite. Of long clips few tracks at a time are looked at."""
        bad = np.zeros_like(self.seen)
        with np.errstate(over="ignore", invalid="ignore"):
            if np.isfinite(value.sum()):  # then every one is; where the sum alone is not, each is looked at
                return bad
        for some in blocks(len(bad), self.n_frames):
            finite = np.isfinite(value[some])
            for known in np.moveaxis(finite, -1, 0) if value.ndim == 3 else [finite]:
                bad[some] |= ~known
        return np.logical_and(bad, self.seen, out=bad)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a versioned ``.npz`` without pickle, atomically."""
        arrays: dict[str, np.ndarray] = {"format": np.array(FORMAT), "version": np.array(VERSION)}
        for field in ("xyz", "visible", "features", "fps", "timestamps", "uv", "sigma", "labels"):
            value = getattr(self, field)
            if value is not None:
                arrays[field] = np.asarray(value)
        arrays["name"] = np.array(self.name)
        if self.frame is not None:
            arrays["frame"] = np.array(self.frame)
        if self.camera is not None:
            for field in ("K", "w2c", "width", "height", "distortion", "readout"):
                value = getattr(self.camera, field)
                if value is not None:
                    arrays[f"camera_{field}"] = np.asarray(value)
        write_npz(path, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, max_bytes: int = MAX_BYTES) -> TrackSet:
        """Read what :meth:`save` wrote. ValueError names the file for anything foreign, damaged or oversized."""
        data = read_npz(path, max_bytes=max_bytes)
        if str(data.get("format")) != FORMAT:
            raise ValueError(f"{path}: expected a track set written by otsync (format {FORMAT!r}); found another .npz.")
        version = data.get("version")
        if version is None or version.shape != () or version.dtype.kind not in "iu" or int(version) != VERSION:
            raise ValueError(
                f"{path}: expected version {VERSION}; found {shown(str(version))}. Read it with the otsync release "
                "that wrote it."
            )
        try:
            for name in data:
                if name not in ARRAYS:
                    near = nearest(name, ARRAYS)
                    meant = f"Did you mean {near!r}? Else" if near else "Read it with the otsync that wrote it, or"
                    raise ValueError(
                        f"{shown(name)[1:-1]}: expected an array of a track set; found one that is none. {meant} leave "
                        "it out."
                    )
            camera = None
            given = [f for f in ARRAYS if f.startswith("camera_") and f in data]
            if given:
                for field in (f for f in CAMERA if f not in data):
                    raise ValueError(f"{field}: expected an array beside {given[0]}; found none. Save it again.")
                parts: dict[str, Any] = {}
                for field in given:
                    kinds = {"camera_width": "iu", "camera_height": "iu", "camera_readout": "iuf"}.get(field)
                    value = _numbers(data[field], field) if kinds is None else _scalar(data, field, kinds)
                    parts[field.removeprefix("camera_")] = value
                camera = Camera(**parts)
            arrays = {k: data[k] for k in ("visible", "features", "timestamps", "uv", "sigma", "labels") if k in data}
            if "timestamps" in arrays:
                arrays["timestamps"] = _numbers(arrays["timestamps"], "timestamps")
            return cls(
                data.get("xyz"),
                **arrays,
                fps=float(_scalar(data, "fps", "iuf")) if "fps" in data else None,
                name=_scalar(data, "name", "U") if "name" in data else "",
                camera=camera,
                frame=_scalar(data, "frame", "U") if "frame" in data else None,
            )
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise ValueError(f"{path}: not a sound track set; {error}") from None


def check_same_world(a: TrackSet, b: TrackSet) -> None:
    """ValueError when both declare a world frame and not the same one: their positions say nothing to each other."""
    if a.frame is not None and b.frame is not None and a.frame != b.frame:
        raise ValueError(
            f"b.frame: expected {a.frame!r} as a declares; found {b.frame!r}. Bring the positions into one world frame."
        )


def _scalar(data: dict[str, np.ndarray], field: str, kinds: str) -> Any:
    """What an array without axes holds, of one of numpy's ``kinds``; text on one line. ValueError names the field."""
    value = data[field]
    want = "text" if kinds == "U" else "a whole number" if kinds == "iu" else "a number"
    if value.shape != () or value.dtype.kind not in kinds:
        raise ValueError(f"{field}: expected {want}; found {value.dtype} of shape {value.shape}. Save it again.")
    if kinds == "U":
        on_one_line(str(value), field)
    return value.item()


def _numbers(value: np.ndarray, field: str) -> np.ndarray:
    if value.dtype.kind not in "iuf":
        raise ValueError(f"{field}: expected numbers; found {value.dtype} of shape {value.shape}. Save it again.")
    return value


def _real(value: Any, shape: tuple[int | None, ...], name: str) -> np.ndarray:
    """``value`` as a float32 or float64 array of ``shape`` (None: any length)."""
    array = np.asarray(value)
    fits = array.ndim == len(shape) and all(s is None or s == n for s, n in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "iufb":
        want = ",".join("D" if s is None else str(s) for s in shape)
        raise ValueError(
            f"{name}: expected real numbers of shape ({want}); found {array.dtype} of shape {array.shape}."
        )
    if array.dtype in (np.float32, np.float64):
        return array
    return array.astype(np.float32 if array.dtype == np.float16 else np.float64)


def _visible(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    if value is None:
        return np.ones(shape, bool)
    visible = np.asarray(value)
    if (
        visible.shape != shape
        or visible.dtype.kind not in "bu"
        or (visible.dtype.kind == "u" and visible.max(initial=0) > 1)
    ):
        raise ValueError(
            f"TrackSet.visible: expected booleans of shape {shape}; found {visible.dtype} of {visible.shape}."
        )
    return visible.astype(bool, copy=False)


def _check_features(features: np.ndarray, name: str) -> None:
    bad = ~np.isfinite(features).all(1)
    if bad.any():
        raise ValueError(f"{name}.features: expected finite values; tracks {_some(bad)} have nan or infinity.")
    # the largest entry, not the norm: it neither under- nor overflows
    bad = np.abs(features).max(1, initial=0.0) == 0
    if bad.any():
        raise ValueError(
            f"{name}.features: expected non-zero descriptors; tracks {_some(bad)} are all zero. Leave those tracks out."
        )


def _some(mask: np.ndarray) -> str:
    """The first few indices where ``mask`` holds, for an error message."""
    index = np.flatnonzero(mask)
    return ", ".join(map(str, index[:8])) + (f" and {len(index) - 8} more" if len(index) > 8 else "")
