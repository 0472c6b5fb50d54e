"""Two-view geometry of calibrated cameras: fundamental matrices, epipolar residuals, lens distortion."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from .types import Camera, TrackSet


def fundamental(a: Camera, b: Camera, frame_a: int = 0, frame_b: int = 0) -> Float[np.ndarray, "3 3"]:
    """F with ``[x_b 1] F [x_a 1]ᵀ = 0`` for pixels of one world point, up to scale.

    ``frame_a``, ``frame_b`` choose the pose of a camera that moves. (Hartley and Zisserman, Sec. 9.2.)
    """
    w2c = [c.w2c if c.w2c.ndim == 2 else c.w2c[k] for c, k in ((a, frame_a), (b, frame_b))]
    return fundamental_of(a.K, w2c[0], b.K, w2c[1])


def fundamentals(a: Camera, b: Camera) -> Float[np.ndarray, "Fa Fb 3 3"]:
    """One F per pair of poses: axes of length 1 for static cameras."""
    wa, wb = (c.w2c[None] if c.w2c.ndim == 2 else c.w2c for c in (a, b))
    return fundamental_of(a.K, wa[:, None], b.K, wb[None])


def fundamental_of(
    Ka: Float[np.ndarray, "3 3"],
    a: Float[np.ndarray, "*A 4 4"],
    Kb: Float[np.ndarray, "3 3"],
    b: Float[np.ndarray, "*B 4 4"],
) -> Float[np.ndarray, "*N 3 3"]:
    """F of unit norm of all poses ``a`` with those of ``b``, which are broadcast against each other."""
    R = b[..., :3, :3] @ np.swapaxes(a[..., :3, :3], -1, -2)
    t = b[..., :3, 3] - np.einsum("...ij,...j->...i", R, a[..., :3, 3])
    cross = np.zeros((*t.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        cross[..., i, j], cross[..., j, i] = -t[..., k], t[..., k]
    F = np.linalg.inv(Kb).T @ cross @ R @ np.linalg.inv(Ka)
    return F / np.maximum(np.linalg.norm(F, axis=(-2, -1), keepdims=True), 1e-300)


def sampson(
    F: Float[np.ndarray, "3 3"], xa: Float[np.ndarray, "N 2"], xb: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, " N"]:
    """Signed distance in pixels of (x_a, x_b) to the epipolar constraint, to first order.

    (Hartley and Zisserman, Sec. 11.4.3.)
    """
    ha, hb = (np.concatenate([x, np.ones((len(x), 1))], 1) for x in (xa, xb))
    la, lb = ha @ F.T, hb @ F
    norm = np.sqrt(la[:, 0] ** 2 + la[:, 1] ** 2 + lb[:, 0] ** 2 + lb[:, 1] ** 2)
    return (hb * la).sum(1) / np.maximum(norm, 1e-300)


def undistort(camera: Camera, uv: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
    """Pixels of the ideal pinhole with the same K; nan stays nan."""
    if camera.distortion is None or not np.any(camera.distortion):
        return uv
    import cv2

    flat = uv.reshape(-1, 2)
    ok = np.isfinite(flat[:, 0])
    out = np.full_like(flat, np.nan)
    if ok.any():
        points = flat[ok].astype(np.float64).reshape(-1, 1, 2)
        out[ok] = cv2.undistortPoints(points, camera.K, camera.distortion, P=camera.K).reshape(-1, 2)
    return out.reshape(uv.shape)


def distort(camera: Camera, uv: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
    """Pixels of the image as it is, from those of the ideal pinhole with the same K; nan stays nan.

    (OpenCV's model: radial, tangential, thin prism, tilted sensor.)
    """
    if camera.distortion is None or not np.any(camera.distortion):
        return uv
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tilt_x, tilt_y = np.pad(
        camera.distortion, (0, 14 - len(camera.distortion))
    )
    K = camera.K
    ideal = np.concatenate([uv, np.ones_like(uv[..., :1])], -1) @ np.linalg.inv(K).T
    x, y = ideal[..., 0], ideal[..., 1]
    r2 = x**2 + y**2
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    bent = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2) + r2 * (s1 + r2 * s2),
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y + r2 * (s3 + r2 * s4),
            np.ones_like(x),
        ],
        -1,
    )
    if tilt_x or tilt_y:
        bent = bent @ _tilt(tilt_x, tilt_y).T
    flat = bent @ K.T
    return flat[..., :2] / flat[..., 2:]


def seen_pixels(tracks: TrackSet) -> Float[np.ndarray, "N T 2"]:
    """``uv`` in float64 with nan where not visible. ValueError when the set holds none."""
    if tracks.uv is None:
        raise ValueError("uv: expected pixels; this track set holds positions only.")
    return np.where(tracks.seen[..., None], tracks.uv, np.nan).astype(float)


def directions(camera: Camera, uv: Float[np.ndarray, "N T 2"]) -> Float[np.ndarray, "N T 3"]:
    """The directions in the world, of length 1, in which pixels look: without the turns of a camera that moves.

    A moving camera needs one w2c per frame of ``uv``'s second axis.
    """
    away = np.concatenate([uv, np.ones((*uv.shape[:2], 1))], 2) @ np.linalg.inv(camera.K).T
    away /= np.linalg.norm(away, axis=2, keepdims=True)
    turn = camera.w2c[..., :3, :3]
    return away @ turn if turn.ndim == 2 else np.einsum("tji,ntj->nti", turn, away)


def view_angle(a: Camera, b: Camera, target: Float[np.ndarray, " 3"]) -> float:
    """Degrees between the directions from ``target`` to both cameras (first poses)."""
    va, vb = (np.atleast_2d(c.center)[0] - target for c in (a, b))
    cosine = va @ vb / max(float(np.linalg.norm(va) * np.linalg.norm(vb)), 1e-300)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def common_target(cameras: list[Camera]) -> Float[np.ndarray, " 3"]:
    """The point nearest to all optical axes in the least-squares sense (first poses)."""
    A, b = 1e-9 * np.eye(3), np.zeros(3)
    for camera in cameras:
        R, _ = _pose(camera, 0)
        across = np.eye(3) - np.outer(R[2], R[2])
        A += across
        b += across @ np.atleast_2d(camera.center)[0]
    return np.linalg.solve(A, b)


def _tilt(x: float, y: float) -> Float[np.ndarray, "3 3"]:
    """The homography of a sensor tilted by angles about its axes, as OpenCV defines it."""
    cx, sx, cy, sy = np.cos(x), np.sin(x), np.cos(y), np.sin(y)
    R = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    return np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]]) @ R


def _pose(camera: Camera, frame: int) -> tuple[np.ndarray, np.ndarray]:
    w2c = camera.w2c if camera.w2c.ndim == 2 else camera.w2c[frame]
    return w2c[:3, :3], w2c[:3, 3]
