"""The scene page: one HTML file that plays the 4D scene in a browser, from any side and at any real time.

The file needs no network and opens by double click. It holds the scene with its motion as splines, so that its size
does not grow with the number of frames; the script in ``web/`` evaluates them in a worker, sorts the Gaussians and
draws them with WebGL2 as :mod:`recon.raster` does.

page.html, style.css   the page              engine: vectors.js, splines.js, motion.js, order.js, engine.js
stepper.js, decode.js  engine, data          splats.js, lines.js, screens.js, stage.js   what is drawn
view.js, clocks.js     from where, and when  strips.js, timeline.js, controls.js, main.js   all around it
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch

from otsync.files.arrays import atomic_write, read_json
from recon.backdrop.surroundings import up_axis
from recon.motion import PerGaussian, Scaffold, Static
from recon.observe.vignetting import NO_FALLOFF, own_falloff
from recon.raster import sh
from recon.raster.rendering import ALPHA_MIN, Settings
from recon.result.export import Exporter
from recon.result.folder import FilmedBy, SavedReconstruction
from recon.result.packing import Packing
from recon.result.strips import Strip, read_strips
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D

ENGINE = ("vectors.js", "splines.js", "motion.js", "order.js", "engine.js")
"""Scripts that the page and its worker read."""

PAGE = (
    *("decode.js", "clocks.js", "view.js", "strips.js", "timeline.js", "splats.js", "lines.js", "screens.js"),
    *("stage.js", "stepper.js", "controls.js", "main.js"),
)

PER_ROW = 1024
"""Gaussians in a row of the page's textures. What stands still begins with a row of its own."""

EVEN = 5e-4
"""Seconds that a video's frames may lie beside an even grid to be told by its step alone."""

FINEST = 0.25
"""Largest step of a position, in working pixels at the depth of what moves."""


SCENE_PAGE = "scene.html"


class Page(Exporter):
    """The whole scene as one HTML file that plays it in a browser: from any side, at any speed, without a network."""

    name, file, holds = "page", SCENE_PAGE, "everything"

    def write(self, scene: Gaussians4D, out: Path, times: Sequence[float], frame: str) -> None:
        write_page(out, scene)

    def write_result(self, result: SavedReconstruction, out: Path, times: Sequence[float]) -> None:
        beside = result.folder is not None and (out.parent / "report.html").is_file()
        beside = beside and out.parent.resolve() == Path(result.folder or "").resolve()
        strips = () if result.folder is None else read_strips(result.folder)
        write_page(out, result, strips, report="report.html" if beside else None)


def write_page(
    out: Path,
    shown: SavedReconstruction | Gaussians4D,
    strips: Sequence[Strip] = (),
    *,
    title: str = "Scene",
    report: str | None = None,
) -> None:
    """Write the page, atomically.

    Args:
        shown: a reconstruction with its cameras and clocks, or a scene alone.
        strips: pictures of its videos; those of videos that it does not have are left out.
        report: address of the report, relative to the page; None: no link.
    """
    packing = Packing()
    result = shown if isinstance(shown, SavedReconstruction) else None
    scene = shown.scene if isinstance(shown, SavedReconstruction) else shown
    about = header(packing, scene, result)
    strip_of = {s.name: s for s in strips}
    pictures = []
    for v, camera in enumerate(about["cameras"]):
        strip = strip_of.get(camera["name"])
        if strip is not None:
            camera["strip"] = _strip_header(strip)
            pictures.append(f'<script type="text/plain" id="strip-{v}">{_base64(strip.webp)}</script>')
    about["arrays"] = packing.entries
    data = [
        f'<script type="application/json" id="about">{_inert(about)}</script>',
        f'<script type="text/plain" id="scene">{packing.text()}</script>',
        *pictures,
    ]
    links = "" if report is None else f'<a href="{escape(report, quote=True)}">Report</a>'
    with atomic_write(out, "w") as stream:
        stream.write(_filled(title, links, "\n".join(data)))


