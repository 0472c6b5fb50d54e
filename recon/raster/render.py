"""render(): one signature for all back ends. Checks the arguments, chooses a back end, projects and rasterizes."""

from __future__ import annotations

import importlib.util
import logging
from types import ModuleType
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from recon.raster import sh
from recon.raster.rendering import Rendering, Settings, Splats

logger = logging.getLogger("recon.raster")
BackendName = Literal["auto", "torch", "cpu", "gsplat"]
_announced: set[str] = set()


def render(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    backgrounds: Tensor | None = None,
    backend: BackendName = "auto",
    **settings: Any,
) -> Rendering:
    """Render N Gaussians into C cameras of one image size; conventions and names are those of gsplat's `rasterization`.

    means: [N,3] world units. quats: [N,4] wxyz, any length. scales: [N,3] standard deviations. opacities: [N] in 0..1.
        Where every camera looks at its own moment, means are [C,N,3] and quats [C,N,4].
    colors: [N,D] or per camera [C,N,D], D channels of any kind; with `sh_degree` spherical-harmonics coefficients
        [N,K,3] or [C,N,K,3], K >= (sh_degree + 1)^2, and D = 3.
    viewmats: [C,4,4] world-to-camera, OpenCV axes (x right, y down, z forward). Ks: [C,3,3] pixels, not differentiable.
    backgrounds: [C,D], seen where the Gaussians let light through; None: black.
    backend: "torch" (any float type; the oracle), "cpu" (numba; computes in float32), "gsplat" (CUDA), or "auto":
        gsplat for CUDA tensors, else cpu where numba is installed, else torch.
    settings: fields of :class:`Settings`: near_plane, far_plane, radius_clip, eps2d, rasterize_mode, sh_degree, depth.

    Differentiable in means, quats, scales, opacities, colors, viewmats and backgrounds. A Gaussian with a NaN or an
    infinity anywhere is not drawn and gets zero gradients; one in `viewmats`, `Ks` or `backgrounds` is a ValueError.

    >>> out = render(means, quats, scales, opacities, colors, viewmats, Ks, 128, 96)
    >>> (out.colors - target).abs().mean().backward()
    """
    options = Settings(**settings)
    Ks = Ks.detach() if isinstance(Ks, Tensor) else Ks
    _check_shapes(means, quats, scales, opacities, colors, viewmats, Ks, width, height, backgrounds, options)
    name = _choose(backend, means)
    means, quats, scales, opacities, colors = _drop_nonfinite(
        (means, quats, scales, opacities, colors), options.sh_degree
    )
    if name == "gsplat":
        from recon.raster import gsplat_backend

        return gsplat_backend.render(
            (means, quats, scales, opacities, colors), viewmats, Ks, (width, height), backgrounds, options
        )
    engine = _engine(name)
    if means.ndim == 2:
        splats = engine.project(means, quats, scales, opacities, viewmats, Ks, width, height, options)
    else:
        each = zip(means, quats, viewmats.split(1), Ks.split(1), strict=True)
        views = [engine.project(m, q, scales, opacities, w2c, K, width, height, options) for m, q, w2c, K in each]
        splats = Splats(*(torch.cat(parts) for parts in zip(*views, strict=True)))
    features = colors
    if options.sh_degree is not None:
        features = sh.view_colors(options.sh_degree, means, colors, viewmats)
    image, depths, alphas = engine.rasterize(splats, features, width, height, options.depth)
    inputs = (means, quats, scales, opacities, colors, viewmats)
    if torch.is_grad_enabled() and not image.requires_grad and any(t.requires_grad for t in inputs):
        # nothing is in view: gradients are zeros, not None
        image = image + 0 * sum(t.nan_to_num().sum() for t in inputs)
    if backgrounds is not None:
        image = image + (1 - alphas) * backgrounds[:, None, None, :]
    return Rendering(image, alphas, depths, splats.means2d, splats.radii, name)


def warmup() -> None:
    """Compile the CPU back end now, or load its compiled code. Does nothing without numba."""
    if _has_numba():
        _engine("cpu").warmup()


def set_threads(n: int) -> None:
    """Let the CPU back end use `n` threads, the caller's included. Results are the same to the last bit."""
    from otsync.compute import threads

    threads.set_threads(n)


def _engine(name: str) -> ModuleType:
    if name == "torch":
        from recon.raster import torch_backend

        return torch_backend
    from recon.raster.cpu import backend as cpu_backend

    return cpu_backend


def _choose(backend: str, means: Tensor) -> str:
    """The back end to run; announced once where the choice was made here."""
    if backend not in ("auto", "torch", "cpu", "gsplat"):
        raise ValueError(f"backend: expected 'auto', 'torch', 'cpu' or 'gsplat'; found {backend!r}.")
    if backend != "auto":
        if backend == "cpu" and not _has_numba():
            raise ValueError(
                "backend: expected numba for 'cpu'; found none. pip install numba, or use 'torch' (15-40x slower)."
            )
        if backend in ("cpu", "torch") and means.device.type != "cpu":
            raise ValueError(
                f"backend: expected CPU tensors for {backend!r}; found {means.device}. Move them with .cpu()."
            )
        return backend
    if means.device.type != "cpu":
        name, reason = "gsplat", "the tensors are on a GPU"
    elif _has_numba():
        name, reason = "cpu", "numba kernels; pass CUDA tensors to use gsplat"
    else:
        name, reason = "torch", "numba is not installed: expect 15-40 times the time of backend 'cpu'"
    if name not in _announced:
        _announced.add(name)
        logger.warning("recon.raster renders with backend '%s' (%s)", name, reason)
    return name


