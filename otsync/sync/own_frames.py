"""``synchronize(tracks, frames="own")``: clocks and frames of reference of many videos that share neither."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..clocks.shutter import at_frame_times
from ..compute.threads import MapLike
from ..frames import OwnFrames
from ..frames.clouds import sizes
from ..frames.weighing import SAME_TIME, SAME_TURN
from ..match.slot import Matcher, MatcherLike
from ..match.synchronous import longest_seen
from ..types import Alignment, Clock, Matches, Similarity, Status, TrackSet, in_order
from ..types.trust import Trust
from .graph import Graph, Pair
from .lags import Lag, with_lags
from .poses import ASTRAY, Link, Poses, place
from .verdict import Answer, Refit, Verdict, judge

log = logging.getLogger("otsync")

Frames = Literal["common", "own"]
"""Whether the positions of all videos are in one frame of reference, or each in one of its own."""

COMPLETE = 16
"""Up to so many videos all pairs are compared: opposite views fail, so that every video needs its neighbours."""

NEAR_TIME, NEAR_TURN = 3 / 30, 12.0
"""Seconds and degrees within which a pair that begins at the graph's prediction must stay to count."""

SOME = 300
"""Tracks that tell where a video's scene lies and how large it is."""

ASTRAY_TIME = 1.5 / 30
"""Seconds by which a pair may contradict the clocks of the graph before its similarity is left out."""

LINK_ROTATION, LINK_SCALE = 6.0, 0.08
"""Sigmas, degrees and share, up to which a pair with a loose pose still ties two videos: many such ties make a firm
pose, and its clock is as good as any."""


@dataclass(frozen=True, eq=False)
class OwnJob:
    """What one pair needs, self-contained so that any executor can carry it. start: instead of the search."""

    pair: Pair
    a: TrackSet
    b: TrackSet
    solver: OwnFrames
    start: tuple[Clock, Similarity] | None = None


def run_own(job: OwnJob) -> Answer:
    """Clock and similarity of one pair. An exception becomes the status FAILED, told in the log."""
    try:
        matches, found = job.solver(job.a, job.b, job.start)
        found = as_tie(found)
        return Answer(job.pair, matches, found, found)
    except Exception as error:
        log.warning("pair %s: %s: %s", job.pair, type(error).__name__, error)
        failed = Alignment(float("nan"), flags=(Status.FAILED,))
        return Answer(job.pair, Matches(np.zeros((0, 2), int), flags=(Status.FAILED,)), failed, failed)


def as_tie(found: Alignment) -> Alignment:
    """Without LOOSE_POSE and COARSE where the pose is firm enough to tie two videos; :func:`with_pose_flags` puts them
    back."""
    S = found.transform
    firm = S is not None and S.rotation_sigma <= LINK_ROTATION and S.scale_sigma <= LINK_SCALE
    loose = (Status.LOOSE_POSE, Status.COARSE) if firm else ()
    return dataclasses.replace(found, flags=tuple(f for f in found.flags if f not in loose))


