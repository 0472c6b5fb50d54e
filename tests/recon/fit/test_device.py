"""A fit on another device: nothing of the CPU gets into a step, and what comes back is what the CPU finds."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.optim import optimizer

from recon.backdrop import fit as backdrop
from recon.fit.densify import Densify
from recon.fit.optimize import RATES
from recon.fit.options import DEFAULT_LOSSES, FitOptions
from recon.fit.problem import Problem
from recon.fit.run import Run
from recon.fit.verb import fit
from recon.losses.image import Depth, Feature, Sightings, Track
from recon.losses.motion import RotationAcceleration, RotationVelocity
from recon.losses.rigidity import Isometry, Rigidity, RotationSimilarity
from recon.motion import ScaffoldOptions, Static, build_scaffold
from recon.observe.effects import Gain, MotionBlur
from recon.pipeline.plan import Plan
from recon.raster import Rendering, Splats, gsplat_backend
from recon.raster.cpu import backend as cpu_backend
from recon.scene import gaussians4d
from recon.scene.device import device_of
from recon.simulate.capture import synthetic
from tests.recon.elsewhere import ELSEWHERE, Far, elsewhere
from tests.recon.fit.test_fit import believed, same, true_scene
from tests.recon.motion.worlds import following


@pytest.fixture(scope="module")
def capture():
    return synthetic(4, cameras=3, held_out=0, frames=8, size=(48, 32))


@pytest.fixture(scope="module")
def scene(capture):
    return true_scene(capture)


@pytest.fixture
def second(monkeypatch):
    """A pretended second device. Only its rasterizer is none: the CPU's, between copies there and back."""

    def rasterized(gaussians, viewmats, Ks, size, backgrounds, options):
        assert all(isinstance(t, Far) for t in (*gaussians, viewmats, Ks)) and backgrounds is None
        means, quats, scales, opacities, colors, w2c, K = (t.cpu() for t in (*gaussians, viewmats, Ks))
        means, quats = (t.expand(len(w2c), *t.shape[-2:]) for t in (means, quats))
        views = [
            cpu_backend.project(m, q, scales, opacities, w[None], k[None], *size, options)
            for m, q, w, k in zip(means, quats, w2c, K, strict=True)
        ]
        drawn = Splats(*(torch.cat(parts) for parts in zip(*views, strict=True)))
        means2d = drawn.means2d.to(ELSEWHERE)  # whose gradient densification asks for
        here = drawn._replace(means2d=means2d.cpu())
        image, depths, alphas = cpu_backend.rasterize(here, colors, *size, options.depth)
        image, alphas, radii = (t.to(ELSEWHERE) for t in (image, alphas, drawn.radii))
        return Rendering(image, alphas, None if depths is None else depths.to(ELSEWHERE), means2d, radii, "gsplat")

    monkeypatch.setattr(gsplat_backend, "render", rasterized)
    monkeypatch.setattr(gaussians4d, "device_of", torch.device)
    monkeypatch.setattr(backdrop, "device_of", torch.device)
    monkeypatch.setattr(optimizer, "_get_fused_kernels_supported_devices", lambda: ["cpu", ELSEWHERE.type])
    with elsewhere() as device:
        yield device


def test_the_pretended_device_keeps_apart(second):
    a, b = torch.arange(6.0).to(second).requires_grad_(), torch.ones(6)
    assert a.device == second != b.device
    for mix in (lambda: a + b, lambda: a * torch.tensor(2.0), lambda: torch.stack([a, b]), lambda: a[b.long()]):
        with pytest.raises(RuntimeError, match="two devices"):
            mix()
    with pytest.raises(RuntimeError):
        a.detach().numpy()
    (gradient,) = torch.autograd.grad((a * b.to(second)).square().sum(), a)
    assert gradient.device == second and gradient.tolist() == [0, 2, 4, 6, 8, 10]


def plain(capture, scene):
    return scene, capture.footage, {"effects": (Gain(),)}


def densified(capture, scene):
    return scene, capture.footage, {"densify": Densify((0.5,), share=0.2, nodes=5), "steps": 6}


def blurred(capture, scene):
    return scene, capture.footage, {"effects": (MotionBlur(0.01), Gain(white_balance=False)), "batch": 3}


def turning(capture, scene):
    return scene, capture.footage, {"losses": (*DEFAULT_LOSSES, RotationVelocity(), RotationAcceleration())}


def dual_quaternions(capture, scene):
    return replace(scene, motion=replace(scene.motion, blend="dual-quaternion")), capture.footage, {}


def per_gaussian(capture, scene):
    return replace(scene, motion=following(scene.motion, scene.dynamic.means)), capture.footage, {}


