"""What plain solvers make of the rows: POT and tslearn called directly, as their manuals show, and nothing around them.

Their outcome stands in the page beside otsync's; it is run, never written by hand.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ...geometry import fundamental, sampson
from ...types import Alignment, Clock, Matches, Offsets, TrackSet
from .case import Case

MOST = 2000
"""Tracks from which a plain solver's dense matrices are not tried."""


def matching(a: TrackSet, b: TrackSet) -> Matches:
    """``ot.gromov.fused_gromov_wasserstein`` on cosine distances and D_track, each track's likest partner in the plan.

    Without features ``ot.gromov.gromov_wasserstein``, without positions ``ot.emd``.
    """
    import ot

    p, q = ot.unif(len(a)), ot.unif(len(b))
    M = None if a.features is None or b.features is None else cosine(a.features, b.features)
    if a.xyz is None or b.xyz is None:
        plan = ot.emd(p, q, M)
    else:
        Ca, Cb = (farthest(np.asarray(x.xyz)) for x in (a, b))
        if M is None:
            plan = ot.gromov.gromov_wasserstein(Ca, Cb, p, q, "square_loss")
        else:
            plan = ot.gromov.fused_gromov_wasserstein(M, Ca, Cb, p, q, "square_loss", alpha=0.5)
    return likest(np.asarray(plan))


def rematching(a: TrackSet, b: TrackSet, clock: Clock) -> Matches:
    """``ot.emd`` on the mean distance at equal frames."""
    import ot

    late = round(clock.offset * (a.fps or 30))
    common = min(a.n_frames - late, b.n_frames)
    x, y = np.asarray(a.xyz)[:, late : late + common], np.asarray(b.xyz)[:, :common]
    D = np.linalg.norm(x[:, None] - y[None], axis=-1).mean(-1)
    return likest(ot.emd(ot.unif(len(a)), ot.unif(len(b)), D))


def aligning(a: TrackSet, b: TrackSet, matches: Matches) -> Alignment:
    """``tslearn.metrics.dtw_path_from_metric`` on D_geo, and the most frequent offset of its path."""
    i, j = matches.pairs.T
    x, y = np.asarray(a.xyz)[i], np.asarray(b.xyz)[j]
    D = np.zeros((x.shape[1], y.shape[1]))
    for p, q in zip(x, y, strict=True):
        D += np.abs(p[:, None] - q[None]).sum(-1) / len(x)
    return most_frequent(D, a.fps or 30)


def scanning(a: TrackSet, b: TrackSet, matches: Matches) -> Alignment:
    """The same on the mean epipolar distance of the matched pixels."""
    assert a.camera is not None and b.camera is not None and a.uv is not None and b.uv is not None
    F = fundamental(a.camera, b.camera)
    i, j = matches.pairs.T
    D = np.zeros((a.n_frames, b.n_frames))
    for p, q in zip(a.uv[i], b.uv[j], strict=True):
        here, there = np.repeat(p, len(q), 0), np.tile(q, (len(p), 1))
        D += np.abs(sampson(F, here, there)).reshape(D.shape) / len(i)
    return most_frequent(D, a.fps or 30)


def graph(tracks: list[TrackSet], matches: dict[tuple[int, int], Matches] | None) -> Offsets:
    """The star of the paper: every video with the first, by the plain solvers above."""
    seconds = [0.0]
    for v in range(1, len(tracks)):
        pair = matching(tracks[0], tracks[v]) if matches is None else matches[0, v]
        seconds.append(aligning(tracks[0], tracks[v], pair).offset)
    n = len(tracks)
    return Offsets(
        names=tuple(str(v) for v in range(n)),
        fps=np.full(n, 30.0),
        seconds=np.array(seconds),
        rates=np.ones(n),
        sigma=np.full(n, np.nan),
        reference=0,
        component=np.zeros(n, int),
        flags=((),) * n,
    )


def outcome(case: Case, solver: Any) -> str:
    """What the plain solver makes of a row, in words."""
    try:
        given = case.make()
    except ValueError:
        return "not run: the data cannot be built"
    sizes = [len(x) for x in given if isinstance(x, TrackSet)]
    if max(sizes, default=0) > MOST:
        return f"not run: {8 * max(sizes) ** 2 / 2**30:.0f} GiB a matrix"
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            with np.errstate(all="ignore"):
                said = words(case, solver(*given))
        except Exception as error:  # whatever it raises is its answer
            said = f"{type(error).__name__}: {' '.join(str(error).split())[:60]}".replace("|", "/")
    return said + ("; warns" if warned else "")


def words(case: Case, answer: Matches | Alignment | Offsets) -> str:
    """Right, or wrong without a word: plain solvers have no flags."""
    if isinstance(answer, Alignment) and not np.isfinite(answer.offset):
        return "nan"
    if isinstance(answer, Matches) and answer.plan is not None:
        plan = np.asarray(answer.plan)
        if not np.isfinite(plan).all():
            return "nan"
        if not plan.any():
            return "a plan of zeros"
        if plan.size > 1 and np.ptp(plan) <= 1e-9 * plan.max():
            return "the product plan, without a word"
    if case.expect == ("flagged",) or case.check is None:
        done = "right" not in case.expect
        if isinstance(answer, Offsets) and case.check is not None:
            done = not np.asarray(case.check(answer)).all()
        return "an answer, without a word" if done else "right"
    return "right" if bool(np.all(case.check(answer))) else "wrong, without a word"


def cosine(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """``1 - cos`` of all pairs of rows."""
    x, y = (z / np.linalg.norm(z, axis=1, keepdims=True) for z in (x, y))
    return 1 - x @ y.T


def farthest(x: np.ndarray) -> np.ndarray:
    """D_track as written, over all frames, seen or not."""
    return np.max([np.linalg.norm(x[:, None, t] - x[None, :, t], axis=-1) for t in range(x.shape[1])], axis=0)


def likest(plan: np.ndarray) -> Matches:
    """Each track's largest entry of the plan, ranked by it."""
    j = np.argmax(np.nan_to_num(plan, nan=-1.0), axis=1)
    i = np.arange(len(plan))
    return Matches(np.stack([i, j], 1), np.nan_to_num(plan[i, j]), plan)


def most_frequent(D: np.ndarray, fps: float) -> Alignment:
    """The mode of the offsets on DTW's path."""
    from tslearn.metrics import dtw_path_from_metric

    path, _ = dtw_path_from_metric(D, metric="precomputed")
    steps = np.asarray(path)
    values, counts = np.unique(steps[:, 0] - steps[:, 1], return_counts=True)
    if not np.isfinite(D).all():
        return Alignment(float("nan"))
    return Alignment(float(values[np.argmax(counts)]) / fps, fps=fps)
