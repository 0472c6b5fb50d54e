"""Every match that obeys a model, adjusted together: a mapper heeds the strongest pairs of pictures alone.

A leaf: it needs pycolmap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..geometry import fundamental, sampson, undistort
from ..types import Camera
from .clips import Lens
from .mapping import LEAST_OF_A_HALF, Model, Pictures, adjust, found_camera, lenses_found, quiet

OBEYS = 1.5
"""Pixels at 640 of width that a match may lie off its epipolar line, and a point off where it is seen. Right matches of
the dome lie .2 to .6 off; 3 pixels let in matches of repeated things, which turn cameras by degrees."""

LEAST_ANGLE = 1.5
"""Degrees between two rays of a point at the least, COLMAP's own limit."""

ROUNDS = 3
"""Of choosing what obeys, and adjusting to it."""

Matches = Mapping[tuple[int, int], Float[np.ndarray, "N 4"]]
Pixel = tuple[int, float, float]
"""The model's n-th picture, and where in it."""


def adjusted(model: Model, matches: Matches, pictures: Pictures) -> Model:
    """The model of static cameras after a bundle adjustment to all verified matches that obey it; lenses stay.

    A picture in which too few matches obey stays where it is.
    """
    lenses = [lenses_found(model, pictures.lenses)[int(pictures.of[p])] for p in model.pictures]
    unit = max(max(pictures.pictures[int(p)].image.shape[:2]) for p in model.pictures) / 640
    error = OBEYS * max(unit, 0.5)
    for _ in range(ROUNDS):
        tracks = _tracks(model, matches, lenses, error)
        model = _bundled(model, tracks, lenses, error)
    return replace(model, halves=np.stack([_bundled(model, tracks[half::2], lenses, error).w2c for half in (0, 1)]))


def _tracks(model: Model, matches: Matches, lenses: Sequence[Lens], error: float) -> list[list[Pixel]]:
    """Pixels that show one point by the matches that obey; in no picture two of them."""
    at = {int(p): n for n, p in enumerate(model.pictures)}
    of: dict[Pixel, list[Pixel]] = {}
    for (a, b), uv in sorted(matches.items(), key=lambda item: (-len(item[1]), item[0])):
        if a not in at or b not in at:
            continue
        one, two = (Camera(lenses[n].K, model.w2c[n], 1, 1, lenses[n].distortion) for n in (at[a], at[b]))
        off = np.abs(sampson(fundamental(one, two), undistort(one, uv[:, :2]), undistort(two, uv[:, 2:])))
        for ua, va, ub, vb in uv[off < error].tolist():
            one_track = of.setdefault((at[a], ua, va), [(at[a], ua, va)])
            other = of.setdefault((at[b], ub, vb), [(at[b], ub, vb)])
            if one_track is not other and not {n for n, _, _ in one_track} & {n for n, _, _ in other}:
                one_track += other
                of |= dict.fromkeys(other, one_track)
    tracks = {id(track): sorted(track) for track in of.values() if len(track) > 1}
    return sorted(tracks.values())


def _bundled(model: Model, tracks: Sequence[list[Pixel]], lenses: Sequence[Lens], error: float) -> Model:
    """The model with the points of these tracks, adjusted."""
    import pycolmap

    points = [point for track in tracks if (point := _point(pycolmap, model, track, lenses, error)) is not None]
    while True:  # a picture that is left out takes its points with it
        seen = np.bincount([n for _, track in points for n, _, _ in track], minlength=len(lenses))
        few = {int(n) for n in np.flatnonzero((seen > 0) & (seen < LEAST_OF_A_HALF))}
        if not few:
            break
        points = [(xyz, track) for xyz, track in points if not few & {n for n, _, _ in track}]
    told = np.flatnonzero(seen)
    if len(told) < 3:
        return model
    built = _reconstruction(pycolmap, model, points, lenses, told)
    with quiet(pycolmap):
        adjust(pycolmap, built, set(built.cameras))
    w2c = model.w2c.copy()
    for n in told:
        w2c[n, :3] = built.images[int(n) + 1].cam_from_world().matrix()
    ids = sorted(built.points3D)
    flat = [(n, k, u, v) for k, (_, track) in enumerate(points) for n, u, v in track]
    return replace(
        model,
        w2c=w2c,
        points=np.array([built.points3D[i].xyz for i in ids]).reshape(-1, 3),
        seen=np.array([(n, k) for n, k, _, _ in flat], int).reshape(-1, 2),
        uv=np.array([(u, v) for _, _, u, v in flat]).reshape(-1, 2),
        error=float(built.compute_mean_reprojection_error()),
    )


def _reconstruction(
    pycolmap: Any,
    model: Model,
    points: Sequence[tuple[np.ndarray, list[Pixel]]],
    lenses: Sequence[Lens],
    told: Int[np.ndarray, " Q"],
) -> Any:
    """COLMAP's own form of the pictures that are told, and of the points; picture n has the number n + 1."""
    built = pycolmap.Reconstruction()
    keypoints: dict[int, list[tuple[float, float]]] = {int(n): [] for n in told}
    tracks = []
    for _, track in points:
        tracks.append(pycolmap.Track([pycolmap.TrackElement(n + 1, len(keypoints[n])) for n, _, _ in track]))
        for n, u, v in track:
            keypoints[n].append((u, v))
    for n, uv in keypoints.items():
        camera = pycolmap.Camera(camera_id=n + 1, **found_camera(lenses[n]))
        built.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"{n}", keypoints=np.array(uv), camera_id=n + 1, image_id=n + 1)
        built.add_image_with_trivial_frame(image, pycolmap.Rigid3d(model.w2c[n, :3]))
    for (xyz, _), each in zip(points, tracks, strict=True):
        built.add_point3D(xyz, each)
    return built


def _point(
    pycolmap: Any, model: Model, track: list[Pixel], lenses: Sequence[Lens], error: float
) -> tuple[Float[np.ndarray, " 3"], list[Pixel]] | None:
    """Where the rays of a track meet, and its pixels without those that miss it; None where fewer than two are left,
    it lies behind one of them, or they look at it from too small an angle.
    """
    track = list(track)
    while len(track) >= 2:
        poses = [model.w2c[n] for n, _, _ in track]
        cameras = [Camera(lenses[n].K, model.w2c[n], 1, 1, lenses[n].distortion) for n, _, _ in track]
        pixels = [np.array([[u, v]]) for _, u, v in track]
        ideal = [undistort(camera, uv)[0] for camera, uv in zip(cameras, pixels, strict=True)]
        rays = [np.linalg.solve(camera.K, [*uv, 1.0]) for camera, uv in zip(cameras, ideal, strict=True)]
        xyz = pycolmap.triangulate_multi_view_point(
            [pose[:3] for pose in poses], [ray / np.linalg.norm(ray) for ray in rays]
        )
        if xyz is None or not np.isfinite(xyz).all():
            return None
        off = [
            float(np.linalg.norm(camera.project(xyz[None, None])[0, 0] - uv))
            for camera, uv in zip(cameras, ideal, strict=True)
        ]
        worst = int(np.argmax([x if np.isfinite(x) else np.inf for x in off]))  # nan: behind the camera
        if off[worst] < error:
            ways = np.array([xyz + pose[:3, :3].T @ pose[:3, 3] for pose in poses])
            ways /= np.linalg.norm(ways, axis=1)[:, None]
            return (xyz, track) if (ways @ ways.T).min() < np.cos(np.radians(LEAST_ANGLE)) else None
        del track[worst]
    return None
