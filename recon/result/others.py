"""Formats of other programs: Dynamic3DGaussians' parameters, TAPVid-3D's tracks, .ply upright for SuperSplat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from otsync.files.arrays import write_npz
from recon.backdrop.surroundings import up_axis
from recon.raster import sh
from recon.result.export import Exporter, scene_tracks
from recon.result.folder import SavedReconstruction
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D
from recon.scene.ply import save_ply

MOST_BYTES = 2**32
"""Of one file of parameters: every frame holds every Gaussian."""


class Dynamic3DGaussians(Exporter):
    """params.npz as Dynamic3DGaussians writes it: every Gaussian at every frame, colours without view dependence."""

    name, file = "dynamic3dgs", "params.npz"

    def write(self, scene: Gaussians4D, out: Path, times: Sequence[float], frame: str) -> None:
        write_npz(out, self._arrays(scene, times, 0))

    def write_result(self, result: SavedReconstruction, out: Path, times: Sequence[float]) -> None:
        write_npz(out, self._arrays(result.scene, times, len(result.videos)))

    def _arrays(self, scene: Gaussians4D, times: Sequence[float], cameras: int) -> dict[str, np.ndarray]:
        first = scene.at(float(times[0]))
        N, T = len(first.means), len(times)
        if N * T * 10 * 4 > MOST_BYTES:
            raise ValueError(
                f"fps: expected at most {MOST_BYTES} bytes; {N} Gaussians in {T} frames take more. Use fewer frames."
            )
        moments = [scene.at(float(t)) for t in times]
        colours = (first.sh[:, 0] * sh.C0 + 0.5).clamp(0, 1)
        moves = torch.zeros(N, 3)
        moves[: len(scene)] = torch.tensor([1.0, 0.0, 0.0])  # as theirs: red what moves, blue what does not
        moves[len(scene) :] = torch.tensor([0.0, 0.0, 1.0])
        return {
            "means3D": _numpy(torch.stack([m.means for m in moments])),
            "unnorm_rotations": _numpy(torch.stack([m.quats for m in moments])),
            "rgb_colors": _numpy(colours[None].expand(T, N, 3)),
            "seg_colors": _numpy(moves),
            "logit_opacities": _numpy(first.opacity_logits[:, None]),
            "log_scales": _numpy(first.log_scales),
            "cam_m": np.zeros((max(cameras, 1), 3), np.float32),
            "cam_c": np.zeros((max(cameras, 1), 3), np.float32),
        }


class TapVid3D(Exporter):
    """The trajectories of moving Gaussians as TAPVid-3D has them: positions in a camera's axes, seen inside its image.

    The camera is the first that took part. Whether something stands before a point is not told: ``visibility`` says
    that it lies in the image.
    """

    name, file = "tapvid3d", "tapvid3d.npz"

    def write(self, scene: Gaussians4D, out: Path, times: Sequence[float], frame: str) -> None:
        raise ValueError("format: tapvid3d needs a camera; found a scene alone. Export the folder of a result.")

    def write_result(self, result: SavedReconstruction, out: Path, times: Sequence[float]) -> None:
        video = next((v for v in result.videos if not v.held_out), result.videos[0])
        K = video.camera.K
        poses = np.stack([video.pose(float(t)) for t in times])
        tracks = scene_tracks(result.scene, times, frame=result.frame)
        xyz = np.einsum("tij,ntj->tni", poses[:, :3, :3], tracks.positions()) + poses[:, None, :3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = xyz[..., :2] / xyz[..., 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
        seen = np.isfinite(uv).all(-1) & (xyz[..., 2] > 0) & (uv >= 0).all(-1)
        seen &= (uv < [video.camera.width, video.camera.height]).all(-1)
        queries = np.zeros((xyz.shape[1], 3))
        at = seen.argmax(0)
        queries[:, :2], queries[:, 2] = uv[at, np.arange(len(at))], at
        write_npz(
            out,
            {
                "tracks_XYZ": xyz.astype(np.float32),
                "visibility": seen,
                "fx_fy_cx_cy": np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]),
                "queries_xyt": np.nan_to_num(queries).astype(np.float32),
                "extrinsics_w2c": poses,
                "seconds": np.asarray(times, float),
            },
        )


class SuperSplat(Exporter):
    """A moment as 3DGS .ply that stands upright in SuperSplat: up is -y, the middle of the scene the origin.

    SuperSplat turns every .ply by 180 degrees about z, because those of COLMAP's world point down with y. Up is what
    the cameras' upper edges agree on.
    """

    name, file, holds = "supersplat", "supersplat.ply", "moment"

    def write(self, scene: Gaussians4D, out: Path, times: Sequence[float], frame: str) -> None:
        raise ValueError("format: supersplat needs cameras, which tell what is up; found a scene alone.")

    def write_result(self, result: SavedReconstruction, out: Path, times: Sequence[float]) -> None:
        gaussians = result.scene.at(float(times[0]))
        up = up_axis(np.stack([video.pose(float(times[0])) for video in result.videos]))
        save_ply(upright(gaussians, np.asarray(up, float)), out)


def upright(gaussians: Gaussians, up: np.ndarray) -> Gaussians:
    """Turned so that ``up`` becomes -y, by the shortest way, and moved so that the median centre is the origin."""
    R = torch.as_tensor(shortest_turn(up, np.array([0.0, -1.0, 0.0])), dtype=gaussians.means.dtype)
    middle = gaussians.means.median(0).values
    return replace(
        gaussians,
        means=(gaussians.means - middle) @ R.T,
        quats=_times(_quaternion(R), gaussians.quats),
        sh=turned_harmonics(gaussians.sh, R),
    )


def shortest_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rotation (3,3) that takes direction ``a`` to ``b`` and moves as little as can be."""
    from scipy.spatial.transform import Rotation

    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    if np.linalg.norm(axis) < 1e-9:
        other = np.array([1.0, 0.0, 0.0])  # half a turn about any axis across
        return np.eye(3) if a @ b > 0 else Rotation.from_rotvec(np.pi * other).as_matrix()
    angle = np.arctan2(np.linalg.norm(axis), a @ b)
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix()


def turned_harmonics(coefficients: Tensor, R: Tensor) -> Tensor:
    """Coefficients (N,K,3) of the same colours seen from directions that are turned by ``R``.

    Found by least squares over directions: harmonics of a degree turn among themselves, so the fit is exact.
    """
    degree = round(coefficients.shape[1] ** 0.5) - 1
    if degree == 0:
        return coefficients
    g = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(200, 3, generator=g, dtype=torch.float64), dim=1)
    after = torch.stack(sh.basis(degree, directions), 1)
    before = torch.stack(sh.basis(degree, directions @ R.double()), 1)
    turn = torch.linalg.lstsq(after, before).solution
    return torch.einsum("kj,njc->nkc", turn.to(coefficients.dtype), coefficients)


def _quaternion(R: Tensor) -> Tensor:
    from scipy.spatial.transform import Rotation

    return torch.as_tensor(Rotation.from_matrix(R.double().numpy()).as_quat(scalar_first=True), dtype=R.dtype)


def _times(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton's product of one quaternion (4) and many (N,4), wxyz."""
    w, x, y, z = a
    p, q, r, s = b.unbind(-1)
    parts = (w * p - x * q - y * r - z * s, w * q + x * p + y * s - z * r, w * r - x * s + y * p + z * q)
    return torch.stack((*parts, w * s + x * r - y * q + z * p), -1)


def _numpy(x: Tensor) -> np.ndarray:
    return x.detach().cpu().numpy().astype(np.float32)
