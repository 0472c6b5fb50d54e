"""Promises of synchronisation, measured on fresh seeds: each figure beside its bar."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..align.verb import align
from ..align.warping import DTW
from ..progress import counted
from ..refine.splines import SplineRefine
from ..refine.verb import refine
from ..simulate import simulate
from ..sync.verb import synchronize
from ..types import Alignment, Matches, TrackSet
from .record import Row
from .sync_worlds import BANDS, FPS, Case, label, many, motions, pair_case, pair_cases

WRONG = 1.0
"""Frames of error beyond which an answer is wrong."""


@dataclass(frozen=True)
class Check:
    """One promise: what was measured, and whether it holds."""

    name: str
    measured: float
    bar: str
    met: bool

    def row(self) -> Row:
        return {"check": self.name, "measured": self.measured, "bar": self.bar, "met": "yes" if self.met else "NO"}


def at_most(name: str, value: float, bar: float) -> Check:
    return Check(name, float(value), f"<= {bar:g}", bool(value <= bar + 1e-9))


def at_least(name: str, value: float, bar: float) -> Check:
    return Check(name, float(value), f">= {bar:g}", bool(value >= bar - 1e-9))


def answer(case: Case, refiner: SplineRefine | None = None) -> Alignment:
    """Aligned and refined with the defaults; the scan's answer where it has no offset."""
    coarse = align(case.a, case.b, case.matches, throw=False)
    if not np.isfinite(coarse.offset):
        return coarse
    return refine(case.a, case.b, case.matches, coarse, refiner, throw=False)


def pair_rows(seeds: Sequence[int], presets: Sequence[str] = ("mid", "hard", "brutal")) -> list[Row]:
    """Every pair's error, sigma (frames), trust and CPU-seconds with the defaults."""
    rows: list[Row] = []
    for case in pair_cases(presets, seeds):
        started = time.process_time()
        alignment = answer(case)
        rows.append(
            {
                "preset": case.preset,
                "class": case.motion,
                "band": f"{BANDS[case.band][0]}-{BANDS[case.band][1]}",
                "seed": case.seed,
                "error": abs(alignment.offset * FPS - case.offset),
                "sigma": alignment.sigma * FPS,
                "trusted": alignment.status.ok,
                "flags": " ".join(f.code for f in alignment.flags),
                "cpu_s": time.process_time() - started,
            }
        )
    return rows


def errors(rows: Sequence[Row], trusted: bool | None = None, **where: str) -> np.ndarray:
    chosen = [r for r in rows if all(r[k] == v for k, v in where.items()) and trusted in (None, r["trusted"])]
    return np.array([r["error"] for r in chosen])


def pairs(rows: Sequence[Row]) -> Iterator[Check]:
    """Single pairs: bars of their errors, and coverage of their sigmas."""
    e, t = errors(rows, preset="mid"), errors(rows, True, preset="mid")
    yield at_most("pair mid: mean", e.mean(), 0.06)
    yield at_most("pair mid: p90", np.quantile(e, 0.9), 0.15)
    yield at_most("pair mid: worst trusted", t.max(), 0.5)
    yield at_least("pair mid: share trusted", len(t) / len(e), 0.85)
    for preset, median, p90, worst, share in (("hard", 0.12, 0.35, 1.0, 0.55), ("brutal", 0.6, 0.7, 1.5, 0.30)):
        e, t = errors(rows, preset=preset), errors(rows, True, preset=preset)
        yield at_most(f"pair {preset}: median", np.median(e), median)
        yield at_most(f"pair {preset}: trusted p90", np.quantile(t, 0.9), p90)
        yield at_most(f"pair {preset}: worst trusted", t.max(), worst)
        yield at_least(f"pair {preset}: share trusted", len(t) / len(e), share)
    yield at_most("pair: CPU-seconds", float(np.mean([r["cpu_s"] for r in rows])), 0.13)
    for preset in ("mid", "hard"):
        chosen = [r for r in rows if r["preset"] == preset and r["trusted"]]
        yield from coverage(f"pair {preset}", errors(chosen), np.array([r["sigma"] for r in chosen]))


def coverage(name: str, error: np.ndarray, sigma: np.ndarray) -> Iterator[Check]:
    one, two = float((error <= sigma).mean()), float((error <= 2 * sigma).mean())
    yield Check(f"{name}: within one sigma", one, "0.6 - 0.85", 0.6 <= one <= 0.85)
    yield at_least(f"{name}: within two sigmas", two, 0.88)


