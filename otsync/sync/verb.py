"""``synchronize(tracks)``: the clocks of many videos from their pairs (paper, Sec. 3.4; its star becomes a graph)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from ..align.another_time import may_be_another_time
from ..align.likelihood import LikelihoodScan
from ..align.slot import Aligner, AlignerLike
from ..align.vouch import scan_of
from ..clocks.common import nominal_fps
from ..clocks.shutter import at_frame_times
from ..compute.threads import MapLike, blas_for
from ..epipolar.scan import EpipolarScan
from ..frames import OwnFrames
from ..match.slot import Matcher, MatcherLike
from ..refine.slot import Rate, Refiner, RefinerLike
from ..refine.splines import SplineRefine
from ..types import Alignment, Break, Clock, Matches, Offsets, Status, TrackSet
from ..types.checks import check_whole
from ..types.trust import Trust
from .graph import Graph, Pair
from .hearing import Hearing
from .lags import Lag, lag_of, lagging, with_lags
from .mend.pixels import mended_in_pixels, without_unsteady
from .mend.proofs import cut_where_it_holds
from .mend.verb import mend_by_cuts, mend_by_windows, mend_clocks
from .mend.ways import ByMotion
from .method import Method
from .own_frames import Frames, refuse_common, solver_from, synchronize_own
from .pairs import Job, Refit, run, run_refit, with_rate
from .parts import broken_part, unvouched
from .rematching import contested, rematching
from .steps import with_steps_heard
from .verdict import Answer, Verdict, judge, off_rates
from .witnesses import contradicted, surest


def synchronize(
    tracks: Sequence[TrackSet],
    *,
    reference: int | Literal["auto"] = 0,
    method: Method | None = None,
    matcher: MatcherLike | None = None,
    aligner: AlignerLike | None = None,
    refiner: RefinerLike | None = None,
    matches: Mapping[Pair, Matches] | None = None,
    graph: Graph | None = None,
    rematch: int | None = None,
    rate: Rate | None = None,
    frames: Frames | OwnFrames = "common",
    map: MapLike = map,
) -> Offsets:
    """Put every video on the reference's clock.

    Pairs of videos are matched, aligned and refined; a robust solution over the graph of pairs gives the offsets, and
    pairs that contradict it are fitted anew from where it puts them. Videos that no sound pair links to the reference
    form components with references of their own.

    Args:
        tracks: one set per video, all in one world frame unless ``frames`` says otherwise. Rolling shutters of declared
            ``readout`` are undone here.
        reference: index of the video whose clock is the world's; "auto" takes the one with the surest pairs.
        method: what stands in the slots below that are left out, for example :data:`otsync.PAPER`.
        matcher, aligner, refiner: the algorithms of each stage; None takes the default, :class:`Unrefined` as refiner
            leaves the aligner's answers as they are.
        matches: ``{(i, j): Matches}`` of your own; those pairs skip matching and no others are tried.
        graph: which pairs are compared and how they are combined; default :class:`Graph`. ``Graph(extra=0)`` is the
            paper's star.
        rematch: how often pairs whose first answer is trusted are matched again with positions at the synchronised
            times (more than once adds nothing); None: once. Matches of your own are left alone.
        rate: "fit" frees frame rates over six seconds and more, and keeps what is significant and moves the ends of
            the overlap; "fixed" takes them as declared, and flags what contradicts them; None: as the refiner says.
        frames: "common" where all positions are in one world frame; "own" where every video has a frame and a unit of
            its own (several depth cameras, phones with depth): then rotation, translation and scale are found beside
            the offsets, in :attr:`Offsets.transforms`. An :class:`OwnFrames` sets how. ``aligner``, ``refiner``,
            ``matches``, ``rate`` and ``rematch`` belong to a common frame; ``matcher`` makes the first matches of both.
        map: any map-like callable: the builtin, an executor's, dask's. Results do not depend on it.

    A pair that fails gets a status and nan; the others live. Wrong input raises ValueError before any work.
    """
    if method is not None and not isinstance(method, Method):
        raise ValueError(f"method: expected a Method such as otsync.PAPER; found {method!r}.")
    chosen_method = (method or Method()).but(
        matcher=matcher, aligner=aligner, refiner=refiner, graph=graph, rematch=rematch, rate=rate
    )
    times = 1 if chosen_method.rematch is None else chosen_method.rematch
    check_whole("rematch", times, 0)
    if matches is not None and matcher is not None:
        raise ValueError("matcher, matches: expected one of them; found both. Matches of your own need no matcher.")
    matching = None if chosen_method.matcher is None else Matcher.of(chosen_method.matcher)
    if frames != "common":
        return _without_common_frame(tracks, reference, frames, matching, chosen_method, matches, map)
    aligning = LikelihoodScan() if chosen_method.aligner is None else Aligner.of(chosen_method.aligner)
    chosen_refiner = SplineRefine() if chosen_method.refiner is None else Refiner.of(chosen_method.refiner)
    refining = with_rate(chosen_refiner, chosen_method.rate)
    needs_xyz = aligning.needs_xyz or refining.needs_xyz or (matching is not None and matching.needs_xyz)
    chosen = check_tracks(tracks, reference, xyz=needs_xyz)
    if matches is None and (matching is None or matching.needs_features):
        for v, t in enumerate(tracks):
            t.check(f"tracks[{v}]", xyz=False, features=True)
    started = time.perf_counter()
    tracks = [at_frame_times(t) for t in tracks]
    graph = chosen_method.graph or Graph()
    centre = most_seen(tracks) if chosen is None else chosen
    pairs = given_pairs(matches, tracks) if matches is not None else graph.pairs(len(tracks), centre)
    jobs = [
        Job(pair, tracks[pair[0]], tracks[pair[1]], matching, aligning, refining, matches[pair] if matches else None)
        for pair in pairs
    ]

    def judged(answers: Sequence[Answer], mended: Sequence[TrackSet]) -> Verdict:
        def refit(tasks: list[tuple[Answer, float, float]]) -> list[Alignment]:
            return list(map(run_refit, [Refit.of(*task, mended, refining) for task in tasks])) if tasks else []

        return judge(len(mended), answers, chosen, centre, graph, refining.trust, refit)

    rematched = times if matches is None else 0
    with blas_for(max(len(t) for t in tracks)):
        hearing = _with_clocks_mended(Hearing.begun(jobs, tracks, judged, map), rematched)
        hearing = _with_returns_heard(hearing, tracks, aligning)
        if isinstance(aligning, EpipolarScan):
            hearing = mended_in_pixels(hearing, aligning, refining)
            hearing = without_unsteady(hearing, aligning)
            hearing = _with_off_rates_told(hearing, refining.trust)
        else:
            hearing = with_parts_checked(hearing)
            hearing = with_witnesses_heard(hearing, rematched > 0, refining.trust.parted)
        hearing = hearing.doubted(cut_where_it_holds(hearing.answers, tracks, hearing.tracks, hearing.broken))
        lags = list(map(lag_of, hearing.tracks))
        lagged = with_lags(hearing.answers, lags, refining.trust.lag)
        if lagged is not None:
            hearing = hearing.judged(lagged)
        answers = with_steps_heard(hearing.answers, hearing.tracks, map)
        verdict = dataclasses.replace(hearing.verdict, answers=answers)
        return to_offsets(tracks, verdict, time.perf_counter() - started, hearing.broken, lags)


def _with_clocks_mended(hearing: Hearing, times: int) -> Hearing:
    """Clocks that break put right, by motion, by pieces, and by matches that are made at the times that were found:
    windows where a clock is doubtful; then all pairs are matched ``times`` times more.
    """
    hearing = mend_by_cuts(mend_clocks(hearing, ByMotion()))
    if not times:
        return hearing
    hearing, timed = mend_by_windows(hearing)
    hearing = hearing.told(contested(hearing.jobs, hearing.verdict, hearing.map))
    for _ in range(times):
        again = [job for job in rematching(hearing.jobs, hearing.verdict) if job.pair not in timed]
        if not again:
            break
        first = {a.pair: a for a in hearing.answers}
        fresh = {answer.pair: answer for answer in hearing.map(run, again)}
        hearing = hearing.told({pair: _still_broken(answer, first[pair]) for pair, answer in fresh.items()})
    return hearing


def _with_returns_heard(hearing: Hearing, filmed: Sequence[TrackSet], aligner: Aligner) -> Hearing:
    """Pairs of mended videos ambiguous that may be another time's by what the videos show as filmed.

    A clock that is mended, or cut, leaves the scan less to compare a video with itself by; what was seen of it is still
    true.
    """
    scan = scan_of(aligner)
    heard = {}
    for a in hearing.answers:
        stats = a.scanned.stats
        if hearing.broken.keys().isdisjoint(a.pair) or not a.finite or stats.get("another_time", 1.0) > 0:
            continue
        found = scan.another_time(
            filmed[a.pair[0]], filmed[a.pair[1]], a.matches, Clock(a.refined.offset, a.refined.rate)
        )
        if may_be_another_time(found["returning"], max(found["likeness"], stats["likeness"]), scan.trust):
            heard[a.pair] = a.that_may_be_another_time()
    return hearing.told(heard)


def _with_off_rates_told(hearing: Hearing, trust: Trust) -> Hearing:
    """The pairs of videos whose clocks run otherwise than declared flagged, or less sure."""
    answers = hearing.answers
    off = off_rates(answers, hearing.verdict.reference, trust)
    for clock in off:
        answers = tuple(clock.told(a) for a in answers)
    return hearing.judged(answers) if off else hearing


def with_parts_checked(hearing: Hearing) -> Hearing:
    """Pairs doubted whose answer does not hold in a part of what both videos share."""
    parts = {}
    for a in hearing.answers:
        first, second = (hearing.tracks[v] for v in a.pair)
        if a.refined.status.ok and a.finite and first.xyz is not None and second.xyz is not None:
            parts[a.pair] = broken_part(a, first, second)
    broken = {pair: part for pair, part in parts.items() if part is not None}
    return hearing.doubted(unvouched(broken, hearing.answers, hearing.tracks)) if broken else hearing


def with_witnesses_heard(hearing: Hearing, rest: bool, limit: float) -> Hearing:
    """Pairs doubted of which a part of the scene tells another time.

    What is wrong with a video is so in all its pairs: of many, those with the most evidence are asked first, and where
    one of them is doubted the others of its videos, too. Of breaks that were mended each side is asked for the time of
    the other one.

    Args:
        rest: whether what an answer does not explain is asked, too.
    """
    answers = {a.pair: a for a in hearing.answers if a.finite and (a.refined.status.ok or _only_returns(a))}
    asked = [job for job in hearing.jobs if job.pair in answers and job.a.xyz is not None and job.b.xyz is not None]
    first = surest(answers, asked)
    doubted = contradicted(answers, first, hearing.broken, rest, limit, hearing.map)
    videos = {v for pair in doubted for v in pair}
    more = [job for job in asked if job not in first and videos & set(job.pair)]
    doubted |= contradicted(answers, more, hearing.broken, rest, limit, hearing.map)
    return hearing.told({pair: lagging(answers[pair]) for pair in doubted})


def _only_returns(answer: Answer) -> bool:
    """Whether a pair's only doubt is that its clock may break where motion comes back: a late performer looks so."""
    return answer.refined.flags == (Status.BROKEN_CLOCK,) and bool(answer.scanned.stats.get("returns"))


