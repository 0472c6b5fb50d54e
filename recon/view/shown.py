"""What a window shows at a moment, with the clocks that its sliders stand at: plain arrays, without a viewer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from otsync.types import Camera, Offsets, TrackSet
from recon.backdrop.surroundings import up_axis

MOST_MATCHES = 400
"""Lines between matched tracks, of all pairs together: the best of each pair."""


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians as a viewer takes them.

    Args:
        centers: (N,3) world units. covariances: (N,3,3). rgbs: (N,3) in 0..1. opacities: (N,1) in 0..1.
    """

    centers: Float[np.ndarray, "N 3"]
    covariances: Float[np.ndarray, "N 3 3"]
    rgbs: Float[np.ndarray, "N 3"]
    opacities: Float[np.ndarray, "N 1"]


@dataclass(frozen=True, eq=False)
class Moment:
    """What is drawn of a moment.

    Args:
        splats: what moves; None: there are none.
        dots: (N,3) by video: where its clock puts what it sees. A ghost, where a slider has left its place.
        lines: (L,2,3) between matched tracks of two videos.
    """

    splats: Splats | None = None
    dots: Mapping[int, Float[np.ndarray, "N 3"]] = field(default_factory=dict)
    lines: Float[np.ndarray, "L 2 3"] = field(default_factory=lambda: np.zeros((0, 2, 3)))


class Shown(ABC):
    """Something with clocks to look at.

    names, frame_step: of the videos, and seconds of a frame of the reference. span: first and last world second.
    cameras: of the videos that have one. still: what never moves.
    """

    names: tuple[str, ...]
    frame_step: float
    span: tuple[float, float]
    cameras: Mapping[int, Camera]
    still: Splats | None = None

    @abstractmethod
    def at(self, t: float, moved: Float[np.ndarray, " V"]) -> Moment:
        """What is there at world second ``t``, with the offset of every video moved by so many seconds."""

    @property
    def up(self) -> Float[np.ndarray, " 3"]:
        """Which way is up; z where no camera tells."""
        poses = [c.w2c.reshape(-1, 4, 4)[0] for c in self.cameras.values()]
        return up_axis(np.stack(poses)) if poses else np.array([0.0, 0, 1])

    def middle(self) -> tuple[Float[np.ndarray, " 3"], float]:
        """What to look at, and from how far, world units."""
        now = self.at(0.5 * sum(self.span), np.zeros(len(self.names)))
        parts = [*now.dots.values()] if now.splats is None else [now.splats.centers]
        points = np.concatenate(parts) if parts else np.zeros((0, 3))
        points = points[np.isfinite(points).all(1)]
        focus = np.median(points, 0) if len(points) else np.zeros(3)
        eyes = [np.linalg.norm(c.center.reshape(-1, 3)[0] - focus) for c in self.cameras.values()]
        spread = float(np.linalg.norm(points - focus, axis=1).max()) if len(points) else 1.0
        return focus, float(np.median(eyes)) if eyes else 3 * max(spread, 1e-6)


class OfScene(Shown):
    """A 4D scene and the cameras that filmed it. A video whose slider is moved shows as dots what it would show then.

    Args:
        scene: the scene, on the CPU. cameras: of the videos, by name, in the order of the sliders.
    """

    def __init__(self, scene: object, cameras: Mapping[str, Camera]):
        from recon.scene.gaussians4d import Gaussians4D

        assert isinstance(scene, Gaussians4D)
        self.scene, self.names = scene, tuple(cameras)
        self.cameras = dict(enumerate(cameras.values()))
        self.frame_step, self.span = scene.frame_step, scene.span
        self.still = None if scene.static is None else splats_of(scene.static)

    def at(self, t: float, moved: Float[np.ndarray, " V"]) -> Moment:
        import torch

        dots = {}
        with torch.no_grad():
            now = splats_of(self.scene.moving(t))
            for v in np.flatnonzero(moved).tolist():
                # at t on its moved clock the video shows what truly was there so much earlier
                dots[v] = self.scene.moving(t - float(moved[v])).means.double().numpy()
        return Moment(now, dots)


