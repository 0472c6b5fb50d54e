"""Both CPU back ends against the dense float64 oracle: images, gradients, cameras, channels, backgrounds, depth."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from recon.bench import raster as bench_raster
from recon.raster import render
from tests.recon.scenes import Scene, random_scene, relative, run

BACKENDS = ("torch", "cpu")
# name -> (scene, tolerance of outputs, tolerance of gradients); no pixel of these lies at a threshold
SCENES = {
    "classic": random_scene(seed=1),
    "antialiased": random_scene(seed=2, rasterize_mode="antialiased"),
    "three cameras": random_scene(n=150, cameras=3, seed=3),
    "wide image": random_scene(n=120, width=150, height=21, seed=4),
    "one channel": random_scene(n=100, channels=1, seed=5),
    "two channels": random_scene(n=100, channels=2, seed=6),
    "four channels": random_scene(n=100, channels=4, seed=7),
    "eight channels": random_scene(n=100, channels=8, seed=8),
    "fifteen channels": random_scene(n=100, channels=15, seed=9),
    "sixteen channels": random_scene(n=100, channels=16, seed=10),
    "33 channels": random_scene(n=100, channels=33, seed=11),
    "64 channels": random_scene(n=100, channels=64, seed=12),
    "no blur": random_scene(n=200, eps2d=0.0, seed=13),
    "near and far": random_scene(n=200, near_plane=3.0, far_plane=6.0, seed=14),
}


@pytest.fixture(scope="module")
def truth():
    """The oracle's outputs and gradients of a scene, computed once for all back ends."""
    known = {}

    def of(name, scene):
        if name not in known:
            known[name] = run(scene, "oracle")
        return known[name]

    return of


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_the_oracle(name, backend, truth):
    scene = SCENES[name]
    outputs, gradients = run(scene, backend)
    true_outputs, true_gradients = truth(name, scene)
    for got, true in zip(outputs, true_outputs, strict=True):
        assert float((got - true).abs().max()) < 3e-5
        assert float((got - true).abs().flatten().quantile(0.999)) < 5e-6 * max(1.0, float(true.abs().max()))
    for leaf, true in true_gradients.items():
        assert relative(gradients[leaf], true) < 5e-6, leaf


@pytest.mark.parametrize("backend", BACKENDS)
def test_background_and_colours_per_camera(backend, truth):
    scene = random_scene(n=80, cameras=2, channels=5, seed=21)
    g = torch.Generator().manual_seed(1)
    scene = replace(scene, colors=torch.rand(2, 80, 5, generator=g), backgrounds=torch.rand(2, 5, generator=g))
    outputs, gradients = run(scene, backend)
    true_outputs, true_gradients = truth("background", scene)
    for got, true in zip(outputs, true_outputs, strict=True):
        assert float((got - true).abs().max()) < 2e-5
    for leaf, true in true_gradients.items():
        assert relative(gradients[leaf], true) < 5e-6, leaf


