"""The folder of a reconstruction: writing it, and reading it back.

scene.npz      the 4D scene          offsets.json   the refined clocks
run.json       cameras, clocks, colour gains and effects of every video, options, wall times, notes
metrics.json   figures of the views  report.html    all of it to look at
scene.html     the scene to fly round  strips.npz   small pictures of the videos, for scene.html
fit.npz        the fit's last state  stages/        earlier results, from which a killed run continues
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import UInt8
from torch import Tensor

from otsync.files.arrays import read_json, write_json
from otsync.files.strict import checked, in_words
from otsync.types import Camera, Clock, Offsets
from otsync.types.camera import matrix_of
from otsync.types.clock import Source
from recon.evaluate.views import ViewScore
from recon.footage.footage import Footage
from recon.observe.effects import Effect, ImageCircle, on_still
from recon.observe.recorded import kept, restored
from recon.result.layout import MAX_SIDE, RunFile
from recon.scene.gaussians4d import Gaussians4D

FORMAT, VERSION = "otsync.reconstruction", 2
MAX_PIXELS = 2**26
"""Of one image: a foreign run.json or a requested width may take no more memory."""


@dataclass(frozen=True, eq=False, repr=False)
class FilmedBy:
    """The camera of one video, placed in a reconstruction.

    Args:
        camera: at working size, without distortion. gain: factors of R, G, B from the scene's colours to its images.
        clock: where it stands in world time. times: (T,) seconds of its frames on its own clock.
        optics: the effects that its images are looked through, see :func:`recon.observe.recorded.optics`.
    """

    name: str
    camera: Camera
    clock: Clock
    gain: np.ndarray
    times: np.ndarray
    held_out: bool = False
    optics: tuple[Effect, ...] = ()

    def __repr__(self) -> str:
        role = "held out" if self.held_out else "fitted"
        return f"FilmedBy({self.name!r}, {len(self.times)} frames, {self.clock}, {role})"

    @classmethod
    def of(
        cls,
        footage: Footage,
        clock: Clock,
        gain: np.ndarray,
        optics: tuple[Effect, ...] = (),
        held_out: bool = False,
    ) -> FilmedBy:
        return cls(footage.name, footage.camera, clock, gain, footage.times, held_out, optics)

    def coloured(self, image: Tensor, camera: Camera | None = None) -> UInt8[np.ndarray, "h w 3"]:
        """An image of the scene, 0..1, in this camera's colours: with its gain, and as its lens darkens it.

        Args:
            camera: that the image is of, if of another size than this one's.
        """
        camera = camera or self.camera
        seen = on_still(self.optics, image, ImageCircle.of(camera.K, (camera.width, camera.height))).numpy()
        return (255 * seen * self.gain).clip(0, 255).round().astype(np.uint8)

    def pose(self, t: float) -> np.ndarray:
        """w2c (4,4) at world second ``t``: of a moving camera that of the nearest frame."""
        if self.camera.w2c.ndim == 2:
            return self.camera.w2c
        world = self.clock.world(self.times)
        return self.camera.w2c[int(np.argmin(np.abs(world - t)))]


@dataclass(frozen=True, eq=False, repr=False)
class SavedReconstruction:
    """A reconstruction as :func:`load_result` reads it: all that rendering, evaluation and export need.

    Args:
        options: those of the fit, as run.json has them. frame: name of the world frame.
        optics: the effects that any other camera is looked through, apart from the shutter that it declares.
        folder: where it was read from; None: it was not.
    """

    scene: Gaussians4D
    offsets: Offsets
    videos: tuple[FilmedBy, ...]
    options: dict[str, Any] = field(default_factory=dict)
    frame: str = "world"
    optics: tuple[Effect, ...] = ()
    folder: Path | None = None

    @property
    def layered(self) -> bool:
        """Whether the fit drew what moves over what is static; see :class:`recon.evaluate.views.CameraView`."""
        return bool(self.options.get("layered", True))

    def __repr__(self) -> str:
        held = sum(v.held_out for v in self.videos)
        return f"SavedReconstruction({len(self.videos)} videos, {held} held out, {self.scene})"

    def show(self, *, camera: str | None = None, moments: int = 4) -> Any:
        """Draw what a camera sees of the scene at a few moments, evenly over its span; the matplotlib figure.

        Args:
            camera: name of a video; default: the first. moments: how many.
        """
        from recon.result.plot import moments_figure

        if moments < 1:
            raise ValueError(f"moments: expected at least 1; found {moments}.")
        video = self.videos[0] if camera is None else self.video(camera)
        times = np.linspace(*self.scene.span, moments + 2)[1:-1]
        views = [self.scene.seen_by(replace(video.camera, w2c=video.pose(t)), t, layered=self.layered) for t in times]
        pictures = [video.coloured(view) for view in views]
        return moments_figure(video.name, times.tolist(), pictures)

    def video(self, name: str) -> FilmedBy:
        """The video of this name. ValueError lists those that there are."""
        for one in self.videos:
            if one.name == name:
                return one
        raise ValueError(f"camera: expected one of {', '.join(v.name for v in self.videos)}; found {name!r}.")


def save_run(
    folder: Path,
    videos: Sequence[FilmedBy],
    *,
    options: Mapping[str, Any],
    frame: str,
    notes: Sequence[str],
    seconds: Mapping[str, float],
) -> None:
    """Write ``run.json``."""
    rows = []
    for v in videos:
        c = v.camera
        camera = {"K": c.K.tolist(), "w2c": c.w2c.tolist(), "width": c.width, "height": c.height, "readout": c.readout}
        clock = {"offset_seconds": v.clock.offset, "rate": v.clock.rate, "known": v.clock.how}
        rows.append(
            {
                "name": v.name,
                "held_out": v.held_out,
                "camera": camera,
                "clock": clock,
                "gain": [float(g) for g in v.gain],
                "times": v.times.tolist(),
                "optics": kept(v.optics),
            }
        )
    document = {
        "format": FORMAT,
        "version": VERSION,
        "frame": frame,
        "options": dict(options),
        "videos": rows,
        "notes": list(notes),
        "seconds": {k: round(float(s), 2) for k, s in seconds.items()},
    }
    write_json(folder / "run.json", document)


def metrics_of(views: Sequence[ViewScore], stats: Mapping[str, float], lpips_reason: str = "") -> dict[str, Any]:
    """The content of ``metrics.json``. It does not depend on wall time: equal fits give equal files."""

    def plain(figures: Mapping[str, float]) -> dict[str, float | None]:
        return {k: float(v) if math.isfinite(v) else None for k, v in figures.items()}

    rows = [
        {
            "name": v.name,
            "held_out": v.held_out,
            "frames": len(v.frames),
            "clock": v.clock.how,
            "offset_seconds": v.clock.offset,
            "gain": [float(g) for g in v.gain],
            **plain(v.mean),
        }
        for v in views
    ]
    held = [v for v in views if v.held_out]
    names = ("psnr", "ssim", "lpips", "mask_psnr", "mask_ssim")
    means = {}
    for name in names:
        known = [v.mean[name] for v in held if math.isfinite(v.mean.get(name, math.nan))]
        means[name] = float(np.mean(known)) if known else None
    document = {"format": "otsync.metrics", "version": 1, "held_out": means, "views": rows}
    document["fit"] = plain({k: v for k, v in stats.items() if k != "seconds"})
    if lpips_reason:
        document["lpips"] = lpips_reason
    return document


def load_result(folder: str | os.PathLike[str]) -> SavedReconstruction:
    """Read a result folder. ValueError and FileNotFoundError name the file that is missing or unsound."""
    folder = Path(folder)
    if not (folder / "run.json").is_file():
        raise FileNotFoundError(
            f"{folder}: expected a finished reconstruction (run.json, scene.npz, offsets.json); found none. "
            "Run: recon fit SCENE --offsets offsets.json --out FOLDER"
        )
    document = read_json(folder / "run.json")
    if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
        raise ValueError(
            f"{folder / 'run.json'}: expected format {FORMAT!r}, version {VERSION}; found another. Run the fit again."
        )
    checked(document, RunFile, folder / "run.json", remedy="Run the fit again.")
    try:
        videos = tuple(_filmed_by(row) for row in document["videos"])
        options, frame = _options(document["options"]), str(document["frame"])
        optics = restored(options["optics"])
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise ValueError(
            f"{folder / 'run.json'}: not a sound reconstruction; {in_words(error)}. Run the fit again."
        ) from None
    scene, offsets = Gaussians4D.load(folder / "scene.npz"), Offsets.load(folder / "offsets.json")
    return SavedReconstruction(scene, offsets, videos, options, frame, optics, folder)


def _options(given: dict[str, Any]) -> dict[str, Any]:
    """The options of the fit. ValueError where those that evaluation needs (width, frames) are unsound."""
    options = dict(given)
    if type(options["width"]) is not int or not 1 <= options["width"] <= MAX_SIDE:
        raise ValueError(f"options.width: expected 1 to {MAX_SIDE} pixels; found {options['width']!r}")
    frames = options.get("frames")
    if frames is not None and not (
        isinstance(frames, list)
        and len(frames) == 2
        and all(type(k) is int for k in frames)
        and 0 <= frames[0] < frames[1]
    ):
        raise ValueError(f"options.frames: expected null, or first and last frame; found {frames!r}")
    priors = options.get("priors", {})
    if not isinstance(priors, dict) or not all(isinstance(v, str | int) for v in priors.values()):
        raise ValueError(f"options.priors: expected what --recording.masks and the like were told; found {priors!r}")
    return options


def check_size(width: int, height: int) -> None:
    """ValueError for images without pixels, or too large for memory."""
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise ValueError(
            f"width, height: expected 1 to {MAX_SIDE} pixels each and {MAX_PIXELS} in all; found {width} x {height}."
        )


def _filmed_by(row: dict[str, Any]) -> FilmedBy:
    c = row["camera"]
    check_size(int(c["width"]), int(c["height"]))
    readout = None if c["readout"] is None else float(c["readout"])
    camera = Camera(
        matrix_of(c["K"], "camera.K", "(3,3)"),
        matrix_of(c["w2c"], "camera.w2c", "(4,4), or (T,4,4)"),
        int(c["width"]),
        int(c["height"]),
        None,
        readout,
    )
    seconds, rate, how = (row["clock"][k] for k in ("offset_seconds", "rate", "known"))
    clock = Clock(float(seconds), float(rate), how)
    if (
        how not in get_args(Source)
        or not math.isfinite(clock.offset)
        or not (math.isfinite(clock.rate) and clock.rate > 0)
    ):
        raise ValueError(
            f"clock: expected seconds, a rate above 0, known {' or '.join(get_args(Source))}; found {row['clock']}"
        )
    gain = np.array(row["gain"], float)
    if gain.shape != (3,) or not np.isfinite(gain).all():
        raise ValueError(f"gain: expected three finite numbers; found {row['gain']!r}")
    times = np.array(row["times"], float)
    if times.ndim != 1 or not len(times) or (camera.w2c.ndim == 3 and len(times) != len(camera.w2c)):
        raise ValueError(f"times: expected one second per frame; found shape {times.shape}")
    return FilmedBy(str(row["name"]), camera, clock, gain, times, bool(row["held_out"]), restored(row["optics"]))
