"""Gradients against finite differences in float64 and torch's gradcheck; the written backward against autograd."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from recon.raster import sh
from recon.raster.cpu import backend as cpu_backend
from recon.raster.projection import project
from recon.raster.rendering import Settings
from tests.recon.scenes import random_scene, relative, run, weighted


def smooth_scene(**settings):
    """A few wide, faint splats: no pixel at a threshold, so that finite differences see no step."""
    scene = random_scene(n=6, width=9, height=7, cameras=2, seed=70, cover=10, **settings).to(torch.float64)
    g = torch.Generator().manual_seed(1)
    return replace(
        scene,
        opacities=0.3 + 0.3 * scene.opacities,
        scales=scene.scales * 4,
        backgrounds=torch.rand(2, 3, generator=g, dtype=torch.float64),
    )


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("depth", ["expected", "accumulated"])
def test_gradcheck_of_the_torch_back_end(mode, depth):
    scene = smooth_scene(rasterize_mode=mode, depth=depth)
    names = list(scene.leaves())

    def f(*leaves):
        out = scene.render("torch", **dict(zip(names, leaves, strict=True)))
        return out.colors, out.alphas, out.depths

    leaves = [t.clone().requires_grad_() for t in scene.leaves().values()]
    assert torch.autograd.gradcheck(f, leaves, eps=1e-6, atol=1e-6, rtol=1e-4, fast_mode=True)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds"])
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_cpu_gradients_against_float64_differences(name, mode):
    """Central differences of the float64 torch back end, entry by entry, against the cpu back end's gradient."""
    scene = smooth_scene(rasterize_mode=mode)
    _, gradients = run(scene, "cpu")
    tensor = getattr(scene, name)
    h, differences = 1e-5, torch.zeros_like(tensor)

    def loss(t):
        out = replace(scene, settings={**scene.settings, "depth": "accumulated"}).render("torch", **{name: t})
        return float(weighted((out.colors, out.alphas, out.depths)))

    for i in range(tensor.numel()):
        step = torch.zeros(tensor.numel(), dtype=torch.float64)
        step[i] = h
        step = step.reshape(tensor.shape)
        differences.view(-1)[i] = (loss(tensor + step) - loss(tensor - step)) / (2 * h)
    assert relative(gradients[name], differences) < 1e-5


def test_gradcheck_of_spherical_harmonics():
    g = torch.Generator().manual_seed(0)
    directions = torch.randn(4, 3, generator=g, dtype=torch.float64, requires_grad=True)
    coefficients = torch.randn(4, 25, 3, generator=g, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d, c: sh.evaluate(4, d, c), (directions, coefficients))


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_projection_node_alone(mode):
    """The hand-written backward of the projection against autograd through its torch twin, output by output."""
    scene = random_scene(n=400, cameras=3, seed=71)
    settings = Settings(rasterize_mode=mode)
    results = {}
    for key, engine, dtype in (("cpu", cpu_backend.project, torch.float32), ("torch", project, torch.float64)):
        s = scene.to(dtype)
        leaves = [t.clone().requires_grad_() for t in (s.means, s.quats, s.scales, s.opacities, s.viewmats)]
        splats = engine(*leaves, s.Ks, s.width, s.height, settings)
        for i, field in enumerate(("means2d", "rows", "depths", "opacities")):
            loss = weighted((splats[i],))
            results[key, field] = torch.autograd.grad(loss, leaves, retain_graph=True, allow_unused=True)
        results[key, "radii"] = splats.radii
    assert (results["cpu", "radii"] == results["torch", "radii"]).all()
    for field in ("means2d", "rows", "depths", "opacities"):
        for a, b in zip(results["cpu", field], results["torch", field], strict=True):
            assert a is None or relative(a, torch.zeros_like(a) if b is None else b) < 2e-6, field


@hypothesis_settings(max_examples=25, deadline=None)
@given(
    n=st.integers(1, 60),
    width=st.integers(1, 90),
    height=st.integers(1, 40),
    channels=st.integers(1, 20),
    cameras=st.integers(1, 3),
    seed=st.integers(0, 10**6),
    mode=st.sampled_from(["classic", "antialiased"]),
    depth=st.sampled_from(["expected", "accumulated", None]),
)
def test_the_two_cpu_back_ends_agree_on_any_scene(n, width, height, channels, cameras, seed, mode, depth):
    scene = random_scene(n, width, height, channels, cameras, seed, rasterize_mode=mode, depth=depth)
    a, b = scene.render("cpu"), scene.to(torch.float64).render("torch")
    assert (a.radii == b.radii).float().mean() > 0.99  # a radius may round up on one side only
    for x, y in ((a.colors, b.colors), (a.alphas, b.alphas)):
        assert float((x - y).abs().max()) < 5e-3  # a pixel may flip at a threshold
        assert float((x - y).abs().flatten().median()) < 1e-6
    assert (a.depths is None) == (depth is None)