def _still_broken(fresh: Answer, first: Answer) -> Answer:
    """Matches that were made at one offset agree with it: they do not lift the doubt whether there is only one."""
    if Status.BROKEN_CLOCK not in first.refined.flags:
        return fresh
    return fresh.doubted()


def _without_common_frame(
    tracks: Sequence[TrackSet],
    reference: int | Literal["auto"],
    frames: Frames | OwnFrames,
    matcher: Matcher | None,
    method: Method,
    matches: Mapping[Pair, Matches] | None,
    map: MapLike,
) -> Offsets:
    """:func:`synchronize` of videos that each have a frame of their own."""
    if frames != "own" and not isinstance(frames, OwnFrames):
        raise ValueError(f"frames: expected 'common', 'own' or an OwnFrames; found {frames!r}.")
    refuse_common(
        aligner=method.aligner,
        refiner=method.refiner,
        matches=matches,
        rate=None if method.rate == "fixed" else method.rate,
        rematch=method.rematch,
    )
    chosen = check_tracks(tracks, reference, own=True)
    if matcher is None or matcher.needs_features:
        for v, t in enumerate(tracks):
            t.check(f"tracks[{v}]", xyz=False, features=True)
    started = time.perf_counter()
    centre = most_seen(tracks) if chosen is None else chosen
    solver = solver_from(frames, matcher)
    lags = list(map(lag_of, tracks))
    verdict, transforms = synchronize_own(tracks, chosen, centre, solver=solver, graph=method.graph, lags=lags, map=map)
    found = to_offsets(tracks, verdict, time.perf_counter() - started, lags=lags)
    return dataclasses.replace(found, transforms=transforms)


