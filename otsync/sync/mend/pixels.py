"""Clocks that break, put right by what pixels tell."""

from __future__ import annotations

from collections.abc import Sequence

from ...epipolar.breaks import Found, find_breaks
from ...epipolar.refine import EpipolarRefine
from ...epipolar.scan import EpipolarScan
from ...epipolar.steady import unsteady
from ...refine.slot import Refiner
from ...types import Break, Matches
from ..graph import Pair
from ..hearing import Hearing, on_own_clock
from ..pairs import run
from ..verdict import Verdict
from .breaks import MOST, SAME_MOMENT, mended


def mended_in_pixels(hearing: Hearing, aligner: EpipolarScan, refining: Refiner) -> Hearing:
    """Clocks that break put right, or their pairs doubted."""
    refiner = refining if isinstance(refining, EpipolarRefine) else EpipolarRefine()

    def told(h: Hearing) -> list[Found]:
        return find_breaks(aligner, refiner, h.tracks, _matches(h.verdict), h.verdict.x, h.broken)

    for _ in range(MOST):
        found = told(hearing)
        new = [f for f in found if f.broke is not None and not _known(f.broke, hearing.broken.get(f.video, ()))]
        if not new:
            break
        surest = max(new, key=lambda f: f.gain)
        assert surest.broke is not None
        hearing = hearing.mended(surest.video, mended(hearing.tracks[surest.video], (surest.broke,)), surest.broke)
        hearing = hearing.told({answer.pair: answer for answer in hearing.map(run, hearing.of(surest.video))})
    else:
        found = told(hearing)
    return hearing.doubted_videos({f.video for f in found})


def without_unsteady(hearing: Hearing, aligner: EpipolarScan) -> Hearing:
    """All pairs of videos doubted whose windows are off against all others alike."""
    sound = {a.pair: a.matches for a in hearing.answers if a.sound}
    return hearing.doubted_videos(unsteady(aligner, hearing.tracks, sound, hearing.verdict.x))


def _matches(verdict: Verdict) -> dict[Pair, Matches]:
    """The matches of all pairs, the surest first."""
    surest = sorted(verdict.answers, key=lambda a: (not a.refined.status.ok, -a.scanned.stats.get("evidence", 0.0)))
    return {a.pair: a.matches for a in surest if len(a.matches)}


def _known(found: Break, earlier: Sequence[Break]) -> bool:
    """Whether a break, told on a mended clock, is one that was mended."""
    at = on_own_clock(found, earlier).at
    return any(abs(at - b.at) < SAME_MOMENT for b in earlier)
