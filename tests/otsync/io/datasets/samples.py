"""Small samples of every layout, made from cameras that are known, by writers that share nothing with the readers.

Each maker fills a folder and returns the cameras by the name of their video: what a reader must give back.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
from PIL import Image
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from otsync.types import Camera
from tests.recording_world import ring

W, H, T = 48, 32, 4
OPENGL = np.diag([1.0, -1, -1, 1])

Made = dict[str, Camera]


def cameras(n: int, *, centred: bool = False, square: bool = True) -> list[Camera]:
    """Cameras on a half circle; K off the middle, with focal lengths of its own a camera unless centred."""
    out = []
    for k, camera in enumerate(ring(n, width=W, height=H)):
        f = 40.0 if centred else 40.0 + k
        K = np.array([[f, 0, W / 2], [0, f if square else f + 0.5, H / 2], [0, 0, 1]])
        if not centred:
            K[:2, 2] += (0.7 + k, -1.3)
        out.append(Camera(K, camera.w2c, W, H))
    return out


def video(path: Path, frames: int = T, size: tuple[int, int] = (W, H)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mpeg4", rate=25)
        stream.width, stream.height = size
        for k in range(frames):
            image = np.full((size[1], size[0], 3), 20 * k + 30, np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode())


def images(folder: Path, frames: int = T, suffix: str = ".png", size: tuple[int, int] = (W, H)) -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{k:04d}{suffix}" for k in range(frames)]
    for k, name in enumerate(names):
        Image.fromarray(np.full((size[1], size[0], 3), 20 * k + 30, np.uint8)).save(folder / name)
    return names


def blender_pose(w2c: np.ndarray) -> list[list[float]]:
    return (np.linalg.inv(w2c) @ OPENGL).tolist()


def angle(camera: Camera) -> float:
    return float(2 * np.arctan(camera.width / 2 / camera.K[0, 0]))


def sync_nerf_blender(folder: Path) -> Made:
    own = cameras(3, centred=True)
    for k in range(3):
        video(folder / f"cam_{k:02d}.mp4")
    frames = [{"file_path": f"./r_{k}", "transform_matrix": blender_pose(c.w2c)} for k, c in enumerate(own)]
    meta = {"width": W, "height": H, "camera_angle_x": angle(own[0]), "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(meta))
    return {f"cam_{k:02d}": c for k, c in enumerate(own)}


def poses_bounds(own: list[Camera], scale: float = 1.0) -> np.ndarray:
    rows = []
    for camera in own:
        c2w = np.linalg.inv(camera.w2c)
        right, down, forward, centre = c2w[:3].T
        hwf = np.array([H, W, camera.K[0, 0]]) * scale
        rows.append([*np.stack([down, right, -forward, centre, hwf], 1).ravel(), 0.5, 9.0])
    return np.array(rows)


def neural_3d_video(folder: Path) -> Made:
    own = cameras(3, centred=True)
    for k in range(3):
        video(folder / f"cam{k:02d}.mp4")
    np.save(folder / "poses_bounds.npy", poses_bounds(own))
    return {f"cam{k:02d}": c for k, c in enumerate(own)}


def sync_nerf_plenoptic(folder: Path) -> Made:
    own = cameras(3, centred=True)
    for k in range(3):
        images(folder / "frames_2" / f"cam{k:02d}")
    np.save(folder / "poses_bounds.npy", poses_bounds(own, scale=2.0))
    return {f"cam{k:02d}": c for k, c in enumerate(own)}


def nerfstudio(folder: Path) -> Made:
    own = [Camera(c.K, c.w2c, W, H, np.array([0.01, -0.02, 0.001, 0.002])) for c in cameras(2, square=False)]
    frames = []
    for k, c in enumerate(own):
        for place in ("depth", "masks"):
            images(folder / f"{place}/cam{k}")
        for n, name in enumerate(images(folder / f"images/cam{k}")):
            Image.fromarray(np.full((H, W), 1500, np.uint16)).save(folder / f"depth/cam{k}/{name}")
            lens = dict(zip(("k1", "k2", "p1", "p2"), c.distortion.tolist(), strict=True))
            frames.append(
                {
                    "file_path": f"images/cam{k}/{name}",
                    "transform_matrix": blender_pose(c.w2c),
                    "time": n / T,
                    "depth_file_path": f"depth/cam{k}/{name}",
                    "mask_path": f"masks/cam{k}/{name}",
                    **{"fl_x": c.K[0, 0], "fl_y": c.K[1, 1], "cx": c.K[0, 2], "cy": c.K[1, 2], "w": W, "h": H, **lens},
                }
            )
    frames = frames[::-1]  # the order of the file means nothing
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))
    return {f"cam{k}": c for k, c in enumerate(own)}


def d_nerf(folder: Path) -> Made:
    own = {}
    for split, n in (("train", 5), ("test", 3)):
        poses = np.stack([c.w2c for c in cameras(n, centred=True)])
        images(folder / split, n)
        frames = [
            {
                "file_path": f"./{split}/{k:04d}",
                "rotation": 0.1,
                "time": k / (n - 1),
                "transform_matrix": blender_pose(w),
            }
            for k, w in enumerate(poses)
        ]
        camera = Camera(cameras(1, centred=True)[0].K, poses, W, H)
        (folder / f"transforms_{split}.json").write_text(
            json.dumps({"camera_angle_x": angle(camera), "frames": frames})
        )
        own[split] = camera
    return own


def wxyz(w2c: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(w2c[:3, :3]).as_quat(scalar_first=True)


def colmap_text(folder: Path) -> Made:
    """Two static cameras as folders of images, in text."""
    own = cameras(2, square=False)
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    lines, posed = ["# Camera list"], ["# Image list"]
    number = 0
    for k, c in enumerate(own):
        K = c.K
        lines.append(
            f"{k + 1} PINHOLE {W} {H} {K[0, 0]!r} {K[1, 1]!r} {K[0, 2]!r} {K[1, 2]!r}".replace("np.float64", "")
        )
        for name in images(folder / f"images/cam{k}"):
            number += 1
            values = " ".join(f"{x:.17g}" for x in (*wxyz(c.w2c), *c.w2c[:3, 3]))
            posed += [f"{number} {values} {k + 1} cam{k}/{name}", "1.5 2.5 -1 3.5 4.5 7"]
    text = "\n".join(lines).replace("(", "").replace(")", "")
    (model / "cameras.txt").write_text(text + "\n")
    (model / "images.txt").write_text("\n".join(posed) + "\n")
    (model / "points3D.txt").write_text("# points\n")
    return {f"cam{k}": c for k, c in enumerate(own)}


def colmap(folder: Path) -> Made:
    """Three videos with an image each, in binary, with OPENCV lenses."""
    own = [Camera(c.K, c.w2c, W, H, np.array([0.01, -0.02, 0.001, 0.002])) for c in cameras(3, square=False)]
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    lenses, posed = struct.pack("<Q", 3), struct.pack("<Q", 3)
    for k, c in enumerate(own):
        video(folder / f"cam{k}.mp4")
        values = (c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2], *c.distortion)
        lenses += struct.pack("<iiQQ8d", k + 1, 4, W, H, *values)
        posed += struct.pack("<i7di", k + 1, *wxyz(c.w2c), *c.w2c[:3, 3], k + 1) + f"cam{k}.png\0".encode()
        posed += struct.pack("<Q", 2) + 2 * struct.pack("<ddq", 1.5, 2.5, -1)
    (model / "cameras.bin").write_bytes(lenses)
    (model / "images.bin").write_bytes(posed)
    (model / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    return {f"cam{k}": c for k, c in enumerate(own)}


def opencv_K(camera: Camera) -> np.ndarray:
    return camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def anipose(folder: Path) -> Made:
    own = [Camera(c.K, c.w2c, W, H, np.array([0.01, -0.02, 0.001, 0.002, 0.003])) for c in cameras(2)]
    text = ""
    for k, c in enumerate(own):
        video(folder / f"videos-raw/trial1-cam{'AB'[k]}.mp4")
        turn = Rotation.from_matrix(c.w2c[:3, :3]).as_rotvec().tolist()
        text += (
            f'[cam_{k}]\nname = "cam{"AB"[k]}"\nsize = [ {W}, {H},]\nmatrix = {opencv_K(c).tolist()}\n'
            f"distortions = {c.distortion.tolist()}\nrotation = {turn}\ntranslation = {c.w2c[:3, 3].tolist()}\n\n"
        )
    (folder / "calibration.toml").write_text(text + "[metadata]\nadjusted = false\nerror = 0.4\n")
    return {f"cam{'AB'[k]}": c for k, c in enumerate(own)}


def easymocap(folder: Path) -> Made:
    own = [Camera(c.K, c.w2c, W, H, np.array([0.01, -0.02, 0.001, 0.002, 0.003])) for c in cameras(2)]
    folder.mkdir(exist_ok=True)
    intri = cv2.FileStorage(str(folder / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    extri = cv2.FileStorage(str(folder / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    for file in (intri, extri):
        file.startWriteStruct("names", cv2.FileNode_SEQ)
        for k in range(2):
            file.write("", f"0{k + 1}")
        file.endWriteStruct()
    for k, c in enumerate(own):
        name = f"0{k + 1}"
        video(folder / f"videos/{name}.mp4")
        intri.write(f"K_{name}", opencv_K(c))
        intri.write(f"dist_{name}", c.distortion[None])
        extri.write(f"R_{name}", Rotation.from_matrix(c.w2c[:3, :3]).as_rotvec()[:, None])
        extri.write(f"Rot_{name}", c.w2c[:3, :3].copy())
        extri.write(f"T_{name}", c.w2c[:3, 3:].copy())
    intri.release()
    extri.release()
    return {f"0{k + 1}": c for k, c in enumerate(own)}


def dannce(folder: Path) -> Made:
    own = [Camera(c.K, c.w2c, W, H, np.array([0.01, -0.02, 0.001, 0.002, 0.0])) for c in cameras(2)]
    (folder / "calibration").mkdir(parents=True)
    for k, c in enumerate(own, 1):
        video(folder / f"videos/Camera{k}/0.mp4")
        K = c.K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        fields = {"K": K.T, "r": c.w2c[:3, :3].T, "t": c.w2c[None, :3, 3]}
        fields |= {"RDistort": c.distortion[None, :2], "TDistort": c.distortion[None, 2:4]}
        savemat(folder / f"calibration/hires_cam{k}_params.mat", fields)
    return {f"Camera{k}": c for k, c in enumerate(own, 1)}


def mosca(folder: Path) -> Made:
    """Two working folders; no cameras."""
    for name in ("left", "right"):
        home = folder / name
        stems = [Path(image).stem for image in images(home / "images", suffix=".jpg")]
        for place in ("uniform_depth", "masks"):
            (home / place).mkdir()
        for k, stem in enumerate(stems):
            np.savez(home / f"uniform_depth/{stem}.npz", dep=np.full((H, W), 2.0 + k, np.float32))
            np.savez(home / f"masks/{stem}.npz", mask=np.arange(H * W).reshape(H, W) % 2)
        tracks = np.random.default_rng(0).uniform(2, 30, (T, 7, 3)).astype(np.float32)
        seen = np.ones((T, 7), bool)
        np.savez(home / "dynamic_dep=uniform_spatracker_tap.npz", tracks=tracks, visibility=seen)
    return {}


SAMPLES: dict[str, Callable[[Path], Made]] = {
    "sync-nerf-blender": sync_nerf_blender,
    "neural-3d-video": neural_3d_video,
    "sync-nerf-plenoptic": sync_nerf_plenoptic,
    "nerfstudio": nerfstudio,
    "d-nerf": d_nerf,
    "colmap": colmap,
    "anipose": anipose,
    "easymocap": easymocap,
    "dannce": dannce,
    "mosca": mosca,
}
