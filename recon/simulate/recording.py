"""A simulated capture as a recording on disk, for ``recon fit`` and ``otsync run``, with the truth beside it."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from otsync.files.arrays import atomic_write
from otsync.io.document import write_document
from otsync.types import Offsets
from recon.footage.footage import Footage
from recon.motion import ScaffoldOptions, build_scaffold
from recon.scene.gaussians4d import Gaussians4D
from recon.scene.seed import Seeding, seed
from recon.simulate.capture import Capture
from recon.simulate.world import DISTANCE

DEPTH_STEP = 0.0005
"""Metres per step of the 16-bit depth images."""


def write_capture(capture: Capture, folder: str | os.PathLike[str], *, masks: bool = True, depth: bool = True) -> None:
    """Write ``scene.json``, ``truth.json``, ``start.json``, images, masks, depth, and the training cameras' tracks.

    start.json holds offsets for a fit to begin with: zero for every camera. Held-out cameras film at true world time,
    as both files say. ValueError for a folder that holds another recording.
    """
    folder = Path(folder)
    if (folder / "scene.json").exists():
        raise ValueError(f"{folder}: expected a folder without a recording; found scene.json in it. Choose another.")
    videos = []
    every = [*capture.footage, *capture.held_out]
    maps = [*capture.depth, *capture.held_depth]
    for n, footage in enumerate(every):
        entry = _images(footage, folder, masks)
        if depth and n < len(maps):
            for k, z in enumerate(maps[n]):
                steps = np.rint(np.asarray(z, float) / DEPTH_STEP).clip(0, 65535).astype(np.uint16)
                _png(folder / "depth" / footage.name / f"{k:04d}.png", steps)
            entry["depth"] = {"frames": f"depth/{footage.name}/*.png", "scale": DEPTH_STEP}
        videos.append(entry)
    for tracks in capture.tracks:
        tracks.save(folder / "tracks" / f"{tracks.name}.npz")
    names = tuple(f.name for f in every)
    true = np.concatenate([capture.offsets - capture.offsets[0], np.zeros(len(capture.held_out))])
    Offsets.known(names, true, 1 / capture.frame_step).save(folder / "truth.json")
    Offsets.known(names, np.zeros(len(names)), 1 / capture.frame_step).save(folder / "start.json")
    write_document(folder / "scene.json", videos)  # last: a folder that holds it is complete


def _images(footage: Footage, folder: Path, masks: bool) -> dict[str, Any]:
    """Write one camera's images and masks; its entry in the scene document."""
    for k, image in enumerate(footage.images):
        _png(folder / "images" / footage.name / f"{k:04d}.png", image)
        if masks and footage.masks is not None:
            _png(folder / "masks" / footage.name / f"{k:04d}.png", footage.masks[k])
    step = float(np.median(np.diff(footage.times))) if len(footage) > 1 else 1.0
    width, height = footage.size
    camera = {"K": footage.K.tolist(), "w2c": footage.w2c.tolist(), "width": width, "height": height}
    if footage.readout is not None:
        camera["readout"] = footage.readout
    entry: dict[str, Any] = {
        "name": footage.name,
        "frames": f"images/{footage.name}/*.png",
        "fps": round(1 / step, 6),
        "camera": camera,
    }
    if masks and footage.masks is not None:
        entry["masks"] = f"masks/{footage.name}/*.png"
    return entry


def _png(path: Path, image: np.ndarray) -> None:
    from PIL import Image

    with atomic_write(path) as stream:
        Image.fromarray(image).save(stream, "PNG")


def initial_scene(
    capture: Capture, offsets: Offsets, options: ScaffoldOptions | None = None, *, seeding: Seeding | None = None
) -> Gaussians4D:
    """The scene with which a fit of a capture begins: scaffold and seeds from the believed ``offsets``, and the true
    static Gaussians, so that what moves is judged by itself."""
    footprint = float(np.median([DISTANCE / f.K[0, 0] for f in capture.footage]))
    span = (float(capture.footage[0].times[0]), float(capture.footage[0].times[-1]))
    motion = build_scaffold(
        capture.tracks, offsets.seconds, footprint=footprint, frame_step=capture.frame_step, options=options
    )
    scene = seed(
        motion,
        capture.footage,
        offsets,
        [z.__getitem__ for z in capture.depth],
        footprint=footprint,
        frame_step=capture.frame_step,
        span=span,
        options=seeding,
    )
    return replace(scene, static=capture.world.static, near=capture.near)
