"""Parity with gsplat 1.5.3: its own torch functions on the CPU, the glue to its CUDA kernels, and those on a GPU."""

from __future__ import annotations

import inspect
from dataclasses import replace

import pytest
import torch

from recon.raster import render, sh
from recon.raster.cpu import backend as cpu_backend
from recon.raster.projection import project
from recon.raster.rendering import Settings
from recon.rotations import rotation_matrices
from tests.recon.scenes import LEAVES, Scene, random_scene, relative, run

gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed: pip install 'otsync[cuda]'")
reference = pytest.importorskip("gsplat.cuda._torch_impl")

SCENE = random_scene(n=3000, width=160, height=120, cameras=2, seed=60)


def gsplat_projection(scene, antialiased):
    covars, _ = reference._quat_scale_to_covar_preci(scene.quats, scene.scales, True, False)
    return reference._fully_fused_projection(
        scene.means, covars, scene.viewmats, scene.Ks, scene.width, scene.height, calc_compensations=antialiased
    )


def percentile(a, b) -> float:
    """99.9th percentile of |a - b| relative to the largest of 1 and |b|."""
    return float(((a - b).abs() / b.abs().clamp_min(1)).flatten().quantile(0.999))


@pytest.mark.parametrize("engine", [project, cpu_backend.project], ids=["torch", "cpu"])
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_projection(engine, mode, dtype):
    """Means, depths, conics and compensations of the splats that both draw."""
    scene = SCENE.to(dtype)
    settings = Settings(rasterize_mode=mode)
    args = (
        scene.means,
        scene.quats,
        scene.scales,
        scene.opacities,
        scene.viewmats,
        scene.Ks,
        scene.width,
        scene.height,
    )
    mine = engine(*args, settings)
    radii, means2d, depths, conics, compensations = gsplat_projection(scene, mode == "antialiased")
    both = (mine.radii > 0).all(-1) & (radii > 0).all(-1)
    assert both.sum() > 4000
    var_x, slope, var_y = mine.rows.unbind(-1)
    my_conics = torch.stack([1 / var_x, -slope / var_x, 1 / var_y + slope * slope / var_x], -1)
    assert percentile(mine.means2d[both], means2d[both]) < 1e-5
    assert percentile(mine.depths[both], depths[both]) < 1e-5
    assert percentile(my_conics[both], conics[both]) < 1e-5
    opacities = scene.opacities.expand_as(depths) * (compensations if mode == "antialiased" else 1)
    assert percentile(mine.opacities[both], opacities[both]) < 1e-5
    # the torch reference takes 3.33 sigma whatever the opacity: ours are at most that
    assert ((mine.radii <= radii.int() + 1) | ~both[..., None]).all()


def test_covariances():
    rotation = rotation_matrices(torch.nn.functional.normalize(SCENE.quats, dim=-1))
    axes = rotation * SCENE.scales[:, None]
    covars, _ = reference._quat_scale_to_covar_preci(SCENE.quats, SCENE.scales, True, False)
    assert float((axes @ axes.transpose(1, 2) - covars).abs().flatten().quantile(0.999)) < 1e-5


@pytest.mark.parametrize("degree", range(5))
def test_spherical_harmonics(degree):
    g = torch.Generator().manual_seed(degree)
    directions, coefficients = torch.randn(2000, 3, generator=g), torch.randn(2000, 25, 3, generator=g)
    mine = sh.evaluate(degree, directions, coefficients)
    theirs = reference._spherical_harmonics(degree, directions, coefficients)
    assert float((mine - theirs).abs().flatten().quantile(0.999)) < 1e-5


def test_harmonics_are_orthonormal_on_the_sphere():
    """Over a quadrature of the sphere the Gram matrix of all 25 is the identity."""
    nodes, weights = (torch.from_numpy(a) for a in __import__("numpy").polynomial.legendre.leggauss(12))
    azimuth = torch.arange(24, dtype=torch.float64) * (2 * torch.pi / 24)
    z, phi = torch.meshgrid(nodes, azimuth, indexing="ij")
    r = (1 - z * z).sqrt()
    directions = torch.stack([r * phi.cos(), r * phi.sin(), z], -1).reshape(-1, 3)
    values = torch.stack(sh.basis(4, directions), -1)
    area = (weights[:, None].expand(-1, 24) * (2 * torch.pi / 24)).reshape(-1, 1)
    torch.testing.assert_close(values.T @ (area * values), torch.eye(25, dtype=torch.float64), atol=1e-12, rtol=0)


