"""fit(): gradients of the clocks, resuming, gauges, frozen groups, units; and the synthetic scene end to end (slow)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from otsync.compute.threads import get_threads
from otsync.types import Offsets
from recon.fit.densify import Densify
from recon.fit.lags import FIRST, LAGS
from recon.fit.optimize import RATES, without
from recon.fit.options import DEFAULT_LOSSES, FitOptions
from recon.fit.problem import Problem
from recon.fit.run import Diverged, Run
from recon.fit.uncertainty import averaged
from recon.fit.verb import Calibration, fit
from recon.losses import ImageLoss
from recon.losses.image import Mask, Photometric
from recon.losses.motion import Velocity
from recon.motion import BSpline, HermiteSpline, PerGaussian, Scaffold, Static, build_scaffold
from recon.observe.cameras import Clip, observer
from recon.observe.effects import Gain, MotionBlur, RollingShutter, Shot
from recon.observe.recorded import with_declared
from recon.raster import set_threads
from recon.rotations import rotation_matrices
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D
from recon.simulate.capture import synthetic
from tests.recon.motion.worlds import following

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def capture():
    return synthetic(4, cameras=3, held_out=0, frames=8, size=(48, 32))


def believed(capture, seconds=None) -> Offsets:
    V = len(capture.footage)
    known = Offsets.known([f.name for f in capture.footage], np.zeros(V) if seconds is None else seconds, 30.0)
    return replace(known, sigma=np.full(V, np.nan))


def true_scene(capture, n: int = 400, scale: float = 1.0) -> Gaussians4D:
    """The world's own Gaussians, carried by a scaffold built from the tracks."""
    world = capture.world
    times = capture.footage[0].times
    footprint = 2.6 / capture.footage[0].K[0, 0] * scale
    tracks = [replace(t, xyz=scale * t.xyz, camera=None) for t in capture.tracks]
    scaffold = build_scaffold(tracks, np.zeros(len(tracks)), footprint=footprint, frame_step=1 / 30)
    pick = np.linspace(0, len(world.part) - 1, n).astype(int)
    points = torch.as_tensor(scale * world.positions([times[4]])[pick, 0], dtype=torch.float32)
    g = Gaussians.from_colors(
        points,
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.full((n, 3), 0.04 * scale),
        torch.full((n,), 0.8),
        torch.as_tensor(world.colors[pick], dtype=torch.float32),
    )
    return Gaussians4D(
        g, scaffold.bind(points, times[4]), footprint, 1 / 30, (times[0], times[-1]), None, near=0.6 * scale
    )


@pytest.fixture(scope="module")
def scene(capture):
    return true_scene(capture)


def same(a, b) -> bool:
    """Equal to the last bit, wall seconds apart."""
    ga, gb = (
        {
            **vars(r.scene.dynamic),
            **r.scene.motion.parameters(),
            **r.parameters,
            "o": torch.as_tensor(r.offsets.seconds),
        }
        for r in (a, b)
    )
    return all(torch.equal(ga[n], gb[n]) for n in ga) and np.array_equal(a.history.loss, b.history.loss)


class Squared(ImageLoss):
    """A loss without kinks, which finite differences would stumble over."""

    weight = 1.0

    def __call__(self, seen):
        return (seen.rendered - seen.image).square().mean()


def gradient_against_differences(problem, group, index, step):
    run = Run(problem, dict(RATES), None, 10)
    values = {n: v.detach() for n, v in run.values().items()}

    def loss(shift: float) -> float:
        moved = {n: v.clone() for n, v in values.items()}
        moved[group][index] += shift
        return run.image_gradient({**moved, group: moved[group].requires_grad_()}, [group], [(1, 4)], False).losses[0]

    values[group] = values[group].clone().requires_grad_()
    gradient = run.image_gradient(values, [group], [(1, 4)], False).gradients[0]
    return float(gradient[index]), (loss(step) - loss(-step)) / (2 * step)


@pytest.mark.parametrize(
    "effects", [(), (MotionBlur(0.02),), (RollingShutter(0.02, 4),)], ids=["plain", "blur", "rolling"]
)
def test_the_clock_s_gradient_is_that_of_the_image(capture, scene, effects):
    problem = Problem.of(scene, capture.footage, believed(capture), FitOptions((Squared(),), effects, batch=1))
    found, expected = gradient_against_differences(problem, "offsets", 1, 3e-4)
    assert found == pytest.approx(
        expected, rel=0.1
    )  # splats end where their alpha falls below 1/255, which differences see