def rigid(capture, scene):
    """Gaussians that move and turn by themselves, held together by their neighbours."""
    motion = following(scene.motion, scene.dynamic.means).turning().tied(scene.dynamic.means, 0.0)
    losses = (*DEFAULT_LOSSES, Rigidity(every=1), RotationSimilarity(every=1), Isometry(every=1))
    return replace(scene, motion=motion), capture.footage, {"losses": losses, "densify": Densify((0.5,), share=0.2)}


def static(capture, scene):
    return replace(scene, motion=Static()), capture.footage, {}


def per_video(capture, scene):
    options = ScaffoldOptions(per_video=True)
    built = build_scaffold(capture.tracks, np.zeros(3), footprint=scene.footprint, frame_step=1 / 30, options=options)
    bound = built.bind(scene.dynamic.means, capture.footage[0].times[4])
    return replace(scene, motion=bound), capture.footage, {"densify": Densify((0.5,), share=0.2, nodes=5)}


def view_dependent(capture, scene):
    sh = torch.cat([scene.dynamic.sh, torch.full((len(scene), 3, 3), 0.1)], 1)
    return replace(scene, dynamic=replace(scene.dynamic, sh=sh)), capture.footage, {}


def joint(capture, scene):
    """Static and moving Gaussians together, cameras that move."""
    whole = replace(scene, static=capture.world.static)
    footage = [replace(f, background=None, w2c=np.repeat(f.w2c[None], len(f), 0)) for f in capture.footage]
    return whole, footage, {"rates": {**RATES, "static.sh": 0.02}}


def given(capture, scene):
    """Every loss on what is given beside the images; clocks that run fast or slow."""
    points = Sightings(torch.arange(4)[:, None], torch.zeros(4, 3), torch.full((4, 2), 20.0))
    drawn = {k: np.full((*capture.footage[0].images.shape[1:3], 2), 0.5, np.float32) for k in range(8)}
    footage = [
        replace(f, depth=dict(enumerate(z)), tracks=dict.fromkeys(range(8), points), features=drawn)
        for f, z in zip(capture.footage, capture.depth, strict=True)
    ]
    features = torch.linspace(0, 1, 2 * len(scene)).reshape(-1, 2)
    rates = {**RATES, "features": 0.01, "clock_rates": 1e-3}
    losses = (*DEFAULT_LOSSES, Depth(1.0, scale="median"), Track(0.1), Feature(1.0))
    return replace(scene, features=features), footage, {"losses": losses, "rates": rates}


@pytest.mark.parametrize(
    "case",
    [
        plain,
        densified,
        pytest.param(blurred, marks=pytest.mark.slow),
        turning,
        pytest.param(dual_quaternions, marks=pytest.mark.slow),
        per_gaussian,
        rigid,
        static,
        per_video,
        view_dependent,
        pytest.param(joint, marks=pytest.mark.slow),
        given,
    ],
    ids=lambda case: case.__name__,
)
def test_a_fit_elsewhere_is_the_fit_here(capture, scene, second, case):
    """The definitions in torch instead of the kernels, a few steps: the same but for rounding, and back on the CPU."""
    start, footage, options = case(capture, scene)
    options = {"steps": 2, **options}
    here = fit(start, footage, believed(capture), **options)
    there = fit(start.to(second), footage, believed(capture), **options)
    parts = {**vars(there.scene.dynamic), **there.scene.motion.parameters(), **there.parameters}
    assert all(t.device.type == "cpu" for t in parts.values())
    assert np.abs(here.offsets.seconds - there.offsets.seconds).max() * 30 < 2e-3
    assert there.history.loss == pytest.approx(here.history.loss, rel=1e-4)
    assert there.offsets.sigma == pytest.approx(here.offsets.sigma, rel=0.05, nan_ok=True)
    assert len(here.scene) == len(there.scene)
    there.scene.tracks([0.1])


@pytest.mark.parametrize("case", [plain, per_gaussian, per_video, view_dependent], ids=lambda case: case.__name__)
def test_images_rendered_at_once_are_each_of_them(capture, scene, case):
    """What a GPU is given: losses, gradients of their sum, and what densification reads, from boxes of any size."""
    start, footage, options = case(capture, scene)
    effects = options.get("effects", ())
    run = Run(
        Problem.of(start, footage, believed(capture), FitOptions(effects=effects, batch=4)), dict(RATES), None, 10
    )
    values, names, keys = run.values(), list(run.adam.groups), [(0, 1), (1, 4), (2, 6), (1, 0)]
    assert len({run.problem.clips[v].box(k) for v, k in keys}) == 4
    whole = run.image_gradient(values, names, keys, True)
    each = [run.image_gradient(values, names, [key], True) for key in keys]
    assert whole.losses == pytest.approx([r.losses[0] for r in each], rel=1e-6)
    assert whole.psnrs == pytest.approx([r.psnrs[0] for r in each], rel=1e-6)
    for n, name in enumerate(names):
        total = sum(r.gradients[n] for r in each if r.gradients[n] is not None)
        assert float((whole.gradients[n] - total).abs().max()) <= 2e-6 * float(total.abs().max()), name
    assert torch.allclose(whole.pull, sum(r.pull for r in each), rtol=1e-5)


