"""Whether a clock holds where it was mended, or where it was not: what the pairs say beside a break."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from ...clocks.cuts import Steps, unexplained
from ...types import Break, Clock, Status, TrackSet, mended_times
from ..graph import Pair
from ..verdict import NOTHING_COMMON, Answer, Verdict
from .breaks import SIGMAS, Seen, Suspect, remeasured, runs_on, suspects


def cut_where_it_holds(
    answers: Sequence[Answer],
    filmed: Sequence[TrackSet],
    tracks: Sequence[TrackSet],
    broken: Mapping[int, tuple[Break, ...]],
) -> set[Pair]:
    """The pairs in whose overlap a video shows a clear cut that no break of its clock explains, and whose answer does
    not hold beside it. What jumps in the scene is no cut: there it holds.

    Args:
        filmed: as they were filmed, on their videos' own clocks. tracks: on the clocks of the answers.
    """
    shown = []  # (K,2) per video: the moments of the frames before and behind each cut
    for v, video in enumerate(filmed):
        steps, breaks = Steps.of(video), broken.get(v, ())
        behind = unexplained(steps, breaks)
        shown.append(mended_times(steps.times, breaks)[0][np.stack([behind - 1, behind], 1)])
    found = set()
    for answer in answers:
        a, b = answer.pair
        if not answer.finite or not len(shown[a]) + len(shown[b]):
            continue
        clock = Clock(answer.refined.offset, answer.refined.rate)
        for before, behind in (*shown[a], *clock.world(shown[b])):
            if not runs_on(answer, tracks[a], tracks[b], float(before), float(behind)):
                found.add(answer.pair)
    return found


def steady_beside(fresh: Mapping[Pair, Answer], tracks: Sequence[TrackSet], v: int, found: Break) -> bool:
    """Whether most pairs of video v agree that its mended clock runs evenly up to the break and from it on."""
    told = []
    for (i, j), answer in fresh.items():
        if not np.isfinite(answer.refined.offset) or not answer.sound:
            continue
        shown = found.at + found.jump
        moments = (shown if found.still > 0 else found.at), shown
        clock = Clock(answer.refined.offset, answer.refined.rate)
        before, behind = moments if v == i else (clock.world(m) for m in moments)
        told.append(runs_on(answer, tracks[i], tracks[j], before, behind))
    return 2 * sum(told) >= len(told)


def seen_of(verdict: Verdict, tracks: Sequence[TrackSet]) -> list[Seen]:
    """What the pairs without any doubt see of their videos."""
    sound = [a for a in verdict.answers if a.refined.status.ok and a.finite]
    return [seen for a in sound for seen in Seen.by(a, tracks[a.pair[0]], tracks[a.pair[1]])]


def suspected(verdict: Verdict, tracks: Sequence[TrackSet], fps: Sequence[float]) -> list[Suspect]:
    """Breaks that were not mended, and that no pair which sees both sides of them speaks against.

    A pair that is ambiguous accuses nobody: what suits a part of it at another time may be motion that comes again.
    """
    doubtful = [
        a
        for a in verdict.answers
        if len(a.scanned.parts)
        and Status.BROKEN_CLOCK in a.refined.flags
        and not {*NOTHING_COMMON, Status.AMBIGUOUS} & set(a.refined.flags)
    ]
    sound = seen_of(verdict, tracks)
    named = [s for a in doubtful for s in suspects(a, tracks[a.pair[0]], tracks[a.pair[1]], fps)]
    return [s for s in named if not any(seen.across(s) for seen in sound)]


def confirmed(found: Break, left: Break | None) -> Break:
    """A pause that was counted, and what the pairs measure after it was mended: where they contradict, by how much is
    its sigma. A performer who rests right beside a pause makes it look longer.
    """
    if left is None or abs(left.jump - found.jump) <= SIGMAS * left.sigma:
        return found
    return dataclasses.replace(found, sigma=float(np.hypot(left.sigma, left.jump - found.jump)))


def remeasured_jump(fresh: Mapping[Pair, Answer], tracks: Sequence[TrackSet], v: int, found: Break) -> Break | None:
    """The break with what all pairs say is left of its jump; None where none can."""
    told, sigmas = [], []
    for (i, j), answer in fresh.items():
        if not np.isfinite(answer.refined.offset) or not answer.sound:
            continue
        clock = Clock(answer.refined.offset, answer.refined.rate)
        shown = found.at + found.jump
        left, sigma = remeasured(answer, tracks[i], tracks[j], shown if v == i else clock.world(shown))
        if np.isfinite(sigma):
            told.append(left if v == j else -left)
            sigmas.append(sigma)
    if not told:
        return None
    sigma = float(np.median(sigmas)) / np.sqrt(len(sigmas))
    return dataclasses.replace(found, jump=found.jump + float(np.median(told)), sigma=sigma)