def synchronize_own(
    tracks: Sequence[TrackSet],
    chosen: int | None,
    centre: int,
    *,
    solver: OwnFrames,
    graph: Graph | None = None,
    lags: Sequence[Lag] = (),
    map: MapLike = map,
) -> tuple[Verdict, tuple[Similarity | None, ...]]:
    """The verdict on the clocks, and each video's similarity to the frame of its reference.

    Pairs are solved one by one; the graph of those that vouch for themselves gives clocks and frames; pairs that failed
    or contradict them are solved once more from where the graph puts them; and the graph decides again.

    Args:
        chosen: index of the reference; None: the video that the others are best tied to. centre: of the star.
        lags: delays among the tracks of each video; none: nobody asked.
    """
    tracks = [at_frame_times(t) for t in tracks]
    graph = graph or Graph(complete=COMPLETE)
    pairs = graph.pairs(len(tracks), centre)
    answers = list(map(run_own, [OwnJob(p, tracks[p[0]], tracks[p[1]], solver) for p in pairs]))

    def refit(tasks: list[tuple[Answer, float, float]]) -> list[Alignment]:
        jobs = [
            OwnJob(a.pair, tracks[a.pair[0]], tracks[a.pair[1]], solver, (Clock(offset, rate), a.refined.transform))
            for a, offset, rate in tasks
            if a.refined.transform is not None
        ]
        done = {answer.pair: answer.refined for answer in map(run_own, jobs)} if jobs else {}
        return [done.get(a.pair, Alignment(math.nan, flags=(Status.FAILED,))) for a, _, _ in tasks]

    middles = [middle_and_extent(t) for t in tracks]
    trust = Trust()
    verdict, poses, links = decide(tracks, answers, chosen, centre, graph, trust, refit, middles)
    again = [job for job in (guided(a, tracks, solver, verdict, poses) for a in answers) if job is not None]
    if again:
        fresh = {a.pair: a for a in map(run_own, again)}
        starts = {job.pair: job.start for job in again}
        answers = [better(a, fresh.get(a.pair), starts.get(a.pair), solver) for a in answers]
        verdict, poses, links = decide(tracks, answers, chosen, centre, graph, trust, refit, middles)
    doubted = with_lags(verdict.answers, lags, trust.lag)
    if doubted is not None:
        verdict, poses, links = decide(tracks, doubted, chosen, centre, graph, trust, refit, middles)
    return with_pose_flags(verdict, poses, links, solver), poses.frames


def decide(
    tracks: Sequence[TrackSet],
    answers: Sequence[Answer],
    chosen: int | None,
    centre: int,
    graph: Graph,
    trust: Trust,
    refit: Refit,
    middles: Sequence[tuple[np.ndarray, float]],
) -> tuple[Verdict, Poses, list[tuple[Pair, Link]]]:
    """Clocks from all pairs, then frames from the pairs that agree with the clocks."""
    verdict = judge(len(tracks), answers, chosen, centre, graph, trust, refit)
    links = []
    for a in verdict.answers:
        S = a.refined.transform
        if S is None or S.covariance is None or not a.finite:
            continue
        i, j = a.pair
        late = abs(verdict.x[j] - verdict.x[i] - verdict.rates[i] * a.refined.offset)
        trusted = a.refined.status.ok and not late > max(ASTRAY_TIME, 4 * a.refined.sigma)
        links.append((a.pair, Link(i, j, S, trusted, middles[j][0], middles[i][1])))
    poses = place(len(tracks), [l for _, l in links], verdict.component.tolist())
    return verdict, poses, links


def guided(
    answer: Answer, tracks: Sequence[TrackSet], solver: OwnFrames, verdict: Verdict, poses: Poses
) -> OwnJob | None:
    """The job that solves a pair from where the graph puts it; None for one that is sound and there already."""
    i, j = answer.pair
    predicted = poses.between(i, j)
    if predicted is None or verdict.component[i] != verdict.component[j]:
        return None
    offset = float((verdict.x[j] - verdict.x[i]) / verdict.rates[i])
    found = answer.refined
    sound = found.status.ok and found.transform is not None and abs(found.offset - offset) <= NEAR_TIME
    if sound and found.transform.degrees_from(predicted) <= NEAR_TURN:  # type: ignore[union-attr]
        return None
    if not math.isfinite(offset):
        return None
    clock = Clock(offset, float(verdict.rates[j] / verdict.rates[i]))
    return OwnJob(answer.pair, tracks[i], tracks[j], solver, (clock, predicted))


def better(answer: Answer, fresh: Answer | None, start: tuple[Clock, Similarity] | None, solver: OwnFrames) -> Answer:
    """The new answer where it vouches for itself and stays where the graph put it, else the old one.

    A fit that begins where the graph puts it looks at no other answer: the one of the free search is its rival.
    """
    if fresh is None or start is None:
        return answer
    found = fresh.refined
    if not found.status.ok or found.transform is None:
        return answer
    near = abs(found.offset - start[0].offset) <= NEAR_TIME
    if not near or found.transform.degrees_from(start[1]) > NEAR_TURN:
        return answer
    before, own = answer.refined, found.stats.get("agreement", 0.0)
    rival = before.stats.get("agreement", 0.0) if before.transform is not None and other(before, found) else 0.0
    if rival > solver.trust.rival * own:
        return answer
    guided_stats = {"guided": 1.0, "rival": rival / max(own, 1e-300)}
    found = dataclasses.replace(found, stats=found.stats | guided_stats)
    return Answer(fresh.pair, fresh.matches, found, found)


