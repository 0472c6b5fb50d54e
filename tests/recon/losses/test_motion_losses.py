"""Motion losses against closed forms, their kernels against torch, and what they do to offsets: nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from recon.fit.options import DEFAULT_LOSSES
from recon.losses import MotionLoss
from recon.losses.motion import (
    SHIFTS,
    SOFT,
    Acceleration,
    Arap,
    Draw,
    Length,
    RotationAcceleration,
    RotationVelocity,
    Velocity,
    soft_norm,
)
from recon.motion import Binding, HermiteSpline, PerGaussian, Sampled, Scaffold, Static
from recon.motion.solve import FRAME
from recon.rotations import continuous, quaternions
from tests.recon.motion.worlds import leaves, random_scaffold

EVERY = (Arap(), Length(), Acceleration(), Velocity(), RotationVelocity(), RotationAcceleration())
NAMES = [type(loss).__name__ for loss in EVERY]


def draw(seed=0, footprint=0.0133, **options):
    return Draw(np.random.default_rng(seed), (0.0, 0.9), FRAME, footprint, **options)


def moving(positions, rotations=None, *, spacing=4 * FRAME, dtype=torch.float64, neighbours=None):
    """A scaffold through `positions` [P,M,3], with rotations [P,M,3,3]."""
    P, M = positions.shape[:2]
    if rotations is None:
        rotations = np.tile(np.eye(3), (P, M, 1, 1))
    knots = torch.from_numpy(np.array(positions, float)).to(dtype)
    if neighbours is None:
        neighbours = np.stack([np.delete(np.arange(M), m)[:6] for m in range(M)])
    return Scaffold(
        HermiteSpline(-spacing, spacing, P),
        knots,
        torch.from_numpy(continuous(quaternions(rotations))).to(dtype),
        torch.from_numpy(neighbours),
        torch.ones(neighbours.shape, dtype=dtype),
        1.0,
        Binding.empty(M, knots),
    )


def ask(loss, motion, *args):
    return loss(motion, torch.zeros(0, 3), torch.zeros(0, 4), *args)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rigid_motions_cost_nothing(dtype):
    """Nodes that turn and travel as one body, at a constant rate between two of its poses: ARAP and lengths vanish."""
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(12, 3))
    spin = Rotation.from_rotvec(np.arange(10)[:, None] * np.array([0.0, 0.3, 0.1]))
    shifts = rng.normal(size=(10, 1, 3))
    positions = np.stack([r.apply(cloud) for r in spin]) + shifts
    rotations = np.tile(spin.as_matrix()[:, None], (1, 12, 1, 1))
    scaffold = moving(positions, rotations, dtype=dtype)
    # knots are exactly rigid to each other; between them the two splines differ by their own small error
    at_knots = 4 * FRAME * np.arange(1, 7)

    class Knots(Draw):
        def moment(self, before, after):
            return float(self.rng.choice(at_knots[:3]))

    for loss in (Arap(shifts=(4 * FRAME, 8 * FRAME)), Length(shifts=(4 * FRAME, 12 * FRAME))):
        for seed in range(4):
            value = ask(loss, scaffold, Knots(np.random.default_rng(seed), (0.0, 0.9), FRAME, 0.0133))
            assert abs(float(value)) < (1e-2 if dtype == torch.float32 else 1e-9)
            bent = replace(
                scaffold,
                knots=scaffold.knots
                * torch.tensor([1.0, 1.0, 1.1]).to(dtype) ** torch.arange(10).to(dtype)[:, None, None],
            )
            assert float(ask(loss, bent, Knots(np.random.default_rng(seed), (0.0, 0.9), FRAME, 0.0133))) > 1
    unturned = replace(scaffold, knot_quats=scaffold.knot_quats[:1].expand(10, -1, -1))
    d = Knots(np.random.default_rng(0), (0.0, 0.9), FRAME, 0.0133)
    assert float(ask(Arap(shifts=(8 * FRAME,)), unturned, d)) > 1  # turning nodes must say so


def test_arap_and_length_of_a_stretch():
    """Two nodes a metre apart that part by v metres a second: both losses are v times the shift, in footprints."""
    v, P = 0.3, 10
    t = np.arange(P)[:, None, None] * 4 * FRAME
    positions = np.zeros((P, 2, 3)) + t * np.array([[0, 0, 0], [v, 0, 0]]) + np.array([[0, 0, 0], [1.0, 0, 0]])
    scaffold = moving(positions, neighbours=np.array([[1], [0]]))
    for shift in SHIFTS:
        change = v * shift / 0.01
        want = np.sqrt(change**2 + SOFT**2) - SOFT
        for loss in (Arap(shifts=(shift,), neighbours=6), Length(shifts=(shift,))):
            assert float(ask(loss, scaffold, draw(footprint=0.01))) == pytest.approx(want, rel=1e-6)


def test_arap_sees_a_shear_that_lengths_do_not():
    """One node circles the other, neither turns: the length stays, the place in the other's frame does not."""
    angle = 0.05
    P = 10
    a = angle * np.arange(P)
    positions = np.zeros((P, 2, 3))
    positions[:, 1, 0], positions[:, 1, 1] = np.cos(a), np.sin(a)
    scaffold = moving(positions, neighbours=np.array([[1], [0]]))

    class Knot(Draw):
        def moment(self, before, after):
            return 4 * FRAME

    d = Knot(np.random.default_rng(0), (0.0, 1.0), FRAME, 0.01)
    chord = 2 * np.sin(angle / 2) / 0.01
    assert float(ask(Arap(shifts=(4 * FRAME,)), scaffold, d)) == pytest.approx(np.hypot(chord, SOFT) - SOFT, rel=1e-6)
    assert float(ask(Length(shifts=(4 * FRAME,)), scaffold, d)) < 1e-9


