"""``otsync audit``: is a rig that is said to be synchronised so? Each camera's verdict, with sigma.

The pictures are synchronised as if nothing were known, on the pixels' route, which needs no depth that was built from
the rig's own clock. What each camera is off by is measured against what most cameras agree on, so that the first one
is judged like the others.

The question is narrower than that of a search, and so is the answer's sigma:

* No camera is the reference. A sigma that is told against one camera has that camera's error in it, and a flag of one
  whose clock is doubtful goes to all that are measured by it. Here every camera is measured against all of them.
* The pairs' errors go the way that the answer goes: a pair that is known to a frame hardly moves it, and hardly adds
  to its sigma. What tracks of a video have in common errs alike in all its pairs, and no number of pairs averages that
  out (:data:`SHARED`).
* The cameras are declared to be of one moment. So how far most of the others are apart is an error that was made,
  whatever the pairs say: sigma is at least what that takes. Pairs that contradict each other, all or those of one
  camera, say the same.
* A flag that asks which of many peaks is the right one (:data:`OF_PEAKS`) is settled by the sum of the curves of the
  camera's pairs with those that agree, where that has no rival.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from ..compute.threads import MapLike
from ..files.cache import Cache
from ..io.scene import Scene
from ..progress import Tell
from ..sync.graph import CAUCHY, CurveSum, Edge
from ..sync.verdict import FRAME, SHARED, STANDING_MARGIN
from ..types import Offsets, Status, in_order
from ..types.results import COARSE_FRAMES
from .routes import synchronize_scene
from .stages import Stages

Finding = Literal["in_sync", "off", "unsure"]

MAD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""

SIGMAS = 3.0
"""Standard deviations that an alarm must stand above the tolerance."""

LEAST = 3
"""Cameras that a majority needs: of two nobody can tell which one is off."""

OF_PEAKS = frozenset(
    {Status.AMBIGUOUS, Status.WEAK, Status.FEW_MATCHES, Status.SHORT_OVERLAP, Status.BORDER, Status.MOVED}
)
"""Flags that doubt which peak of a pair is the right one."""

OTHERS = 4
"""Cameras beside one that tell by themselves how far apart they are: one of four may be off, of three hardly."""

SMALL = 0.8
"""A median absolute deviation of n is too small by n / (n - SMALL) (Croux and Rousseeuw, 1992)."""

FAR = 1.5
"""Standard deviations beyond which a camera counts as if it were there."""

OF_NORMAL = float(chi2.cdf(FAR**2, 3) + FAR**2 * chi2.sf(FAR**2, 1))
"""Mean square of normal noise of variance 1 that is cut there."""

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
            the majority, nan where there is no answer. sigma: one standard deviation of that, frames: against all
            cameras, not against one of them.
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
    # the flags of a camera that is not sure go to all that hang on it: let that be the surest one
    found = synchronize_scene(scene, route="epipolar", reference="auto", stages=stages, cache=cache, map=map, tell=tell)
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
    links = _links(offsets, linked)
    jitter, sigma = _scatter(links, V)
    linked &= np.isfinite(sigma)
    doubts = [_doubts(v, offsets) for v in range(V)]
    quiet = linked & np.array([not flags for flags in doubts])
    agreed = quiet if quiet.sum() >= LEAST else linked
    centre = float(np.median(late[agreed])) if agreed.any() else np.nan
    sigma = sigma * _discord(np.abs(late - centre) / sigma, agreed)
    frames, sigma_frames, jitter_frames = (late - centre) * fps, sigma * fps, jitter * fps
    beside = linked & (np.abs(frames) <= np.maximum(tolerance, SIGMAS * sigma_frames))
    near = agreed & beside
    # a camera that is doubted, and all the same where the sure ones are, is one voice more for their clock
    majority = V >= LEAST and 2 * int(beside.sum()) > V
    cameras = []
    for v, name in enumerate(offsets.names):
        left = doubts[v]
        if left and OF_PEAKS.issuperset(left) and _settled(v, links, near, np.asarray(offsets.seconds, float)):
            left = ()
        finding, why = _judge(float(frames[v]), float(sigma_frames[v]), bool(linked[v]), left, majority, V, tolerance)
        cameras.append(
            CameraVerdict(
                name, finding, float(frames[v]), float(sigma_frames[v]), float(jitter_frames[v]), offsets.flags[v], why
            )
        )
    return Audit(tuple(cameras), tolerance, offsets)


def _judge(
    frames: float, sigma: float, linked: bool, flags: tuple[Status, ...], majority: bool, V: int, tolerance: float
) -> tuple[Finding, str]:
    """The verdict on one camera. ``flags``: doubts that the question leaves."""
    if not linked or not np.isfinite(frames):
        return "unsure", "no sound pair links it to the others"
    if not majority:
        if V < LEAST:
            return "unsure", f"of {V} cameras nobody can tell which one is off"
        return "unsure", "no majority of the cameras agrees on one clock"
    late = f"{'late' if frames > 0 else 'early'} by {abs(frames):.2f} frames"
    flagged = f"flagged {', '.join(f.code for f in flags)}"
    if abs(frames) - SIGMAS * sigma > tolerance:
        if OF_PEAKS & set(flags):
            return "unsure", f"it seems {late}; {flagged}"
        return "off", f"{late}; {flagged}" if flags else late
    if flags:
        return "unsure", flagged
    if sigma > COARSE_FRAMES:
        return "unsure", f"known to {sigma:.2f} frame at one sigma: more than a third"
    if abs(frames) <= tolerance or abs(frames) <= 2 * sigma <= 2 * tolerance:
        return "in_sync", ""
    return "unsure", f"{abs(frames):.2f} frames are more than {tolerance:g}, and within {SIGMAS:g} sigma of it"


def _doubts(v: int, offsets: Offsets) -> tuple[Status, ...]:
    """The flags of a video, but for that of its sigma, which is judged here; of the reference, too, which has none by
    definition: what is wrong with its clock stands in its pairs.
    """
    flags = [f for f in offsets.flags[v] if f is not Status.COARSE]
    own = [pair for ends, pair in offsets.alignments.items() if v in ends and np.isfinite(pair.offset)]
    broken = v == offsets.reference and 2 * sum(Status.BROKEN_CLOCK in p.flags for p in own) >= max(len(own), 1)
    if broken or offsets.breaks[v]:
        flags.append(Status.BROKEN_CLOCK)
    return in_order(flags)


@dataclass(frozen=True, eq=False)
class _Link:
    """A pair that counts, in world seconds. ``residual``: x_b - x_a less what it says; ``vouches``: no flag."""

    edge: Edge
    residual: float
    vouches: bool


def _links(offsets: Offsets, linked: np.ndarray) -> list[_Link]:
    """The pairs that the offsets were solved from; the sigma of a flagged one counts three times, as there."""
    out = []
    seconds = np.asarray(offsets.seconds, float)
    for (a, b), pair in sorted(offsets.alignments.items()):
        if not (linked[a] and linked[b] and np.isfinite(pair.offset) and pair.stats.get("used", 1.0)):
            continue
        edge = Edge.of(a, b, float(offsets.rates[a] * pair.offset), pair, pair.curve)
        out.append(_Link(edge, float(seconds[b] - seconds[a]) - edge.offset, edge.trusted))
    return out


def _scatter(links: list[_Link], V: int) -> tuple[Float[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    """(robust scatter of the answers of each video's pairs around the solution, sigma of each video), seconds; nan
    where there is no pair.

    Sigma is of the difference to the mean of all videos that pairs link. Of a pair's variance, ``SHARED`` or what it
    tells of common errors, whichever is more, is its two videos' own, half of it each; one video errs alike in all its
    pairs. The rest is each pair's.
    """
    jitter, out = np.full(V, np.nan), np.full(V, np.nan)
    inside = sorted({v for link in links for v in (link.edge.a, link.edge.b)})
    if not inside:
        return jitter, out
    A = np.zeros((len(links), V))
    for row, link in enumerate(links):
        A[row, link.edge.b], A[row, link.edge.a] = 1, -1
    A = A[:, inside]
    sigma, common = (np.array([getattr(link.edge, k) for link in links]) for k in ("sigma", "common"))
    residual = np.array([link.residual for link in links])
    z = residual / sigma
    weight = 1 / (1 + (z / CAUCHY) ** 2) / sigma**2
    gain = np.linalg.pinv(A.T @ (A * weight[:, None])) @ (A.T * weight)  # what each pair moves each video by
    own = np.maximum(common**2, SHARED * sigma**2)
    shared = (gain * np.sqrt(own / 2)) @ A
    told = np.sqrt((shared**2).sum(1) + (gain**2 * np.maximum(sigma**2 - own, 0)).sum(1))
    # a fit of n videos to E pairs takes n - 1 of their E residuals away
    free = len(links) - (len(inside) - 1)
    lost = np.sqrt(len(links) / free) if free > 0 else 1.0
    discord = lost * float(np.sqrt(np.mean(np.minimum(z**2, CAUCHY**2))))
    for k, v in enumerate(inside):
        at = A[:, k] != 0
        out[v] = told[k] * max(1.0, discord, MAD * lost * float(np.median(np.abs(z[at]))))
        vouching = at & np.array([link.vouches for link in links])
        if vouching.any():
            jitter[v] = MAD * float(np.median(np.abs(residual[vouching])))
    return jitter, out


def _settled(v: int, links: list[_Link], near: np.ndarray, seconds: Float[np.ndarray, " V"]) -> bool:
    """Whether the summed curves of v's pairs with the cameras that agree peak at its place, without a rival."""
    near = near.copy()
    near[v] = True
    curves = CurveSum(len(near), [link.edge for link in links if near[link.edge.a] and near[link.edge.b]], FRAME)
    if not curves.around[v]:
        return False
    here, rival = curves.standing(v, seconds)
    return here > 0 and here - rival >= STANDING_MARGIN * here


def _discord(apart: Float[np.ndarray, " V"], agreed: Bool[np.ndarray, " V"]) -> Float[np.ndarray, " V"]:
    """What each camera's sigma is to be multiplied by: 1, or what most of the others are apart, in their sigmas.

    That is an error of measuring. What the camera itself is off by is the question, and no part of the answer's error.
    Of fewer than :data:`OTHERS` one that is off would be too large a part, so there all answer, by their median.
    """
    count = int(agreed.sum())
    if count <= OTHERS:
        told = MAD * float(np.median(apart[agreed])) * count / (count - SMALL) if count else 1.0
        return np.full(len(apart), max(1.0, told))
    out = np.ones(len(apart))
    for v in range(len(apart)):
        out[v] = max(1.0, scale_of(apart[agreed & (np.arange(len(apart)) != v)]))
    return out


def scale_of(apart: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of n >= 2 values from distances to their middle, which hardly heeds a few that are far away.

    The largest solution s of mean(min((d / s)², FAR²)) = OF_NORMAL: those beyond :data:`FAR` of it count as if they
    were there (Huber, 1964, proposal 2). Of few values it is known far better than by their median. Corrected as the
    standard deviation of n normal values about their mean is.
    """
    n, squares = len(apart), np.sort(apart**2)
    for near in range(n, 0, -1):
        variance = float(squares[:near].sum()) / (OF_NORMAL * n - FAR**2 * (n - near))
        if squares[near - 1] <= FAR**2 * variance:
            break
    return math.sqrt(variance * n / (n - 1)) * (4 * n - 3) / (4 * n - 4)