def test_the_sign_of_an_offset(capture, scene):
    """A video that started later has a positive offset: t_world = t_own + offset."""
    problem = Problem.of(scene, capture.footage, believed(capture, np.array([0, 0.05, 0])), FitOptions(batch=1))
    run = Run(problem, dict(RATES), None, 1)
    later, now = (
        run.look(run.values(), 1, 2),
        run.look({**run.values(), "offsets": torch.zeros(3).double()}, 1, 2, 0.05),
    )
    assert torch.equal(later, now)


def test_every_video_is_seen_through_its_own_readout(capture, scene):
    readouts = [0.02, None, 0.06]

    def losses(effects) -> list[float]:
        problem = Problem.of(scene, capture.footage, believed(capture), FitOptions((Squared(),), effects, batch=1))
        run = Run(problem, dict(RATES), None, 1)
        return [run.image_gradient(run.values(), ["offsets"], [(v, 4)], False).losses[0] for v in range(3)]

    alone = [losses((RollingShutter(r or 0.0),)) for r in readouts]  # every video through each
    assert losses(with_declared((), readouts)) == [alone[v][v] for v in range(3)]
    assert all(len({seen[v] for seen in alone}) == 3 for v in range(3))  # so that another video's would be noticed


@pytest.mark.parametrize("batch", [1, 3])
def test_a_fit_does_not_depend_on_threads(capture, scene, batch):
    results = []
    for threads in (1, 4):
        before = get_threads()
        set_threads(threads)
        try:
            results.append(fit(scene, capture.footage, believed(capture), steps=6, batch=batch, effects=(Gain(),)))
        finally:
            set_threads(before)
    assert same(*results)


@pytest.mark.parametrize(
    "densify",
    [
        None,
        Densify((0.3,), share=0.2),
        Densify((0.8,), share=0.2),
        Densify((0.6,), share=0.2),
        Densify((0.3,), nodes=9),
    ],
    ids=["plain", "densified before", "densified after", "densified then", "nodes too"],
)
def test_a_stopped_fit_continues_with_the_same_bits(capture, scene, tmp_path, monkeypatch, densify):
    options = {"steps": 10, "batch": 2, "densify": densify}
    whole = fit(scene, capture.footage, believed(capture), **options)
    path, step = tmp_path / "fit.npz", Run.one_step

    def one_step(self, *args, **kwargs):
        step(self, *args, **kwargs)
        if self.step == 6:  # Ctrl-C in the middle of what follows a step
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Run, "one_step", one_step)
        with pytest.raises(KeyboardInterrupt):
            fit(scene, capture.footage, believed(capture), checkpoint=path, **options)
    assert path.exists()
    again = fit(scene, capture.footage, believed(capture), checkpoint=path, **options)
    assert again.stats["steps"] == 10
    assert same(whole, again)


def test_view_dependent_colours_are_a_group_of_their_own(capture, scene, tmp_path):
    sh = torch.cat([scene.dynamic.sh, scene.dynamic.sh.new_zeros(len(scene), 3, 3)], 1)
    shiny = replace(scene, dynamic=replace(scene.dynamic, sh=sh))
    found = fit(shiny, capture.footage, believed(capture), steps=6, densify=Densify((0.5,), share=0.2))
    assert found.scene.dynamic.sh.shape[1:] == (4, 3) and found.scene.dynamic.sh[:, 1:].abs().max() > 0
    held = fit(shiny, capture.footage, believed(capture), steps=6, rates=without(RATES, "sh_rest"))
    assert not held.scene.dynamic.sh[:, 1:].any() and not torch.equal(held.scene.dynamic.sh[:, :1], sh[:, :1])
    # as long as they are zero they change no bit of the rest
    plain = fit(scene, capture.footage, believed(capture), steps=6)
    np.testing.assert_allclose(held.offsets.seconds, plain.offsets.seconds, atol=1e-7)


def test_a_finished_fit_is_read_back(capture, scene, tmp_path):
    options = {"steps": 3, "checkpoint": tmp_path / "fit.npz"}
    assert same(*(fit(scene, capture.footage, believed(capture), **options) for _ in range(2)))