def _filled(title: str, links: str, data: str) -> str:
    """The page with its parts. Its policy allows these scripts and this style, by their digests, and nothing else."""
    web = files("recon.result") / "web"

    def read(name: str) -> str:
        return (web / name).read_text(encoding="utf-8")

    engine, page = ("\n".join(map(read, names)) for names in (ENGINE, PAGE))
    style = read("style.css")
    policy = (
        f"default-src 'none'; script-src {_digest(engine)} {_digest(page)}; style-src {_digest(style)}; "
        "worker-src blob:; img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    parts = {
        "title": escape(title),
        "policy": policy,
        "style": style,
        "links": links,
        "data": data,
        "engine": engine,
        "page": page,
    }
    # part by part, in order: what was filled in is not searched again
    text, rest = "", read("page.html")
    while "@" in rest:
        before, name, rest = rest.split("@", 2)
        text += before + parts[name]
    return text + rest


def _digest(text: str) -> str:
    return f"'sha256-{_base64(hashlib.sha256(text.encode()).digest())}'"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _inert(value: Any) -> str:
    """JSON that stays data inside a script element, whatever names are in it."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def header(packing: Packing, scene: Gaussians4D, result: SavedReconstruction | None) -> dict[str, Any]:
    """What the page knows of the scene but for its arrays, which go into ``packing``."""
    videos = () if result is None else result.videos
    with torch.no_grad():
        middle = scene.moving(0.5 * (scene.span[0] + scene.span[1])).means.double().cpu().numpy()
    # positions lie about the middle of what moves: float32 of a graphics card has no digits for far-off origins
    centre = np.median(middle, 0) if len(middle) else np.zeros(3)
    finest = FINEST * scene.footprint
    layered = scene.static is not None and (result is None or result.layered)
    moving = _moving(packing, scene, centre, finest)
    still = _gaussians(packing, "static", scene.static, centre, finest)
    degrees = {"dynamic": scene.dynamic.sh_degree, "static": 0 if scene.static is None else scene.static.sh_degree}
    cameras = [_camera(packing, v, video, centre, result) for v, video in enumerate(videos)]
    reference = 0
    if result is not None and result.offsets.names[result.offsets.reference] in [v.name for v in videos]:
        reference = [v.name for v in videos].index(result.offsets.names[result.offsets.reference])
    return {
        "format": "otsync.page",
        "version": 1,
        "span": list(scene.span),
        "start": scene.span[0] if not videos else float(videos[reference].times[0]),
        "step": scene.frame_step,
        "near": scene.near,
        "moving_near": scene.moving_near if layered else scene.near,
        "layered": layered,
        "blur": Settings().eps2d,
        "degree": max(degrees.values()),
        "degrees": degrees,
        "moving": len(scene),
        "still": still,
        "row_start": -(-len(scene) // PER_ROW) * PER_ROW,
        "motion": moving,
        "cameras": cameras,
        "reference": reference,
        "quality": _quality(result),
        **_surroundings(videos, middle - centre, centre),
    }


GRADES = ((30.0, "sharp"), (25.0, "fair"), (20.0, "rough"))
"""PSNR in dB from which on a held-out camera's pictures are called so; below, a sketch."""


def _quality(result: SavedReconstruction | None) -> str:
    """How near the scene is to what a camera filmed that the fit did not see, in words; empty where unknown."""
    path = None if result is None or result.folder is None else Path(result.folder) / "metrics.json"
    if path is None or not path.is_file():
        return ""
    document = read_json(path)
    held = document.get("held_out") if isinstance(document, dict) else None
    psnr = held.get("psnr") if isinstance(held, dict) else None
    if not isinstance(psnr, int | float) or not math.isfinite(psnr):
        return "no camera was held out to measure quality"
    grade = next((word for least, word in GRADES if psnr >= least), "a sketch")
    return f"{grade}: {psnr:.1f} dB at a camera that the fit did not see"


