"""A 4D scene as files that other tools read: 3DGS .ply at a moment or as a sequence, .splat, plain arrays, tracks.

No public format stores splined motion: every viewer of 3DGS can play a sequence of .ply. ``.npz`` keeps everything and
is read back by :meth:`Gaussians4D.load`; the dense trajectories are an ordinary otsync track set.

A format is one :class:`Exporter`: to add one, write it in one file and name it in ``EXPORTERS`` of
recon/result/__init__.py, or ``@register("exporters")`` it in a file of your own.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from otsync.files.arrays import write_json
from otsync.types import TrackSet
from recon.result.folder import SavedReconstruction
from recon.scene.gaussians4d import Gaussians4D
from recon.scene.ply import save_ply, save_splat

MAX_FRAMES = 100_000
"""Frames of one export; more is a wrong unit of time rather than a wish."""


def frame_times(scene: Gaussians4D, fps: float | None = None) -> np.ndarray:
    """World seconds (T,) of the frames over the scene's span, ``fps`` a second; default: the reference's own frames."""
    if fps is not None and not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps: expected frames per second above 0; found {fps}.")
    step = scene.frame_step if fps is None else 1.0 / fps
    count = int((scene.span[1] - scene.span[0]) / step + 1e-6) + 1
    if count > MAX_FRAMES:
        raise ValueError(
            f"fps: expected at most {MAX_FRAMES} frames; the span {scene.span} at {1 / step:g} has {count}."
        )
    return scene.span[0] + step * np.arange(count)


def check_times(scene: Gaussians4D, times: Sequence[float]) -> None:
    """ValueError for world seconds that the videos do not cover by more than a frame: nothing was seen there."""
    low, high = scene.span[0] - scene.frame_step, scene.span[1] + scene.frame_step
    beyond = [float(t) for t in times if not low <= t <= high]
    if beyond:
        raise ValueError(
            f"times: expected world seconds in {scene.span[0]:.3f} to {scene.span[1]:.3f}, which the videos cover; "
            f"found {beyond[0]:g}."
        )


def export_ply_sequence(scene: Gaussians4D, times: Sequence[float], folder: str | os.PathLike[str]) -> None:
    """``00000.ply``, ``00001.ply``, ... (3DGS) at world ``times``, and ``frames.json`` with the seconds of each."""
    folder = Path(folder)
    names = [f"{n:05d}.ply" for n in range(len(times))]
    stale = sorted({p.name for p in folder.glob("*.ply")} - set(names))
    if stale:
        raise ValueError(f"{folder}: expected a folder without another sequence; it holds {stale[0]}. Choose another.")
    for name, t in zip(names, times, strict=True):
        save_ply(scene.at(float(t)), folder / name)
    frames = [{"file": name, "seconds": float(t)} for name, t in zip(names, times, strict=True)]
    write_json(folder / "frames.json", {"format": "otsync.ply_sequence", "version": 1, "frames": frames})


def scene_tracks(scene: Gaussians4D, times: Sequence[float], name: str = "scene", frame: str = "world") -> TrackSet:
    """The trajectories of all moving Gaussians at world ``times`` as a track set on the world's clock.

    frame: name of the world frame that the recording declares. Features are the Gaussians' own, where lifted, as unit
    vectors; of Gaussians that no camera saw, equal entries, as of tracks that no frame was looked at for.
    """
    features = None
    if scene.features is not None:
        own = scene.features.detach().cpu().double().numpy()
        own = np.where(np.linalg.norm(own, axis=1, keepdims=True) > 1e-9, own, 1.0)
        features = own / np.linalg.norm(own, axis=1, keepdims=True)
    return TrackSet(scene.tracks(times), features=features, timestamps=np.asarray(times, float), name=name, frame=frame)


class Exporter(ABC):
    """A format that a scene is written in."""

    name: ClassVar[str]
    """How the shell spells it."""

    file: ClassVar[str]
    """Name of the file or folder that it writes by default."""

    holds: ClassVar[Literal["moment", "frames", "everything"]] = "frames"
    """What it holds of time: one moment, the frames that are asked for, or all that the scene knows."""

    @abstractmethod
    def write(self, scene: Gaussians4D, out: Path, times: Sequence[float], frame: str) -> None:
        """Write ``scene`` to ``out``.

        Args:
            times: world seconds: one of them for a format that holds a moment.
            frame: name of the world frame that the recording declares.
        """

    def write_result(self, result: SavedReconstruction, out: Path, times: Sequence[float]) -> None:
        """Write a whole reconstruction to ``out``: for formats that hold cameras and clocks too. Default: its scene."""
        self.write(result.scene, out, times, result.frame)


class Ply(Exporter):
    """A moment as 3DGS .ply, which every viewer of Gaussians opens."""

    name, file, holds = "ply", "scene.ply", "moment"

    def write(self, scene: Gaussians4D, out: Path, times: Sequence[float], frame: str) -> None:
        save_ply(scene.at(float(times[0])), out)


class Splat(Exporter):
    """A moment as .splat, small, for viewers in a browser."""

    name, file, holds = "splat", "scene.splat", "moment"

    def write(self, scene: Gaussians4D, out: Path, times: Sequence[float], frame: str) -> None:
        save_splat(scene.at(float(times[0])), out)


class PlySequence(Exporter):
    """A folder with a .ply of every frame."""

    name, file = "ply-sequence", "sequence"

    def write(self, scene: Gaussians4D, out: Path, times: Sequence[float], frame: str) -> None:
        export_ply_sequence(scene, times, out)


class Checkpoint(Exporter):
    """The whole scene with its motion, as plain arrays."""

    name, file, holds = "checkpoint", "scene4d.npz", "everything"

    def write(self, scene: Gaussians4D, out: Path, times: Sequence[float], frame: str) -> None:
        scene.save(out)


class Tracks(Exporter):
    """The trajectories of all moving Gaussians, as an otsync track set."""

    name, file = "tracks", "tracks.npz"

    def write(self, scene: Gaussians4D, out: Path, times: Sequence[float], frame: str) -> None:
        scene_tracks(scene, times, frame=frame).save(out)


def export(
    scene: Gaussians4D, exporter: Exporter, out: str | os.PathLike[str], times: Sequence[float], frame: str = "world"
) -> None:
    """Write ``scene`` in a format. ValueError for times that it cannot hold, or that the videos do not cover."""
    _check(scene, exporter, times)
    exporter.write(scene, Path(out), times, frame)


def export_result(
    result: SavedReconstruction, exporter: Exporter, out: str | os.PathLike[str], times: Sequence[float] = ()
) -> None:
    """Write a reconstruction in a format. ValueError as of :func:`export`."""
    _check(result.scene, exporter, times)
    exporter.write_result(result, Path(out), times)


def _check(scene: Gaussians4D, exporter: Exporter, times: Sequence[float]) -> None:
    """ValueError for times that a format cannot hold, or that the videos do not cover."""
    if exporter.holds != "everything":
        check_times(scene, times)
    if exporter.holds == "moment" and len(times) != 1:
        raise ValueError(
            f"times: expected one moment for {exporter.name}; found {len(times)}. Use a sequence for more."
        )