def test_a_checkpoint_of_other_options_is_refused(capture, scene, tmp_path):
    path = tmp_path / "fit.npz"
    fit(scene, capture.footage, believed(capture), steps=2, checkpoint=path)
    with pytest.raises(ValueError, match="belongs to other"):
        fit(scene, capture.footage, believed(capture), steps=3, checkpoint=path)


def test_losses_and_effects_of_plain_classes_are_known_again(capture, scene, tmp_path):
    """Objects without a repr of their own count by what they hold, not by where they lie in memory."""

    def key(loss, effect=None, frame=0):
        footage = [replace(f, depth={frame: np.ones(f.size[::-1], np.float32)}) for f in capture.footage]
        problem = Problem.of(scene, footage, believed(capture), FitOptions((loss,), batch=1))
        return problem.key((loss,), () if effect is None else (effect,))

    class Effect:
        def __init__(self, strength):
            self.strength = strength

    heavier = Squared()
    heavier.weight = 2.0
    keys = [key(Squared()), key(heavier), key(Squared(), frame=1), key(Squared(), Effect(1)), key(Squared(), Effect(2))]
    assert len(set(keys)) == len(keys)
    assert keys[0] == key(Squared()) and keys[3] == key(Squared(), Effect(1))
    path = tmp_path / "fit.npz"
    first, again = (
        fit(scene, capture.footage, believed(capture), steps=2, checkpoint=path, losses=(Squared(),)) for _ in range(2)
    )
    assert same(first, again)


def test_frozen_groups_stand_still(capture, scene):
    result = fit(scene, capture.footage, believed(capture), steps=3, rates=without(RATES, "offsets", "means"))
    assert torch.equal(result.scene.dynamic.means, scene.dynamic.means)
    assert np.array_equal(result.offsets.seconds, np.zeros(3))
    assert not torch.equal(result.scene.dynamic.sh, scene.dynamic.sh)


def test_the_reference_keeps_its_place_and_the_motion_goes_with_it(capture, scene):
    """The common shift that the fit drifts by is taken out of offsets and motion alike: the images stay."""
    result = fit(scene, capture.footage, believed(capture), steps=5)
    assert result.offsets.seconds[0] == 0 and result.stats["drift_frames"] != 0
    drift = result.stats["drift_frames"] / 30
    start = result.scene.motion.path.start
    assert start == pytest.approx(scene.motion.path.start - drift, abs=1e-12)


def test_a_change_of_units_changes_nothing_but_the_units(capture):
    offsets = []
    for scale in (1.0, 1000.0):
        footage = []
        for f in capture.footage:
            w2c = f.w2c.copy()
            w2c[:3, 3] *= scale
            footage.append(replace(f, w2c=w2c))
        result = fit(true_scene(capture, scale=scale), footage, believed(capture), steps=12)
        offsets.append(result.offsets.seconds * 30)
    assert offsets[0] == pytest.approx(offsets[1], abs=2e-3)
    assert np.abs(offsets[0]).max() > 0.02


@pytest.mark.parametrize("motion", ["per-gaussian", "static"])
def test_other_motions_stand_in_the_slot(capture, scene, motion):
    other = Static() if motion == "static" else following(scene.motion, scene.dynamic.means)
    result = fit(replace(scene, motion=other), capture.footage, believed(capture), steps=3)
    assert isinstance(result.scene.motion, type(other)) and result.history.loss[-1] > 0


def test_a_scaffold_per_video(capture, scene):
    from recon.motion import ScaffoldOptions

    per_video = build_scaffold(
        capture.tracks,
        np.zeros(3),
        footprint=scene.footprint,
        frame_step=1 / 30,
        options=ScaffoldOptions(per_video=True),
    )
    bound = per_video.bind(scene.dynamic.means, capture.footage[0].times[4])
    result = fit(replace(scene, motion=bound), capture.footage, believed(capture), steps=4)
    assert torch.allclose(result.scene.motion.offsets, torch.as_tensor(result.offsets.seconds), atol=1e-12)


