"""A motion class driven by motion capture: a BVH file, or an AMC file with its ASF skeleton."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from .body import Parts, capsule_area
from .scenes import Scene
from .skeleton_files import Clip, read_amc, read_bvh

CMU_UNIT = 0.0254 / 0.45  # m: the CMU database measures in inches / 0.45
_UNITS = (CMU_UNIT, 0.01, 1.0, 0.001)
_HEIGHT = (1.2, 2.4)  # m, of a rest pose that makes sense
_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # captures have y up, worlds z


@dataclass(frozen=True)
class Mocap:
    """A scene that replays a captured motion, from a start that the seed draws.

    Between captured frames joint quaternions and the root follow cubic splines; before the first and after the last
    frame the motion runs backwards.

    Args:
        path: a ``.bvh`` or ``.amc`` file.
        skeleton: the ``.asf`` of an AMC; None: beside it, by the name of its subject (``11.asf`` for ``11_01.amc``).
        unit: m; None: that of the CMU database, centimetres, metres or millimetres, the first that makes a person
            1.2 to 2.4 m tall.
        start: s into the file at world time 0; None: drawn.
    """

    path: str | Path
    skeleton: str | Path | None = None
    unit: float | None = None
    start: float | None = None

    def __call__(self, rng: np.random.Generator) -> Scene:
        path = Path(self.path)
        stat = path.stat() if path.exists() else None
        figure = _load(path, self._skeleton(), self.unit, stat and (stat.st_mtime_ns, stat.st_size))
        duration = figure.duration
        start = rng.uniform(min(2.0, duration / 3), max(duration - 8.0, duration / 3))
        turn = rng.uniform(0, 2 * np.pi)
        return figure.scene(start if self.start is None else self.start, turn)

    def _skeleton(self) -> Path | None:
        path = Path(self.path)
        if path.suffix.lower() == ".bvh":
            return None
        if path.suffix.lower() != ".amc":
            raise ValueError(f"{path}: expected a .bvh or an .amc file; found {path.suffix or 'no suffix'!r}.")
        beside = [path.with_name(f"{stem}.asf") for stem in (path.stem.split("_")[0], path.stem)]
        skeleton = Path(self.skeleton) if self.skeleton else next((p for p in beside if p.exists()), None)
        if skeleton is None:
            raise ValueError(f"skeleton: expected the .asf file of {path}; found none beside it. Give its path.")
        return skeleton


@dataclass(frozen=True, eq=False)
class _Figure:
    """A captured motion in metres with z up, continuous in time."""

    parts: Parts
    joints: np.ndarray  # (P,) joint of every part
    parents: np.ndarray
    offsets: np.ndarray
    turns: Callable[[np.ndarray], np.ndarray]  # s -> (T,J,4)
    root: Callable[[np.ndarray], np.ndarray]  # s -> (T,3)
    duration: float

    def scene(self, start: float, turn: float) -> Scene:
        around = Rotation.from_rotvec([0, 0, turn]).as_matrix()
        path = self.root(self._inside(start + np.linspace(-1.0, 6.0, 50)))[:, :2]
        middle = np.append(0.5 * (path.min(0) + path.max(0)), 0.0)
        reach = float(np.linalg.norm(path - middle[:2], axis=1).max())

        def pose(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            R, p = self.joint_poses(self._inside(start + t))
            return around @ R[self.joints], (p[self.joints] - middle) @ around.T

        return Scene(self.parts, pose, distance=max(3.2, 2.2 + reach))

    def _inside(self, t: np.ndarray) -> np.ndarray:
        """Time within the capture; to and fro beyond its ends."""
        return self.duration - np.abs(np.mod(t, 2 * self.duration) - self.duration)

    def joint_poses(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(J,T,3,3), (J,T,3) of all joints at seconds ``t`` of the file."""
        q = self.turns(t)
        local = Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:2], 3, 3).swapaxes(0, 1)
        return _chain(self.parents, self.offsets, local, self.root(t))


