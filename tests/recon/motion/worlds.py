"""Scaffolds and tracks with known answers, for the tests of motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from otsync.types import TrackSet
from recon.motion import Binding, BSpline, Motion, Path, PerGaussian, Scaffold
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D

FOOTPRINT = 0.0133
FRAME = 1 / 30


def random_scaffold(
    nodes: int = 40,
    gaussians: int = 200,
    knots: int = 8,
    rests: tuple[float, ...] = (0.1, 0.5),
    *,
    blend: str = "linear",
    videos: int = 0,
    dtype: torch.dtype = torch.float32,
    turn: float = 0.3,
    seed: int = 0,
    kind: type[Path] = BSpline,
) -> Scaffold:
    """Nodes that wander and turn at random, with Gaussians bound near them at each of `rests`; all but the first are
    bound after the nodes' knots changed, so that rests are not poses of the present curves."""
    rng = np.random.default_rng(seed)
    base = rng.normal(size=(nodes, 3))
    curves = base + 0.2 * rng.normal(size=(knots, 1, 3)).cumsum(0) + 0.05 * rng.normal(size=(knots, nodes, 3))
    quats = np.array([1.0, 0, 0, 0]) + turn * rng.normal(size=(knots, nodes, 4))
    apart = np.linalg.norm(base[:, None] - base, axis=2) + 1e9 * np.eye(nodes)
    edges = np.argsort(apart, axis=1)[:, : min(10, nodes - 1)]
    weights = np.exp(-(np.take_along_axis(apart, edges, 1) ** 2) / 0.5) + 1e-6
    weights[:, 3] = 0
    kn, kq = torch.from_numpy(curves).to(dtype), torch.from_numpy(quats).to(dtype)
    path = kind(0.0, 4 * FRAME, knots)
    scaffold = Scaffold(
        path,
        kn,
        kq,
        torch.from_numpy(edges),
        torch.from_numpy(weights).to(dtype),
        0.5,
        Binding.empty(nodes, kn),
        blend=blend,
    )
    if videos:
        clock = np.arange(nodes) % videos
        edges = np.stack([np.flatnonzero((clock == clock[m]) & (np.arange(nodes) != m))[:4] for m in range(nodes)])
        scaffold = replace(
            scaffold,
            edges=torch.from_numpy(edges),
            edge_weights=torch.ones(edges.shape, dtype=dtype),
            clock=torch.from_numpy(clock),
            offsets=torch.from_numpy(0.05 * rng.normal(size=videos)),
            rates=torch.from_numpy(1 + 0.05 * rng.normal(size=videos)),
        )
    for r, t in enumerate(rests):
        n = gaussians // len(rests)
        points = base[rng.integers(nodes, size=n)] + 0.3 * rng.normal(size=(n, 3))
        scaffold = scaffold.bind(torch.from_numpy(points).to(dtype), t)
        if r == 0:
            moved = scaffold.knots + 0.02 * torch.from_numpy(rng.normal(size=scaffold.knots.shape)).to(dtype)
            scaffold = replace(scaffold, knots=moved)
    return scaffold


def following(scaffold: Scaffold, means: torch.Tensor, path: Path | None = None) -> PerGaussian:
    """Paths of their own on which a scaffold carries its Gaussians of these `means` [N,3]; exact at the knots."""
    path = path or scaffold.path
    upright = means.new_tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    with torch.no_grad():
        return PerGaussian(path, torch.stack([scaffold.warp(means, upright, float(t))[0] - means for t in path.times]))


def random_gaussians(n: int, dtype: torch.dtype = torch.float32, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    """Means [n,3] and quaternions [n,4] of any length."""
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.normal(size=(n, 3))).to(dtype), torch.from_numpy(rng.normal(size=(n, 4))).to(dtype)


def random_scene(motion: Motion | None = None, n: int = 200, features: bool = False) -> Gaussians4D:
    """n Gaussians carried by `motion`, by default a random scaffold, and three static ones."""
    static = Gaussians(*random_gaussians(3), torch.zeros(3, 3), torch.zeros(3), torch.zeros(3, 1, 3))
    dynamic = Gaussians(*random_gaussians(n), torch.zeros(n, 3), torch.zeros(n), torch.zeros(n, 4, 3))
    extra = torch.ones(n, 5) if features else None
    motion = random_scaffold() if motion is None else motion
    return Gaussians4D(dynamic, motion, FOOTPRINT, FRAME, (0.0, 0.8), static, features=extra)


def leaves(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Copies that ask for gradients."""
    return {k: v.detach().clone().requires_grad_() for k, v in tensors.items()}


class Bodies:
    """Two bodies that wander, turn and bend in metres: surface points and where they are at any world second."""

    def __init__(self, n: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.points = rng.uniform(-1, 1, (n, 3)) * [0.25, 0.8, 0.2]
        self.side = np.where(rng.random(n) < 0.5, -1.0, 1.0)

    def at(self, t: float) -> np.ndarray:
        x = self.points + np.stack(
            [0.15 * np.sin(2 * t + 2 * self.points[:, 1]), 0 * self.side, 0.1 * np.sin(3 * t + self.side)], 1
        )
        angle = 1.2 * t + self.side
        c, s = np.cos(angle), np.sin(angle)
        moved = np.stack([c * x[:, 0] + s * x[:, 2], x[:, 1], -s * x[:, 0] + c * x[:, 2]], 1)
        return moved + np.stack([self.side + 0.3 * np.sin(t), 0 * angle, 0.2 * np.cos(2 * t + self.side)], 1)

    def over(self, times: np.ndarray) -> np.ndarray:
        """[N,T,3]."""
        return np.stack([self.at(t) for t in times], 1)


def filmed(
    videos: int = 3,
    tracks: int = 250,
    frames: int = 36,
    *,
    life: int = 24,
    noise: float = 0.004,
    offsets: np.ndarray | None = None,
    fps: float = 30.0,
    scale: float = 1.0,
    rigid: tuple[np.ndarray, np.ndarray] | None = None,
    seed: int = 0,
) -> tuple[list[TrackSet], np.ndarray]:
    """Tracks of the bodies by several videos, each seen for `life` frames, with gaps; and the videos' offsets (s).

    scale, rigid: the world in other units, and turned and moved: R (scale x) + t.
    """
    rng = np.random.default_rng(seed)
    offsets = rng.uniform(-0.03, 0.03, videos) if offsets is None else offsets
    sets = []
    for v in range(videos):
        bodies = Bodies(tracks, seed=100 * seed + v)
        xyz = bodies.over(np.arange(frames) / fps + offsets[v]) + noise * rng.normal(size=(tracks, frames, 3))
        first = rng.integers(0, max(1, frames - life + 1), tracks)[:, None]
        visible = (
            (np.arange(frames) >= first) & (np.arange(frames) < first + life) & (rng.random((tracks, frames)) < 0.9)
        )
        xyz = scale * xyz
        if rigid is not None:
            xyz = xyz @ rigid[0].T + rigid[1]
        xyz[~visible] = np.nan
        sets.append(TrackSet(xyz, visible, fps=fps, name=str(v)))
    return sets, offsets


def random_rotation(seed: int = 0) -> np.ndarray:
    return Rotation.random(random_state=seed).as_matrix()