def test_velocity_and_acceleration_of_known_curves():
    v, g, P = np.array([0.3, -0.4, 0.0]), np.array([0.0, 0.0, 9.0]), 12
    t = (np.arange(P)[:, None, None] - 1) * 4 * FRAME
    start = np.random.default_rng(0).normal(size=(5, 3))
    straight, falling = start + v * t, start + g * t**2 / 2
    soft = lambda x: np.hypot(x, SOFT) - SOFT  # noqa: E731
    for positions, velocity, acceleration in ((straight, 0.5 * FRAME, 0.0), (falling, None, 9.0 * FRAME**2)):
        for motion in (
            moving(positions),
            PerGaussian(HermiteSpline(-4 * FRAME, 4 * FRAME, P), torch.from_numpy(positions)),
        ):
            for dtype in (torch.float32, torch.float64):
                cast = motion.with_parameters({k: x.to(dtype) for k, x in motion.parameters().items()})
                exact = {
                    "rel": 1e-4 if dtype == torch.float32 else 1e-9,
                    "abs": 1e-3 if dtype == torch.float32 else 1e-9,
                }
                if velocity is not None:
                    found = ask(Velocity(), cast, draw())
                    assert float(found) == pytest.approx(soft(velocity / 0.0133), **exact)
                # Catmull-Rom tangents are exact for parabolas
                found = ask(Acceleration(), cast, draw())
                assert float(found) == pytest.approx(soft(acceleration / 0.0133), **exact)


def test_turning_at_a_constant_rate():
    spin = Rotation.from_rotvec(0.1 * np.arange(14)[:, None] * np.array([0.6, 0.0, -0.8]))
    rotations = np.tile(spin.as_matrix()[:, None], (1, 5, 1, 1))
    scaffold = moving(np.zeros((14, 5, 3)), rotations)
    assert float(ask(RotationVelocity(), scaffold, draw())) == pytest.approx(0.1 / 4, rel=2e-2)
    assert float(ask(RotationAcceleration(), scaffold, draw())) < 1e-4
    faster = Rotation.from_rotvec(0.02 * (np.arange(14)[:, None] ** 2) * np.array([0.6, 0.0, -0.8]))
    speeding = moving(np.zeros((14, 5, 3)), np.tile(faster.as_matrix()[:, None], (1, 5, 1, 1)))
    assert float(ask(RotationAcceleration(), speeding, draw())) == pytest.approx(0.04 / 16, rel=0.2)


@pytest.mark.parametrize("loss", EVERY, ids=NAMES)
@pytest.mark.parametrize("videos", [0, 3])
def test_kernels_are_the_definitions(loss, videos):
    """Value and gradients in float32 by kernels, in float64 by torch; a masked edge has no say."""
    scaffold, found = random_scaffold(videos=videos), []
    clocks = torch.tensor([0.0, 0.03, -0.02], dtype=torch.float64) if videos else None
    for dtype in (torch.float32, torch.float64):
        cast = replace(scaffold, edge_weights=scaffold.edge_weights.to(dtype))
        knots = leaves({k: v.to(dtype) for k, v in scaffold.parameters().items()})
        value = ask(loss, cast.with_parameters(knots), draw(clocks=clocks))
        value.backward()
        found.append([value.detach(), *(k.grad if k.grad is not None else torch.zeros_like(k) for k in knots.values())])
    for a, b in zip(*found, strict=True):
        assert torch.allclose(a.double(), b, rtol=1e-4, atol=1e-5 * float(b.abs().max()) + 1e-12)