@pytest.mark.parametrize("backend", BACKENDS)
def test_expected_depth_is_the_accumulated_one_over_alpha(backend):
    scene = random_scene(seed=22).to(torch.float64)
    outputs = {}
    for mode in ("expected", "accumulated", None):
        means = scene.means.to(torch.float32).requires_grad_()
        out = replace(scene.to(torch.float32), settings={"depth": mode}).render(backend, means=means)
        outputs[mode] = out
        if mode == "expected":
            out.depths.square().sum().backward()
            gradient = means.grad
        if mode == "accumulated":
            (out.depths / out.alphas.clamp_min(1e-10)).square().sum().backward()
            assert relative(gradient, means.grad) < 1e-5
    assert outputs[None].depths is None
    torch.testing.assert_close(
        outputs["expected"].depths, outputs["accumulated"].depths / outputs["accumulated"].alphas.clamp_min(1e-10)
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_densification_reads_the_gradient_of_the_2d_means(backend):
    """dL/dmeans2d of both back ends agree, and vanish exactly where nothing was drawn."""
    scene = random_scene(n=200, cameras=2, seed=23, near_plane=4.0)
    gradients = {}
    for name in (backend, "torch"):
        out = scene.render(name, means=scene.means.clone().requires_grad_())
        out.means2d.retain_grad()
        out.colors.square().sum().backward()
        gradients[name] = out.means2d.grad
        assert (out.means2d.grad[(out.radii == 0).all(-1)] == 0).all()
        assert (out.radii > 0).any() and (out.radii == 0).any()
    assert relative(gradients[backend], gradients["torch"]) < 1e-5


def test_a_single_splat_in_closed_form():
    """One isotropic splat straight ahead: alpha = o exp(-r^2 / (2 (s f / z)^2 + 2 eps))."""
    f, z, s, o = 20.0, 4.0, 0.5, 0.7
    K = torch.tensor([[[f, 0, 10.0], [0, f, 8.0], [0, 0, 1]]])
    args = [torch.tensor([[0.0, 0, z]]), torch.tensor([[2.0, 0, 0, 0]]), torch.full((1, 3), s), torch.tensor([o])]
    ys, xs = torch.meshgrid(torch.arange(16) + 0.5 - 8, torch.arange(20) + 0.5 - 10, indexing="ij")
    alpha = o * torch.exp(-0.5 * (xs**2 + ys**2) / ((s * f / z) ** 2 + 0.3))
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    for backend in BACKENDS:
        out = render(*args, torch.tensor([[0.2, 0.5, 1.0]]), torch.eye(4)[None], K, 20, 16, backend=backend)
        torch.testing.assert_close(out.alphas[0, ..., 0], alpha, atol=1e-6, rtol=0)
        torch.testing.assert_close(out.colors[0, ..., 2], alpha, atol=1e-6, rtol=0)
        torch.testing.assert_close(out.depths[0, ..., 0], torch.where(alpha > 0, z, 0.0))
        assert out.radii[0, 0].tolist() == [9, 9]  # ceil(sqrt(2 ln(255 * 0.7)) * sqrt(6.25 + 0.3))
        assert out.means2d[0, 0].tolist() == [10, 8]


@pytest.mark.parametrize("backend", BACKENDS)
def test_turning_the_world_and_the_camera_together_changes_nothing(backend):
    scene = random_scene(seed=24)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn).sign()
    rigid = torch.eye(4, dtype=torch.float64)
    rigid[:3, :3], rigid[:3, 3] = turn, torch.tensor([1.0, 2, 3])
    w = 0.5 * (1 + turn.trace()).sqrt()
    q = torch.stack(
        [w, *(torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / (4 * w))]
    )
    a, b = q, scene.quats.double()
    product = torch.stack(
        [
            a[0] * b[:, 0] - a[1] * b[:, 1] - a[2] * b[:, 2] - a[3] * b[:, 3],
            a[0] * b[:, 1] + a[1] * b[:, 0] + a[2] * b[:, 3] - a[3] * b[:, 2],
            a[0] * b[:, 2] - a[1] * b[:, 3] + a[2] * b[:, 0] + a[3] * b[:, 1],
            a[0] * b[:, 3] + a[1] * b[:, 2] - a[2] * b[:, 1] + a[3] * b[:, 0],
        ],
        -1,
    )
    moved = replace(
        scene.to(torch.float64),
        means=scene.means.double() @ turn.T + rigid[:3, 3],
        quats=product,
        viewmats=scene.viewmats.double() @ torch.linalg.inv(rigid),
    )
    here, there = scene.render(backend).colors, moved.to(torch.float32).render(backend).colors
    assert float((here - there).abs().flatten().quantile(0.99)) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("size", bench_raster.SIZES, ids=str)
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_accuracy_at_the_sizes_of_the_benchmark(size, mode):
    """Against the torch back end in float64: the percentile, the pixels that flip at a threshold, the gradients."""
    width, height, n = size
    means, quats, scales, opacities, colors, viewmats, Ks = bench_raster.scene(width, height, n, 3)
    settings = {"rasterize_mode": mode, "depth": "accumulated"}
    scene = Scene(means, quats, scales, opacities, colors, viewmats, Ks, width, height, settings=settings)
    (image, _, _), gradients = run(scene, "cpu")
    (true_image, _, _), true_gradients = run(scene, "torch", torch.float64)
    difference = (image - true_image).abs().flatten()
    flips = int((difference > 1e-4).sum())
    percentile = float(difference.kthvalue(int(0.999 * len(difference))).values)
    worst = {name: relative(gradients[name], true) for name, true in true_gradients.items()}
    print(
        f"\n{size} {mode}: p99.9 {percentile:.1e}, largest {float(difference.max()):.1e}, {flips} flipped values, "
        f"gradients { ({k: f'{v:.1e}' for k, v in worst.items()}) }"
    )
    assert percentile <= 5e-6
    assert flips <= 20 and float(difference.max()) <= 5e-3
    if flips == 0:
        assert max(worst.values()) <= 5e-6


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("harmonics", [False, True], ids=["colours", "harmonics"])
def test_cameras_that_look_at_other_moments(backend, harmonics):
    """One call with means and quats per camera is one call per camera: images, gradients, and what is no number."""
    scene, g = random_scene(n=120, cameras=3, seed=23), torch.Generator().manual_seed(2)
    if harmonics:
        colors = 0.5 * torch.randn(120, 4, 3, generator=g)
        scene = replace(scene, colors=colors, settings={"sh_degree": 1})
    moved = scene.means + 0.2 * torch.randn(3, 120, 3, generator=g)
    moved[1, 7, 2] = torch.nan  # in one camera: drawn in none
    turned = torch.randn(3, 120, 4, generator=g)
    weights = torch.rand(3, scene.height, scene.width, 5, generator=g)
    seen = moved.clone()
    seen[:, 7] = torch.nan
    found = []
    for at_once in (True, False):
        start = {"means": moved if at_once else seen, "quats": turned}
        leaves = {n: t.clone().requires_grad_() for n, t in {**scene.leaves(), **start}.items()}
        if at_once:
            out = scene.render(backend, **leaves)
            images = torch.cat([out.colors, out.alphas, out.depths], -1)
            assert out.means2d.shape == (3, 120, 2) and not (out.radii[:, 7] > 0).any()
        else:
            each = [
                replace(scene, Ks=scene.Ks[c : c + 1]).render(
                    backend,
                    **{n: t[c] if n in start else t for n, t in leaves.items() if n != "viewmats"},
                    viewmats=leaves["viewmats"][c : c + 1],
                )
                for c in range(3)
            ]
            images = torch.cat([torch.cat([o.colors, o.alphas, o.depths], -1) for o in each])
        gradients = torch.autograd.grad((images * weights).sum(), list(leaves.values()))
        found.append([images.detach(), *(x.nan_to_num() for x in gradients)])
    for a, b in zip(*found, strict=True):
        assert float((a - b).abs().max()) <= 2e-6 * float(b.abs().max())


def test_one_moment_more_than_cameras_is_refused():
    scene = random_scene(n=9, cameras=2, seed=24)
    with pytest.raises(ValueError, match=r"means: expected \[N,3\] or \[2,N,3\]"):
        replace(scene, means=scene.means.expand(3, 9, 3)).render("torch")
    with pytest.raises(ValueError, match=r"quats: expected \[2,9,4\]"):
        replace(scene, means=scene.means.expand(2, 9, 3)).render("torch")
