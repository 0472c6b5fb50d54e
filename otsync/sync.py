"""Offsets of all videos from their pairs: ``synchronize(tracks)`` (paper, Sec. 3.4: a star around the reference)."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .align import Aligner, align
from .match import Matcher, match
from .refine import Refiner, refine
from .types import Alignment, Matches, Offsets, Status, TrackSet

log = logging.getLogger("otsync")

Pair = tuple[int, int]
MapLike = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


def synchronize(
    tracks: Sequence[TrackSet],
    *,
    reference: int = 0,
    matcher: Matcher | None = None,
    aligner: Aligner | None = None,
    refiner: Refiner | None = None,
    matches: Mapping[Pair, Matches] | None = None,
    map: MapLike = map,
) -> Offsets:
    """Put every video on the reference's clock.

    Args:
        tracks: one set per video, all in one world frame.
        reference: index of the video whose clock is the world's.
        matcher, aligner, refiner: the algorithms of each stage; None takes the default (no refinement without one).
        matches: ``{(i, j): Matches}`` of your own; those pairs skip matching and no others are tried.
        map: any map-like callable: the builtin, an executor's, dask's.

    A pair that fails gets a status and nan; the others live. Wrong input raises ValueError before any work.
    """
    check_tracks(tracks, reference)
    started = time.perf_counter()
    jobs = []
    for v in range(len(tracks)):
        if v == reference:
            continue
        given = given_matches(matches, (reference, v), tracks)
        if matches is None or given is not None:
            jobs.append(Job((reference, v), tracks[reference], tracks[v], matcher, aligner, refiner, given))
    answers = list(map(run, jobs))
    return star(tracks, reference, answers, time.perf_counter() - started)


@dataclass(frozen=True, eq=False)
class Job:
    """What one pair needs, self-contained so that any executor can carry it."""

    pair: Pair
    a: TrackSet
    b: TrackSet
    matcher: Matcher | None
    aligner: Aligner | None
    refiner: Refiner | None
    matches: Matches | None


def run(job: Job) -> tuple[Pair, Matches, Alignment]:
    """Match, align and refine one pair. An exception becomes the status FAILED, told in the log."""
    matches = Matches(np.zeros((0, 2), int), status=Status.FAILED, flags=(Status.FAILED,))
    try:
        found_matches = job.matches if job.matches is not None else match(job.a, job.b, job.matcher, throw=False)
        matches = found_matches.without_plan()
        if not matches.status.ok:
            failed = Alignment(float("nan"), status=matches.status, flags=matches.flags, stats=matches.stats)
            return job.pair, matches, failed
        found = align(job.a, job.b, matches, job.aligner, throw=False)
        if job.refiner is not None and np.isfinite(found.offset):
            found = refine(job.a, job.b, matches, found, job.refiner, throw=False)
        return job.pair, matches, found
    except Exception as error:
        log.warning("pair %s: %s: %s", job.pair, type(error).__name__, error)
        return job.pair, matches, Alignment(float("nan"), status=Status.FAILED, flags=(Status.FAILED,))


def star(
    tracks: Sequence[TrackSet], reference: int, answers: list[tuple[Pair, Matches, Alignment]], seconds: float
) -> Offsets:
    """Every video's offset is its pair's with the reference."""
    alignments = {pair: alignment for pair, _, alignment in answers}
    V = len(tracks)
    offset, rate, sigma = np.full(V, np.nan), np.ones(V), np.full(V, np.nan)
    offset[reference] = sigma[reference] = 0.0
    status, flags = [Status.OK] * V, [()] * V  # type: list[Status], list[tuple[Status, ...]]
    for v in range(V):
        if v == reference:
            continue
        found = alignments.get((reference, v))
        if found is None:
            status[v], flags[v] = Status.DISCONNECTED, (Status.DISCONNECTED,)
            continue
        offset[v], rate[v], sigma[v] = found.offset, found.rate, found.sigma
        status[v], flags[v] = found.status, found.flags
    return Offsets(
        names=unique_names(tracks),
        fps=np.array([t.fps for t in tracks], float),
        seconds=offset,
        rates=rate,
        sigma=sigma,
        reference=reference,
        component=np.full(V, reference),
        status=tuple(status),
        flags=tuple(flags),
        alignments=alignments,
        matches={pair: matches for pair, matches, _ in answers},
        stats={"seconds": seconds, "pairs": float(len(alignments))},
    )


def check_tracks(tracks: Sequence[TrackSet], reference: int) -> None:
    """ValueError unless there are at least two sound track sets and the reference is one of them."""
    if isinstance(tracks, TrackSet) or len(tracks) < 2:
        raise ValueError("tracks: expected a sequence of at least two track sets, one per video; found fewer.")
    if not -len(tracks) <= reference < len(tracks):
        raise ValueError(f"reference: expected an index of the {len(tracks)} videos; found {reference}.")
    for v, t in enumerate(tracks):
        t.check(f"tracks[{v}]")
    frames = {t.frame for t in tracks if t.frame is not None}
    if len(frames) > 1:
        raise ValueError(f"tracks: expected one world frame; found {sorted(frames)}. Bring the positions into one.")


def given_matches(matches: Mapping[Pair, Matches] | None, pair: Pair, tracks: Sequence[TrackSet]) -> Matches | None:
    """The matches that the caller brought for ``pair``, in its order; (j, i) serves (i, j)."""
    if matches is None:
        return None
    i, j = pair
    found = matches[pair] if pair in matches else matches[j, i].swapped() if (j, i) in matches else None
    if found is not None:
        found.check(f"matches[{pair}]", len(tracks[i]), len(tracks[j]))
    return found


def unique_names(tracks: Sequence[TrackSet]) -> tuple[str, ...]:
    """The videos' names; ``video3`` for a nameless one, ``name~2`` for a repeated one."""
    names: list[str] = []
    for v, t in enumerate(tracks):
        name = base = t.name or f"video{v}"
        n = 1
        while name in names:
            n += 1
            name = f"{base}~{n}"
        names.append(name)
    return tuple(names)
