"""Static cameras that a mapper leaves out, put where their matches with all others say: likely right, never confirmed.

A leaf like :mod:`otsync.calibrate.poses`: it needs poselib.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from .clips import Lens
from .mapping import Model, Pictures, found_camera, lenses_found

LEAST, SHARE = 30, 0.2
"""Matches that must agree on the pose, and the share of all which they must be."""

OF_A_HALF = 10
"""Matches that must agree when half of them are left out, for the halves to tell how sure the pose is."""

ERROR = 1.0
"""Pixels at 640 of width that a match may lie off its epipolar line. More lets in matches of repeated things nearby: on
the dome 2 pixels turn a camera by 2.3 degrees, 1 pixel by .8."""

TRIALS = {"min_iterations": 3000, "max_iterations": 20000}
"""Of the search: a third of the matches may be right, and six of them must be at once."""

Matches = Mapping[tuple[int, int], Float[np.ndarray, "N 4"]]


def with_left_out(model: Model, matches: Matches, pictures: Pictures) -> Model:
    """The model and the static cameras that it lacks, where their lens is known and enough of their matches agree.

    A mapper places a picture by points that others see already; of a picture with few matches nearly none are. Here all
    matches with all pictures that are placed speak at once, seen from one rig (the generalised relative pose of six
    matches; Stewénius, Nistér, Oskarsson and Åström 2005), and the others stay where they are. Nothing confirms such a
    camera: the verdict names it doubtful, with what to film.
    """
    lenses = lenses_found(model, pictures.lenses)
    have = {int(pictures.of[p]) for p in model.pictures}
    videos = [(p, int(v)) for p, v in enumerate(pictures.of)]
    lost = [p for p, v in videos if v not in have and not pictures.moving[v] and lenses[v].known]
    while lost:
        # the surest first: the others' matches with it are heard, too
        tried = {p: _found(model, p, matches, pictures, lenses) for p in lost}
        known = {p: one for p, one in tried.items() if one is not None}
        if not known:
            break
        surest = max(known, key=lambda p: known[p].share)
        model = _placed(model, surest, known[surest])
        lost.remove(surest)
    return model


@dataclass(frozen=True, eq=False)
class Found:
    """The pose of a picture that was left out, by all its matches and by either half of those that agree; and which
    share of its matches agree.
    """

    w2c: Float[np.ndarray, "4 4"]
    halves: Float[np.ndarray, "H 4 4"]
    share: float


def _found(model: Model, p: int, matches: Matches, pictures: Pictures, lenses: Sequence[Lens]) -> Found | None:
    """Where a picture was taken; None where too few of its matches agree."""
    seen = [(n, _from(matches, int(q), p)) for n, q in enumerate(model.pictures)]
    seen = [(n, uv) for n, uv in seen if len(uv)]
    total = sum(len(uv) for _, uv in seen)
    if total < LEAST:
        return None
    of = [*(int(model.pictures[n]) for n, _ in seen), p]
    each = [lenses[int(pictures.of[q])] for q in of]
    error = ERROR * max(max(pictures.pictures[p].image.shape[:2]) / 640, 0.5)
    w2c, agree = rig_pose(model.w2c, seen, each, error)
    count = int(sum(map(np.count_nonzero, agree)))
    if count < max(LEAST, SHARE * total):
        return None
    kept = [(n, uv[good]) for (n, uv), good in zip(seen, agree, strict=True)]
    parts = [rig_pose(model.w2c, [(n, uv[k::2]) for n, uv in kept], each, error) for k in (0, 1)]
    halves = [pose for pose, good in parts if sum(map(np.count_nonzero, good)) >= OF_A_HALF]
    return Found(w2c, np.array(halves).reshape(-1, 4, 4), count / total)


def _from(matches: Matches, other: int, p: int) -> Float[np.ndarray, "N 4"]:
    """Matches of two pictures: pixels in the other one, then in picture ``p``."""
    uv = matches.get((min(other, p), max(other, p)), np.zeros((0, 4)))
    return uv if other < p else uv[:, [2, 3, 0, 1]]


def _placed(model: Model, p: int, found: Found) -> Model:
    """The model with one more picture."""
    at = int(np.searchsorted(model.pictures, p))
    both = len(model.halves) == len(found.halves) == 2
    return replace(
        model,
        pictures=np.insert(model.pictures, at, p),
        w2c=np.insert(model.w2c, at, found.w2c, 0),
        seen=model.seen + np.stack([model.seen[:, 0] >= at, np.zeros(len(model.seen), bool)], 1),
        halves=np.insert(model.halves, at, found.halves, 1) if both else model.halves[:0],
    )


def rig_pose(
    w2c: Float[np.ndarray, "P 4 4"], seen: Sequence[tuple[int, np.ndarray]], lenses: Sequence[Lens], error: float
) -> tuple[Float[np.ndarray, "4 4"], list[np.ndarray]]:
    """World to camera of one picture from matches with several that are placed, and which matches agree within
    ``error`` pixels, by picture.

    Args:
        seen: (index into ``w2c``, (N,4) pixels there and in the picture). lenses: of these, and of the picture.
    """
    import poselib

    def pose_of(matrix: np.ndarray) -> Any:
        pose = poselib.CameraPose()
        pose.R, pose.t = matrix[:3, :3], matrix[:3, 3]
        return pose

    pairs = []
    for k, (_, uv) in enumerate(seen):
        pair = poselib.PairwiseMatches()
        pair.cam_id1, pair.cam_id2, pair.x1, pair.x2 = k, 0, uv[:, :2], uv[:, 2:]
        pairs.append(pair)
    cameras = [found_camera(lens) for lens in lenses]
    rig = [pose_of(w2c[n]) for n, _ in seen]
    options = {"max_epipolar_error": error, "seed": 0, **TRIALS}
    found, info = poselib.estimate_generalized_relative_pose(
        pairs, rig, cameras[:-1], [pose_of(np.eye(4))], cameras[-1:], options, {}
    )
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = found.R, found.t
    return out, [np.asarray(good, bool) for good in info["inliers"]]
