"""Effects of cameras and clocks: frames of reference that are off, rows read one by one, clocks that wander."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ...types.checks import check_number
from ..observation import Observation, Similarity
from .noise import smooth_noise


@dataclass(frozen=True)
class CameraFrame:
    """The video's frame is off: scale (relative), rotation (degrees, about a random axis), translation (m per axis)."""

    scale: float = 0.01
    rotation: float = 1.0
    translation: float = 0.03

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        axis = rng.standard_normal(3)
        angle = np.radians(self.rotation) * rng.standard_normal()
        scale = 1 + self.scale * rng.standard_normal()
        error = Similarity(scale, rotation(axis, angle), self.translation * rng.standard_normal(3))
        return _reframed(obs, error)


@dataclass(frozen=True)
class RigidFrame:
    """The video has a frame of its own: any rotation, an origin within ``distance`` m."""

    distance: float = 5.0

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        q, r = np.linalg.qr(rng.standard_normal((3, 3)))
        q *= np.sign(np.diag(r))
        q[:, 0] *= np.linalg.det(q)
        return _reframed(obs, Similarity(1.0, q, rng.uniform(-self.distance, self.distance, 3)))


@dataclass(frozen=True)
class OwnFrame:
    """The video has a frame and a unit of its own: any rotation, an origin within ``distance`` m, and a scale of up to
    ``scale`` times more or less. What a phone with depth reports, or a depth camera that nobody calibrated.
    """

    scale: float = 2.0
    distance: float = 5.0

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        obs = RigidFrame(self.distance)(obs, rng)
        grown = float(np.exp(rng.uniform(-1, 1) * np.log(self.scale)))
        return _reframed(obs, Similarity(grown, np.eye(3), np.zeros(3)))


def _reframed(obs: Observation, change: Similarity) -> Observation:
    return replace(obs, xyz=change(obs.xyz), frame=change.after(obs.frame), camera=change.camera(obs.camera))


def rotation(axis: Float[np.ndarray, " 3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """About ``axis`` by ``angle`` rad (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


@dataclass(frozen=True)
class RollingShutter:
    """Rows are read one after the other over ``readout`` s, the middle one at the frame's time.

    A point is seen at the row that is read when it is there. The motion within a readout is followed by a polynomial
    through five exact instants.

    Args:
        readout: seconds from the first to the last row; or a range (from, to), of which every video draws its own.
    """

    readout: float | tuple[float, float] = 0.02

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        readout = float(rng.uniform(*self.readout)) if isinstance(self.readout, tuple) else self.readout
        at_time = obs.frame(obs.at(obs.world_times))
        nodes = np.linspace(-0.5, 0.5, 5)
        steps = [obs.moved(obs.rate * node * readout) for node in nodes]
        moved = np.zeros_like(obs.xyz)
        for _ in range(4):  # a point's row moves by a few percent of the height: an error of 1e-6 remains
            row = obs.camera.project(at_time + moved)[..., 1] / obs.camera.height - 0.5
            row = np.nan_to_num(np.clip(row, -0.5, 0.5))
            moved = np.zeros_like(obs.xyz)
            for i, (node, step) in enumerate(zip(nodes, steps, strict=True)):
                others = np.delete(nodes, i)
                weight = np.prod((row[..., None] - others) / (node - others), axis=2)
                moved += weight[..., None].astype(moved.dtype) * step
        return replace(obs, xyz=obs.xyz + moved, camera=replace(obs.camera, readout=readout))


@dataclass(frozen=True)
class LatePoses:
    """A camera that turns after what it films, by the middle of its tracks, and whose poses come late: a gimbal's or a
    phone's, stamped when they were read.

    What a frame shows is then put where the camera pointed ``late`` s before, so that all of it turns about the camera
    as the middle turned in that time. One performer who is followed seems to be ``late`` s behind across the ray.

    Args:
        late: s. settles: s over which the camera smooths what it follows.
    """

    late: float = 0.1
    settles: float = 0.3

    def __post_init__(self) -> None:
        check_number("LatePoses.late", self.late, -10.0, 10.0)
        check_number("LatePoses.settles", self.settles, 1e-3, 10.0)

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        centre = obs.camera.center if obs.camera.center.ndim == 2 else obs.camera.center[None]
        aim = np.median(obs.xyz, 0).astype(float) - centre
        near = np.exp(-(((obs.times[:, None] - obs.times) / self.settles) ** 2) / 2)
        aim = near / near.sum(1, keepdims=True) @ aim
        said = np.stack([np.interp(obs.times - self.late, obs.times, x) for x in aim.T], axis=1)
        turn = _turning(aim, said)
        at = obs.xyz - centre
        return replace(obs, xyz=obs.xyz + (np.einsum("tij,ntj->nti", turn, at) - at).astype(obs.xyz.dtype))


def _turning(a: Float[np.ndarray, "T 3"], b: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3 3"]:
    """The smallest rotations that turn the directions a towards b (Rodrigues); no two may be opposite."""
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    x, y, z = np.cross(a, b).T
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return np.eye(3) + K + K @ K / (1 + (a * b).sum(1))[:, None, None]


@dataclass(frozen=True)
class ClockDrift:
    """The video's clock wanders: frames are exposed up to ``size`` s (one sigma) off the times the file tells.

    ``Truth.shown`` tells when they were.
    """

    size: float = 0.005
    correlation: float = 2.0

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        return _shown_late(obs, self.size * smooth_noise((1,), obs.times, self.correlation, rng, np.float64)[0])


@dataclass(frozen=True)
class ClockRamp:
    """The video's clock bends: from its first frame to its last one its rate grows evenly by ``change``, -1 to 1.

    A rate is seconds of the world in a second of the clock: where it grows, the file plays ever faster. The file tells
    times of the mean rate. ``Truth.shown`` tells the true ones: at both ends ``change`` · length / 8 later than those
    told, or earlier where ``change`` is negative.
    """

    change: float = 0.02

    def __post_init__(self) -> None:
        check_number("ClockRamp.change", self.change, -1.0, 1.0)

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        t = obs.times - (obs.times[0] + obs.times[-1]) / 2
        return _shown_late(obs, self.change * t**2 / (2 * max(float(np.ptp(t)), 1e-9)))


@dataclass(frozen=True)
class ClockSway:
    """The video's clock falls behind and runs ahead in turn, by ``size`` s at most, once in ``period`` s.

    Every video begins at a moment of its own in this period. ``Truth.shown`` tells when frames were exposed.
    """

    size: float = 0.5 / 30
    period: float = 2.0

    def __post_init__(self) -> None:
        check_number("ClockSway.period", self.period)
        most = float(self.period / (2 * np.pi))  # of more, time would run backwards
        check_number("ClockSway.size", self.size, -most, most)

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        turn = 2 * np.pi * (obs.times / self.period + rng.random())
        return _shown_late(obs, self.size * np.sin(turn))


def _shown_late(obs: Observation, off: Float[np.ndarray, " T"]) -> Observation:
    """Every frame shows what was ``off`` s later than the time that its file tells."""
    late = off if obs.late is None else obs.late + off
    return replace(obs, xyz=obs.xyz + obs.moved(off), late=late)


@dataclass(frozen=True)
class DroppedFrames:
    """A ``share`` of the frames never reached the file; the first stays. The others keep their timestamps."""

    share: float = 0.05

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        stays = rng.random(len(obs.times)) >= self.share
        stays[0] = True
        late = None if obs.late is None else obs.late[stays]
        xyz, visible = obs.xyz[:, stays], obs.visible[:, stays]
        return replace(obs, xyz=xyz, visible=visible, times=obs.times[stays], late=late, regular=False)
