"""Checkpoints of a fit: plain arrays in one file, written whole or not at all, refused when they belong to another fit."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from otsync.files import read_npz, write_npz
from recon.gaussians4d import UNSOUND, scene_from_arrays

FORMAT, VERSION = "otsync.fit", 1


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A fit between two steps.

    Args:
        step, steps: done, and in all.
        scene: arrays of the scene as it stood (constants of the motion too: densification changes them).
        groups, moments: the optimiser's parameters and averages.
        history: one row per record, see :class:`recon.fit.History`. since: (loss, psnr) of the images since the last row.
        densified: how often the scene was made denser. pull: [2,N] what that is decided by, gathered since the last time.
    """

    step: int
    steps: int
    scene: dict[str, np.ndarray]
    groups: dict[str, Tensor]
    moments: dict[str, Tensor]
    history: np.ndarray
    densified: int
    pull: Tensor
    since: np.ndarray


class Checkpoint:
    """Where a fit is kept while it runs, and how often.

    Args:
        path: the file; None keeps nothing. every: seconds between two writings.
    """

    def __init__(self, path: str | os.PathLike[str] | None, key: str, every: float = 60.0):
        self.path, self.key, self.every = None if path is None else Path(path), key, every
        self._last = time.monotonic()

    def due(self) -> bool:
        """Whether it is time to write again."""
        return self.path is not None and time.monotonic() - self._last >= self.every

    def save(self, snapshot: Snapshot) -> None:
        """Write ``snapshot`` over the last one, atomically."""
        if self.path is None:
            return
        about = {"format": FORMAT, "version": VERSION, "key": self.key, "step": snapshot.step,
                 "steps": snapshot.steps, "densified": snapshot.densified}  # fmt: skip
        arrays = {"fit": np.frombuffer(json.dumps(about).encode(), np.uint8), "history": snapshot.history,
                  "since": snapshot.since, "pull": snapshot.pull.cpu().numpy()}  # fmt: skip
        arrays |= {f"scene/{k}": v for k, v in snapshot.scene.items()}
        for part in ("groups", "moments"):
            arrays |= {f"{part}/{k}": v.detach().cpu().numpy() for k, v in getattr(snapshot, part).items()}
        write_npz(self.path, arrays)
        self._last = time.monotonic()

    def load(self) -> Snapshot | None:
        """The last snapshot; None when there is none. ValueError for a damaged file or one of another fit."""
        if self.path is None or not self.path.exists():
            return None
        arrays = read_npz(self.path)
        try:
            about: dict[str, Any] = json.loads(arrays["fit"].tobytes().decode())
            if about["format"] != FORMAT or about["version"] != VERSION:
                raise ValueError(f"format {about['format']!r}, version {about['version']!r}")
            parts: dict[str, dict[str, np.ndarray]] = {"scene": {}, "groups": {}, "moments": {}}
            for name, array in arrays.items():
                part, _, key = name.partition("/")
                if part in parts and key:
                    parts[part][key] = array
            snapshot = Snapshot(
                int(about["step"]), int(about["steps"]), parts["scene"], _tensors(parts["groups"]),
                _tensors(parts["moments"]), arrays["history"], int(about["densified"]),
                torch.from_numpy(np.array(arrays["pull"])), arrays["since"],
            )  # fmt: skip
            key = about["key"]
            scene_from_arrays(snapshot.scene)  # what a fit continues from: here its errors name the file
        except (*UNSOUND, ValueError) as error:
            raise ValueError(
                f"{self.path}: not a sound checkpoint; {type(error).__name__}: {error}. Delete it to begin anew."
            ) from None
        if key != self.key:
            raise ValueError(
                f"{self.path}: expected a checkpoint of this fit; it belongs to other videos, offsets or options. "
                "Choose another path, or delete it to begin anew."
            )
        return snapshot


def _tensors(arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    return {name: torch.from_numpy(np.array(array)) for name, array in arrays.items()}


def key_of(arrays: Iterable[np.ndarray], *options: Any) -> str:
    """A hash of all that decides a fit's result: its arrays, and the text of its options."""
    digest = hashlib.blake2b(repr(options).encode(), digest_size=16)
    for array in arrays:
        array = np.ascontiguousarray(array)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.view(np.uint8).reshape(-1).data if array.size else b"")
    return digest.hexdigest()