UNMEASURED = 2.0
"""Frames, one sigma, of a jump whose parts leave too little to measure it by: seed 35015 was 1.8 frames off, and ok."""


def jump_sigma(found: Break, frame: float) -> float:
    """One sigma, s, of how far a clock jumps; one that could not be measured is known to a few frames at best."""
    return found.sigma if np.isfinite(found.sigma) else UNMEASURED * frame


def to_offsets(
    tracks: Sequence[TrackSet],
    verdict: Verdict,
    seconds: float,
    broken: Mapping[int, tuple[Break, ...]] | None = None,
    lags: Sequence[Lag] = (),
) -> Offsets:
    """Args: lags: delays among the tracks of each video; none: nobody asked."""
    found = tuple(tuple(sorted((broken or {}).get(v, ()), key=lambda b: b.at)) for v in range(len(tracks)))
    # the error of a jump is that of all behind it
    loose = [
        sum(jump_sigma(b, 1 / nominal_fps(t)) ** 2 for b in breaks) for breaks, t in zip(found, tracks, strict=True)
    ]
    # and so is that of tracks that come late
    loose = [total + lag.sigma**2 for total, lag in zip(loose, lags or [Lag(0.0, 0.0)] * len(loose), strict=True)]
    loose = [total + loose[verdict.reference] for total in loose]
    sigma = np.where(np.arange(len(tracks)) == verdict.reference, 0.0, np.hypot(verdict.sigma, np.sqrt(loose)))
    return Offsets(
        names=unique_names(tracks),
        fps=np.array([t.fps for t in tracks], float),
        seconds=verdict.x,
        rates=verdict.rates,
        sigma=sigma,
        reference=verdict.reference,
        component=verdict.component,
        flags=verdict.flags,
        alignments={a.pair: a.refined for a in verdict.answers},
        matches={a.pair: a.matches for a in verdict.answers},
        stats=verdict.stats | {"seconds": seconds},
        breaks=found,
    ).judged_by_sigma()


