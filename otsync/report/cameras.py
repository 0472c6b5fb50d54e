"""The page of a calibration: the cameras from above, from the side and at an angle, how sure each is, what to film."""

from __future__ import annotations

import os
from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Float

from ..calibrate.found import Calibration, FoundCamera
from .page import cards, footer, write_page

COLOURS = ("#2a83c6", "#d9690f", "#a06cc4", "#159c7c", "#c25b8f", "#a8892b", "#5f7fa8", "#c0573f", "#6f8f3a", "#8a8f98")

VIEWS = {
    "from above": np.array([[1.0, 0, 0], [0, -1, 0]]),
    "from the side": np.array([[1.0, 0, 0], [0, 0, -1]]),
    "at an angle": np.array([[0.87, 0.5, 0], [0.29, -0.5, -0.82]]),
}
"""World axes (z up) to those of a picture (x right, y down)."""

SIZE, MARGIN = 330, 20
"""Of a picture, in pixels."""

POINTS = 1500
"""Points of the model that a picture shows."""


def write_cameras(path: str | os.PathLike[str], found: Calibration) -> None:
    """Write the page, atomically. No script, nothing loaded from outside."""
    good = sum(camera.ok for camera in found.cameras)
    cameras = [camera for camera in (*found.cameras, *found.helpers) if camera.w2c is not None]
    unit = "metres" if found.unit == "metres" else "units of a scale that is not known (a usual distance is 3)"
    unit = "units of the first video's depth" if found.method == "motion" else unit
    parts = [
        "<p class=kind>Calibration of a recording</p>",
        f"<h1>{good} of {len(found.cameras)} cameras {'is' if len(found.cameras) == 1 else 'are'} to be trusted</h1>",
        f"<p class=lead>The world is in {unit}, z up.</p>",
        *([_pictures(cameras, found.points)] if cameras else ["<p>No camera was found.</p>"]),
        "<h2>How sure</h2>",
        _table(found),
        _remedies(found),
        footer({}),
    ]
    write_page(path, "Cameras", parts)


def _pictures(cameras: Sequence[FoundCamera], points: Float[np.ndarray, "M 3"]) -> str:
    drawn = []
    for title, axes in VIEWS.items():
        drawn.append(f"<figure>{_picture(cameras, points, axes)}<figcaption>{title}</figcaption></figure>")
    what = "A line is the way of a camera that moves; dots are what stands still. Dashed: not to be trusted."
    return f"<div class=figs>{''.join(drawn)}</div><p class=s>{what}</p>"


def _picture(cameras: Sequence[FoundCamera], points: Float[np.ndarray, "M 3"], axes: Float[np.ndarray, "2 3"]) -> str:
    places = [camera.places for camera in cameras]
    around = np.concatenate(places)
    size = 1.15 * max(float(np.abs(around).max()), 1e-9)
    length = 0.13 * size

    def at(xyz: np.ndarray) -> str:
        flat = SIZE / 2 + (SIZE / 2 - MARGIN) * (np.atleast_2d(xyz) @ axes.T) / size
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in flat)

    near = points[np.abs(points).max(1) < size] if len(points) else points
    some = near[:: max(1, len(near) // POINTS)]
    parts = [f"<circle cx='{p.split(',')[0]}' cy='{p.split(',')[1]}' r='.7' fill='#b8bec8'/>" for p in at(some).split()]
    for n, (camera, way) in enumerate(zip(cameras, places, strict=True)):
        colour = COLOURS[n % len(COLOURS)]
        if len(way) > 1:
            step = max(1, len(way) // 100)
            parts.append(f"<polyline points='{at(way[::step])}' fill='none' stroke='{colour}'/>")
        assert camera.w2c is not None
        R, eye = camera.w2c.reshape(-1, 4, 4)[0, :3, :3], way[0]
        w, h, f = camera.width, camera.height, camera.K[0, 0]
        corners = np.array([[x * w / f / 2, y * h / f / 2, 1.0] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        ends = eye + length * corners @ R
        dashes = "" if camera.ok else " stroke-dasharray='3 2'"
        for end in ends:
            parts.append(f"<polyline points='{at(np.stack([eye, end]))}' stroke='{colour}'{dashes}/>")
        parts.append(f"<polygon points='{at(ends)}' fill='{colour}22' stroke='{colour}'{dashes}/>")
        x, y = at(eye).split(",")
        parts.append(f"<text x='{x}' y='{y}' dy='-5' font-size='11' fill='{colour}'>{escape(camera.name)}</text>")
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' width='{SIZE}' height='{SIZE}' viewBox='0 0 {SIZE} {SIZE}' "
        f"fill='currentColor'>{''.join(parts)}</svg>"
    )


def _table(found: Calibration) -> str:
    unit = "m" if found.unit == "metres" else "units"
    head = [("video", False), ("status", True), ("focal", False), ("lens", False), ("turn", False), ("place", False)]
    head += [("matches", False), ("points", False)]
    rows = []
    for c in found.cameras:
        status = "✓ ok" if c.ok else "⚠ doubtful" if c.w2c is not None else "⚠ not found"
        turn, place = (
            f"±{x:.{n}f}{u}" if np.isfinite(x) else "–"
            for x, n, u in ((c.sigma_degrees, 2, "°"), (c.sigma_position, 3, f" {unit}"))
        )
        words = f"<span class={'ok' if c.ok else 'no'}>{status}</span>"
        rows.append([escape(c.name), words, f"{c.K[0, 0]:.1f}", c.lens, turn, place, str(c.inliers), str(c.points)])
    return cards(head, rows)


def _remedies(found: Calibration) -> str:
    doubtful = [camera for camera in found.cameras if not camera.ok]
    if not doubtful:
        return ""
    told = "".join(f"<dt>{escape(c.doubt)}</dt><dd>{escape(c.remedy)}</dd>" for c in doubtful)
    return f"<h2>What to do</h2><dl>{told}</dl>"
