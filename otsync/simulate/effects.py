"""What goes wrong between a surface and its tracks: each effect is an object ``(observation, rng) -> observation``.

Effects stand in a tuple and are applied in order; what is not in the tuple is not computed. Every effect draws from a
stream of its own, so that adding, removing or reordering others leaves its draws bit for bit as they are. An effect of
strength zero changes no bit of the positions. Depth errors act along the viewing ray and are relative to depth;
lengths are metres, times seconds, so nothing depends on the frame rate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from .observation import Observation, Similarity, Surface


@runtime_checkable
class Effect(Protocol):
    """Anything that turns an observation into another. A user's own goes into the tuple like these."""

    def __call__(self, observation: Observation, rng: np.random.Generator) -> Observation: ...


def smooth_noise(
    shape: tuple[int, ...], times: Float[np.ndarray, " T"], correlation: float, rng: np.random.Generator, dtype: type
) -> Float[np.ndarray, "*shape T"]:
    """Unit-variance Gaussian noise, smooth in time: correlation ``exp(-(dt / correlation)^2 / 2)``.

    White noise on knots, spread by Gaussians and normalised at every instant; defined at any times.
    """
    width = correlation / np.sqrt(2)
    knots = np.arange(times[0] - 4 * width, times[-1] + 4 * width, width)
    basis = np.exp(-0.5 * ((times - knots[:, None]) / width) ** 2)
    basis /= np.sqrt((basis**2).sum(0))
    return rng.standard_normal((*shape, len(knots)), dtype=dtype) @ basis.astype(dtype)


def _along_ray(obs: Observation, relative: np.ndarray) -> Observation:
    return replace(obs, xyz=obs.xyz + obs.rays() * relative.astype(obs.xyz.dtype)[..., None])


def _dtype(obs: Observation) -> type:
    return obs.xyz.dtype.type


@dataclass(frozen=True)
class DepthBias:
    """A wrong depth of the whole track, relative standard deviation ``size``."""

    size: float = 0.02

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        return _along_ray(obs, self.size * rng.standard_normal((len(obs.xyz), 1)))


@dataclass(frozen=True)
class DepthDrift:
    """A slowly changing wrong depth of every track of its own."""

    size: float = 0.008
    correlation: float = 1.0

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        drift = smooth_noise((len(obs.xyz),), obs.times, self.correlation, rng, _dtype(obs))
        return _along_ray(obs, self.size * drift)


@dataclass(frozen=True)
class CameraDepthDrift:
    """A slowly changing wrong depth that all tracks of the video share."""

    size: float = 0.004
    correlation: float = 1.2

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        drift = smooth_noise((1,), obs.times, self.correlation, rng, _dtype(obs))
        return _along_ray(obs, self.size * drift)


@dataclass(frozen=True)
class DepthJitter:
    """White noise of depth, a new value in every sample."""

    size: float = 0.005

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        return _along_ray(obs, self.size * rng.standard_normal(obs.xyz.shape[:2], dtype=_dtype(obs)))


@dataclass(frozen=True)
class LateralJitter:
    """White noise across the viewing ray: ``size`` m in each of the two directions."""

    size: float = 0.003

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        noise = _dtype(obs)(self.size) * rng.standard_normal(obs.xyz.shape, dtype=_dtype(obs))
        ray = obs.rays()
        along = np.einsum("nti,nti->nt", noise, ray) / np.einsum("nti,nti->nt", ray, ray)
        return replace(obs, xyz=obs.xyz + (noise - along[..., None] * ray))


@dataclass(frozen=True)
class PositionNoise:
    """White noise in all three directions, relative to the size of the scene."""

    size: float = 0.01

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        noise = rng.standard_normal(obs.xyz.shape, dtype=_dtype(obs))
        noise *= _dtype(obs)(self.size * obs.size)
        noise += obs.xyz
        return replace(obs, xyz=noise)


@dataclass(frozen=True)
class SlowDrift:
    """Every track slides over the surface: smooth noise of ``size`` m in each direction."""

    size: float = 0.008
    correlation: float = 1.2

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        drift = smooth_noise((len(obs.xyz), 3), obs.times, self.correlation, rng, _dtype(obs))
        return replace(obs, xyz=obs.xyz + _dtype(obs)(self.size) * drift.swapaxes(1, 2))


@dataclass(frozen=True)
class LimbDrift:
    """All tracks of a limb drift together: smooth noise of ``size`` m in each direction."""

    size: float = 0.05
    correlation: float = 0.8

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        parts = int(obs.surface.part.max(initial=-1)) + 2  # the last row is for outliers, part -1: none
        drift = smooth_noise((parts, 3), obs.times, self.correlation, rng, _dtype(obs)) * _dtype(obs)(self.size)
        drift[-1] = 0
        return replace(obs, xyz=obs.xyz + drift.swapaxes(1, 2)[obs.surface.part])


