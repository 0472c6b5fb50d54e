"""Thresholds behind the flags, in one place: when an answer is to be trusted.

Lengths of time are seconds (the designs' frame counts at 30 fps); nothing has a unit of length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Trust:
    """Limits beyond which an alignment is flagged.

    Chosen on simulated worlds of seeds below 10,000 (each note names its own); ``otsync bench thresholds`` says what
    other values would do on them, and ``otsync bench trust`` measures from seed 20,000 on.

    Args:
        evidence: WEAK below this rise of the score's peak over its median, in nats a match. Right answers that no other
            flag refuses have 13 and more (260 pairs, hard and brutal, seeds 500-699).
        margin: AMBIGUOUS when another peak comes this close to the first, as a share of the first's rise, altogether
            or per common frame.
        returning: AMBIGUOUS when a video is, by what is seen of it, this much like itself at another time, as a share
            of how like the other one it is at the answer; of times only at which the scan had nothing to compare, where
            no peak could say so. Of pairs with a video that has no frame in common the share is about 1 (ten such
            videos of one scene), of the right pairs beside them .35.
        disagreement: DISAGREE when slow velocities or windowed positions peak further away than this, s.
        alias: ALIAS when the score divided by the overlap peaks further away than this, s.
        overlap: SHORT_OVERLAP below this many seconds in common.
        matches: FEW_MATCHES below this effective number of matches.
        motion: STATIC when the motion that both videos share is below this share of the scene's extent.
        moved: MOVED when the sub-frame fit ends further from the scan's peak than this, s.
        spread: SPREAD when fits with other detrending windows differ by more than this, s.
        correlation: POOR_FIT below this pooled correlation of the matched velocities, over a third of a second, at the
            answer. Three of 60 brutal answers that were right had .45 to .53 (seeds 500-559); two scenes have .51 at
            most, and next to none in ``common``.
        blur: WEAK when the rms residual of the fit is more than this many seconds of rms motion: right answers to
            brutal noise (seeds 500-539) have up to 6.4 frames.
        common: WEAK when less than this share of the matched velocities, moment by moment, is common to both videos. Of
            40 brutal worlds (seeds 500-539) those whose answer is right, and that no other flag refuses, have .22 and
            more; rain, static scenes with one drift and two scenes (20 each, seeds 41000-41019) have .06, .13 and .16
            at most.
        wander: BROKEN_CLOCK when the offsets of single seconds differ by more than this share of ``blur``: of noise
            they differ by .08 of it at most (16 pairs each, mid to brutal), in two takes of one choreography by .12 to
            .46. Sigma counts what they differ by beyond it.
        unsteady: BROKEN_CLOCK when single seconds, each fitted by itself, are off by more than this, rms, in units of
            how well each is known. Of 320 right answers (mid to brutal, few tracks, like people, drifts; seeds
            41000-41029) none has more than 1.65; two takes that were trusted 2.3 to 4.
        astray: BROKEN_CLOCK when one of these seconds is off by more than this, in the same units, which many others
            hide in a mean. Of 18 right answers to hard and brutal worlds none has more than 2.2 (seeds 79100-79113);
            two takes have 5.6 and more there, and one that was trusted 4.0 (80113).
        untold: BROKEN_CLOCK when things move in the first or the last second, and their offset there, fitted by itself,
            is not known to this many seconds, while single seconds usually know theirs three times better. Of the same
            right answers three of 210 have more; brutal tracks that froze behind their first second, 15 frames off
            there at sigma .22, have 9.8, ten frames that were lost .7 s before the end 1.4 and 2.6.
        lag: LAGGING when the tracks of one video differ by more than this many seconds, in the mean, in how late they
            are: see :mod:`otsync.sync.lags`. Of 648 videos without delays two have more (clean, mid and hard, seeds
            82000-82599); of 57 with delays of 3 frames in the mean three have less.
        parted: LAGGING when a neighbourhood of matches, fitted by itself, is off by more than this many units of how
            well it is known (:mod:`otsync.sync.witnesses`). Of 262 right answers (mid to brutal, like people, drifts;
            seeds 41000-41019) none has more than 6.0; where one of two performers, or every second limb, is 8 frames
            late, wrong answers that were trusted have 9 and more.
        rate_gain: RATE_MISMATCH when another common ratio of frame rates raises the score's peak by this factor.
        rate_sigmas: a fitted rate counts when it differs from the declared one by more than this many sigmas. Clocks
            that run as declared differ by half a sigma, rms, and by 1.3 at most (mid noise, 10 and 20 s), under hard
            noise by 1.1 and 2.0 (20 s; 12 each, seeds 66200-66211); those of .1 % over 20 s by 3.5 and more (22 worlds
            of mid noise).
    """

    evidence: float = 12.0
    margin: float = 0.15
    returning: float = 0.75
    disagreement: float = 3 / 30
    alias: float = 3 / 30
    overlap: float = 40 / 30
    matches: float = 5.0
    motion: float = 0.02
    moved: float = 2 / 30
    spread: float = 0.5 / 30
    correlation: float = 0.45
    blur: float = 8 / 30
    common: float = 0.18
    wander: float = 0.1
    unsteady: float = 2.0
    astray: float = 3.5
    untold: float = 1 / 30
    lag: float = 0.3 / 30
    parted: float = 7.0
    rate_sigmas: float = 3.0
    rate_gain: float = 1.3

    def check(self, owner: str, reads: tuple[str, ...]) -> None:
        """ValueError for a limit that is set although its owner does not read it, or that is no number.

        Args:
            owner: "LikelihoodScan.trust", in the error. reads: names of the limits that the owner reads.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
                raise ValueError(f"{owner}.{field.name}: expected a finite number; found {value!r}.")
            if field.name not in reads and value != field.default:
                raise ValueError(
                    f"{owner}.{field.name}: expected one of {', '.join(reads)}, which are what it reads; found "
                    f"{value:g}. Leave it out, or set it where it is read (the scan's limits in the aligner, the fit's "
                    "in the refiner)."
                )