def other(one: Alignment, two: Alignment) -> bool:
    """Whether two answers are not the same one."""
    assert one.transform is not None and two.transform is not None
    return abs(one.offset - two.offset) > SAME_TIME or one.transform.degrees_from(two.transform) > SAME_TURN


def with_pose_flags(verdict: Verdict, poses: Poses, links: Sequence[tuple[Pair, Link]], solver: OwnFrames) -> Verdict:
    """The verdict with flags of videos whose frame is doubtful, and what the solution says of each pair."""
    error = {pair: float(e) for (pair, _), e in zip(links, poses.errors, strict=True)}
    closed = {pair: bool(c) for (pair, _), c in zip(links, poses.closed, strict=True)}
    flags = []
    for v, own in enumerate(verdict.flags):
        raised = list(own)
        frame = poses.frames[v]
        used = [error[p] for p in error if v in p and np.isfinite(error[p])]
        if verdict.component[v] != v or not own:
            if v != verdict.reference and solver.trust.loose(frame):
                raised.append(Status.LOOSE_POSE)
            if used and sum(e > ASTRAY for e in used) >= len(used) / 2 and v != verdict.reference:
                raised.append(Status.INCONSISTENT)
        flags.append(in_order(raised))
    answers = []
    for a in verdict.answers:
        stats = dict(a.refined.stats)
        if a.pair in error and np.isfinite(error[a.pair]):
            stats["pose_error"] = error[a.pair]
        extra: tuple[Status, ...] = ()
        if a.refined.status.ok and (not closed.get(a.pair, True) or stats.get("pose_error", 0.0) > ASTRAY):
            extra = (Status.INCONSISTENT,)
        if a.refined.transform is not None and solver.trust.loose(a.refined.transform):
            extra = (*extra, Status.LOOSE_POSE)
        if a.refined.sigma > solver.trust.clock:
            extra = (*extra, Status.COARSE)
        found = dataclasses.replace(a.refined, flags=in_order((*a.refined.flags, *extra)), stats=stats)
        answers.append(dataclasses.replace(a, refined=found))
    known = [e for e in error.values() if np.isfinite(e)]
    stats = verdict.stats | {"pose_links": float(len(known))}
    if known:
        stats["pose_error_median"] = float(np.median(known))
    return dataclasses.replace(verdict, flags=tuple(flags), answers=tuple(answers), stats=stats)


def middle_and_extent(tracks: TrackSet) -> tuple[np.ndarray, float]:
    """(the median place of the tracks seen longest, how far apart they get), in the video's own frame."""
    tracks = tracks.take(longest_seen(tracks, SOME))
    x = tracks.positions().reshape(-1, 3)
    return np.median(x[np.isfinite(x[:, 0])], 0), max(sizes(tracks)[0], 1e-300)


def solver_from(frames: str | OwnFrames, matcher: MatcherLike | None) -> OwnFrames:
    """The solver that ``frames`` names, with the matcher of the first matches. ValueError for two of them, and for one
    that compares positions.
    """
    solver = frames if isinstance(frames, OwnFrames) else OwnFrames()
    if matcher is None:
        return solver
    across = [c for c in Matcher.of(matcher).costs if getattr(c, "needs_xyz", False)]
    if across:
        raise ValueError(
            f"matcher, frames: expected costs that compare no positions, which are in two frames; found {across[0]!r}. "
            "Take features, or structure."
        )
    if solver.matcher is not None:
        raise ValueError("matcher, frames: expected one matcher; found two. Leave out OwnFrames.matcher, or matcher.")
    return dataclasses.replace(solver, matcher=Matcher.of(matcher))


def refuse_common(**given: object) -> None:
    """ValueError for what only videos with a common frame can use."""
    for name, value in given.items():
        if value is not None:
            raise ValueError(
                f"{name}: expected none with frames='own', which finds clock and pose together; found {value!r}. Leave "
                "it out, or bring the videos into one frame and use frames='common'."
            )
