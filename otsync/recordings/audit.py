"""``otsync audit``: is a rig that is said to be synchronised so? Each camera's verdict, with sigma.

The pictures are synchronised as if nothing were known, on the pixels' route, which needs no depth that was built from
the rig's own clock. What each camera is off by is measured against what most cameras agree on, so that the first one
is judged like the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..compute.threads import MapLike
from ..files.cache import Cache
from ..io.scene import Scene
from ..progress import Tell
from ..types import Offsets, Status
from .routes import synchronize_scene
from .stages import Stages

Finding = Literal["in_sync", "off", "unsure"]

MAD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""

SIGMAS = 3.0
"""Standard deviations that an alarm must stand above the tolerance."""

LEAST = 3
"""Cameras that a majority needs: of two nobody can tell which one is off."""

REMEDIES = {
    "in_sync": "",
    "off": "Check that camera's trigger and dropped frames; or take the offset into account (otsync sync).",
    "unsure": "Look at its pairs in the report of otsync sync; use a part of the clip with more motion.",
}


@dataclass(frozen=True)
class CameraVerdict:
    """One camera of a rig.

    Args:
        name: of the video. finding: what is said of it. frames: of its own that it is late (negative: early) against
            the majority, nan where there is no answer. sigma: one standard deviation, frames.
        jitter: robust scatter of its pairs' answers, frames: a rig of sound clocks has some hundredths.
        flags: of its offset, as in :class:`otsync.Offsets`. why: in words.
    """

    name: str
    finding: Finding
    frames: float
    sigma: float
    jitter: float
    flags: tuple[Status, ...] = ()
    why: str = ""


@dataclass(frozen=True, eq=False)
class Audit:
    """All cameras of a rig. ``tolerance``: frames that are no alarm; ``offsets``: what was measured."""

    cameras: tuple[CameraVerdict, ...]
    tolerance: float
    offsets: Offsets

    @property
    def alarms(self) -> tuple[str, ...]:
        """Names of the cameras that are off."""
        return tuple(c.name for c in self.cameras if c.finding == "off")

    @property
    def unsure(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.cameras if c.finding == "unsure")


def audit_scene(
    scene: Scene,
    *,
    tolerance: float = 0.25,
    stages: Stages | None = None,
    cache: Cache | None = None,
    map: MapLike = map,
    tell: Tell = lambda text: None,
) -> Audit:
    """The verdict on every camera of a scene.

    Args:
        tolerance: frames that a camera may be off by: sound rigs are off by a tenth.
        stages, cache, map, tell: as of :func:`otsync.recordings.synchronize_scene`.
    """
    found = synchronize_scene(scene, route="epipolar", stages=stages, cache=cache, map=map, tell=tell)
    starts = np.array([float(video.times[0]) for video in scene.videos])
    fps = np.array([video.fps or 30.0 for video in scene.videos])
    return audit_offsets(found.offsets, starts=starts, fps=fps, tolerance=tolerance)


def audit_offsets(
    offsets: Offsets,
    *,
    starts: Float[np.ndarray, " V"] | None = None,
    fps: Float[np.ndarray, " V"] | None = None,
    tolerance: float = 0.25,
) -> Audit:
    """The verdict from measured offsets.

    Args:
        starts: seconds of each video's first frame on its own clock; first frames of a synchronised rig are of one
            moment. Default: all equal. fps: of each video; default: ``offsets.fps``.
        tolerance: frames. ValueError unless it is above 0.
    """
    if not (np.isfinite(tolerance) and tolerance > 0):
        raise ValueError(f"tolerance: expected frames above 0; found {tolerance:g}.")
    V = len(offsets)
    fps = offsets.fps if fps is None else np.asarray(fps, float)
    late = np.asarray(offsets.seconds, float) + (0.0 if starts is None else starts)
    linked = np.isfinite(late) & (np.asarray(offsets.component) == offsets.component[offsets.reference])
    quiet = linked & np.array([not flags for flags in offsets.flags])
    agreed = quiet if quiet.sum() >= LEAST else linked
    centre = float(np.median(late[agreed])) if agreed.any() else np.nan
    jitter, sigma = _scatter(offsets, late, linked)
    frames, sigma_frames, jitter_frames = (late - centre) * fps, sigma * fps, jitter * fps
    near = agreed & (np.abs(frames) <= np.maximum(tolerance, SIGMAS * sigma_frames))
    majority = V >= LEAST and 2 * int(near.sum()) > V
    cameras = []
    for v, name in enumerate(offsets.names):
        finding, why = _judge(
            float(frames[v]), float(sigma_frames[v]), bool(linked[v]), offsets.flags[v], majority, V, tolerance
        )
        cameras.append(
            CameraVerdict(
                name, finding, float(frames[v]), float(sigma_frames[v]), float(jitter_frames[v]), offsets.flags[v], why
            )
        )
    return Audit(tuple(cameras), tolerance, offsets)


def _judge(
    frames: float, sigma: float, linked: bool, flags: tuple[Status, ...], majority: bool, V: int, tolerance: float
) -> tuple[Finding, str]:
    if not linked or not np.isfinite(frames):
        return "unsure", "no sound pair links it to the others"
    if not majority:
        if V < LEAST:
            return "unsure", f"of {V} cameras nobody can tell which one is off"
        return "unsure", "no majority of the cameras agrees on one clock"
    if abs(frames) - SIGMAS * sigma > tolerance:
        doubt = f"; flagged {', '.join(f.code for f in flags)}" if flags else ""
        return "off", f"{'late' if frames > 0 else 'early'} by {abs(frames):.2f} frames{doubt}"
    if flags:
        return "unsure", f"flagged {', '.join(f.code for f in flags)}"
    if abs(frames) <= tolerance or abs(frames) <= 2 * sigma <= 2 * tolerance:
        return "in_sync", ""
    return "unsure", f"{abs(frames):.2f} frames are more than {tolerance:g}, and within {SIGMAS:g} sigma of it"


def _scatter(
    offsets: Offsets, late: Float[np.ndarray, " V"], linked: np.ndarray
) -> tuple[Float[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    """(robust scatter of the answers of each video's pairs around the solution, sigma of each video), seconds.

    The reference's own sigma is 0 by definition; here it is what its pairs leave, as of the others.
    """
    V = len(offsets)
    seconds = np.asarray(offsets.seconds, float)
    left: list[list[float]] = [[] for _ in range(V)]
    for (a, b), pair in offsets.alignments.items():
        if pair.status.ok and linked[a] and linked[b]:
            residual = float(offsets.rates[a] * pair.offset - (seconds[b] - seconds[a]))
            left[a].append(residual)
            left[b].append(residual)
    jitter = np.array([MAD * np.median(np.abs(r)) if r else np.nan for r in left])
    count = np.array([max(len(r), 1) for r in left])
    told = np.where(np.arange(V) == offsets.reference, np.nan, np.asarray(offsets.sigma, float))
    usual = float(np.nanmedian(told)) if np.isfinite(told).any() else np.nan
    told = np.where(np.isfinite(told), told, usual)
    return jitter, np.fmax(told, jitter / np.sqrt(count))