def check_tracks(
    tracks: Sequence[TrackSet], reference: int | Literal["auto"], *, xyz: bool = True, own: bool = False
) -> int | None:
    """ValueError unless there are at least two sound track sets; the reference's index, None when it is to be
    chosen.
    """
    if isinstance(tracks, TrackSet) or len(tracks) < 2:
        raise ValueError("tracks: expected a sequence of at least two track sets, one per video; found fewer.")
    chosen = None
    if reference != "auto":
        if isinstance(reference, str) or not -len(tracks) <= reference < len(tracks):
            raise ValueError(
                f"reference: expected an index of the {len(tracks)} videos, or 'auto'; found {reference!r}."
            )
        chosen = reference % len(tracks)
    for v, t in enumerate(tracks):
        if not isinstance(t, TrackSet):
            raise ValueError(f"tracks[{v}]: expected a TrackSet; found {type(t).__name__}.")
        t.check(f"tracks[{v}]", xyz=xyz)
    frames = {t.frame for t in tracks if t.frame is not None}
    if len(frames) > 1 and not own:
        raise ValueError(
            f"tracks: expected one world frame; found {sorted(frames)}. Bring the positions into one, or let the "
            "frames be found: frames='own' (otsync sync --frames own)."
        )
    return chosen


def most_seen(tracks: Sequence[TrackSet]) -> int:
    """The video with the most observed samples; the first on ties."""
    return int(np.argmax([t.seen.sum() for t in tracks]))


def given_pairs(matches: Mapping[Pair, Matches], tracks: Sequence[TrackSet]) -> list[Pair]:
    """Sorted pairs that the caller brought matches for; ValueError when they do not fit the tracks."""
    for (i, j), given in matches.items():
        if not (0 <= i < len(tracks) and 0 <= j < len(tracks)) or i == j:
            raise ValueError(f"matches: expected pairs of two of the {len(tracks)} videos; found {(i, j)}.")
        if (j, i) in matches:
            raise ValueError(f"matches: expected each pair once; found both {(i, j)} and {(j, i)}.")
        given.check(f"matches[{(i, j)}]", len(tracks[i]), len(tracks[j]))
    return sorted(matches)


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
