"""Render a scene of Gaussians from a circling camera to a video, on the CPU.

python examples/05_render.py --out circle.mp4
"""

import math
import time
from pathlib import Path

import av
import numpy as np
import torch
import tyro

from otsync.types import Camera
from recon.scene.gaussians import Gaussians
from recon.scene.ply import load_ply, save_ply


def knot(n: int = 6000, seed: int = 0) -> Gaussians:
    """A trefoil knot of flat, coloured Gaussians. In your own work: load_ply("point_cloud.ply")."""
    g = torch.Generator().manual_seed(seed)
    t = 2 * math.pi * torch.rand(n, generator=g)
    ring = 2 + torch.cos(3 * t)
    means = torch.stack([ring * torch.cos(2 * t), torch.sin(3 * t), ring * torch.sin(2 * t)], -1)
    means = means + 0.12 * torch.randn(n, 3, generator=g)
    colors = 0.5 + 0.45 * torch.cos(t[:, None] + torch.tensor([0.0, 2.1, 4.2]))
    scales = torch.tensor([0.06, 0.06, 0.01]) * torch.exp(0.3 * torch.randn(n, 3, generator=g))
    opacities = 0.5 + 0.45 * torch.rand(n, generator=g)
    return Gaussians.from_colors(means, torch.randn(n, 4, generator=g), scales, opacities, colors)


def circle(frames: int, width: int, height: int, radius: float = 6.5) -> Camera:
    """A camera that goes once around the origin and looks at it: one (4,4) pose per frame, OpenCV axes."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, frames, endpoint=False):
        centre = np.array([radius * np.sin(angle), -2.0, -radius * np.cos(angle)])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross([0, 1, 0], forward)  # y points down
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
        poses.append(pose)
    focal = 1.1 * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(K, np.stack(poses), width, height)


def main(out: Path = Path("circle.mp4"), frames: int = 90, width: int = 480, height: int = 320) -> None:
    scene = knot()
    save_ply(scene, out.with_suffix(".ply"))  # opens in any 3DGS viewer
    scene = load_ply(out.with_suffix(".ply"))

    camera = circle(frames, width, height)
    start = time.perf_counter()
    with torch.no_grad():
        # the T poses of a moving camera become T images; depth=None: what is not asked for is not computed
        backgrounds = torch.full((frames, 3), 0.05)
        images = scene.render(camera, backgrounds=backgrounds, depth=None).colors
    print(f"{frames} frames of {len(scene)} Gaussians at {width}x{height}: {time.perf_counter() - start:.2f} s")

    with av.open(str(out), "w") as video:
        stream = video.add_stream("libx264", rate=30, options={"crf": "18"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for image in (images.clamp(0, 1) * 255).byte().numpy():
            video.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        video.mux(stream.encode())
    print(f"wrote {out} and {out.with_suffix('.ply')}")


if __name__ == "__main__":
    tyro.cli(main)