def splats_of(gaussians: object) -> Splats:
    """Gaussians of :mod:`recon.scene` as arrays, in the colours that they have from all sides."""
    import torch

    from recon.raster import sh
    from recon.rotations import rotation_matrices, unit
    from recon.scene.gaussians import Gaussians

    assert isinstance(gaussians, Gaussians)
    with torch.no_grad():
        flat = gaussians.detach().finite()
        root = rotation_matrices(unit(flat.quats)) * flat.scales[:, None]
        colours = (sh.C0 * flat.sh[:, 0] + 0.5).clamp(0, 1)
        arrays = (flat.means, root @ root.transpose(1, 2), colours, flat.opacities[:, None])
        return Splats(*(a.double().cpu().numpy() for a in arrays))


class OfTracks(Shown):
    """Track sets in space, each on its video's clock, with lines between matched tracks.

    Args:
        tracks: one a video, in one world frame, in the order of ``offsets.names``.
        offsets: their clocks. ValueError where fewer than two are in space on one clock.
    """

    def __init__(self, tracks: Sequence[TrackSet], offsets: Offsets):
        there = [
            v
            for v, t in enumerate(tracks)
            if t.xyz is not None and np.isfinite(offsets.seconds[v]) and offsets.component[v] == offsets.reference
        ]
        if len(there) < 2:
            raise ValueError(
                f"tracks: expected two videos with tracks in space on one clock; found {len(there)}. Give depth, or "
                "five static cameras, so that tracks can be lifted; or look at a finished reconstruction."
            )
        self.names, self.offsets = offsets.names, offsets
        self.cameras = {v: c for v in there if (c := tracks[v].camera) is not None}
        self.frame_step = 1 / float(offsets.fps[offsets.reference])
        self.positions = {v: np.asarray(tracks[v].positions(), float) for v in there}
        self.own = {v: np.asarray(tracks[v].times, float) for v in there}
        worlds = [offsets.clock(v).world(self.own[v]) for v in there]
        self.span = (min(float(w[0]) for w in worlds), max(float(w[-1]) for w in worlds))
        self.pairs = self._pairs()

    def _pairs(self) -> dict[tuple[int, int], Int[np.ndarray, "M 2"]]:
        kept = {k: m for k, m in self.offsets.matches.items() if set(k) <= set(self.positions) and len(m)}
        each = max(1, MOST_MATCHES // max(len(kept), 1))
        return {k: m.best(each).pairs for k, m in kept.items()}

    def at(self, t: float, moved: Float[np.ndarray, " V"]) -> Moment:
        now = {v: self._placed(v, t, float(moved[v])) for v in self.positions}
        lines = [np.stack([now[i][pairs[:, 0]], now[j][pairs[:, 1]]], 1) for (i, j), pairs in self.pairs.items()]
        ends = np.concatenate(lines) if lines else np.zeros((0, 2, 3))
        dots = {v: p[np.isfinite(p).all(1)] for v, p in now.items()}
        return Moment(None, dots, ends[np.isfinite(ends).all((1, 2))])

    def _placed(self, v: int, t: float, moved: float) -> Float[np.ndarray, "N 3"]:
        """Positions of a video's tracks at world second ``t``, nan where they are not seen then."""
        own, positions = self.own[v], self.positions[v]
        at = (t - float(self.offsets.seconds[v]) - moved) / float(self.offsets.rates[v])
        if not own[0] <= at <= own[-1] or len(own) < 2:
            return np.full((len(positions), 3), np.nan)
        k = int(np.clip(np.searchsorted(own, at, side="right") - 1, 0, len(own) - 2))
        share = (at - own[k]) / (own[k + 1] - own[k])
        return (1 - share) * positions[:, k] + share * positions[:, k + 1]
