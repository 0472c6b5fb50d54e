"""Statuses of answers: one code per finding, whose text is the remedy."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import Any


class Status(StrEnum):
    """Outcome of a verb, from harmless to grave; ``str(status)`` says what happened and what to do about it.

    Results carry ``status`` (the gravest) and ``flags`` (all of them). ``status.ok`` means "to be trusted".
    Files store ``status.code``, the lower-case name.
    """

    OK = "To be trusted."
    COARSE = (
        "The offset is known to about a frame, not to a fraction: sigma is more than a third of a frame. Use longer "
        "clips, sharper or swifter motion, or more videos; a reconstruction (otsync run) refines it by the pictures."
    )
    FORCED = (
        "Part of the matches join tracks that are nothing alike: what only one video sees was forced onto something. "
        "Use only the best of them, or a matcher of partial or relaxed mass (PartialFGW, UnbalancedFGW, AnchoredFGW)."
    )
    RATE_MISMATCH = (
        "The motion contradicts the declared frame rates. Check fps (29.97 against 30, 25 against 30) or the "
        "container's timestamps; with depth, let the rate be fitted (rate='fit', the default)."
    )
    BROKEN_CLOCK = (
        "Parts of the overlap seem to have offsets of their own, or frames are shown far better at another time of the "
        "scene: a video froze, lost frames, was paused or cut, tracks slide over what they follow, or a fit began far "
        "off. Look at the parts; give the true timestamps, or cut the recording there."
    )
    LAGGING = (
        "Tracks of this video, or of the reference, come late by delays of their own: those of a tracker that filters "
        "as it goes, or a part of the scene that is shown late (a screen, another tracker). By how much all of them "
        "are late nobody can tell. Track without such a filter, or leave that part out."
    )
    POOR_FIT = (
        "The matched motions hardly correlate at the answer. Check that both videos show the same scene, and the "
        "matches and camera poses."
    )
    SPREAD = (
        "Fits that see slow and fast motion disagree. Use less smoothed tracks or more matches, or read sigma as a "
        "lower bound."
    )
    MOVED = (
        "The sub-frame fit left the peak of the frame-level scan. Look at the score curve; more or better matches "
        "usually settle it."
    )
    SHORT_OVERLAP = "The videos overlap by too little to be sure. Use longer clips, or limit max_lag if you know more."
    BORDER = "The best offset lies at the border of the search range. Widen max_lag, or use longer clips."
    FEW_MATCHES = "Too few matches carry the answer. Lift more tracks, or use a more permissive matcher."
    ALIAS = (
        "Weighted by overlap another offset wins: a periodic motion or a short overlap may alias. Add videos to the "
        "graph, or limit max_lag."
    )
    AMBIGUOUS = (
        "Several answers explain the data about equally well (a periodic motion; a symmetric or mirrored scene). Look "
        "at the hypotheses; add videos to the graph, limit max_lag, use a longer clip, or features and labels that "
        "tell the parts apart."
    )
    DISAGREE = (
        "Slow motion, fast motion and positions point to different offsets. Check the matches; wrong ones or a "
        "drifting depth do this."
    )
    WEAK = "The evidence for this offset is weak. Use more tracks on moving things, or longer clips."
    LOOSE_POSE = (
        "The tracks leave the pose between the videos loose: they lie on a line, close together, or agree badly. Track "
        "more of the scene, or use longer clips."
    )
    CONTRADICTED = (
        "The photometric fit moved this clock by more than three sigmas of what tracks and pictures say together: one "
        "of them is wrong. Fit longer (--steps), or keep the clock of the tracks (--freeze offsets)."
    )
    MISPLACED = (
        "The camera of this video may stand elsewhere than the scene says: its calibration is doubtful, or most of its "
        "pairs are. Look at calibration in scene.json (otsync calibrate says what to film), run otsync check, or leave "
        "the video out."
    )
    STATIC = "Nothing moves enough to tell the time. Choose a part of the clip with motion, or track the moving parts."
    INCONSISTENT = (
        "The pairs of this video contradict the rest of the graph. Look at its residuals in the report; a wrong "
        "pair or a wrong frame rate does this."
    )
    NO_INFORMATION = (
        "Costs are constant: neither features nor structure distinguish the tracks. Use informative features, or "
        "tracks that are not all alike."
    )
    NO_MATCH = "No trustworthy matches: the videos seem to be unrelated. Check that they show the same scene."
    NO_OVERLAP = "No offset leaves enough common frames with observed matches. Use longer clips or more matches."
    DISCONNECTED = "No usable pair links this video to the reference: its offset is on the clock of its own component."
    FAILED = "The computation failed; stats or the log say why. Mend the input and run this pair again."

    @property
    def ok(self) -> bool:
        """Whether the answer is to be trusted."""
        return self is Status.OK

    @property
    def code(self) -> str:
        """Short stable name used in files and tables, e.g. ``'short_overlap'``."""
        return self.name.lower()

    @classmethod
    def from_code(cls, code: str) -> Status:
        """The status of a file's ``code``; ValueError with the known codes otherwise."""
        try:
            return cls[code.upper()]
        except (KeyError, AttributeError):
            known = ", ".join(s.code for s in cls)
            raise ValueError(f"status: expected one of {known}; found {code!r}.") from None


_RANK = {status: rank for rank, status in enumerate(Status)}


def gravest(flags: Iterable[Status]) -> Status:
    """The gravest of ``flags`` (declaration order of :class:`Status`); ``OK`` when there are none."""
    return max(flags, key=_RANK.__getitem__, default=Status.OK)


def in_order(flags: Iterable[Status]) -> tuple[Status, ...]:
    """``flags`` without repetition and without ``OK``, gravest first."""
    return tuple(sorted(set(flags) - {Status.OK}, key=_RANK.__getitem__, reverse=True))


class Refused(RuntimeError):
    """A single-pair verb would not vouch for its answer; ``.result`` holds it all the same.

    Pass ``throw=False`` to receive the flagged result instead.
    """

    def __init__(self, verb: str, result: Any):
        self.result = result
        reasons = "; ".join(f"{flag.code}: {flag}" for flag in (result.flags or (result.status,)))
        super().__init__(f"{verb}: {reasons} (throw=False returns the flagged result)")