@dataclass(frozen=True)
class RayCompression:
    """Depth follows motion along the ray only in part: one factor in [low, high] for every limb."""

    low: float = 0.5
    high: float = 1.0

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        factor = rng.uniform(self.low, self.high, int(obs.surface.part.max(initial=-1)) + 2)[obs.surface.part]
        depth = np.linalg.norm(obs.rays(), axis=2)
        return _along_ray(obs, (factor[:, None] - 1) * (1 - depth.mean(1, keepdims=True) / depth))


@dataclass(frozen=True)
class IdentitySwitch:
    """A ``share`` of the tracks jumps once, to some track of another part, and follows that one from then on.

    The truth still calls such a track by its first identity.
    """

    share: float = 0.3

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        n, frames = obs.xyz.shape[:2]
        part = obs.surface.part
        when = rng.integers(frames // 5, max(frames - frames // 5, frames // 5 + 1), n)
        order = rng.permutation(n)
        xyz = obs.xyz.copy()
        for i in np.flatnonzero(rng.random(n) < self.share):
            # the first of another part, from a random place in a random order
            others = np.roll(order, -i)
            others = others[part[others] != part[i]]
            if len(others):
                xyz[i, when[i] :] = obs.xyz[others[0], when[i] :]
        return replace(obs, xyz=xyz)


@dataclass(frozen=True)
class Smoothing:
    """The tracker's temporal smoother: a Gaussian of ``sigma`` s, times one random factor a video."""

    sigma: float = 2.5 / 30
    low: float = 0.6
    high: float = 1.4

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        sigma = self.sigma * rng.uniform(self.low, self.high)
        if sigma <= 0:
            return obs
        kernel = np.exp(-0.5 * ((obs.times - obs.times[:, None]) / sigma) ** 2).astype(obs.xyz.dtype)
        seen = obs.visible.astype(obs.xyz.dtype)
        weight = np.maximum(seen @ kernel, 1e-12)
        middle = obs.xyz.mean(1, keepdims=True)  # numerics only
        xyz = (
            middle
            + np.einsum("st,nti->nsi", kernel, (obs.xyz - middle) * seen[..., None], optimize=True) / weight[..., None]
        )
        return replace(obs, xyz=np.where(obs.visible[..., None], xyz, obs.xyz))


@dataclass(frozen=True)
class Gaps:
    """A ``share`` of all samples is not observed, in runs of ``shortest`` to ``longest`` seconds.

    Runs and the spans between them follow each other as a stationary renewal process, so the share holds in the mean,
    also at the ends of the clip. A track that would be hidden throughout is left whole: it would not be a track.
    """

    share: float = 0.2
    shortest: float = 8 / 30
    longest: float = 45 / 30

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        if self.share <= 0 or len(obs.times) < 2:
            return obs
        n = len(obs.xyz)
        hidden = (self.shortest + self.longest) / 2
        shown = hidden * (1 - self.share) / self.share
        cycle = shown + hidden
        start, end = obs.times[0] - rng.uniform(3, 4, (n, 1)) * cycle, obs.times[-1]
        count = int(np.ceil((end - obs.times[0]) / cycle + 4 + 4 * np.sqrt((end - obs.times[0]) / cycle + 4)))
        spans = rng.exponential(shown, (n, count))
        runs = rng.uniform(self.shortest, self.longest, (n, count))
        ends = start + np.cumsum(spans + runs, 1)
        change = np.zeros((n, len(obs.times) + 1))
        rows = np.repeat(np.arange(n), count)
        np.add.at(change, (rows, np.searchsorted(obs.times, ends - runs).ravel()), 1)
        np.add.at(change, (rows, np.searchsorted(obs.times, ends).ravel()), -1)
        seen = np.cumsum(change[:, :-1], 1) == 0
        seen[~(seen & obs.visible).any(1)] = True
        return replace(obs, visible=obs.visible & seen)


@dataclass(frozen=True)
class Hallucination:
    """A ``share`` of the spans that are missing so far is reported as seen: interpolated linearly, held at the ends."""

    share: float = 0.3

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        edge = np.diff(np.pad(obs.visible, ((0, 0), (1, 1)), constant_values=True).astype(np.int8), axis=1)
        rows, first = np.nonzero(edge == -1)
        last = np.nonzero(edge == 1)[1]  # one past the span
        chosen = np.flatnonzero(rng.random(len(rows)) < self.share)
        xyz, visible = obs.xyz.copy(), obs.visible.copy()
        for i in chosen:
            n, a, b = rows[i], first[i], last[i]
            if a == 0 and b == len(obs.times):
                continue
            before, after = max(a - 1, 0) if a else b, min(b, len(obs.times) - 1) if b < len(obs.times) else a - 1
            s = np.clip((obs.times[a:b] - obs.times[before]) / max(obs.times[after] - obs.times[before], 1e-9), 0, 1)
            xyz[n, a:b] = obs.xyz[n, before] + s[:, None] * (obs.xyz[n, after] - obs.xyz[n, before])
            visible[n, a:b] = True
        return replace(obs, xyz=xyz, visible=visible)


@dataclass(frozen=True)
class Occlusion:
    """Samples whose surface is turned away from the camera are not observed (``clearance``: cosine below which)."""

    clearance: float = 0.0

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        seen = obs.facing(obs.world_times) > self.clearance
        seen[~(seen & obs.visible).any(1)] = True
        return replace(obs, visible=obs.visible & seen)


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


def _reframed(obs: Observation, change: Similarity) -> Observation:
    return replace(obs, xyz=change(obs.xyz), frame=change.after(obs.frame), camera=change.camera(obs.camera))


def rotation(axis: Float[np.ndarray, " 3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """About ``axis`` by ``angle`` rad (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


@dataclass(frozen=True)
class Outliers:
    """A ``share`` of the tracks belongs to nothing: ``background`` of them static, the others float about.

    Floaters carry the feature of some real track, background its own. Both belong to no object in the truth.
    """

    share: float = 0.2
    background: float = 0.5

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        n, dtype = len(obs.xyz), _dtype(obs)
        count = round(self.share * n)
        chosen = rng.permutation(n)[:count]
        if not 0 < count < n:
            return obs
        fixed, floating = np.split(chosen, [round(self.background * count)])
        real = np.setdiff1d(np.arange(n), chosen)
        middle = obs.xyz[real].mean((0, 1))
        xyz = obs.xyz.copy()
        xyz[fixed] = (middle + obs.size * rng.uniform(-1.0, 1.0, (len(fixed), 1, 3))).astype(dtype)
        drift = smooth_noise((len(floating), 3), obs.times, 1.0, rng, dtype).swapaxes(1, 2)
        spot = middle + obs.size * rng.uniform(-0.5, 0.5, (len(floating), 1, 3))
        xyz[floating] = spot.astype(dtype) + dtype(0.1 * obs.size) * drift
        features = obs.features
        if features is not None:
            features = features.copy()
            features[floating] = features[rng.choice(real, len(floating))]
            scale = np.sqrt(np.mean(np.square(features[real]), dtype=np.float64))
            features[fixed] = dtype(scale) * rng.standard_normal((len(fixed), features.shape[1]), dtype=dtype)
        s = obs.surface
        part, object, position, mirrored = s.part.copy(), s.object.copy(), s.position.copy(), s.mirrored.copy()
        part[chosen] = object[chosen] = -1
        position[chosen] = mirrored[chosen] = np.nan
        surface = Surface(part, object, s.local, position, mirrored)
        return replace(obs, xyz=xyz, features=features, surface=surface)


@dataclass(frozen=True)
class RollingShutter:
    """Rows are read one after the other over ``readout`` s, the middle one at the frame's time.

    The motion within a readout is followed by a polynomial through five exact instants.
    """

    readout: float = 0.02

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        row = obs.camera.project(obs.frame(obs.at(obs.world_times)))[..., 1] / obs.camera.height - 0.5
        row = np.nan_to_num(np.clip(row, -0.5, 0.5))
        nodes = np.linspace(-0.5, 0.5, 5)
        moved = np.zeros_like(obs.xyz)
        for i, node in enumerate(nodes):
            others = np.delete(nodes, i)
            weight = np.prod((row[..., None] - others) / (node - others), axis=2)
            moved += weight[..., None].astype(moved.dtype) * obs.moved(obs.rate * node * self.readout)
        return replace(obs, xyz=obs.xyz + moved, camera=replace(obs.camera, readout=self.readout))


@dataclass(frozen=True)
class ClockDrift:
    """The video's clock wanders: frames are exposed up to ``size`` s (one sigma) off the times the file tells."""

    size: float = 0.005
    correlation: float = 2.0

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        off = self.size * smooth_noise((1,), obs.times, self.correlation, rng, np.float64)[0]
        return replace(obs, xyz=obs.xyz + obs.moved(off))


@dataclass(frozen=True)
class DroppedFrames:
    """A ``share`` of the frames never reached the file; the first stays. The others keep their timestamps."""

    share: float = 0.05

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        keep = rng.random(len(obs.times)) >= self.share
        keep[0] = True
        return replace(obs, xyz=obs.xyz[:, keep], visible=obs.visible[:, keep], times=obs.times[keep], regular=False)