def test_only_where_it_is_exact_are_images_rendered_at_once(capture, scene, second):
    for case, at_once in ((plain, True), (given, True), (blurred, False), (joint, False)):
        start, footage, options = case(capture, scene)
        problem = Problem.of(
            start.to(second), footage, believed(capture), FitOptions(effects=options.get("effects", ()))
        )
        assert problem.at_once is at_once
        assert not Problem.of(start, footage, believed(capture)).at_once


def test_a_fit_begun_elsewhere_continues_there_and_here(capture, scene, second, tmp_path, monkeypatch):
    """A checkpoint belongs to no device: where it was begun it ends with the same bits, on the CPU nearly so."""
    options = {"steps": 6, "densify": Densify((0.4,), share=0.2), "effects": (Gain(),)}
    whole = fit(scene.to(second), capture.footage, believed(capture), **options)
    advance = Run.advance

    def interrupted(self, *args):
        if self.step == 4:
            raise KeyboardInterrupt
        advance(self, *args)

    for start in (scene.to(second), scene):
        path = tmp_path / f"{start.dynamic.means.device.type}.npz"
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Run, "advance", interrupted)
            fit(scene.to(second), capture.footage, believed(capture), **options, checkpoint=path)
        again = fit(start, capture.footage, believed(capture), **options, checkpoint=path)
        assert again.stats["steps"] == 6
        if start is scene:
            assert again.offsets.seconds == pytest.approx(whole.offsets.seconds, abs=1e-4)
        else:
            assert same(whole, again)


def test_the_static_part_is_fitted_elsewhere(capture, second):
    here, there = (
        backdrop.fit_backdrop(capture.footage, depth=capture.depth, steps=6, progress=False, device=d)
        for d in ("cpu", second)
    )
    assert there.gaussians.means.device.type == "cpu"
    assert there.psnr == pytest.approx(here.psnr, abs=0.02) and there.gains == pytest.approx(here.gains, abs=1e-3)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_gpu_that_is_not_there_is_refused_before_the_work(scene):
    for ask in (device_of, scene.to, lambda name: Plan(device=name)):
        with pytest.raises(ValueError, match=r"device: expected one of cpu; found 'cuda'\. .*'cpu'"):
            ask("cuda")


def test_what_is_no_device_is_refused():
    for name in ("gpu", "meta", "cuda:x", "", "cpu:3", "cpu:0"):
        with pytest.raises(ValueError, match="device: expected 'cpu', 'cuda' or 'cuda:N'; found"):
            device_of(name)
    assert device_of("cpu").type == "cpu"


def test_a_gpu_without_gsplat_says_what_to_install(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "gsplat" else find(name))
    with pytest.raises(ValueError, match=r"expected gsplat, which renders on 'cuda:1'.* pip install 'otsync\[cuda\]'"):
        device_of("cuda:1")
    with pytest.raises(ValueError, match=r"one of cpu, cuda:0, cuda:1; found 'cuda:2'"):
        device_of("cuda:2")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("case", [plain, densified, per_video, joint, given], ids=lambda case: case.__name__)
def test_a_fit_on_a_gpu_is_the_fit_here(capture, scene, case):
    """Through gsplat's kernels, whose sums run in any order."""
    pytest.importorskip("gsplat", reason="gsplat is not installed: pip install 'otsync[cuda]'")
    start, footage, options = case(capture, scene)
    options = {"steps": 10, **options}
    here = fit(start, footage, believed(capture), **options)
    there = fit(start.to("cuda"), footage, believed(capture), **options)
    parts = {**vars(there.scene.dynamic), **there.scene.motion.parameters(), **there.parameters}
    assert all(t.device.type == "cpu" for t in parts.values())
    assert np.abs(here.offsets.seconds - there.offsets.seconds).max() * 30 < 1e-2
    assert there.history.loss == pytest.approx(here.history.loss, rel=1e-2)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_static_part_on_a_gpu(capture):
    pytest.importorskip("gsplat", reason="gsplat is not installed: pip install 'otsync[cuda]'")
    here, there = (
        backdrop.fit_backdrop(capture.footage, depth=capture.depth, steps=20, progress=False, device=d)
        for d in ("cpu", "cuda")
    )
    assert there.psnr == pytest.approx(here.psnr, abs=0.2)
