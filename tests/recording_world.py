"""A tiny recording with known answers: speckled balls fly before a speckled wall, seen by a ring of cameras."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from otsync.io.document import FORMAT, VERSION
from otsync.types import Camera

W, H, FPS = 320, 180, 30.0


def ring(n: int, radius: float = 3.3, width: int = W, height: int = H) -> list[Camera]:
    """Cameras on a half circle that look at the origin, OpenCV axes, y down."""
    out = []
    K = np.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1.0]])
    for i in range(n):
        angle = np.pi * (i / n - 0.4)
        centre = radius * np.array([np.sin(angle), -0.25 + 0.2 * np.cos(2.3 * i), -np.cos(angle)])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross([0, 1.0, 0], forward)
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        w2c = np.eye(4)
        w2c[:3, :3], w2c[:3, 3] = R, -R @ centre
        out.append(Camera(K, w2c, width, height))
    return out


def paths(t: np.ndarray, balls: int, seed: int) -> np.ndarray:
    """(balls, T, 3): smooth, aperiodic paths through the middle of the scene."""
    rng = np.random.default_rng(seed)
    out = 0.35 * rng.normal(size=(balls, 1, 3))
    for f in (0.4, 0.9, 1.7):
        out = out + 0.28 / f**0.5 * rng.normal(size=(balls, 1, 3)) * np.sin(
            2 * np.pi * f * t[None, :, None] + rng.uniform(0, 6.3, (balls, 1, 3))
        )
    return np.clip(out, -0.9, 0.9)


def render(camera: Camera, centres: np.ndarray, colours: np.ndarray, radius: float, seed: int) -> np.ndarray:
    """One frame: balls with speckles fixed in the world's directions, far ones first."""
    rng = np.random.default_rng(seed)
    wall = cv2.GaussianBlur(rng.uniform(90, 170, (camera.height, camera.width, 3)), (0, 0), 1.2)
    image = wall.astype(np.uint8)
    speckles = np.random.default_rng(5).normal(size=(90, 3))
    speckles /= np.linalg.norm(speckles, axis=1, keepdims=True)
    R, t = camera.w2c[:3, :3], camera.w2c[:3, 3]
    f = camera.K[0, 0]

    def pixel(x: np.ndarray) -> tuple[int, int]:
        p = camera.K @ x / x[2]
        return round(float(p[0] - 0.5) * 16), round(float(p[1] - 0.5) * 16)

    for b in np.argsort(-(centres @ R.T + t)[:, 2]):
        local = R @ centres[b] + t
        cv2.circle(image, pixel(local), int(f * radius / local[2] * 16), colours[b].tolist(), -1, cv2.LINE_AA, 4)
        for k, s in enumerate(speckles):
            if (R @ s) @ (local / np.linalg.norm(local)) < -0.25:
                spot = R @ (centres[b] + radius * s) + t
                shade = (colours[b] * (0.25 if (k + b) % 2 else 1.0) + (0 if (k + b) % 2 else 60)).clip(0, 255)
                cv2.circle(image, pixel(spot), int(f * 0.1 * radius / spot[2] * 16), shade.tolist(), -1, cv2.LINE_AA, 4)
    return image


def exact_depth(camera: Camera, centres: np.ndarray, radius: float, pixels: np.ndarray | None = None) -> np.ndarray:
    """Depth along z of the balls' surfaces, 0 on the wall: (H,W) at pixel centres, or at ideal ``pixels`` (...,2)."""
    if pixels is None:
        pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1) + 0.5
    z = surfaces(camera, centres, radius, pixels).min(0)
    return np.where(np.isfinite(z), z, 0)


def exact_labels(camera: Camera, centres: np.ndarray, radius: float) -> np.ndarray:
    """(H,W) uint8: which ball is seen, from 1 on; 0 the wall."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1) + 0.5
    z = surfaces(camera, centres, radius, pixels)
    return np.where(np.isfinite(z.min(0)), z.argmin(0) + 1, 0).astype(np.uint8)


def surfaces(camera: Camera, centres: np.ndarray, radius: float, pixels: np.ndarray) -> np.ndarray:
    """(balls, ...) depth at which the rays through ideal ``pixels`` (...,2) meet every ball; inf: never."""
    rays = np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1) @ np.linalg.inv(camera.K).T
    out = []
    for c in camera.to_camera(centres):
        a, b, q = (rays**2).sum(-1), rays @ c, c @ c - radius**2
        root = b**2 - a * q
        out.append(np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf))
    return np.stack(out)


def write_recording(
    folder: Path, offsets: list[float], *, frames: int = 75, balls: int = 7, seed: int = 1, suffix: str = ".jpg"
) -> np.ndarray:
    """Write images and scene.json; frame k of video v shows world time k/fps + offsets[v]/fps. Returns the offsets."""
    rng = np.random.default_rng(seed)
    colours = rng.integers(30, 225, (balls, 3)).astype(float)
    videos = []
    for v, (camera, offset) in enumerate(zip(ring(len(offsets)), offsets, strict=True)):
        home = folder / f"cam{v}"
        home.mkdir(parents=True, exist_ok=True)
        centres = paths((np.arange(frames) + offset) / FPS, balls, seed)
        for k in range(frames):
            image = render(camera, centres[:, k], colours, 0.16, 100 + v)
            cv2.imwrite(str(home / f"{k:03d}{suffix}"), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
        told = {"K": camera.K.tolist(), "w2c": camera.w2c.tolist(), "width": W, "height": H}
        videos.append({"name": f"cam{v}", "frames": f"cam{v}/*{suffix}", "fps": FPS, "camera": told})
    document = {"format": FORMAT, "version": VERSION, "frame": "world", "videos": videos}
    (folder / "scene.json").write_text(json.dumps(document))
    return np.asarray(offsets, float)
