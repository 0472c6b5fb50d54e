"""Effects of trackers: they lose tracks, invent them, mix them up, smooth them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ..observation import Observation, Surface
from .noise import along_ray, dtype_of, smooth_noise

LAG_STEP = 1 / 120
"""Seconds between the delays at which a world is asked where its points are."""


@dataclass(frozen=True)
class RayCompression:
    """Depth follows motion along the ray only in part: one factor in [low, high] for every limb."""

    low: float = 0.5
    high: float = 1.0

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        factor = rng.uniform(self.low, self.high, int(obs.surface.part.max(initial=-1)) + 2)[obs.surface.part]
        depth = np.linalg.norm(obs.rays(), axis=2)
        return along_ray(obs, (factor[:, None] - 1) * (1 - depth.mean(1, keepdims=True) / depth))


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
class Lag:
    """Every track comes late by a delay of its own, as those of a tracker that filters as it goes.

    Args:
        mean: s; delays are exponentially distributed.
    """

    mean: float = 3 / 30

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        if self.mean <= 0:
            return obs
        delay = rng.exponential(self.mean, len(obs.xyz))
        known = np.linspace(0.0, float(delay.max()), max(2, int(np.ceil(delay.max() / LAG_STEP)) + 1))
        xyz = obs.xyz.copy()
        # between two known delays a track is taken to run straight on
        right = np.clip(np.searchsorted(known, delay), 1, len(known) - 1)
        share = ((delay - known[right - 1]) / (known[right] - known[right - 1])).astype(obs.xyz.dtype)
        for k, late in enumerate(known):
            weight = np.where(right == k, share, 0) + np.where(right - 1 == k, 1 - share, 0)
            chosen = np.flatnonzero(weight)
            if len(chosen):
                xyz[chosen] += weight[chosen, None, None] * obs.moved(-late)[chosen]
        return replace(obs, xyz=xyz)


@dataclass(frozen=True)
class PartLate:
    """Every second thing, the first one among them, is shown ``seconds`` late: on a screen, or by another tracker."""

    seconds: float = 8 / 30

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        things = np.unique(obs.surface.object[obs.surface.object >= 0])
        late = np.isin(obs.surface.object, things[::2])
        return replace(obs, xyz=obs.xyz + np.where(late[:, None, None], obs.moved(-self.seconds), 0))


def lost_spans(
    times: Float[np.ndarray, " T"], n: int, share: float, lengths: tuple[float, float], rng: np.random.Generator
) -> Bool[np.ndarray, "n T"]:
    """Where ``n`` tracks are lost: a ``share`` of all samples, in runs of random length (seconds, from, to).

    Runs and the spans between them follow each other as a stationary renewal process, so the share holds in the mean,
    also at the ends of the clip, where runs are cut.
    """
    hidden = sum(lengths) / 2
    shown = hidden * (1 - share) / share
    cycle = shown + hidden
    cycles = (times[-1] - times[0]) / cycle + 4
    start = times[0] - rng.uniform(3, 4, (n, 1)) * cycle
    count = int(np.ceil(cycles + 4 * np.sqrt(cycles)))
    runs = rng.uniform(*lengths, (n, count))
    ends = start + np.cumsum(rng.exponential(shown, (n, count)) + runs, 1)
    change = np.zeros((n, len(times) + 1))
    rows = np.repeat(np.arange(n), count)
    np.add.at(change, (rows, np.searchsorted(times, ends - runs).ravel()), 1)
    np.add.at(change, (rows, np.searchsorted(times, ends).ravel()), -1)
    return np.cumsum(change[:, :-1], 1) > 0


@dataclass(frozen=True)
class Gaps:
    """A ``share`` of all samples is not observed, in runs of ``shortest`` to ``longest`` seconds.

    A track that would be hidden throughout is left whole: it would not be a track.
    """

    share: float = 0.2
    shortest: float = 8 / 30
    longest: float = 45 / 30

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        if self.share <= 0:
            return obs
        seen = ~lost_spans(obs.times, len(obs.xyz), self.share, (self.shortest, self.longest), rng)
        seen[~(seen & obs.visible).any(1)] = True
        return replace(obs, visible=obs.visible & seen)


@dataclass(frozen=True)
class Hallucination:
    """A ``share`` of all samples is lost in runs as by :class:`Gaps`, but reported as seen.

    There the tracker goes straight from the last to the next true sample, and stands still at the ends of the clip.
    """

    share: float = 0.3
    shortest: float = 8 / 30
    longest: float = 45 / 30

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        if self.share <= 0:
            return obs
        lost = lost_spans(obs.times, len(obs.xyz), self.share, (self.shortest, self.longest), rng)
        known = obs.visible & ~lost
        lost[~known.any(1)] = False
        xyz = obs.xyz.copy()
        for i in np.flatnonzero(lost.any(1)):
            for axis in range(3):
                xyz[i, lost[i], axis] = np.interp(obs.times[lost[i]], obs.times[known[i]], obs.xyz[i, known[i], axis])
        return replace(obs, xyz=xyz, visible=obs.visible | lost)


@dataclass(frozen=True)
class Occlusion:
    """Samples whose surface is turned away from the camera are not observed (``clearance``: cosine below which).

    Outliers have no surface and stay; so does a track that is turned away throughout.
    """

    clearance: float = 0.0

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        seen = obs.facing(obs.world_times) > self.clearance
        seen[obs.surface.part < 0] = True
        seen[~(seen & obs.visible).any(1)] = True
        return replace(obs, visible=obs.visible & seen)


@dataclass(frozen=True)
class Outliers:
    """A ``share`` of the tracks belongs to nothing: ``background`` of them static, the others float about.

    Floaters carry the feature of some real track, background its own. Both belong to no object in the truth.
    """

    share: float = 0.2
    background: float = 0.5

    def __call__(self, obs: Observation, rng: np.random.Generator) -> Observation:
        n, dtype = len(obs.xyz), dtype_of(obs)
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
