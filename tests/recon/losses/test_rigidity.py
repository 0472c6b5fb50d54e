"""Losses on rigidity against their formulas, spelled out pair by pair, and against motions that are rigid."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from recon.losses.motion import SOFT, SOFT_ANGLE, Draw
from recon.losses.rigidity import FALLOFF, Isometry, Rigidity, RotationSimilarity
from recon.motion import HermiteSpline, PerGaussian, Sampled, Static
from recon.motion.solve import FRAME
from recon.rotations import quaternions
from tests.recon.motion.worlds import leaves, random_scaffold

EVERY = (Rigidity(), RotationSimilarity(), Isometry())
NAMES = [type(loss).__name__ for loss in EVERY]
FOOTPRINT = 0.0067


class Fixed(Draw):
    """Always the same moment: the third frame."""

    def moment(self, before, after):
        return 3 * FRAME


def draw(footprint=FOOTPRINT) -> Draw:
    return Fixed(np.random.default_rng(0), (0.0, 7 * FRAME), FRAME, footprint)


def cloud(spin, shifts, *, unit=1.0, n=30, turning=True, k=4):
    """N Gaussians, some footprints apart, that stand at the poses (spin[p], shifts[p]) in frame p, and their means."""
    rng = np.random.default_rng(0)
    means = 0.01 * rng.normal(size=(n, 3))
    moved = np.stack([r.apply(means) + s - means for r, s in zip(spin, shifts, strict=True)])
    motion = PerGaussian(Sampled(0.0, FRAME, len(spin)), unit * torch.from_numpy(moved))
    if turning:
        q = torch.from_numpy(quaternions(np.stack([r.as_matrix() for r in spin])))
        motion = PerGaussian(motion.path, motion.own_knots, (2 * q)[:, None].repeat(1, n, 1))
    means = unit * torch.from_numpy(means)
    return motion.tied(means, 0.0, k), means


SPIN = Rotation.from_rotvec(np.arange(8)[:, None] * np.array([0.0, 0.3, 0.1]))
SHIFTS = np.random.default_rng(1).normal(size=(8, 3))


@pytest.mark.parametrize("loss", EVERY, ids=NAMES)
def test_a_body_that_turns_and_travels_costs_nothing(loss):
    motion, means = cloud(SPIN, SHIFTS)
    assert float(loss(motion, means, means, draw())) < 1e-9
    rng = np.random.default_rng(2)
    loose = motion.with_parameters(
        {n: x + 0.02 * torch.from_numpy(rng.normal(size=x.shape)) for n, x in motion.parameters().items()}
    )
    assert float(loss(loose, means, means, draw())) > 1e-3


def test_without_turns_a_spin_is_not_rigid_but_isometric():
    motion, means = cloud(SPIN, SHIFTS, turning=False)
    assert float(Rigidity()(motion, means, means, draw())) > 0.01
    assert RotationSimilarity()(motion, means, means, draw()) is None
    assert float(Isometry()(motion, means, means, draw())) < 1e-9


def test_losses_are_those_published_in_footprints():
    """The sums of the paper, pair by pair in metres, at the footprint at which its constants were chosen."""
    rng = np.random.default_rng(3)
    n, k = 12, 5
    means = torch.from_numpy(0.02 * rng.normal(size=(n, 3)))
    quats = torch.tensor([1.0, 0, 0, 0]).double() + 0.2 * torch.from_numpy(rng.normal(size=(8, n, 4)))
    motion = PerGaussian(Sampled(0.0, FRAME, 8), 0.02 * torch.from_numpy(rng.normal(size=(8, n, 3))), quats)
    motion = motion.tied(means, 0.0, k)
    x = (means + motion.own_knots).numpy()
    R = Rotation.from_quat(quats.numpy().reshape(-1, 4), scalar_first=True).as_matrix().reshape(8, n, 3, 3)
    rigid = alike = isometric = 0.0
    for i in range(n):
        for j in np.argsort(np.linalg.norm(x[0] - x[0, i], axis=1), kind="stable")[1 : k + 1]:
            w = np.exp(-2000 * np.sum((x[0, j] - x[0, i]) ** 2))
            back = R[3, i] @ R[4, i].T @ (x[4, j] - x[4, i])
            rigid += w * np.linalg.norm((x[3, j] - x[3, i]) - back)
            turn = [
                (Rotation.from_matrix(R[4, m]) * Rotation.from_matrix(R[3, m]).inv()).as_quat(True, scalar_first=True)
                for m in (i, j)
            ]
            alike += w * np.linalg.norm(turn[1] - turn[0])
            apart = [np.linalg.norm(x[p, j] - x[p, i]) for p in (0, 3)]
            isometric += w * abs(apart[1] - apart[0])
    unit, pairs = np.sqrt(FALLOFF / 2000), n * k
    found = [float(loss(motion, means, means, draw(unit))) for loss in EVERY]
    # norms are softened near zero
    assert found[0] == pytest.approx(rigid / pairs / unit, rel=1e-3, abs=SOFT)
    assert found[1] == pytest.approx(alike / pairs, rel=1e-3, abs=SOFT_ANGLE)
    assert found[2] == pytest.approx(isometric / pairs / unit, rel=1e-2, abs=SOFT)
    weights = [loss.weight for loss in EVERY]
    assert weights == pytest.approx([4 * unit, 4.0, 2 * unit], rel=0.03)  # per metre, no unit, per metre


@pytest.mark.parametrize("loss", EVERY, ids=NAMES)
def test_a_weight_means_the_same_in_other_units(loss):
    rng = np.random.default_rng(4)
    shifts = 0.01 * rng.normal(size=(8, 30, 3))
    found = []
    for unit in (1.0, 1000.0):
        motion, means = cloud(SPIN, np.zeros((8, 3)), unit=unit)
        knots = motion.own_knots + unit * torch.from_numpy(shifts)
        motion = motion.with_parameters({**motion.parameters(), "own_knots": knots})
        found.append(float(loss(motion, means, means, draw(unit * FOOTPRINT))))
    assert found[0] == pytest.approx(found[1], rel=1e-9)


@pytest.mark.parametrize("loss", EVERY, ids=NAMES)
def test_nodes_of_a_scaffold_are_held_together_too(loss):
    scaffold = random_scaffold(dtype=torch.float64, gaussians=0, rests=())
    knots = leaves(scaffold.parameters())
    d = Draw(np.random.default_rng(0), (0.0, 0.7), FRAME, 0.2)
    value = loss(scaffold.with_parameters(knots), torch.zeros(0, 3), torch.zeros(0, 4), d)
    value.backward()
    assert float(value.detach()) > 0 and any(k.grad is not None and (k.grad != 0).any() for k in knots.values())


@pytest.mark.parametrize("loss", EVERY, ids=NAMES)
def test_what_has_no_neighbours_has_no_such_loss(loss):
    path = HermiteSpline(0.0, 0.1, 8)
    for motion in (Static(), PerGaussian.at_rest(path, 5).turning()):
        assert loss(motion, torch.zeros(5, 3), torch.zeros(5, 4), draw()) is None


@pytest.mark.parametrize("loss", EVERY, ids=NAMES)
def test_gradcheck(loss):
    rng = np.random.default_rng(5)
    means = torch.from_numpy(0.02 * rng.normal(size=(6, 3))).requires_grad_()
    motion = PerGaussian.at_rest(HermiteSpline(0.0, 4 * FRAME, 6), 6).turning().tied(means, 0.0, 3)
    knots = {
        n: (x.double() + 0.02 * torch.from_numpy(rng.normal(size=x.shape))).requires_grad_()
        for n, x in motion.parameters().items()
    }
    near = motion.near

    def value(means, own_knots, own_quats):
        moved = PerGaussian(motion.path, own_knots, own_quats, near)
        return loss(moved, means, means, draw(1.0))  # so that weights, which are constants, hardly change

    assert torch.autograd.gradcheck(value, (means, *knots.values()), fast_mode=True, atol=1e-4, rtol=5e-2)
