""".4dgs: one small file of Gaussians on a clock, for players that read the format (PyPI ``fourdgs``; extra ``4dgs``).

The format knows no splines: a Gaussian moves along a straight line and keeps its orientation while its window is open.
So every moving Gaussian becomes one of it for each step between two frames, which leaves the first frame's place and
arrives at the second's; static ones are open all the time. More frames a second follow the motion more closely.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from otsync.files.arrays import atomic_write
from recon.raster import sh
from recon.result.export import Exporter
from recon.result.folder import SavedReconstruction
from recon.scene.gaussians import Gaussians
from recon.scene.gaussians4d import Gaussians4D

MOST = 20_000_000
"""Gaussians of a file, those of all steps together; about 200 bytes each while it is written."""

PROFILE = "fine"
"""Places to a fiftieth of the median size, colours to half of 1/255."""

LOW, HIGH = -4.0, 4.0
"""What the bytes 0 and 255 of a coefficient of view-dependent colour stand for."""


class FourDgs(Exporter):
    """The whole span as .4dgs. Second 0 of the file is the first frame; the header's ``zero`` says which world
    second that was."""

    name, file = "4dgs", "scene.4dgs"

    def write(self, scene: Gaussians4D, out: Path, times: Sequence[float], frame: str) -> None:
        _write(scene, out, times, frame, None)

    def write_result(self, result: SavedReconstruction, out: Path, times: Sequence[float]) -> None:
        _write(result.scene, out, times, result.frame, _first_view(result, float(times[0])))


def _write(scene: Gaussians4D, out: Path, times: Sequence[float], frame: str, camera: Any) -> None:
    import fourdgs

    static = 0 if scene.static is None else len(scene.static)
    if len(scene) * len(times) + static > MOST:
        raise ValueError(
            f"fps: expected at most {MOST} Gaussians in all steps; {len(scene)} moving ones in {len(times)} frames "
            "are more. Use fewer frames a second."
        )
    clock = np.asarray(times, float) - float(times[0])
    edges = np.append(clock, clock[-1] + scene.frame_step)  # the last frame is shown, too
    sizes = np.exp(_numpy(scene.at(float(times[0])).log_scales))
    beat = fourdgs.Steps.of(fourdgs.Bounds.for_profile(PROFILE, median_scale=float(np.median(sizes)))).time
    moments = [scene.moving(float(t)) for t in times]
    parts = []
    for n, (now, after) in enumerate(zip(moments, [*moments[1:], moments[-1]], strict=True)):
        speed = (_numpy(after.means) - _numpy(now.means)) / (edges[n + 1] - edges[n])
        # times are stored on a beat: a Gaussian is told where it is on the beat, so that rounding moves nothing
        on_beat = beat * np.round(edges[n] / beat)
        halfway = _halfway(_numpy(now.quats), _numpy(after.quats))
        part = _looks(now) | {"rotations": halfway, "motions": speed, "mu_t": np.full(len(now.means), on_beat)}
        part["positions"] = _numpy(now.means) + speed * (on_beat - edges[n])
        parts.append(part | _window(len(now.means), edges[n], edges[n + 1]))
    if scene.static is not None:
        still = {"motions": np.zeros((static, 3)), "mu_t": np.zeros(static)}
        still |= {"positions": _numpy(scene.static.means), "rotations": _xyzw(_numpy(scene.static.quats))}
        parts.append(_looks(scene.static) | still | _window(static, 0.0, edges[-1]))
    width = max(part["sh"].shape[1] for part in parts)
    for part in parts:
        part["sh"] = _as_wide(part["sh"], width)
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    rest = joined.pop("sh")
    kinds = {key: value if key.startswith("win") else value.astype(np.float32) for key, value in joined.items()}
    degree = round((width + 1) ** 0.5) - 1
    coloured = {"sh": _bytes(rest), "sh_degree": degree} if degree else {}
    gaussians = fourdgs.GaussianSet(**kinds, **coloured)
    about = {"source": "otsync", "frame": frame, "zero": repr(float(times[0]))}
    options = fourdgs.WriteOptions(profile=PROFILE, metadata=about)
    with atomic_write(out) as stream:
        fourdgs.write(stream, gaussians, float(edges[-1]), options=options, camera=camera)


def _looks(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Size, colour and opacity; colours that depend on the view as (N,K-1,3) coefficients under ``sh``."""
    base = np.clip(0.5 + sh.C0 * _numpy(gaussians.sh[:, 0]), 0, 1)
    alpha = 1 / (1 + np.exp(-_numpy(gaussians.opacity_logits).astype(float)))
    return {
        "scales": np.exp(_numpy(gaussians.log_scales)),
        "colors": np.concatenate([base, alpha.reshape(-1, 1)], 1),
        "sh": _numpy(gaussians.sh[:, 1:]),
    }


def _window(count: int, first: float, stop: float) -> dict[str, np.ndarray]:
    """Seen from ``first`` to ``stop``, without fading."""
    return {
        "sigma_t": np.full(count, np.inf),
        "win_lo": np.full(count, first),
        "win_hi": np.full(count, stop),
    }


def _halfway(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Orientations (N,4) xyzw half-way between two, wxyz."""
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    return _xyzw(a + np.where((a * b).sum(1, keepdims=True) < 0, -b, b))


def _xyzw(q: np.ndarray) -> np.ndarray:
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return q[:, [1, 2, 3, 0]]


def _as_wide(coefficients: np.ndarray, width: int) -> np.ndarray:
    """Coefficients (N,K,3) with zeros behind them, up to ``width``."""
    lacking = width - coefficients.shape[1]
    return np.pad(coefficients, ((0, 0), (0, lacking), (0, 0)))


def _bytes(coefficients: np.ndarray) -> np.ndarray:
    """Coefficients (N,K,3) as bytes (N,3K), channel by channel."""
    flat = coefficients.transpose(0, 2, 1).reshape(len(coefficients), -1)
    return np.clip(np.rint((flat - LOW) / (HIGH - LOW) * 255), 0, 255).astype(np.uint8)


def _first_view(result: SavedReconstruction, t: float) -> Any:
    """Where a player begins: the first camera that took part, looking at the middle of what moves."""
    import fourdgs

    video = next((v for v in result.videos if not v.held_out), result.videos[0])
    w2c, camera = video.pose(t), video.camera
    eye, ahead = -w2c[:3, :3].T @ w2c[:3, 3], w2c[2, :3]
    moving = result.scene.moving(t) if len(result.scene) else result.scene.at(t)
    middle = np.median(_numpy(moving.means), 0)
    far = max(float((middle - eye) @ ahead), result.scene.near)
    angle = 2 * np.degrees(np.arctan(camera.height / 2 / camera.K[1, 1]))
    place, target = (tuple(float(x) for x in v) for v in (eye, eye + far * ahead))
    return fourdgs.CameraTrajectory(fov_y_deg=float(angle), position=place, target=target)


def _numpy(x: Tensor) -> np.ndarray:
    return x.detach().cpu().numpy()