def _chain(
    parents: np.ndarray, offsets: np.ndarray, local: np.ndarray, root: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    R, p = np.empty(local.shape), np.empty(local.shape[:3])
    R[0], p[0] = _Y_UP @ local[0], root
    for j in range(1, len(parents)):
        R[j] = R[parents[j]] @ local[j]
        p[j] = p[parents[j]] + R[parents[j]] @ offsets[j]
    return R, p


@lru_cache(maxsize=4)
def _load(path: Path, skeleton: Path | None, unit: float | None, _version: tuple[int, int] | None) -> _Figure:
    clip = read_bvh(path) if skeleton is None else read_amc(path, skeleton)
    eye = np.broadcast_to(np.eye(3), (len(clip.names), 1, 3, 3))
    R, p = _chain(clip.parents, clip.offsets, eye, np.zeros((1, 3)))
    ends = np.concatenate([p[:, 0], p[:, 0] + np.einsum("jab,jb->ja", R[:, 0], clip.tips)])
    tall = np.ptp(ends[:, 2])
    scale = unit or next((u for u in _UNITS if _HEIGHT[0] <= u * tall <= _HEIGHT[1]), None)
    if scale is None or not np.isfinite(scale) or scale <= 0:
        raise ValueError(
            f"{path}: expected a skeleton of a person's height in CMU units, cm, m or mm; found {tall:g} units. "
            "Give Mocap(unit=) in metres."
        )
    joints, parts = _limbs(clip, scale, R[:, 0], scale * p[:, 0], scale * float(ends[:, 2].min()))
    # frame 0 of converted files is often a T pose that the subject never took
    turns, root = clip.rotations[1:], scale * clip.root[1:] @ _Y_UP.T
    root[:, 2] -= min(0.0, _lowest_foot(clip, scale, turns, root))
    seconds = np.arange(len(turns)) / clip.fps
    if len(seconds) < 4:
        raise ValueError(f"{path}: expected at least 5 frames of motion; found {len(clip.root)}.")
    quats = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_quat().reshape(*turns.shape[:2], 4)
    flips = np.cumprod(np.where(np.einsum("fjq,fjq->fj", quats[1:], quats[:-1]) < 0, -1.0, 1.0), axis=0)
    quats[1:] *= flips[..., None]
    return _Figure(
        parts,
        joints,
        clip.parents,
        scale * clip.offsets,
        CubicSpline(seconds, quats),
        CubicSpline(seconds, root),
        float(seconds[-1]),
    )


def _lowest_foot(clip: Clip, scale: float, turns: np.ndarray, root: np.ndarray) -> float:
    some = slice(None, None, max(1, len(turns) // 64))
    _, p = _chain(clip.parents, scale * clip.offsets, turns[some].swapaxes(0, 1), root[some])
    return float(p[..., 2].min())


def _limbs(clip: Clip, scale: float, R: np.ndarray, p: np.ndarray, floor: float) -> tuple[np.ndarray, Parts]:
    """Capsules around the bones longer than 3 cm, thick in the trunk; left and right share a kind by their names."""
    lengths = scale * np.linalg.norm(clip.tips, axis=1)
    joints = np.flatnonzero(lengths > 0.03)
    if not len(joints):
        raise ValueError(
            f"expected bones longer than 3 cm; the longest has {100 * lengths.max():.2g} cm. Set the unit."
        )
    names = [clip.names[j] for j in joints]
    sideless = [_sideless(n) for n in names]
    kinds = {n: k for k, n in enumerate(dict.fromkeys(sideless))}
    trunk = np.array(
        [n == s and not any(w in n.lower() for w in ("head", "neck")) for n, s in zip(names, sideless, strict=True)]
    )
    radius = np.where(trunk, 0.12, np.clip(0.22 * lengths[joints], 0.02, 0.085))
    n = len(joints)
    start, end = np.zeros((n, 3)), scale * clip.tips[joints]
    radii = np.repeat(radius[:, None], 3, 1)
    return joints, Parts(
        object=np.zeros(n, int),
        limb=np.arange(n),
        kind=np.array([kinds[s] for s in sideless]),
        figure=np.ones(n, bool),
        start=start,
        end=end,
        radii=radii,
        box=np.zeros(n, bool),
        rest_rotation=R[joints],
        rest_position=p[joints] - [0, 0, floor],
        weight=capsule_area(start, end, radii),
    )


def _sideless(name: str) -> str:
    """A bone's name without its side: LeftArm and RightArm, lfemur and rfemur, LThumb and RThumb are pairs."""
    for side in ("Left", "Right", "left", "right"):
        if name.startswith(side):
            return name[len(side) :]
    if len(name) > 2 and name[0] in "LR" and name[1].isupper():
        return name[1:]
    if len(name) > 2 and name[0] in "lr" and name not in ("root", "lowerback", "lowerneck"):
        return name[1:]
    return name
