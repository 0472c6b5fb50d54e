"""Differentiable rasterization of 3-D Gaussians: `render`, one signature over three back ends.

rendering.py       thresholds, Settings, Splats, Rendering
render.py          render(): checks, choice of the back end, background, depth
sh.py              spherical harmonics to colours
projection.py      3-D Gaussians to splats in torch: the definition
torch_backend.py   compositing in torch: oracle and fallback
cpu/               the same in numba with explicit SIMD and a hand-written backward
gsplat_backend.py  the same on CUDA, through gsplat
"""

from recon.raster.render import render, set_threads, warmup
from recon.raster.rendering import Rendering, Settings, Splats

__all__ = ["Rendering", "Settings", "Splats", "render", "set_threads", "warmup"]
