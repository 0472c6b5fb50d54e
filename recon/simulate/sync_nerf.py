"""A simulated capture in Sync-NeRF's Blender layout: one pose a camera, one video each, and nobody tells the offsets.

``transforms.json`` with ``width``, ``height``, ``camera_angle_x`` and a camera-to-world matrix (OpenGL axes) a camera,
in the order of ``cam_00.mp4``, ``cam_01.mp4``, ...; the first is held out, as theirs is. Theirs are of Blender, ours of
``recon.simulate``: what is the same is the layout. ``truth.json`` and ``start.json`` are our own, beside it.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from otsync.files.arrays import write_json
from otsync.io.datasets.common import to_opengl
from otsync.simulate.phones import write_video
from otsync.types import Offsets
from recon.simulate.capture import Capture

SHARP = 6
"""x264's quality: noise of 1 % stays, errors of encoding are a fifth of it."""


def write_sync_nerf(capture: Capture, folder: str | os.PathLike[str]) -> tuple[str, ...]:
    """Write the videos, the poses, the truth, and offsets of zero to begin with; the names of the videos.

    Held-out cameras come first. ValueError for a folder that holds another recording, for cameras that differ in their
    lens (the layout has one for all), and for a rolling shutter, which it cannot tell.
    """
    folder = Path(folder)
    if (folder / "transforms.json").exists():
        raise ValueError(f"{folder}: expected a folder without a recording; found transforms.json. Choose another.")
    every = [*capture.held_out, *capture.footage]
    if any(f.readout is not None for f in every):
        raise ValueError("readout: expected none, since the layout has no field for it. Leave it out.")
    first, (width, height) = every[0], every[0].size
    if any(not np.array_equal(f.K, first.K) or f.size != first.size for f in every):
        raise ValueError("cameras: expected one lens for all, as the layout has it; found several.")
    names = tuple(f"cam_{n:02d}" for n in range(len(every)))
    for name, footage in zip(names, every, strict=True):
        write_video(folder / f"{name}.mp4", footage.images, 1 / capture.frame_step, crf=SHARP)
    seen = len(capture.held_out)
    true = np.concatenate([np.zeros(seen), capture.offsets]) - capture.offsets[0]
    for file, seconds in (("truth.json", true), ("start.json", np.zeros(len(names)))):
        known = Offsets.known(names, seconds, 1 / capture.frame_step)
        clock = replace(known, reference=seen, component=np.full(len(names), seen))  # of one that a fit may see
        clock.save(folder / file)
    told = {
        "width": width,
        "height": height,
        "camera_angle_x": float(2 * np.arctan(width / (2 * first.K[0, 0]))),
        "cx": float(first.K[0, 2]),
        "cy": float(first.K[1, 2]),
        "frames": [{"transform_matrix": to_opengl(f.w2c).tolist()} for f in every],
    }
    write_json(folder / "transforms.json", told)  # last: a folder that holds it is complete
    return names