def _surroundings(videos: Sequence[FilmedBy], middle: np.ndarray, centre: np.ndarray) -> dict[str, Any]:
    """What a free view turns about, which way is up, and from where it looks where no camera filmed."""
    if videos:
        poses = np.stack([v.camera.w2c if v.camera.w2c.ndim == 2 else v.camera.w2c[0] for v in videos])
        eyes = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3]) - centre
        radius = float(np.median(np.linalg.norm(eyes, axis=1)))
        up = up_axis(poses)
    else:
        radius = 3 * float(np.percentile(np.linalg.norm(middle, axis=1), 90)) if len(middle) else 1.0
        up = np.array([0.0, 0, 1])
    radius = radius if radius > 0 else 1.0
    lens = {"width": 640, "height": 480, "lens": [600.0, 600.0, 320.0, 240.0]}
    eye = [0.0, -0.95 * radius, 0.3 * radius]
    return {"focus": [0.0, 0.0, 0.0], "up": up.tolist(), "radius": radius, "eye": eye, "lens": lens}


def _camera(
    packing: Packing, v: int, video: FilmedBy, centre: np.ndarray, result: SavedReconstruction | None
) -> dict[str, Any]:
    camera, K = video.camera, video.camera.K
    w2c = camera.w2c.reshape(-1, 4, 4)[:, :3].copy()
    w2c[:, :, 3] += w2c[:, :, :3] @ centre
    packing.exact(f"poses-{v}", w2c.reshape(-1, 12))
    packing.exact(f"times-{v}", video.times if len(w2c) > 1 else video.times[:1])
    return {
        "name": video.name,
        "width": camera.width,
        "height": camera.height,
        "lens": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        "offset": video.clock.offset,
        "rate": video.clock.rate,
        "first": float(video.times[0]),
        "last": float(video.times[-1]),
        "shots": _shots(video.times),
        "gain": [float(g) for g in video.gain],
        "falloff": list(own_falloff(video.optics) or NO_FALLOFF),
        "held_out": video.held_out,
        **_trust(video, result),
    }


def _shots(times: np.ndarray) -> dict[str, Any]:
    """When a video has frames: the seconds between them where these are even, else all times."""
    step = (times[-1] - times[0]) / max(len(times) - 1, 1)
    even = times[0] + step * np.arange(len(times))
    if step > 0 and np.abs(times - even).max() < EVEN:
        return {"step": float(step)}
    return {"times": [round(float(t), 5) for t in times]}


def _trust(video: FilmedBy, result: SavedReconstruction | None) -> dict[str, Any]:
    """How sure a video's offset is, in words."""
    if result is None or video.name not in result.offsets.names:
        how = {"given": "held out", "found": "held out, found on the scene"}
        return {"sigma": None, "trust": how.get(video.clock.how, "held out"), "remedy": "", "doubtful": False}
    n = result.offsets.names.index(video.name)
    sigma, status = float(result.offsets.sigma[n]), result.offsets.status[n]
    if n == result.offsets.reference:
        return {"sigma": 0.0, "trust": "", "remedy": "", "doubtful": False}
    return {
        "sigma": sigma if np.isfinite(sigma) else None,
        "trust": "✓ trusted" if status.ok else f"⚠ {status.code.replace('_', ' ')}",
        "remedy": "" if status.ok else str(status),
        "doubtful": not status.ok,
    }


def _strip_header(strip: Strip) -> dict[str, Any]:
    times = [round(float(t), 6) for t in strip.times]
    return {"times": times, "columns": strip.columns, "width": strip.size[0], "height": strip.size[1]}