def test_densification_splits_what_is_pulled_and_drops_what_is_faint(scene):
    n = len(scene)
    faint = scene.dynamic.opacity_logits.clone()
    faint[:10] = -8.0
    pull = torch.zeros(n)
    pull[20:40] = 1.0
    denser, old, new = Densify((0.5,), share=20 / (n - 10))(
        replace(scene, dynamic=replace(scene.dynamic, opacity_logits=faint)), pull
    )
    assert len(denser) == n - 10 + 20 == len(denser.motion.binding)
    assert not set(range(10)) & set(old.tolist())
    assert sorted(old[new].unique().tolist()) == list(range(20, 40))
    # halves stand either side of their parent
    for parent in (20, 30):
        rows = torch.nonzero(old == parent)[:, 0]
        assert torch.allclose(denser.dynamic.means[rows].mean(0), scene.dynamic.means[parent], atol=1e-6)


@pytest.mark.parametrize("kind", [BSpline, HermiteSpline])
@pytest.mark.parametrize("apart", [False, True], ids=["scaffold", "per Gaussian"])
def test_a_step_moves_a_curve_as_far_whatever_it_is_made_of(capture, scene, kind, apart):
    """A lone knot of a B-spline moves its curve by two thirds of its own way: so it goes half as far again."""
    path = scene.motion.path
    path = kind(path.start, path.spacing, path.count)
    motion = PerGaussian.at_rest(path, len(scene)).turning() if apart else scene.motion.on(path)
    places, turns = motion.parameters()
    problem = Problem.of(replace(scene, motion=motion), capture.footage, believed(capture), FitOptions())
    run = Run(problem, {places: 0.01, turns: 0.001, "means": 0.01}, None, 10)
    before = run.groups[places].clone()
    pushed = torch.zeros_like(before)
    pushed[2] = 1.0  # a lone knot
    run.adam.step({places: pushed}, 1.0)
    moved = path.at(run.values()[places].detach() - before, float(path.times[2])).abs().amax()
    unit = scene.footprint
    assert float(moved) == pytest.approx(0.01 * unit, rel=1e-3)
    assert run.adam.rates[turns] * path.peak == pytest.approx(0.001)
    assert run.adam.rates["means"] == pytest.approx(0.01 * unit)


def test_a_step_follows_the_mean_of_its_images(capture, scene):
    """Weights of losses mean the same for any number of images a step: motion losses are not divided by it."""
    problem = Problem.of(scene, capture.footage, believed(capture), FitOptions((Squared(), Velocity()), batch=3))
    run = Run(problem, {"means": 0.01, "knots": 0.01}, None, 10)
    values, names, taken = run.values(), list(run.adam.groups), {}
    run.adam.step = lambda gradients, factor: taken.update({n: g.clone() for n, g in gradients.items()})
    run.one_step(map)
    of_images = [run.image_gradient(values, names, [key], False).gradients for key in problem.pick(0)]
    run.step = 0
    of_motion = run.motion_gradient(values, names).gradients
    for i, name in enumerate(names):
        expected = sum(g[i] for g in of_images) / 3
        if of_motion[i] is not None:
            expected = expected + of_motion[i]
        torch.testing.assert_close(taken[name], expected)
    assert of_motion[names.index("knots")].any()


class Watched(Densify):
    """Keeps what it is given, and what it answers."""

    def __call__(self, scene, pull):
        object.__setattr__(self, "given", pull)
        object.__setattr__(self, "answer", super().__call__(scene, pull))
        return self.answer


def test_pulls_are_means_over_the_images_and_new_rows_have_no_past(capture, scene):
    """A Gaussian that many images drew is not pulled harder for that; halves of a split begin without momentum."""
    problem = Problem.of(scene, capture.footage, believed(capture), FitOptions(batch=1))
    run, watched = Run(problem, dict(RATES), None, 10), Watched((0.5,), share=0.2)
    run.one_step(map)
    before = run.adam.moments()["means.exp_avg"].clone()
    times = torch.arange(len(scene)) % 4
    length = torch.rand(len(scene), generator=torch.Generator().manual_seed(0))
    run._pull = torch.stack([length * times, times.float()])
    run.densify(watched)
    torch.testing.assert_close(watched.given, length * (times > 0))
    _, old, fresh = watched.answer
    after = run.adam.moments()["means.exp_avg"]
    assert fresh.any() and before[old[fresh]].any()
    assert not after[fresh].any() and torch.equal(after[~fresh], before[old[~fresh]])