@pytest.mark.parametrize("loss", EVERY, ids=NAMES)
def test_gradcheck(loss):
    scaffold = random_scaffold(nodes=6, gaussians=0, rests=(), knots=6, dtype=torch.float64)
    knots = leaves(scaffold.parameters())

    def value(p, q):
        return ask(loss, scaffold.with_parameters({"knots": p, "knot_quats": q}), draw(footprint=1.0))

    assert torch.autograd.gradcheck(value, tuple(knots.values()), fast_mode=True)


@pytest.mark.parametrize("loss", EVERY[:4], ids=NAMES[:4])
def test_a_weight_means_the_same_in_other_units(loss):
    scaffold = random_scaffold(dtype=torch.float64)
    larger = replace(scaffold, knots=100 * scaffold.knots)
    a, b = ask(loss, scaffold, draw(footprint=0.01)), ask(loss, larger, draw(footprint=1.0))
    assert torch.allclose(a, b)


def test_motions_without_the_thing_give_none():
    apart = PerGaussian(HermiteSpline(0.0, 0.1, 8), torch.zeros(8, 5, 3))
    for loss, name in zip(EVERY, NAMES, strict=True):
        assert ask(loss, Static(), draw()) is None
        assert (ask(loss, apart, draw()) is None) == (name not in ("Velocity", "Acceleration"))


def test_offsets_feel_nothing():
    """A scaffold per video would otherwise be moved in time to where its motion is stiff."""
    scaffold = random_scaffold(videos=2)
    clocks = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    for dtype in (torch.float32, torch.float64):
        knots = leaves({k: v.to(dtype) for k, v in scaffold.parameters().items()})
        cast = replace(scaffold.with_parameters(knots), edge_weights=scaffold.edge_weights.to(dtype))
        for loss in EVERY:
            ask(loss, cast, draw(clocks=clocks)).backward()
    assert clocks.grad is None


def test_samples_are_compared_over_whole_samples():
    """On per-frame samples of 15 frames a second a velocity is taken over one of them, and still per 1/30 s."""
    P = 20
    positions = np.zeros((P, 4, 3)) + np.arange(P)[:, None, None] * 0.02
    base = moving(positions, spacing=1 / 15)
    sampled = replace(base, path=Sampled(base.path.start, base.path.spacing, P))
    want = np.sqrt(3) * 0.02 / 2 / 0.0133
    for seed in range(5):
        assert float(ask(Velocity(), sampled, draw(seed))) == pytest.approx(want, rel=1e-2)
        assert float(ask(Acceleration(), sampled, draw(seed))) < 1e-9


def test_short_footage_has_its_middle():
    d = Draw(np.random.default_rng(0), (1.0, 1.1), FRAME, 0.01)
    assert d.moment(0, 8 * FRAME) == pytest.approx((1.0 + 1.1 - 8 * FRAME) / 2)
    assert all(1.02 <= d.moment(0.02, 0.03) <= 1.07 for _ in range(20))


def test_the_soft_norm_is_smooth_and_zero_at_zero():
    x = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    y = soft_norm(x)
    y.backward()
    assert y == 0 and (x.grad == 0).all()
    assert float(soft_norm(torch.tensor([3.0, 4.0]))) == pytest.approx(5 - SOFT, rel=1e-4)


def test_weights_are_the_studys_but_for_neighbours():
    """1.0 and .02 a metre for acceleration and velocity, where a footprint is 1.33 cm; for ARAP and lengths, of which
    the study has .6, a little more at the begin and twelve times that at the end: fits are longer, and coherence goes
    as they go on.
    """
    usual = [loss for loss in DEFAULT_LOSSES if isinstance(loss, MotionLoss)]
    for done, near in ((0.0, 0.752), (0.5, 4.135), (1.0, 7.52)):
        weights = {type(loss).__name__: loss.weight_at(done) / 0.0133 for loss in usual}
        want = {"Arap": near, "Length": near, "Acceleration": 1.0, "Velocity": 0.02}
        assert weights == pytest.approx(want, rel=0.02)
    assert all(loss.every == 2 for loss in usual)
