"""Small reconstructions with every kind of motion and camera, made without a fit: for the tests of the scene page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from otsync.types import Camera, Clock, Offsets
from recon.footage.footage import Footage
from recon.motion import BSpline, HermiteSpline, Motion, PerGaussian, Sampled, Static
from recon.result.folder import FilmedBy, SavedReconstruction
from recon.rotations import look_at
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D
from tests.recon.motion.worlds import random_scaffold

SIZE = (160, 96)
FPS = 30.0
FAR = np.array([100.0, -200.0, 50.0])
"""Where the scene lies: float32 alone would lose it."""

MOTIONS = ("scaffold", "dual", "per video", "sampled", "own", "static")


def motion_of(kind: str, points: torch.Tensor, seconds: float, nodes: int) -> Motion:
    """A motion of a kind for Gaussians at ``points`` [N,3]."""
    knots = max(6, round(seconds * FPS / 4) + 2)
    if kind == "static":
        return Static()
    if kind == "own":
        g = torch.Generator().manual_seed(4)
        path = BSpline(-0.1, 4 / FPS, knots)
        turns = torch.tensor([1.0, 0, 0, 0]) + 0.4 * torch.randn(knots, len(points), 4, generator=g)
        return PerGaussian(path, 0.1 * torch.randn(knots, len(points), 3, generator=g), turns)
    blend = "dual-quaternion" if kind == "dual" else "linear"
    scaffold = random_scaffold(
        nodes,
        knots=knots,
        rests=(),
        blend=blend,
        videos=2 if kind == "per video" else 0,
        turn=0.2,
        kind=HermiteSpline if kind == "per video" else BSpline,  # the paper's, and ours
    )
    scaffold = replace(scaffold, knots=scaffold.knots + torch.as_tensor(FAR).float())
    half = len(points) // 2
    scaffold = scaffold.bind(points[:half], 0.1).bind(points[half:], 0.3)
    return scaffold.on(Sampled(0.0, 1 / FPS, round(seconds * FPS) + 4)) if kind == "sampled" else scaffold


def blobs(points: np.ndarray, size: float, seed: int, degree: int) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    n = len(points)
    made = Gaussians.from_colors(
        torch.as_tensor(points, dtype=torch.float32),
        torch.randn(n, 4, generator=g),
        size * torch.exp(0.6 * torch.randn(n, 3, generator=g)),
        torch.sigmoid(2 * torch.randn(n, generator=g)),
        torch.rand(n, 3, generator=g),
        sh_degree=degree,
    )
    made.sh[:, 1:] += 0.15 * torch.randn(made.sh[:, 1:].shape, generator=g)
    return made


def scene_of(
    kind: str = "scaffold",
    gaussians: int = 300,
    still: int = 200,
    seconds: float = 0.8,
    nodes: int = 30,
    degree: int = 0,
) -> Gaussians4D:
    """A cloud that moves, before a cloud that does not."""
    rng = np.random.default_rng(3)
    cloud = rng.normal(size=(gaussians, 3)) + FAR
    shell = rng.normal(size=(still, 3))
    shell = 4.2 * shell / np.linalg.norm(shell, axis=1, keepdims=True) + FAR
    return Gaussians4D(
        blobs(cloud, 0.07, 5, degree),
        motion_of(kind, torch.as_tensor(cloud, dtype=torch.float32), seconds, nodes),
        footprint=0.02,
        frame_step=1 / FPS,
        span=(0.0, seconds),
        static=blobs(shell, 0.4, 6, degree) if still else None,
        near=0.5,
    )


def cameras_of(names: Sequence[str], frames: int) -> tuple[FilmedBy, ...]:
    """Cameras around the scene, the last of which moves; each late by 0.08 s more, and no two alike in colour."""
    width, height = SIZE
    K = np.array([[1.1 * width, 0, width / 2 + 3], [0, 1.1 * width, height / 2 - 2], [0, 0, 1.0]])
    up, found = np.array([0, 0, 1.0]), []
    for v, name in enumerate(names):
        turns = 0.9 * v + (0.01 * np.arange(frames) if v == len(names) - 1 else np.zeros(1))
        eyes = FAR + np.stack([3.6 * np.cos(turns), 3.6 * np.sin(turns), 0.7 + 0 * turns], 1)
        poses = np.stack([look_at(eye, FAR, up) for eye in eyes])
        camera = Camera(K, poses if len(poses) > 1 else poses[0], width, height)
        gain = np.array([1.0, 1 - 0.05 * v, 1 + 0.04 * v])
        found.append(FilmedBy(name, camera, Clock(0.08 * v, 1 + 0.01 * v), gain, np.arange(frames) / FPS))
    return tuple(found)


def reconstruction(
    kind: str = "scaffold",
    names: Sequence[str] = ("a", "b", "c"),
    *,
    layered: bool = True,
    frames: int = 24,
    **scene: int | float,
) -> SavedReconstruction:
    videos = cameras_of(names, frames)
    seconds = np.array([v.clock.offset for v in videos])
    offsets = Offsets.known(tuple(names), seconds, FPS, np.array([v.clock.rate for v in videos]))
    return SavedReconstruction(scene_of(kind, **scene), offsets, videos, {"layered": layered})


def footage_like(result: SavedReconstruction) -> tuple[Footage, ...]:
    """Footage of the result's cameras in which a square wanders over a gradient, one shade per frame."""
    found = []
    for video in result.videos:
        count, (width, height) = len(video.times), (video.camera.width, video.camera.height)
        images = np.zeros((count, height, width, 3), np.uint8)
        images[..., 2] = np.linspace(40, 200, width)
        for k in range(count):
            images[k, ..., 1] = 255 * k // count
            x = 4 + k * (width - 24) // count
            images[k, 10:26, x : x + 16] = 250, 240, 60
        camera, bad = video.camera, np.zeros(count, bool)
        boxes = np.tile([0, 0, width, height], (count, 1))
        found.append(Footage(video.name, images, video.times, camera.K, camera.w2c, None, None, None, boxes, None, bad))
    return tuple(found)