def test_halves_of_a_split_lie_along_the_longest_axis(scene):
    n, g = len(scene), torch.Generator().manual_seed(0)
    size = torch.tensor([0.02, 0.08, 0.03]).repeat(n, 1) * torch.linspace(0.5, 1.5, n)[:, None]
    quats = torch.randn(n, 4, generator=g)
    long = replace(scene, dynamic=replace(scene.dynamic, log_scales=size.log(), quats=quats))
    pull = torch.zeros(n)
    pull[-10:] = 1.0  # the largest
    denser, old, fresh = Densify((0.5,), share=10 / n)(long, pull)
    axes = rotation_matrices(torch.nn.functional.normalize(quats, dim=-1))[..., 1]
    for parent in range(n - 10, n):
        one, other = denser.dynamic.means[old == parent]
        torch.testing.assert_close((other - one).abs(), (size[parent, 1] * axes[parent]).abs(), rtol=1e-4, atol=1e-6)
        assert fresh[old == parent].all()


def test_a_scaffold_gains_nodes_where_it_is_pulled(capture, scene):
    result = fit(scene, capture.footage, believed(capture), steps=6, densify=Densify((0.5,), nodes=5))
    assert len(scene.motion) - 20 < len(result.scene.motion) <= len(scene.motion) + 5
    assert len(result.scene.motion) != len(scene.motion) and np.isfinite(result.history.loss).all()


def test_joint_rendering_where_no_background_is_cached(capture, scene):
    """A camera without a cached background renders static and moving Gaussians together."""
    footage = [replace(f, background=None) for f in capture.footage]
    whole = replace(scene, static=capture.world.static)
    rates = {**RATES, "static.sh": 0.02}
    result = fit(whole, footage, believed(capture), steps=3, rates=rates)
    assert not torch.equal(result.scene.static.sh, whole.static.sh)
    assert torch.equal(result.scene.static.means, whole.static.means)


def test_a_diverged_fit_names_step_group_and_frame(capture, scene):
    class Broken(Mask):
        def __call__(self, seen):
            return seen.alpha.sum() * float("nan")

    with pytest.raises(Diverged, match=r"step 0: .* is no number \(cam"):
        fit(scene, capture.footage, believed(capture), losses=(Photometric(), Broken()), steps=2)


def test_what_does_not_fit_together_is_refused(capture, scene):
    off = believed(capture)
    with pytest.raises(ValueError, match="footage: expected at least one"):
        fit(scene, (), off)
    with pytest.raises(ValueError, match="footage: expected unique names"):
        fit(scene, [replace(capture.footage[0], name="elsewhere")], off)
    with pytest.raises(ValueError, match="expected every video on one clock"):
        fit(scene, capture.footage, believed(capture, np.array([0, np.nan, 0])))
    with pytest.raises(ValueError, match="rates: expected groups"):
        fit(scene, capture.footage, off, rates={"mean": 1.0}, steps=1)
    with pytest.raises(ValueError, match="steps, budget"):
        fit(scene, capture.footage, off, steps=1, budget=1.0)
    empty = replace(
        scene,
        dynamic=Gaussians(*(t[:0] for t in vars(scene.dynamic).values())),
        motion=scene.motion.take(np.zeros(0, int)),
    )
    with pytest.raises(ValueError, match="scene: expected moving Gaussians"):
        fit(empty, capture.footage, off)
    still = [replace(f, boxes=np.zeros_like(f.boxes)) for f in capture.footage]
    with pytest.raises(ValueError, match="expected frames in which something moves"):
        fit(scene, still, off)


def test_one_camera_and_bad_frames_are_no_obstacle(capture, scene):
    bad = capture.footage[0].bad.copy()
    bad[3] = True
    result = fit(scene, [replace(capture.footage[0], bad=bad)], believed(capture), steps=3)
    assert np.isfinite(result.history.loss[-1]) and result.offsets.seconds[0] == 0


def test_a_scene_on_disk_comes_back(scene, tmp_path):
    scene.save(tmp_path / "scene.npz")
    back = Gaussians4D.load(tmp_path / "scene.npz")
    assert back.span == scene.span and back.footprint == scene.footprint
    assert np.array_equal(back.tracks([0.05, 0.2]), scene.tracks([0.05, 0.2]))
    (tmp_path / "scene.npz").write_bytes(b"PK\x03\x04" + bytes(40))
    with pytest.raises(ValueError, match=r"scene\.npz"):
        Gaussians4D.load(tmp_path / "scene.npz")