def test_view_dependent_colours_follow_the_convention():
    """colour = max(SH(mean - camera centre) + 0.5, 0) on the back ends, gradients to means and cameras included."""
    scene = random_scene(n=60, cameras=2, seed=61)
    g = torch.Generator().manual_seed(1)
    coefficients = 0.5 * torch.randn(60, 9, 3, generator=g)
    centres = torch.linalg.inv(scene.viewmats)[:, :3, 3]
    directions = scene.means[None] - centres[:, None]
    colors = reference._spherical_harmonics(2, directions, coefficients.expand(2, -1, -1, -1)) + 0.5
    direct = replace(scene, colors=colors.clamp_min(0))
    harmonic = replace(scene, colors=coefficients, settings={"sh_degree": 2})
    expected, _ = run(direct, "torch", torch.float64)
    truth, true_gradients = run(harmonic, "torch", torch.float64)
    for a, b in zip(truth, expected, strict=True):
        assert float((a - b).abs().max()) < 1e-5
    _, gradients = run(harmonic, "cpu")
    for name, true in true_gradients.items():
        assert relative(gradients[name], true) < 1e-5, name


def test_every_keyword_that_is_passed_exists():
    """The glue speaks gsplat's language: signature, order of the leading arguments, render modes."""
    from recon.raster import gsplat_backend

    names = list(inspect.signature(gsplat.rasterization).parameters)
    assert names[:9] == ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height"]
    seen = {}

    def recorded(*args, **kwargs):
        inspect.signature(gsplat.rasterization).bind(*args, **kwargs)
        seen.update(kwargs)
        c, h, w, n = len(args[5]), args[8], args[7], len(args[0])
        d = args[4].shape[-1] + (kwargs["render_mode"] != "RGB")
        meta = {"means2d": torch.zeros(c, n, 2), "radii": torch.ones(c, n, 2, dtype=torch.int32)}
        return torch.arange(d).float().expand(c, h, w, d), torch.full((c, h, w, 1), 0.5), meta

    scene = SCENE
    gaussians = (scene.means, scene.quats, scene.scales, scene.opacities, scene.colors)
    for depth, mode in ((None, "RGB"), ("accumulated", "RGB+D"), ("expected", "RGB+ED")):
        out = gsplat_backend.rasterize(
            recorded,
            gaussians,
            scene.viewmats,
            scene.Ks,
            (160, 120),
            torch.ones(2, 3),
            Settings(depth=depth, rasterize_mode="antialiased", near_plane=0.2),
        )
        assert seen["render_mode"] == mode and seen["rasterize_mode"] == "antialiased" and seen["near_plane"] == 0.2
        assert seen["packed"] is False and out.backend == "gsplat"
        assert out.colors.shape == (2, 120, 160, 3) and out.alphas.shape == (2, 120, 160, 1)
        assert (out.depths is None) == (depth is None)
        if depth:
            assert (out.depths == 3).all()  # the channel after the colours
        assert out.radii.shape == (2, 3000, 2)


def by_the_book(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options):
    """gsplat's rules about leading dimensions, with the torch back end in the place of its kernels."""
    lead, n = means.shape[:-2], means.shape[-2]
    assert quats.shape == (*lead, n, 4) and scales.shape == (*lead, n, 3) and opacities.shape == (*lead, n)
    assert viewmats.shape[:-3] == Ks.shape[:-3] == lead and colors.shape[: len(lead) + 1] == (*lead, n)
    assert options["backgrounds"].shape[:-2] == lead
    each = [
        render(*parts[:7], width, height, backgrounds=parts[7], backend="torch", sh_degree=options["sh_degree"])
        for parts in zip(means, quats, scales, opacities, colors, viewmats, Ks, options["backgrounds"], strict=True)
    ]
    image, alphas, depths, means2d, radii = (
        torch.stack([getattr(out, name) for out in each]) for name in ("colors", "alphas", "depths", "means2d", "radii")
    )
    return torch.cat([image, depths], -1), alphas, {"means2d": means2d, "radii": radii}


@pytest.mark.parametrize("harmonics", [False, True], ids=["colours", "harmonics"])
def test_cameras_that_look_at_other_moments_become_gsplat_s_batch(harmonics):
    from recon.raster import gsplat_backend

    scene, g = random_scene(n=50, cameras=3, seed=63), torch.Generator().manual_seed(2)
    degree, colors = (1, 0.5 * torch.randn(50, 4, 3, generator=g)) if harmonics else (None, scene.colors)
    means, quats = scene.means + 0.2 * torch.randn(3, 50, 3, generator=g), torch.randn(3, 50, 4, generator=g)
    quats[1, 3] = 0  # no rotation: not drawn by that camera
    gaussians = (means, quats, scene.scales, scene.opacities, colors)
    behind = torch.rand(3, 3, generator=g)
    options = Settings(sh_degree=degree)
    views = (scene.viewmats, scene.Ks)
    out = gsplat_backend.rasterize(by_the_book, gaussians, *views, (scene.width, scene.height), behind, options)
    true = render(*gaussians, *views, scene.width, scene.height, backgrounds=behind, backend="torch", sh_degree=degree)
    for name in ("colors", "alphas", "depths", "radii"):
        torch.testing.assert_close(getattr(out, name), getattr(true, name))
    torch.testing.assert_close(out.means2d[:, 0], true.means2d)