def _has_numba() -> bool:
    return importlib.util.find_spec("numba") is not None


def _drop_nonfinite(gaussians: tuple[Tensor, ...], sh_degree: int | None) -> tuple[Tensor, ...]:
    """Replace Gaussians that hold a NaN or an infinity by ones that are not drawn; the rest pass untouched.

    A finite sum means that all entries are finite, and takes a small fraction of the time of a rendering. (A sum may
    exceed the largest float; that only costs the slower exact test.)
    """
    with torch.no_grad():
        if _finite_sums(*gaussians):
            return gaussians
        means, colors = gaussians[0], gaussians[4]
        moving, per_camera = means.ndim - 2, colors.ndim == 4 or (colors.ndim == 3 and (sh_degree is None))
        axes = (moving, moving, 0, 0, int(per_camera))  # along which the Gaussians lie
        good = torch.ones(means.shape[-2], dtype=torch.bool, device=means.device)
        for t, axis in zip(gaussians, axes, strict=True):
            good &= t.movedim(axis, 0).isfinite().reshape(len(good), -1).all(-1)

    def keep(t: Tensor, axis: int) -> Tensor:
        return torch.where(good.reshape(-1, *[1] * (t.ndim - 1 - axis)), t, 0.0)

    return tuple(keep(t, axis) for t, axis in zip(gaussians, axes, strict=True))


def _finite_sums(*tensors: Tensor) -> bool:
    if tensors[0].device.type != "cpu":
        # one transfer for all: each answer of a GPU is waited for
        return bool(torch.stack([t.sum().isfinite() for t in tensors]).all())
    with np.errstate(all="ignore"):
        # torch would wake its own threads, which compete with ours
        return all(np.isfinite(t.detach().numpy().sum()) for t in tensors)


def _check_shapes(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    backgrounds: Tensor | None,
    options: Settings,
) -> None:
    """Raise ValueError for arguments whose shapes, types or cameras do not fit together."""
    for name, tensor in {"means": means, "viewmats": viewmats}.items():
        if not isinstance(tensor, Tensor):
            raise ValueError(
                f"{name}: expected a torch tensor; found {type(tensor).__name__}. Convert it with torch.as_tensor."
            )
    if means.dtype not in (torch.float16, torch.float32, torch.float64):
        raise ValueError(
            f"means: expected float16, float32 or float64; found {means.dtype}. Convert them with .float()."
        )
    c, moving = len(viewmats), means.ndim == 3
    n = means.shape[-2] if means.ndim > 1 else 0

    def expect(name: str, tensor: Tensor, *shapes: tuple[int | str, ...]) -> None:
        if not isinstance(tensor, Tensor):
            raise ValueError(
                f"{name}: expected a torch tensor; found {type(tensor).__name__}. Convert it with torch.as_tensor."
            )
        for shape in shapes:
            if tensor.ndim == len(shape) and all(
                isinstance(want, str) or want == actual for want, actual in zip(shape, tensor.shape, strict=True)
            ):
                break
        else:
            wanted = " or ".join("[" + ",".join(map(str, s)) + "]" for s in shapes)
            raise ValueError(
                f"{name}: expected {wanted} (N = {n} from means, C = {c} from viewmats); found {list(tensor.shape)}."
            )
        if tensor.dtype != means.dtype or not tensor.is_floating_point() or tensor.device != means.device:
            raise ValueError(
                f"{name}: expected {means.dtype} on {means.device} like means (a float type); "
                f"found {tensor.dtype} on {tensor.device}. Convert it with .to(means)."
            )

    expect("means", means, ("N", 3), (c, "N", 3))
    expect("quats", quats, (c, n, 4) if moving else (n, 4))
    expect("scales", scales, (n, 3))
    expect("opacities", opacities, (n,))
    expect("viewmats", viewmats, ("C", 4, 4))
    expect("Ks", Ks, (c, 3, 3))
    d = 3 if options.sh_degree is not None else colors.shape[-1]
    if options.sh_degree is None:
        expect("colors", colors, (n, "D"), (c, n, "D"))
        if d == 0:
            raise ValueError(
                "colors: expected at least one channel; found none. Pass ones [N,1] to render the alpha only."
            )
    else:
        expect("colors", colors, (n, "K", 3), (c, n, "K", 3))
        if colors.shape[-2] < (options.sh_degree + 1) ** 2:
            raise ValueError(
                f"colors: expected {(options.sh_degree + 1) ** 2} coefficients for sh_degree {options.sh_degree}; "
                f"found {colors.shape[-2]}."
            )
    if not (isinstance(width, int) and isinstance(height, int)) or width < 1 or height < 1:
        raise ValueError(f"width, height: expected whole numbers of at least one pixel; found {width} x {height}.")
    if c < 1:
        raise ValueError("viewmats: expected at least one camera; found none.")
    cameras = {"viewmats": viewmats, "Ks": Ks}
    if backgrounds is not None:
        expect("backgrounds", backgrounds, (c, d))
        cameras["backgrounds"] = backgrounds
    if not _finite_sums(*cameras.values()):
        name = next(name for name, tensor in cameras.items() if not _finite_sums(tensor))
        raise ValueError(
            f"{name}: expected finite entries; found NaN or infinity. A camera or a background has diverged."
        )
    if not ((Ks[:, 0, 0] > 0) & (Ks[:, 1, 1] > 0)).all():
        raise ValueError(
            "Ks: expected positive focal lengths; found zero or negative ones. Flip the image, not the camera."
        )
    if (Ks[:, 0, 1] != 0).any():
        raise ValueError("Ks: expected no skew (K[0,1] = 0), which is not modelled; found some. Rectify the images.")