def views(seeds: Sequence[int], videos: int = 8) -> Iterator[Check]:
    """Many views: medians over the moving classes, and coverage of the graph's sigmas."""
    for preset, bar in (("mid", 0.03), ("hard", 0.06), ("brutal", 0.3)):
        e, s, ok = [], [], []
        worlds = list(itertools.product(motions(), seeds))
        for motion, seed in counted(worlds, f"{videos} videos {preset}", "world"):
            tracks, truth, matches = many(motion, preset, videos, seed)
            offsets = synchronize(tracks, matches=matches)
            e += list(np.abs(offsets.seconds - truth.offsets)[1:] * FPS)
            s += list(offsets.sigma[1:] * FPS)
            ok += [status.ok for status in offsets.status[1:]]
        error, sigma, trusted = np.array(e), np.array(s), np.array(ok)
        yield at_most(f"{videos} videos {preset}: median", float(np.nanmedian(error)), bar)
        yield Check(f"{videos} videos {preset}: share trusted", float(trusted.mean()), "", True)
        yield at_most(f"{videos} videos {preset}: worst trusted", float(error[trusted].max(initial=0)), 2 * WRONG)
        if preset != "brutal":
            yield from coverage(f"{videos} videos {preset}", error[trusted], sigma[trusted])


def thirty(seed: int) -> Iterator[Check]:
    """30 videos of 150 frames with 100 given matches per pair, about 90 pairs."""
    tracks, truth, matches = many("basketball", "mid", 30, seed, n=100)
    started = time.perf_counter()
    offsets = synchronize(tracks, matches=matches)
    yield at_most(f"30 videos, {len(matches)} pairs: seconds (one process)", time.perf_counter() - started, 30)
    yield at_most("30 videos: median error", float(np.median(np.abs(offsets.seconds - truth.offsets)[1:]) * FPS), 0.03)


def juggling(seeds: Sequence[int], matches: int = 10) -> Iterator[Check]:
    """Periodic motion, few matches, brutal tracks: the curves of many pairs together against each pair alone."""
    star, graph, alone = [], [], []
    for seed in counted(seeds, "juggling", "world"):
        tracks, truth, given = many("juggle", "brutal", 8, seed, n=matches)
        offsets = synchronize(tracks, matches=given)
        graph += list(~(np.abs(offsets.seconds - truth.offsets)[1:] * FPS <= 2))
        for (i, j), m in given.items():
            one = answer(Case("juggle", "brutal", 0, seed, tracks[i], tracks[j], m, truth, truth.offset(i, j) * FPS))
            wrong = not abs(one.offset - truth.offset(i, j)) * FPS <= 2
            alone.append(wrong)
            if i == 0:
                star.append(wrong)
    yield Check(f"juggle, {matches} matches: pairs over 2 frames", float(np.mean(alone)), "about .44", True)
    yield Check(f"juggle, {matches} matches: star, views over 2 frames", float(np.mean(star)), "about half", True)
    yield at_most(f"juggle, {matches} matches: graph, views over 2 frames", float(np.mean(graph)), 0.15)


def judged(kind: str, case: Case) -> tuple[str, Alignment, float]:
    """(kind, answer, error in frames) of a case."""
    alignment = answer(case)
    return kind, alignment, abs(alignment.offset * FPS - case.offset)


def odd_cases(seeds: Sequence[int]) -> Iterator[tuple[str, Alignment, float]]:
    """(kind, answer, error in frames) of cases that must be flagged, or often are."""
    for preset in ("mid", "hard"):
        for seed in seeds:
            for motion in motions():
                name = label(motion)
                rng = np.random.default_rng([seed, len(name), 11])
                for n in (1, 2, 3, 4):
                    yield judged(f"{n} matches", pair_case(motion, preset, 1, seed, n=n))
                for kind, offset, frames in (
                    ("no overlap", 160.0, 150),
                    ("overlap 50", 100.0, 150),
                    ("40 frames", 6.0, 40),
                ):
                    (a, b), truth = simulate(
                        motion, preset=preset, frames=frames, offsets=[0, offset / FPS], seed=int(rng.integers(2**31))
                    )
                    case = Case(name, preset, 0, seed, a, b, truth.matches(0, 1), truth, offset)
                    yield judged(kind, case)
                other = motions()[(motions().index(motion) + 1 + seed) % len(motions())]
                a, b = (
                    simulate(m, preset=preset, videos=1, seed=int(rng.integers(2**31)))[0][0] for m in (motion, other)
                )
                m = Matches(np.stack([rng.integers(0, len(a), 60), rng.integers(0, len(b), 60)], 1))
                yield "unrelated", refine(a, b, m, align(a, b, m, throw=False), throw=False), np.nan
                yield judged("70 % wrong", pair_case(motion, preset, 1, seed, wrong=0.7))
                yield judged("8 matches", pair_case(motion, preset, 1, seed, n=8))
            yield judged("static", pair_case("static", preset, 1, seed))