@pytest.mark.parametrize(("n", "asked"), [(50, True), (50, False), (64, True), (20, False)])
def test_no_warp_of_gsplat_s_holds_two_cameras(n, asked):
    """gsplat 1.5.3 adds the gradients of two entries of its batch where they share a warp of 32."""
    from recon.raster import gsplat_backend

    scene, lengths = random_scene(n=n, cameras=3, seed=65), []

    def recorded(means, *args, **options):
        lengths.append(means.shape[-2])
        return by_the_book(means, *args, **options)

    means, quats = scene.means.expand(3, n, 3).clone().requires_grad_(), scene.quats.expand(3, n, 4)
    viewmats = scene.viewmats.clone().requires_grad_(asked)
    gaussians = (means, quats, scene.scales, scene.opacities, scene.colors)
    options, size = Settings(), (scene.width, scene.height)
    out = gsplat_backend.rasterize(recorded, gaussians, viewmats, scene.Ks, size, torch.zeros(3, 3), options)
    assert lengths == [n if n % 32 == 0 or (n > 32 and not asked) else -(-n // 32) * 32]
    true = scene.render("torch", backgrounds=torch.zeros(3, 3))
    assert out.radii.shape == (3, n, 2)
    torch.testing.assert_close(out.colors, true.colors)
    torch.testing.assert_close(out.means2d.reshape(3, -1, 2)[:, :n], true.means2d)


def test_no_gaussians_have_gradients_of_zero():
    from recon.raster import gsplat_backend

    leaves = [torch.zeros(0, *more, requires_grad=True) for more in ((3,), (4,), (3,), (), (3,))]
    viewmats = SCENE.viewmats.clone().requires_grad_()
    out = gsplat_backend.rasterize(None, tuple(leaves), viewmats, SCENE.Ks, (8, 6), torch.ones(2, 3), Settings())
    assert (out.colors == 1).all() and not out.alphas.any() and not out.depths.any()
    outputs = (out.colors.sum() + out.alphas.sum() + out.depths.sum(),)
    gradients = torch.autograd.grad(outputs, [*leaves, viewmats])
    assert not any(g.any() for g in gradients) and gradients[-1].shape == viewmats.shape


def test_gsplat_without_cuda_says_what_to_do():
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    with pytest.raises(ValueError, match="CUDA tensors"):
        SCENE.render("gsplat")


def agrees_with_the_oracle(scene: Scene) -> None:
    """Images and gradients of gsplat's kernels against the float64 torch back end; a pixel at a threshold may flip."""
    truth, true_gradients = run(scene, "torch", torch.float64)
    outputs, gradients = run(scene, "gsplat")
    for got, true in zip(outputs, truth, strict=True):
        assert float((got - true).abs().flatten().quantile(0.999)) < 1e-4
    for name, true in true_gradients.items():
        assert relative(gradients[name], true) < 1e-2, name


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_images_and_gradients_on_a_gpu(mode):
    agrees_with_the_oracle(random_scene(n=2000, width=128, height=96, seed=62, rasterize_mode=mode))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cameras_that_look_at_other_moments_on_a_gpu():
    """One call with means and quats per camera, and the gradient of the 2-D means that densification reads."""
    scene, g = random_scene(n=2000, width=128, height=96, cameras=3, seed=64), torch.Generator().manual_seed(2)
    means, quats = scene.means + 0.1 * torch.randn(3, 2000, 3, generator=g), torch.randn(3, 2000, 4, generator=g)
    scene = replace(scene, means=means, quats=quats)
    agrees_with_the_oracle(scene)
    there = {n: t.cuda() for n, t in scene.leaves().items()}
    there["means"].requires_grad_()
    out = render(*(there[n] for n in LEAVES[:6]), scene.Ks.cuda(), scene.width, scene.height)
    (pull,) = torch.autograd.grad(out.colors.square().sum(), out.means2d)
    assert pull.reshape(3, -1, 2)[:, :2000][(out.radii > 0).all(-1)].abs().max() > 0
