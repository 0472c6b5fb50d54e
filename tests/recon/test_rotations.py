"""Rotations for torch and for kernels are one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from otsync.compute import quaternions as kernels
from recon import rotations


def test_kernels_and_torch_turn_alike():
    quats = torch.randn(40, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    assert rotations.LEAST_NORM == kernels.LEAST_NORM
    for q, unit, matrix in zip(
        quats, rotations.unit(quats), rotations.rotation_matrices(rotations.unit(quats)), strict=True
    ):
        np.testing.assert_allclose(kernels.unit(tuple(q.tolist()))[0], unit, atol=1e-15)
        np.testing.assert_allclose(kernels.rotation(tuple(unit.tolist())), matrix.reshape(-1), atol=1e-15)
        np.testing.assert_allclose(
            kernels.product(tuple(q.tolist()), tuple(unit.tolist())), rotations.product(q, unit), atol=1e-14
        )


def test_a_camera_looks_at_its_focus_with_level_rows():
    eye, focus, up = np.array([3.0, 1.0, 2.0]), np.array([0.2, -0.4, 0.5]), np.array([0.0, 0.0, 1.0])
    w2c = rotations.look_at(eye, focus, up)
    np.testing.assert_allclose(w2c[:3, :3] @ w2c[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(w2c[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(w2c @ [*focus, 1], [0, 0, np.linalg.norm(focus - eye), 1], atol=1e-12)
    np.testing.assert_allclose(w2c @ [*eye, 1], [0, 0, 0, 1], atol=1e-12)
    assert w2c[0, :3] @ up == pytest.approx(0) and w2c[1, :3] @ up < 0  # rows lie level, columns point down
    with pytest.raises(ValueError, match="up: expected an axis across"):
        rotations.look_at(eye, eye + up, up)
