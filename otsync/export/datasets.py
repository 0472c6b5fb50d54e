"""Synchronised recordings in the layouts that reconstructions of others read: nerfstudio, Dynamic3DGaussians, COLMAP.

Every image keeps its own world second where the layout has one (nerfstudio's ``time``); where it has none
(Dynamic3DGaussians) the nearest frames of a common beat stand together.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..files.arrays import atomic_write, write_json
from ..types import Camera
from .slot import Aligned, Clip, Export, file_names, grid

QUALITY = 95
"""Of JPEG: what others write their datasets with."""

TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


class Nerfstudio(Export):
    """``transforms.json`` with ``time`` from 0 to 1 over ``otsync_seconds``, and the images of every video."""

    name = "nerfstudio"
    default = False

    def targets(self, videos: Aligned, folder: Path) -> list[Path]:
        return [folder / "nerfstudio" / "transforms.json"]

    def write(self, videos: Aligned, folder: Path, *, width: int, fps: float) -> list[str]:
        home = folder / "nerfstudio"
        first, last = videos.span
        length = max(last - first, 1e-9)
        frames = []
        for clip, place in zip(videos.clips, _places(videos), strict=True):
            lens = _nerfstudio_lens(clip.video.camera, clip.name)
            for n, k in enumerate(clip.index):
                path = f"images/{place}/{n:05d}.jpg"
                _save(home / path, _decoded(clip, int(k)))
                pose = np.linalg.inv(_pose(clip.video.camera, int(k))) @ TO_OPENGL
                time = (float(clip.world[n]) - first) / length
                frames.append({"file_path": path, "transform_matrix": pose.tolist(), "time": time, **lens})
        told = {"camera_model": "OPENCV", "otsync_seconds": length, "frames": frames}
        write_json(home / "transforms.json", told)
        return [f"nerfstudio: time 0 to 1 is {length:.6g} s, from world second {first:.6g} on"]


class Dynamic3DGaussians(Export):
    """The layout of Dynamic3DGaussians: every moment the nearest frame of each video, without lens distortion."""

    name = "dynamic3dgs"
    default = False
    heeds = frozenset({"fps"})

    def targets(self, videos: Aligned, folder: Path) -> list[Path]:
        return [folder / "dynamic3dgs" / "train_meta.json"]

    def write(self, videos: Aligned, folder: Path, *, width: int, fps: float) -> list[str]:
        home = folder / "dynamic3dgs"
        sizes = {(c.video.camera.width, c.video.camera.height) for c in videos.clips}
        if len(sizes) > 1:
            raise ValueError(
                "what: expected images of one size for dynamic3dgs, which stores one; found "
                f"{', '.join(f'{w} x {h}' for w, h in sorted(sizes))}. Choose cameras of one size, or nerfstudio."
            )
        moments = grid(videos, videos.shared, fps)
        w, h = sizes.pop()
        meta: dict[str, Any] = {"w": w, "h": h, "fn": [], "k": [], "w2c": [], "cam_id": []}
        late = [0.0]
        for n, t in enumerate(moments):
            row: dict[str, list[Any]] = {"fn": [], "k": [], "w2c": []}
            for v, clip in enumerate(videos.clips):
                k = clip.nearest(float(t))
                late.append(abs(float(clip.world[int(np.flatnonzero(clip.index == k)[0])]) - float(t)))
                path = f"{v}/{n:06d}.jpg"
                _save(home / "ims" / path, _straight(_decoded(clip, k), clip.video.camera))
                row["fn"].append(path)
                row["k"].append(clip.video.camera.K.tolist())
                row["w2c"].append(_pose(clip.video.camera, k).tolist())
            for key, values in row.items():
                meta[key].append(values)
            meta["cam_id"].append(list(range(len(videos.clips))))
        write_json(home / "train_meta.json", meta)
        names = ", ".join(f"{v} {clip.name}" for v, clip in enumerate(videos.clips))
        return [
            f"dynamic3dgs: frames stand on one beat, up to {max(late):.4f} s from their moments; cameras: {names}",
            "dynamic3dgs: it asks for masks (seg/) and a point cloud (init_pt_cld.npz), which are not written",
        ]


class Colmap(Export):
    """A model of COLMAP's in text (``sparse/0``) without points, and the images of every video."""

    name = "colmap"
    default = False

    def targets(self, videos: Aligned, folder: Path) -> list[Path]:
        return [folder / "colmap" / "sparse/0" / name for name in ("cameras.txt", "images.txt", "points3D.txt")]

    def write(self, videos: Aligned, folder: Path, *, width: int, fps: float) -> list[str]:
        from scipy.spatial.transform import Rotation

        home = folder / "colmap"
        cameras, images = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"], ["# IMAGE_ID, QW, ..., NAME; POINTS2D[]"]
        number = 0
        for v, (clip, place) in enumerate(zip(videos.clips, _places(videos), strict=True), 1):
            camera = clip.video.camera
            model, values = _colmap_lens(camera, clip.name)
            cameras.append(f"{v} {model} {camera.width} {camera.height} {' '.join(f'{x:.17g}' for x in values)}")
            for n, k in enumerate(clip.index):
                number += 1
                name = f"{place}/{n:05d}.jpg"
                _save(home / "images" / name, _decoded(clip, int(k)))
                w2c = _pose(camera, int(k))
                x, y, z, w = Rotation.from_matrix(w2c[:3, :3]).as_quat()
                pose = " ".join(f"{float(value):.17g}" for value in (w, x, y, z, *w2c[:3, 3]))
                images += [f"{number} {pose} {v} {name}", ""]
        for path, lines in zip(self.targets(videos, folder), (cameras, images, ["# no points"]), strict=True):
            with atomic_write(path, "w") as stream:
                stream.write("\n".join(lines) + "\n")
        return ["colmap: the model holds no times; frame k of a folder is the k-th of its video"]