def test_losses_on_what_is_given_beside_the_images(capture, scene):
    """Depth, tracks and features change the fit where they are given, and are refused where they are not."""
    from recon.losses.image import Depth, Feature, Sightings, Track

    maps = [dict(enumerate(z)) for z in capture.depth]
    some = torch.arange(4)[:, None]
    points = Sightings(some, torch.zeros(4, 3), torch.full((4, 2), 20.0))
    drawn = {k: np.full((*capture.footage[0].images.shape[1:3], 2), 0.5, np.float32) for k in range(8)}
    given = [
        replace(f, depth=z, tracks=dict.fromkeys(range(8), points), features=drawn)
        for f, z in zip(capture.footage, maps, strict=True)
    ]
    whole = replace(scene, features=torch.rand(len(scene), 2))
    plain = fit(whole, given, believed(capture), steps=3)
    for loss in (Depth(1.0), Track(0.1), Feature(1.0)):
        with pytest.raises(ValueError, match=f"losses: {type(loss).__name__} compares with"):
            fit(scene, capture.footage, believed(capture), losses=(Photometric(), loss), steps=1)
        rates = {**RATES, "features": 0.01}
        with_it = fit(whole, given, believed(capture), losses=(*DEFAULT_LOSSES, loss), steps=3, rates=rates)
        assert not torch.equal(with_it.scene.dynamic.means, plain.scene.dynamic.means)
    assert not torch.equal(with_it.scene.features, whole.features)


def test_fitted_clock_rates_leave_the_reference_s_alone(capture, scene):
    result = fit(scene, capture.footage, believed(capture), steps=3, rates={**RATES, "clock_rates": 1e-3})
    assert result.offsets.rates[0] == 1 and (result.offsets.rates[1:] != 1).all()


def test_a_budget_becomes_steps_that_decay_and_densify(capture, scene):
    result = fit(scene, capture.footage, believed(capture), budget=0.01, densify=Densify((0.1, 0.6), share=0.1))
    assert result.stats["steps"] == 120 and result.history.step[-1] == 120
    assert len(result.scene) > len(scene)
    with pytest.raises(ValueError, match="budget: expected"):
        fit(scene, capture.footage, believed(capture), budget=float("inf"))


@pytest.mark.parametrize(("after", "each"), [(0, 0), (400, 0), (100, 0.2)])
@pytest.mark.parametrize("slow", [1.0, 1.5, 2.0])
def test_a_budget_is_used_though_the_first_steps_are_slow(monkeypatch, slow, after, each):
    """Steps of 10 ms, of which the first 200 take longer: the fit, and what follows it, end within a twentieth of
    their time.
    """
    now = 0.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    calibrate = Calibration(30.0, after=lambda total: after + int(each * total))
    guesses, total, step = set(), None, 0
    while total is None or step < total:
        step += 1
        now += 0.01 * (slow if step <= 200 else 1.0)
        guess, total = calibrate(step)
        guesses.add(guess)
        assert total is None or step >= 0.2 * total
    assert now + 0.01 * (after + each * step) == pytest.approx(30.0, rel=0.05)
    assert None in guesses and len(guesses) <= 3  # none, a guess, what is known


@pytest.mark.parametrize("share", [0.4, 0.6, 0.8])
@pytest.mark.parametrize("slow", [0.5, 2.0])
def test_a_budget_is_kept_though_the_machine_changes_its_speed(monkeypatch, slow, share):
    """From ``share`` of the time on steps of 10 ms take longer, or less: a laptop grows hot, other work ends."""
    now = 0.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    calibrate, totals, total, step = Calibration(30.0), set(), None, 0
    while total is None or step < total:
        step += 1
        now += 0.01 * (slow if now >= 30 * share else 1.0)
        _, total = calibrate(step)
        totals.add(total)
        assert total is None or step <= total
    assert now == pytest.approx(30.0, rel=0.08)
    assert len(totals) > 2


def test_other_rates_and_frame_times(capture, scene):
    """A video at another rate: t_world = rate * t_own + offset, so that slowed-down times with rate 2 are the same."""
    slow = [capture.footage[0], *(replace(f, times=f.times / 2) for f in capture.footage[1:])]
    offsets = replace(believed(capture), rates=np.array([1.0, 2.0, 2.0]))
    a = fit(scene, capture.footage, believed(capture), steps=4)
    b = fit(scene, slow, offsets, steps=4)
    assert a.offsets.seconds == pytest.approx(b.offsets.seconds, abs=1e-9)


