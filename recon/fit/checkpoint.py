"""Checkpoints of a fit: plain arrays in one file, written whole or not at all; those of another fit are refused."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from otsync.files.arrays import read_npz, write_npz
from otsync.files.strict import in_words
from recon.fit.problem import scene_groups
from recon.scene.gaussians4d import UNSOUND, scene_from_arrays

FORMAT, VERSION = "otsync.fit", 1


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A fit between two steps.

    Args:
        step, steps: done, and in all.
        scene: arrays of the scene as it stood (constants of the motion too: densification changes them).
        groups, moments: the optimiser's parameters and averages.
        history: one row per record, see :class:`recon.fit.History`. since: (loss, psnr) of the images since the last
            row.
        densified: how often the scene was made denser. pull: [2,N] what that is decided by, gathered since the last
            time.
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
        about = {
            "format": FORMAT,
            "version": VERSION,
            "key": self.key,
            "step": snapshot.step,
            "steps": snapshot.steps,
            "densified": snapshot.densified,
        }
        arrays = {
            "fit": np.frombuffer(json.dumps(about).encode(), np.uint8),
            "history": snapshot.history,
            "since": snapshot.since,
            "pull": snapshot.pull.cpu().numpy(),
        }
        arrays |= {f"scene/{k}": v for k, v in snapshot.scene.items()}
        for part in ("groups", "moments"):
            arrays |= {f"{part}/{k}": v.detach().cpu().numpy() for k, v in getattr(snapshot, part).items()}
        write_npz(self.path, arrays)
        self._last = time.monotonic()

    def load(self, groups: Mapping[str, Tensor]) -> Snapshot | None:
        """The last snapshot; None when there is none. ValueError for a damaged file or one of another fit.

        groups: what the fit begins with. The snapshot has the same ones, of the same types and shapes, but for the
        number of nodes and Gaussians, which is that of its own scene.
        """
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
                int(about["step"]),
                int(about["steps"]),
                parts["scene"],
                _tensors(parts["groups"]),
                _tensors(parts["moments"]),
                arrays["history"],
                int(about["densified"]),
                torch.from_numpy(np.array(arrays["pull"])),
                arrays["since"],
            )
            key = about["key"]
            scene = scene_from_arrays(snapshot.scene)  # what a fit continues from: here its errors name the file
        except (*UNSOUND, ValueError) as error:
            raise ValueError(
                f"{self.path}: not a sound checkpoint; {in_words(error)}. Delete it to begin anew."
            ) from None
        if key != self.key:
            raise ValueError(
                f"{self.path}: expected a checkpoint of this fit; it belongs to other videos, offsets or options. "
                "Choose another path, or delete it to begin anew."
            )
        own = scene_groups(scene)
        beside = {name: tensor for name, tensor in groups.items() if name not in own}
        wrong = "; ".join(_misfits(snapshot, own | beside, set(groups), len(scene)))
        if wrong:
            raise ValueError(f"{self.path}: not a sound checkpoint; {wrong}. Delete it to begin anew.")
        return snapshot


def _misfits(snapshot: Snapshot, expected: Mapping[str, Tensor], names: set[str], gaussians: int) -> Iterator[str]:
    """What of a snapshot is not as the fit needs it; ``expected``: its groups as its scene has them."""
    if set(snapshot.groups) != names or set(expected) != names:
        found = set(snapshot.groups) | (set(expected) - names)
        yield f"groups: expected {', '.join(sorted(names))}; found {', '.join(sorted(found))}"
        return
    for name, tensor in expected.items():
        yield from _misfit(f"groups/{name}", snapshot.groups[name], tensor.shape, _type(tensor))
    for name, moment in snapshot.moments.items():
        group, _, kind = name.rpartition(".")
        if group not in expected or kind not in ("step", "exp_avg", "exp_avg_sq"):
            yield f"moments/{name}: expected step, exp_avg or exp_avg_sq of a group"
        elif kind == "step":
            yield from _misfit(f"moments/{name}", moment, (), "float32")
        else:
            yield from _misfit(f"moments/{name}", moment, expected[group].shape, _type(expected[group]))
    yield from _misfit("pull", snapshot.pull, (2, gaussians), "float32")
    rows = {"history": (snapshot.history, 4 + len(expected["offsets"])), "since": (snapshot.since, 2)}
    for name, (array, columns) in rows.items():
        yield from _misfit(name, array, (*array.shape[:1], columns), "float64")


def _misfit(name: str, found: Tensor | np.ndarray, shape: Sequence[int], dtype: str) -> Iterator[str]:
    if tuple(found.shape) != tuple(shape) or _type(found) != dtype:
        yield f"{name}: expected {dtype} of shape {tuple(shape)}; found {_type(found)} of shape {tuple(found.shape)}"


def _type(x: Tensor | np.ndarray) -> str:
    return str(x.dtype).removeprefix("torch.")


def _tensors(arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    return {name: torch.from_numpy(np.array(array)) for name, array in arrays.items()}