def _places(videos: Aligned) -> list[str]:
    """A folder for each video."""
    return file_names([clip.name for clip in videos.clips], "")


def _decoded(clip: Clip, k: int) -> np.ndarray:
    frames: Any = clip.video.frames
    return np.asarray(frames[k])


def _pose(camera: Camera, k: int) -> np.ndarray:
    return camera.w2c if camera.w2c.ndim == 2 else camera.w2c[k]


def _save(path: Path, image: np.ndarray) -> None:
    from PIL import Image

    with atomic_write(path) as stream:
        Image.fromarray(image).save(stream, "JPEG", quality=QUALITY, subsampling=0)


def _straight(image: np.ndarray, camera: Camera) -> np.ndarray:
    """The image without lens distortion, with the same K."""
    if camera.distortion is None or not np.any(camera.distortion):
        return image
    import cv2

    # cv2's pixel centres lie at whole numbers, K's at halves
    K = camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    maps = cv2.initUndistortRectifyMap(K, camera.distortion, None, K, image.shape[1::-1], cv2.CV_32FC1)
    return cv2.remap(image, *maps, cv2.INTER_LINEAR)


def _coefficients(camera: Camera, most: int, name: str, what: str) -> list[float]:
    """OpenCV's coefficients, at least four. ValueError for more than the layout takes."""
    given = [] if camera.distortion is None else camera.distortion.tolist()
    if any(given[most:]):
        raise ValueError(
            f"what: expected at most {most} coefficients of distortion for {what}; {name} has {len(given)}. Choose "
            "dynamic3dgs, whose images are undistorted."
        )
    given = given[:most]
    return given + [0.0] * (4 - len(given))


def _nerfstudio_lens(camera: Camera, name: str) -> dict[str, float | int]:
    K = camera.K
    given = _coefficients(camera, 5, name, "nerfstudio")
    lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), given, strict=False))
    return {
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "w": camera.width,
        "h": camera.height,
        **lens,
    }


def _colmap_lens(camera: Camera, name: str) -> tuple[str, list[float]]:
    K = camera.K
    pinhole = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    given = _coefficients(camera, 8, name, "colmap")
    if not any(given):
        return "PINHOLE", pinhole
    if not any(given[4:]):
        return "OPENCV", pinhole + given[:4]
    return "FULL_OPENCV", pinhole + given + [0.0] * (8 - len(given))