def _gaussians(packing: Packing, part: str, gaussians: Gaussians | None, centre: np.ndarray, finest: float) -> int:
    """Packs how Gaussians look, and where they rest; how many they are. Those too faint keep their place."""
    if gaussians is None or not len(gaussians):
        return 0
    flat = gaussians.detach().finite()
    means = flat.means.double().numpy() - centre
    colors = sh.C0 * flat.sh[:, 0].double().numpy() + 0.5
    if flat.sh_degree:  # the view's share is added before the colour is cut at 0
        packing.measured(f"{part}_bands", flat.sh[:, 1:].numpy(), 8)
    else:
        colors = colors.clip(0)
    quats = torch.nn.functional.normalize(flat.quats, dim=-1).numpy()
    opacities = flat.opacities.double().numpy()
    packing.measured(f"{part}_means", means, 16, finest)
    packing.measured(f"{part}_quats", quats, 8)
    packing.measured(f"{part}_log_scales", flat.log_scales.double().numpy(), 8)
    packing.measured(f"{part}_opacities", np.where(opacities < ALPHA_MIN, 0, opacities)[:, None], 8)
    packing.measured(f"{part}_colors", colors, 8)
    return len(gaussians)


def _moving(packing: Packing, scene: Gaussians4D, centre: np.ndarray, finest: float) -> dict[str, Any]:
    """Packs what moves, and how; the motion's part of the header."""
    motion = scene.motion
    _gaussians(packing, "dynamic", scene.dynamic, centre, finest)
    if isinstance(motion, Scaffold):
        return _scaffold(packing, motion, centre, finest)
    if isinstance(motion, PerGaussian):
        packing.measured("own_knots", motion.own_knots.detach().cpu().numpy(), 16, finest)
        if motion.own_quats is not None:
            packing.measured("own_quats", _of_one_length(motion.own_quats), 16)
        return {"kind": "per-gaussian", "path": _path(motion)}
    if isinstance(motion, Static):
        return {"kind": "static"}
    raise ValueError(
        f"scene.motion: expected a scaffold, a motion per Gaussian or none; found {type(motion).__name__}, which the "
        "page cannot evaluate. Export a sequence of .ply."
    )


def _scaffold(packing: Packing, motion: Scaffold, centre: np.ndarray, finest: float) -> dict[str, Any]:
    bound = motion.binding
    # Gaussians near one node hang on the same eight: the eight are packed once
    slots = np.concatenate([bound.rest.cpu().numpy()[:, None], bound.nodes.cpu().numpy()], 1)
    groups, group_of = np.unique(slots, axis=0, return_inverse=True)
    packing.measured("knots", motion.knots.detach().cpu().double().numpy() - centre, 16, finest)
    packing.measured("knot_quats", _of_one_length(motion.knot_quats), 16)
    packing.measured("rest_positions", bound.positions.cpu().double().numpy() - centre, 16, finest)
    packing.measured("rest_quats", bound.quats.cpu().numpy(), 16)
    packing.whole("groups", groups)
    packing.whole("group_of", group_of.reshape(-1))
    packing.measured("weights", bound.weights.cpu().numpy(), 8)
    clocks = [{"offset": 0.0, "rate": 1.0}]
    if motion.clock is not None and motion.offsets is not None and motion.rates is not None:
        packing.whole("clock_of", motion.clock.cpu().numpy())
        pairs = zip(motion.offsets.tolist(), motion.rates.tolist(), strict=True)
        clocks = [{"offset": offset, "rate": rate} for offset, rate in pairs]
    return {"kind": "scaffold", "path": _path(motion), "nodes": len(motion), "clocks": clocks, "blend": motion.blend}


def _of_one_length(quats: torch.Tensor) -> np.ndarray:
    """Quaternions [P,M,4] of a spline, scaled as a whole to at most 1: their sum's direction is what counts."""
    values = quats.detach().cpu().double().numpy()
    return values / max(float(np.abs(values).max(initial=0)), 1e-12)


def _path(motion: Scaffold | PerGaussian) -> dict[str, Any]:
    path = motion.path
    return {"kind": type(path).__name__, "start": path.start, "spacing": path.spacing, "count": path.count}