def test_a_camera_that_moves_is_seen_from_its_pose_of_the_frame(capture, scene):
    footage = [replace(f, w2c=np.repeat(f.w2c[None], len(f), 0)) for f in capture.footage]
    a = fit(scene, capture.footage, believed(capture), steps=2)
    assert same(a, fit(scene, footage, believed(capture), steps=2))
    turned = [replace(f, w2c=f.w2c.copy()) for f in footage]
    for f in turned:
        f.w2c[1:, 0, 3] += 0.5
    assert not same(a, fit(scene, turned, believed(capture), steps=2))


def test_the_rows_of_a_camera_that_moves_are_seen_from_where_it_is_then(capture, scene):
    """What is static is slanted too: every band of rows is what a camera in between would show."""
    f, box = replace(capture.footage[0], background=None), (0, 0, *capture.footage[0].size)
    path = np.repeat(f.w2c[None], len(f), 0)
    path[:, 0, 3] += 0.6 * np.arange(len(f))
    moving = Clip.of(replace(f, w2c=path))
    readout, bands, k = 0.03, 4, 3
    asked = Shot(0, torch.tensor(k / 30, dtype=torch.float64), box, box[3], k)
    with torch.no_grad():
        rolled = RollingShutter(readout, bands).wrap(observer(scene, [moving]), {})(asked).rgb
        for b in range(bands):
            later = readout * ((b + 0.5) / bands - 0.5)
            there = Clip.of(replace(f, w2c=moving.footage.pose_after(k, later)))
            rows = slice(box[3] * b // bands, box[3] * (b + 1) // bands)
            seen = observer(scene, [there])(replace(asked, t=asked.t + later)).rgb
            torch.testing.assert_close(rolled[rows], seen[rows], atol=1e-3, rtol=0)
        assert not torch.allclose(rolled, observer(scene, [moving])(asked).rgb, atol=0.02)


def test_a_spline_far_beyond_its_knots_still_renders(capture, scene):
    lost = believed(capture, np.array([0, 100.0, 0]))
    assert np.isfinite(fit(scene, capture.footage, lost, steps=2).history.loss[-1])


def test_types_of_motion_are_scaffolds(scene):
    assert isinstance(scene.motion, Scaffold) and isinstance(scene.motion.path, BSpline)


KILLED = """
import sys
sys.path.insert(0, {tests!r})
from tests.recon.fit.test_fit import believed, true_scene
from recon.fit import fit
from recon.simulate import synthetic
capture = synthetic(4, cameras=3, held_out=0, frames=8, size=(48, 32))
result = fit(true_scene(capture), capture.footage, believed(capture), steps=60, checkpoint={path!r}, save_every=0.0)
result.offsets.save({out!r})
"""


@pytest.mark.slow
def test_the_process_that_compiles_the_kernels_gives_the_same_bits_as_those_that_load_them(tmp_path):
    code = KILLED.format(tests=str(ROOT), path=str(tmp_path / "fit.npz"), out=str(tmp_path / "{name}.json"))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path / "compiled")}
    for name in ("compiled", "loaded"):
        (tmp_path / "fit.npz").unlink(missing_ok=True)
        subprocess.run(
            [sys.executable, "-c", code.replace("{name}", name)], cwd=ROOT, env=environment, check=True, timeout=3600
        )
    assert (tmp_path / "compiled.json").read_bytes() == (tmp_path / "loaded.json").read_bytes()


@pytest.mark.slow
def test_sigkill_at_random_moments_changes_nothing(tmp_path):
    def start(name):
        code = KILLED.format(tests=str(ROOT), path=str(tmp_path / f"{name}.npz"), out=str(tmp_path / f"{name}.json"))
        return subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)})

    assert start("whole").wait() == 0
    rng, kills = np.random.default_rng(0), 0
    for _ in range(40):
        process = start("killed")
        seen = (tmp_path / "killed.npz").exists()
        deadline = time.monotonic() + 3600
        while not seen and process.poll() is None and time.monotonic() < deadline:
            seen = (tmp_path / "killed.npz").exists()
            time.sleep(0.01)
        time.sleep(float(rng.uniform(0, 0.4)) if kills else 0.1)
        if kills < 8 and process.poll() is None:
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
        elif process.wait() == 0:
            break
    assert kills >= 3
    assert (tmp_path / "killed.json").read_bytes() == (tmp_path / "whole.json").read_bytes()


