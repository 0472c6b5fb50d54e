"""Similarities: rotation, scale and translation from one frame of reference to another, and how sure they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from .camera import Camera


@dataclass(frozen=True, eq=False)
class Similarity:
    """``x -> scale R x + t``: positions of one frame, in another.

    Args:
        scale: units of the target frame per unit of the source frame.
        R: rotation matrix, determinant +1. t: where the source's origin lies in the target frame.
        covariance: of a small error (w, s, u) that acts in the target frame, after the similarity:
            ``y -> y + w x y + s y + u``. Rows and columns: w rotation vector in radians (3), s relative scale (1),
            u translation in target units (3). None: not estimated.

    Example:
        >>> import numpy as np
        >>> double = Similarity(2.0, np.eye(3), np.array([1.0, 0.0, 0.0]))
        >>> double(np.array([1.0, 1.0, 1.0])).tolist()
        [3.0, 2.0, 2.0]
        >>> double.inverse()(double(np.ones(3))).tolist()
        [1.0, 1.0, 1.0]
    """

    scale: float
    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "7 7"] | None = None

    def __call__(self, xyz: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
        """The positions in the target frame; nan stays nan."""
        # one long product: numpy's stacked ones are slow for small matrices
        moved = xyz.reshape(-1, 3) @ (self.scale * self.R.T).astype(xyz.dtype)
        moved += self.t.astype(xyz.dtype)
        return moved.reshape(xyz.shape)

    def inverse(self) -> Similarity:
        """From the target frame back to the source frame."""
        back = Similarity(1 / self.scale, self.R.T, -self.R.T @ self.t / self.scale)
        return back if self.covariance is None else back.with_covariance(_carried(back, self.covariance))

    def after(self, first: Similarity) -> Similarity:
        """This one applied to what ``first`` gives. Covariances add up where both are known."""
        R, t = self.R @ first.R, self.scale * self.R @ first.t + self.t
        both = Similarity(self.scale * first.scale, R, t)
        if self.covariance is None or first.covariance is None:
            return both
        return both.with_covariance(self.covariance + _carried(self, first.covariance))

    def with_covariance(self, covariance: Float[np.ndarray, "7 7"] | None) -> Similarity:
        """The same with another covariance."""
        return Similarity(self.scale, self.R, self.t, covariance)

    def camera(self, camera: Camera) -> Camera:
        """The camera that sees the mapped points at the pixels where ``camera`` sees the originals.

        Depths grow by ``scale``. A camera that moves has (T,4,4) poses before and after.
        """
        R, t = camera.w2c[..., :3, :3], camera.w2c[..., :3, 3]
        w2c = np.zeros(camera.w2c.shape)
        w2c[..., 3, 3] = 1.0
        w2c[..., :3, :3] = R @ self.R.T
        w2c[..., :3, 3] = self.scale * t - w2c[..., :3, :3] @ self.t
        return Camera(camera.K, w2c, camera.width, camera.height, camera.distortion, camera.readout)

    def moved(self, small: Float[np.ndarray, " 7"]) -> Similarity:
        """After a small change (w, s, u) in the target frame, see ``covariance``."""
        R, grown = rotation_of(small[:3]), float(np.exp(small[3]))
        return Similarity(grown * self.scale, R @ self.R, grown * R @ self.t + small[4:], self.covariance)

    def difference(self, other: Similarity) -> Float[np.ndarray, " 7"]:
        """The (w, s, u) with ``self.moved(difference) = other``."""
        back = Similarity(self.scale, self.R, self.t).inverse()
        change = Similarity(other.scale, other.R, other.t).after(back)
        return np.concatenate([rotation_vector(change.R), [np.log(change.scale)], change.t])

    def degrees_from(self, other: Similarity) -> float:
        """Angle between the two rotations."""
        turn = other.R @ self.R.T
        twice_sine = np.hypot(np.hypot(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0]), turn[1, 0] - turn[0, 1])
        return float(np.degrees(np.arctan2(twice_sine, np.trace(turn) - 1)))

    @property
    def rotation_sigma(self) -> float:
        """Degrees: one standard deviation of the rotation, the root of the sum over its three axes; nan if unknown."""
        return (
            float("nan") if self.covariance is None else float(np.degrees(np.sqrt(np.trace(self.covariance[:3, :3]))))
        )

    @property
    def scale_sigma(self) -> float:
        """One standard deviation of the scale, as a share of it; nan if unknown."""
        return float("nan") if self.covariance is None else float(np.sqrt(self.covariance[3, 3]))

    def sigma_at(self, point: Float[np.ndarray, " 3"]) -> float:
        """One standard deviation, target units, of where ``point`` of the source frame lies, summed over three axes.

        A rotation that is a little wrong moves what is far from the scene the more; nan if unknown.
        """
        if self.covariance is None:
            return float("nan")
        y = self(np.asarray(point, float))
        J = np.concatenate([-cross_matrix(y), y[:, None], np.eye(3)], 1)
        return float(np.sqrt(np.trace(J @ self.covariance @ J.T)))

    @property
    def quaternion(self) -> Float[np.ndarray, " 4"]:
        """The rotation as w, x, y, z of unit norm, w >= 0."""
        from scipy.spatial.transform import Rotation

        q = Rotation.from_matrix(self.R).as_quat()[[3, 0, 1, 2]]
        return -q if q[0] < 0 else q

    @classmethod
    def of_quaternion(
        cls,
        scale: float,
        quaternion: Float[np.ndarray, " 4"],
        t: Float[np.ndarray, " 3"],
        covariance: Float[np.ndarray, "7 7"] | None = None,
    ) -> Similarity:
        """From a quaternion w, x, y, z of any length but 0. ValueError for what is no similarity."""
        q, t = np.asarray(quaternion, float), np.asarray(t, float)
        if q.shape != (4,) or t.shape != (3,) or not (np.isfinite(q).all() and np.isfinite(t).all()):
            raise ValueError("transform: expected a quaternion of 4 and a translation of 3 finite numbers")
        if not np.linalg.norm(q) > 0 or not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"transform: expected a quaternion that is not zero and a scale above 0; found {scale!r}")
        if covariance is not None:
            covariance = np.asarray(covariance, float)
            if covariance.shape != (7, 7) or not np.isfinite(covariance).all():
                raise ValueError("transform: expected a covariance of 7 x 7 finite numbers")
        from scipy.spatial.transform import Rotation

        return cls(float(scale), Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), t, covariance)

    def to_dict(self) -> dict[str, Any]:
        """For files: scale, quaternion, translation, and what is known of their errors."""
        known = {} if self.covariance is None else {"covariance": self.covariance.tolist()}
        sigmas = {"rotation_sigma_degrees": self.rotation_sigma, "scale_sigma": self.scale_sigma} if known else {}
        return {"scale": self.scale, "quaternion": self.quaternion.tolist(), "translation": self.t.tolist()} | {
            **sigmas,
            **known,
        }

    @classmethod
    def from_dict(cls, data: Any) -> Similarity:
        """What :meth:`to_dict` made. ValueError or KeyError for anything else."""
        if not isinstance(data, dict):
            raise ValueError(f"transform: expected an object; found {data!r}")
        return cls.of_quaternion(data["scale"], data["quaternion"], data["translation"], data.get("covariance"))


IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


def cross_matrix(v: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The matrix of ``v x``."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def rotation_of(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation about ``vector`` by its length in radians."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.asarray(vector, float)).as_matrix()


def rotation_vector(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
    """Axis times angle in radians, angle in [0, π]; the inverse of :func:`rotation_of`."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_rotvec()


def _carried(by: Similarity, covariance: Float[np.ndarray, "7 7"]) -> Float[np.ndarray, "7 7"]:
    """The covariance of an error of the source frame, in the target frame of ``by``: Ad C Adᵀ."""
    A = adjoint(by)
    return A @ covariance @ A.T


def adjoint(by: Similarity) -> Float[np.ndarray, "7 7"]:
    """How an error (w, s, u) before the similarity looks after it: ``by . exp(e) = exp(Ad e) . by``."""
    A = np.zeros((7, 7))
    A[:3, :3] = by.R
    A[3, 3] = 1.0
    A[4:, :3] = cross_matrix(by.t) @ by.R
    A[4:, 3] = -by.t
    A[4:, 4:] = by.scale * by.R
    return A