def flags(rows: Sequence[Row], seeds: Sequence[int]) -> Iterator[Check]:
    """Odd cases, errors that are caught, and needless flags."""
    wrong, caught = 0, 0
    by_kind: dict[str, list[bool]] = {}
    for kind, alignment, error in counted(odd_cases(seeds), "odd cases", "case"):
        flagged = not alignment.status.ok
        by_kind.setdefault(kind, []).append(flagged)
        if not error <= WRONG:
            wrong += 1
            caught += flagged
    always = {"static", "unrelated", "no overlap", "1 matches", "2 matches", "3 matches", "4 matches"}
    for kind, marks in sorted(by_kind.items()):
        share = float(np.mean(marks))
        yield at_least(f"flagged: {kind}", share, 1.0) if kind in always else Check(f"flagged: {kind}", share, "", True)
    usual = [r for r in rows if r["preset"] in ("mid", "hard")]
    wrong += sum(r["error"] > WRONG for r in usual)
    caught += sum(r["error"] > WRONG and not r["trusted"] for r in usual)
    good = [r for r in usual if r["error"] <= WRONG]
    yield at_least(f"errors over 1 frame flagged ({wrong} of mid, hard and odd cases)", caught / max(wrong, 1), 0.95)
    yield at_most("good answers flagged, mid and hard", float(np.mean([not r["trusted"] for r in good])), 0.20)


def clocks(seeds: Sequence[int]) -> Iterator[Check]:
    """Rates and timestamps."""
    e, kept = {"fixed": [], "fit": []}, {150: [], 900: []}  # type: dict[str, list[float]], dict[int, list[bool]]
    for motion in counted(motions(), "clocks", "class"):
        for seed in seeds:
            for frames, rate in ((900, 30 / 29.97), (150, 30 / 29.97), (900, 1.0)):
                offset = float(np.random.default_rng([seed, frames]).uniform(-30, 30))
                world = seed * 7 + frames
                (a, b), truth = simulate(
                    motion, preset="mid", frames=frames, rates=[1, rate], offsets=[0, offset / FPS], seed=world
                )
                m = truth.matches(0, 1)
                start = align(a, b, m, throw=False)
                for kind in ("fixed", "fit") if (frames, rate > 1) == (900, True) else ("fit",):
                    refined = refine(a, b, m, start, SplineRefine(rate=kind), throw=False)
                    if frames == 900 and rate > 1:
                        e[kind].append(abs(refined.offset * FPS - offset))
                    elif kind == "fit":
                        kept[frames].append(refined.rate == 1.0)
    yield Check("29.97 against 30 at T = 900, fixed: mean error", float(np.mean(e["fixed"])), "", True)
    yield at_most("29.97 against 30 at T = 900, fit: mean error", float(np.mean(e["fit"])), 0.1)
    yield at_least("rate left alone at T = 150", float(np.mean(kept[150])), 1.0)
    yield at_least("true rate 1 left alone at T = 900", float(np.mean(kept[900])), 0.95)
    whole, dropped = [], []
    for case in pair_cases(("mid",), seeds):
        keep = np.sort(np.random.default_rng(case.seed).choice(150, 120, replace=False))
        whole.append(abs(answer(case).offset * FPS - case.offset))
        dropped.append(abs(answer(dataclasses.replace(case, b=frames_of(case.b, keep))).offset * FPS - case.offset))
    yield at_most(
        "20 % of frames dropped, timestamps kept: mean error over that without",
        float(np.mean(dropped) / np.mean(whole)),
        1.2,
    )


def frames_of(tracks: TrackSet, keep: np.ndarray) -> TrackSet:
    """The tracks at some of their frames, with these frames' timestamps."""
    assert tracks.xyz is not None
    return TrackSet(
        tracks.xyz[:, keep], tracks.seen[:, keep], tracks.features, timestamps=tracks.times[keep], frame=tracks.frame
    )


def baseline(seeds: Sequence[int]) -> Iterator[Check]:
    """The paper's DTW against the default in the widest band."""
    for preset in ("mid", "hard"):
        ours, paper = [], []
        for case in pair_cases((preset,), seeds):
            if case.band == len(BANDS) - 1:
                ours.append(abs(answer(case).offset * FPS - case.offset))
                warped = align(case.a, case.b, case.matches, DTW(), throw=False)
                paper.append(abs(warped.offset * FPS - case.offset))
        yield at_least(
            f"{preset}, 30-50: mean error of the paper's DTW over the default's",
            float(np.mean(paper) / np.mean(ours)),
            3,
        )


def acceptance(seeds: Sequence[int], rows: Sequence[Row], progress: Callable[[str], None] = print) -> list[Check]:
    """All checks; ``rows`` from :func:`pair_rows`."""
    checks: list[Check] = []
    for part in (
        pairs(rows),
        views(seeds),
        thirty(seeds[0]),
        juggling(seeds),
        flags(rows, seeds),
        clocks(seeds),
        baseline(seeds),
    ):
        for check in part:
            checks.append(check)
            progress(f"{'ok  ' if check.met else 'MISS'} {check.name}: {check.measured:.3g} ({check.bar or 'no bar'})")
    return checks
