"""Scenes for the renderer's tests, and the dense float64 oracle they are held against."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from recon.raster import render

LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")


@dataclass(frozen=True)
class Scene:
    """The arguments of one call of render()."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    backgrounds: Tensor | None = None
    settings: dict[str, Any] = field(default_factory=dict)

    def to(self, dtype: torch.dtype) -> Scene:
        tensors = {k: v.to(dtype) for k, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **tensors)

    def leaves(self) -> dict[str, Tensor]:
        return {name: getattr(self, name) for name in LEAVES if getattr(self, name) is not None}

    def render(self, backend: str, **leaves: Tensor):
        scene = replace(self, **leaves)
        device = "cuda" if backend == "gsplat" and torch.cuda.is_available() else "cpu"
        names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
        out = render(
            *(getattr(scene, name).to(device) for name in names),
            *(scene.width, scene.height),
            backgrounds=None if scene.backgrounds is None else scene.backgrounds.to(device),
            backend=backend,
            **scene.settings,
        )
        if device == "cpu":
            return out
        return replace(out, **{k: v.cpu() for k, v in vars(out).items() if isinstance(v, Tensor)})


def look(angle: float = 0.1, shift=(0.2, -0.1, 0.3)) -> Tensor:
    """A camera turned about y: world to camera [4,4]."""
    c, s = math.cos(angle), math.sin(angle)
    view = torch.eye(4)
    view[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    view[:3, 3] = torch.tensor(shift)
    return view


def random_scene(n=300, width=49, height=35, channels=3, cameras=1, seed=0, cover=25.0, **settings) -> Scene:
    """Gaussians spread over the image and a margin, about `cover` of them a pixel, of all shapes and opacities."""
    g = torch.Generator().manual_seed(seed)
    focal = 0.8 * width
    K = torch.tensor([[focal, 0, width / 2], [0, 1.1 * focal, height / 2 - 1], [0, 0, 1.0]])
    z = 2 + 6 * torch.rand(n, generator=g)
    u, v = ((torch.rand(n, generator=g) * 1.2 - 0.1) * size for size in (width, height))
    pixel = math.sqrt(cover * width * height / max(n, 1) / 28)
    camera = torch.stack([(u - width / 2) / focal * z, (v - height / 2) / focal * z, z], -1)
    first = look()
    views = torch.stack([look(0.1 + 0.05 * c, (0.2 - 0.1 * c, -0.1, 0.3)) for c in range(cameras)])
    return Scene(
        means=(camera - first[:3, 3]) @ first[:3, :3],
        quats=torch.randn(n, 4, generator=g),
        scales=(pixel * z / focal)[:, None] * torch.exp(0.5 * torch.randn(n, 3, generator=g)),
        opacities=torch.sigmoid(1.5 * torch.randn(n, generator=g)),
        colors=torch.rand(n, channels, generator=g),
        viewmats=views,
        Ks=K.expand(cameras, 3, 3).clone(),
        width=width,
        height=height,
        settings=settings,
    )


def oracle(scene: Scene, **leaves: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Colours, alphas and accumulated depth by the textbook: every splat at every pixel, conics, a loop over splats.

    Written without the renderer's own modules; float64 throughout, differentiable. For finite Gaussians.
    """
    s = replace(scene.to(torch.float64), **leaves)
    eps, antialiased = s.settings.get("eps2d", 0.3), s.settings.get("rasterize_mode") == "antialiased"
    near, far = s.settings.get("near_plane", 0.01), s.settings.get("far_plane", 1e10)
    pixels = (torch.arange(size, dtype=torch.float64) + 0.5 for size in (s.height, s.width))
    ys, xs = torch.meshgrid(*pixels, indexing="ij")
    images, alphas, depths = [], [], []
    for c in range(len(s.viewmats)):
        R, t = s.viewmats[c, :3, :3], s.viewmats[c, :3, 3]
        fx, fy, cx, cy = s.Ks[c, 0, 0], s.Ks[c, 1, 1], s.Ks[c, 0, 2], s.Ks[c, 1, 2]
        camera = s.means @ R.T + t
        colors = s.colors if s.colors.ndim == 2 else s.colors[c]
        left = torch.ones(s.height, s.width, dtype=torch.float64)
        done = torch.zeros(s.height, s.width, dtype=torch.bool)
        image = torch.zeros(s.height, s.width, colors.shape[-1], dtype=torch.float64)
        depth = torch.zeros_like(left)
        for i in camera[:, 2].detach().float().argsort(stable=True).tolist():
            x, y, z = camera[i]
            if not (near <= z.float() <= far) or (s.quats[i] ** 2).sum() < 1e-24:
                continue
            w, a, b, d = (s.quats[i] / s.quats[i].norm()).unbind()
            rotation = torch.stack(
                [
                    1 - 2 * (b * b + d * d),
                    2 * (a * b - w * d),
                    2 * (a * d + w * b),
                    2 * (a * b + w * d),
                    1 - 2 * (a * a + d * d),
                    2 * (b * d - w * a),
                    2 * (a * d - w * b),
                    2 * (b * d + w * a),
                    1 - 2 * (a * a + b * b),
                ]
            ).reshape(3, 3)
            axes = R @ rotation * s.scales[i]
            margin_x, margin_y = 0.15 * s.width / fx, 0.15 * s.height / fy
            tx = z * (x / z).clamp(-(cx / fx + margin_x), (s.width - cx) / fx + margin_x)
            ty = z * (y / z).clamp(-(cy / fy + margin_y), (s.height - cy) / fy + margin_y)
            zero = torch.zeros((), dtype=torch.float64)
            J = torch.stack([fx / z, zero, -fx * tx / z**2, zero, fy / z, -fy * ty / z**2]).reshape(2, 3)
            sharp = J @ axes @ (J @ axes).T
            cov = sharp + eps * torch.eye(2, dtype=torch.float64)
            det_sharp, det = torch.linalg.det(sharp), torch.linalg.det(cov)
            if not det > 0:
                continue
            opacity = s.opacities[i]
            if antialiased:
                opacity = opacity * (det_sharp.clamp_min(1e-300) / det).sqrt()
            if not opacity >= 1 / 255:
                continue
            dx, dy = xs - (fx * x / z + cx), ys - (fy * y / z + cy)
            sigma = 0.5 * (cov[1, 1] * dx * dx + cov[0, 0] * dy * dy - 2 * cov[0, 1] * dx * dy) / det
            alpha = (opacity * torch.exp(-sigma)).clamp_max(0.999)
            touched = (alpha >= 1 / 255) & ~done
            done = done | (touched & (left * (1 - alpha) <= 1e-4))
            alpha = torch.where(touched & ~done, alpha, 0.0)
            image = image + (alpha * left)[..., None] * colors[i]
            depth = depth + alpha * left * z
            left = left * (1 - alpha)
        if s.backgrounds is not None:
            image = image + left[..., None] * s.backgrounds[c]
        images.append(image)
        alphas.append(1 - left[..., None])
        depths.append(depth[..., None])
    return torch.stack(images), torch.stack(alphas), torch.stack(depths)


def weighted(outputs: tuple[Tensor, ...], seed: int = 3) -> Tensor:
    """A scalar in which every output value counts, with weights of both signs that are the same for every back end."""
    g = torch.Generator().manual_seed(seed)
    total = torch.zeros((), dtype=torch.float64)
    for t in outputs:
        total = total + (t.double() * torch.randn(t.shape, generator=g, dtype=torch.float64)).sum()
    return total


def run(scene: Scene, backend: str, dtype: torch.dtype = torch.float32):
    """Outputs (detached) and gradients of weighted() by name, from a back end or from "oracle"."""
    scene = scene.to(torch.float64 if backend == "oracle" else dtype)
    leaves = {name: t.clone().requires_grad_() for name, t in scene.leaves().items()}
    if backend == "oracle":
        outputs = oracle(scene, **leaves)
    else:
        out = replace(scene, settings={"depth": "accumulated", **scene.settings}).render(backend, **leaves)
        outputs = (out.colors, out.alphas, out.depths)
    loss = weighted(outputs)
    if backend != "oracle" or loss.requires_grad:  # every back end has gradients, also of an image of nothing
        loss.backward()
    gradients = {k: t.grad if t.grad is not None else torch.zeros_like(t) for k, t in leaves.items()}
    return tuple(t.detach() for t in outputs), gradients


def relative(a: Tensor, b: Tensor) -> float:
    """|a - b| / |b| in the Frobenius norm. Below 1e-14 |b| is the rounding of a zero, as for the turns of a sphere."""
    a, b = a.double(), b.double()
    return float((a - b).norm() / b.norm().clamp_min(1e-9 if float(b.norm()) < 1e-14 else 0))