def test_a_fit_of_few_steps_is_as_unsure_of_the_clocks_as_it_began(capture, scene):
    """Two steps move an offset by .04 frame at most: that pictures agree on the start says nothing then."""
    wrong = np.array([0.0, 1.0, -1.0]) / 30
    start = replace(believed(capture, wrong), sigma=np.array([0.0, 0.7, 0.7]) / 30)
    for steps, reach in ((0, 0.0), (2, 0.04)):
        found = fit(scene, capture.footage, start, steps=steps).offsets
        assert (found.sigma[1:] * 30 >= 0.7 - reach - 1e-6).all() and not any(s.ok for s in found.status[1:])
    longer = fit(scene, capture.footage, start, steps=60).offsets
    assert (longer.sigma[1:] < found.sigma[1:]).all()


def test_a_fit_that_was_too_short_does_not_claim_its_clocks(capture):
    """The scene is made of every video's own tracks at a wrong clock: at first each of them agrees with itself."""
    start = replace(believed(capture), sigma=np.array([0.0, 0.35, 0.35]) / 30)
    scene = true_scene(capture)
    short = fit(scene, capture.footage, start, steps=40, seed=3).offsets
    # 27 images a video keep exp(-27 / 90) of what was unknown
    assert (short.sigma[1:] * 30 > 0.24).all()
    longer = fit(scene, capture.footage, start, steps=360, seed=3).offsets  # 240 images a video
    assert (longer.sigma[1:] < 0.7 * short.sigma[1:]).all()


@pytest.mark.parametrize(("known", "flag"), [(0.35, "coarse"), (np.nan, "static"), (0.0, None)])
def test_a_video_in_which_nothing_moves_keeps_the_clock_that_it_began_with(capture, scene, known, flag):
    """Its pictures tell nothing of time: neither the fit's answer nor its sigma is one."""
    off = capture.footage[2]
    turned = np.diag([-1.0, 1, -1, 1])
    still = replace(off, w2c=turned @ off.w2c, images=np.repeat(off.images[:1], len(off.images), 0))
    start = np.array([0.0, 0.3, 0.2]) / 30
    told = replace(believed(capture, start), sigma=np.array([0, known, known]) / 30)
    found = fit(scene, (*capture.footage[:2], still), told, steps=120).offsets
    assert found.seconds[2] == pytest.approx(start[2])
    np.testing.assert_allclose(found.sigma[2] * 30, known)
    assert [f.code for f in found.flags[2]] == ([flag] if flag else [])
    assert np.isfinite(found.sigma[1]) and found.seconds[1] != pytest.approx(start[1])


def test_the_clocks_are_the_mean_of_the_last_steps_and_doubt_what_they_had_left_to_go(capture, scene, monkeypatch):
    start = believed(capture, np.array([0.0, 0.4, -0.3]) / 30)
    done = fit(scene, capture.footage, start, steps=60)
    rows = np.column_stack([done.history.step, done.history.offsets])
    want = averaged(np.vstack([[0, *start.seconds], rows, rows[-1]]))
    found = done.offsets.seconds
    np.testing.assert_allclose(found - found[0], want - want[0], atol=1e-9)
    last = rows[-1, 1:] - rows[-1, 1]
    assert np.abs(found - found[0] - last).max() > 1e-6  # which is not where the last step left them
    monkeypatch.setattr(sys.modules["recon.fit.verb"], "unsettled", lambda history, reference: np.array([0, 0.5, 0.5]))
    assert (fit(scene, capture.footage, start, steps=60).offsets.sigma[1:] > 0.5).all()


def test_votes_take_as_long_as_some_steps(capture, scene):
    renderings = sum(3 * len(f.times) + FIRST * (2 * len(LAGS) + 2) for f in capture.footage)
    for options, want in ((FitOptions(batch=2), renderings / 2), (FitOptions(freeze=("offsets",)), 0)):
        problem = Problem.of(scene, capture.footage, believed(capture), options)
        assert Run(problem, options.active_rates(), None, None).steps_after() == want
