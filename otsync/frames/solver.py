"""Clock and similarity of one pair of videos from motion alone, from first matches to flags."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Int

from ..align.likelihood import LikelihoodScan
from ..align.vouch import drifts
from ..clocks.common import CommonClock, common_clock, nominal_fps
from ..costs.linear import Cosine
from ..match.anchored import AnchoredFGW
from ..match.dense import NearestNeighbor, OptimalTransport, PartialFGW
from ..match.slot import Matcher, MatcherLike
from ..match.vouch import chirality_of
from ..refine.splines import SplineRefine
from ..types import Alignment, Clock, Matches, Similarity, Status, TrackSet, in_order
from ..types.checks import positive
from .clouds import clouds, comes_first, from_units, in_units
from .scan import APART, STRIDE, Shifts, scan
from .weighing import CLOSE, Candidate, Pair, Weighed

SHIFTS_A_TURN = 2
"""Shifts at which candidates of one rotation are weighed: a scene turned over agrees with itself at many shifts, and
would take all places."""

POSE_INFLATION = np.array([1.7] * 3 + [2.2] + [1.7] * 3)
"""Factors on the sigmas of rotation, scale and translation: the tracks of two cameras lie on two sides of the same
bodies, an error that all matches share. Measured where the truth is known, on simulated seeds 100 to 219 and on
basketball (seeds 4 and 5): without them the errors are 1.5 to 1.7 sigma in rotation and 2 to 2.6 in scale (rms)."""


PLAIN = (Cosine(center=False),)

STRUCTURE: tuple[MatcherLike, ...] = (
    AnchoredFGW(restarts=2),
    AnchoredFGW(restarts=2, costs=PLAIN),
    PartialFGW(alpha=5.0),
)
"""First matches: two views of what is alike, and of how much structure counts."""

FEATURES_ALONE: tuple[MatcherLike, ...] = (OptimalTransport(), OptimalTransport(costs=PLAIN), NearestNeighbor())
"""Matches of a second search, where the first one is doubtful. Structure can be wrong as a whole: people turned over
stand like people. Then its wrong matches agree with each other, and outvote the right ones; those of features do not.
"""


MORE = 4
"""Times as many candidates are weighed in the second search. Where people turned over stand like people, the right
answer was the eighth to seventeenth by consensus, and the first by how many tracks move alike."""


@dataclass(frozen=True)
class PoseTrust:
    """Limits beyond which an answer without a common frame is flagged, besides those of :class:`otsync.types.Trust`.

    Chosen on simulated seeds below 1000 and the camera pairs of basketball drawn with seeds 4 and 5;
    ``otsync bench own-frames`` measures from seed 7000 on.

    Args:
        agreement: WEAK when fewer than this share of the smaller video's tracks, weighted by how well, have a
            counterpart that is near and moves alike. NO_MATCH below a third of it. Right answers reach .18 to .35,
            wrong ones .13.
        rival: AMBIGUOUS when another answer reaches this share of the first one's agreement.
        blur: WEAK when the residual of the motion is more than this many seconds of it.
        rotation: LOOSE_POSE when one sigma of the rotation is more than this, degrees.
        scale: LOOSE_POSE when one sigma of the scale is more than this share of it.
        clock: COARSE when one sigma of a pair's offset is more than this many seconds.
        elsewhere: DISAGREE when the likelihood scan of the final matches peaks more than this many seconds away.
        chirality: AMBIGUOUS when fewer of the matched quads have the same handedness in both videos.
    """

    agreement: float = 0.14
    rival: float = 0.6
    blur: float = 4.2 / 30
    rotation: float = 2.25
    scale: float = 0.05
    clock: float = math.inf
    elsewhere: float = 3 / 30
    chirality: float = 0.5

    @classmethod
    def within(
        cls, *, seconds: float | None = None, degrees: float | None = None, scale: float | None = None
    ) -> PoseTrust:
        """The limits of one who needs errors within these: an answer is flagged where two of its sigmas are more.

        Args:
            seconds: of the offset. degrees: of the rotation. scale: as a share of it. None: the usual limit.
        """
        needs = {"clock": ("seconds", seconds), "rotation": ("degrees", degrees), "scale": ("scale", scale)}
        for name, value in needs.values():
            if value is not None:
                positive(f"PoseTrust.within, {name}", value)
        return cls(**{limit: value / 2 for limit, (_, value) in needs.items() if value is not None})

    def loose(self, transform: Similarity | None) -> bool:
        """Whether the pose is unknown, or known to less than these limits."""
        S = transform
        return S is None or not (S.rotation_sigma < self.rotation and S.scale_sigma < self.scale)


@dataclass(frozen=True)
class OwnFrames:
    """Clock, rotation, translation and scale between two videos that share no frame of reference.

    Positions say nothing across frames; the distances among a video's own tracks do, since no rigid motion changes
    them. So: matches by Gromov-Wasserstein on these distances, fused with features -> at every shift the similarity
    that most matches agree on, by consensus of three tracks at a time -> each candidate laid over the other video,
    matched anew in the common frame, fitted, and weighed by how many tracks then lie near each other *and* move alike
    -> for the best, a joint fit of offset, rotation, translation and scale on continuous curves -> flags.

    Args:
        matcher: of the first matches; None: :class:`AnchoredFGW` with features that are centred and not, and
            :class:`PartialFGW`, pooled. What reads positions across videos has no meaning here.
        best: matches taken of each. draws: triples at each shift. near: units of the scene within which they agree.
        candidates: answers of the scan that are weighed.
        limit: of more tracks only so many are read, those seen longest.
        max_lag: largest |offset| in seconds; None: whatever leaves 0.8 s in common.
        seed: of the draws. trust: limits behind the flags.
    """

    matcher: Matcher | None = None
    best: int = 70
    draws: int = 100
    near: float = 0.1
    candidates: int = 5
    limit: int = 300
    max_lag: float | None = None
    seed: int = 0
    trust: PoseTrust = field(default_factory=PoseTrust)

    def __post_init__(self) -> None:
        for name in ("best", "draws", "candidates", "limit"):
            if int(getattr(self, name)) < 1:
                raise ValueError(f"OwnFrames.{name}: expected a whole number >= 1; found {getattr(self, name)}.")
        if int(self.seed) < 0:
            raise ValueError(f"OwnFrames.seed: expected a whole number >= 0; found {self.seed}.")
        positive("OwnFrames.near", self.near)
        if self.max_lag is not None:
            positive("OwnFrames.max_lag", self.max_lag, zero=True)

    def __call__(
        self, a: TrackSet, b: TrackSet, start: tuple[Clock, Similarity] | None = None
    ) -> tuple[Matches, Alignment]:
        """The matches in the common frame, and the alignment with its ``transform`` from b's frame to a's.

        Args:
            start: clock and similarity to begin from instead of the search, as when the graph predicts them.

        The answer is the same, inverted, when the videos are exchanged, and does not change with their frames.
        """
        started = time.process_time()
        if comes_first(a, b):
            matches, found = self._solve(a, b, start)
        else:
            turned = None if start is None else (_inverse_clock(start[0]), start[1].inverse())
            matches, found = self._solve(b, a, turned)
            matches, found = matches.swapped(), _exchanged(found)
        spent = {"seconds": time.process_time() - started}
        return matches, replace(found, stats=found.stats | spent)

    def _solve(self, a: TrackSet, b: TrackSet, start: tuple[Clock, Similarity] | None) -> tuple[Matches, Alignment]:
        few = min(len(a), len(b)) < 4
        made = None if few else clouds(a, b, self.limit)
        if made is None:
            why = Status.FEW_MATCHES if few else Status.NO_INFORMATION
            return nothing(why), Alignment(math.nan, fps=min(nominal_fps(a), nominal_fps(b)), flags=(why,))
        pair = Pair.of(*made)
        stats: dict[str, float] = {}
        if start is None:
            tops, stats = self._search(pair)
        else:
            tops = [(0.0, start[0].offset, in_units(start[1], *made))]
        weighed = pair.weigh_all(tops)
        if start is None and self.matcher is None and self._doubtful(weighed, pair) and not pair.still():
            tops, _ = self._search(pair, FEATURES_ALONE, MORE * self.candidates)
            weighed = sorted([*weighed, *pair.weigh_all(tops)], key=lambda w: -w.agreement)
            stats["second_search"] = 1.0
        if not weighed:
            fps = min(nominal_fps(a), nominal_fps(b))
            return nothing(Status.NO_MATCH), Alignment(math.nan, fps=fps, flags=(Status.NO_MATCH,), stats=stats)
        first = weighed[0]
        return self._answer(a, b, pair, first, pair.rival(first, weighed[1:]), stats)

    # --- the search ---------------------------------------------------------------------------------------------

    def _doubtful(self, weighed: list[Weighed], pair: Pair) -> bool:
        """Whether the best candidate is so poor, or so nearly reached, that it pays to look elsewhere."""
        if not weighed:
            return True
        first = weighed[0]
        share = first.agreement / min(len(pair.a), len(pair.b))
        rival = max((w.agreement for w in weighed[1:] if not first.same(w)), default=0.0)
        poor = share < self.trust.agreement or first.joint.blur > self.trust.blur
        return poor or rival > self.trust.rival * first.agreement

    def _search(
        self, pair: Pair, matchers: tuple[MatcherLike, ...] = STRUCTURE, most: int | None = None
    ) -> tuple[list[Candidate], dict[str, float]]:
        """At most ``most`` (:attr:`candidates`) candidates for offset and similarity, most promising first."""
        proposed = self._propose(pair, matchers)
        if len(proposed) < 4:
            return [], {"proposed": float(len(proposed))}
        clock = thinned(common_clock(pair.a.tracks, pair.b.tracks, Matches(proposed)))
        shifts = scan(clock, draws=self.draws, near=self.near, seed=self.seed, max_lag=self.max_lag)
        tops = different(shifts, clock, most or self.candidates)
        stats = {"proposed": float(len(proposed)), "consensus": tops[0][0] if tops else 0.0}
        return tops, stats

    def _propose(self, pair: Pair, matchers: tuple[MatcherLike, ...]) -> Int[np.ndarray, "M 2"]:
        """Matches by structure and features, or by features alone; none of position."""
        chosen = matchers if self.matcher is None else (self.matcher,)
        found = [m(pair.a.tracks, pair.b.tracks).best(self.best).pairs for m in chosen]
        return np.unique(np.concatenate(found), axis=0)

    # --- the answer ---------------------------------------------------------------------------------------------

    def _answer(
        self, a: TrackSet, b: TrackSet, pair: Pair, first: Weighed, rival: float, stats: dict[str, float]
    ) -> tuple[Matches, Alignment]:
        """Args: rival: agreement of the best other answer."""
        sure = first.agreement >= self.trust.agreement * min(len(pair.a), len(pair.b))
        joint = pair.finish(first.joint, sure)
        laid = pair.overlay(joint)
        finished = laid.agreement()
        agreement = finished / min(len(pair.a), len(pair.b))
        # its rivals were fitted on, too
        stats = stats | {"rival": rival / max(finished, first.agreement, 1e-300)}
        pairs, cost = laid.matches(pair.features, *CLOSE)
        covariance = joint.transform.covariance
        assert covariance is not None
        inflated = np.outer(POSE_INFLATION, POSE_INFLATION) * covariance
        transform = from_units(joint.transform.with_covariance(inflated), pair.a, pair.b)
        rows = np.stack([pair.a.index[pairs[:, 0]], pair.b.index[pairs[:, 1]]], 1)
        matches = Matches(rows, -cost, stats={"agreement": agreement})
        common = "common"
        here = replace(a, frame=common)
        there = moved(b, transform, common)
        scanned = LikelihoodScan(max_lag=self.max_lag)(here, there, matches)
        begun = replace(scanned, offset=joint.clock.offset, sigma=math.sqrt(joint.offset_variance))
        fine = SplineRefine()(here, there, matches, begun)
        stats = (
            fine.stats
            | stats
            | {
                "agreement": agreement,
                "joint_offset": joint.clock.offset,
                "rotation_sigma": transform.rotation_sigma,
                "scale_sigma": transform.scale_sigma,
                "place": joint.place,
                "blur": fine.stats.get("blur", joint.blur),
                "elsewhere": abs(scanned.offset - joint.clock.offset),
                "chirality": chirality_of(a, b, rows[:, 0], rows[:, 1]),
            }
        )
        still = (Status.STATIC,) if drifts(a, rows[:, 0]) and drifts(b, rows[:, 1]) else ()
        found = replace(fine, transform=transform, stats=stats)
        return matches, replace(found, flags=in_order((*fine.flags, *self._flags(found), *still)))

    def _flags(self, fine: Alignment) -> tuple[Status, ...]:
        t, stats = self.trust, fine.stats
        raised = {
            Status.NO_MATCH: stats["agreement"] < t.agreement / 3,
            Status.WEAK: stats["agreement"] < t.agreement or stats["blur"] > t.blur,
            Status.AMBIGUOUS: stats["rival"] > t.rival or stats["chirality"] < t.chirality,
            # the scan over all shifts, of the same matches, ended somewhere else
            Status.DISAGREE: stats["elsewhere"] > t.elsewhere,
            Status.LOOSE_POSE: t.loose(fine.transform),
            Status.COARSE: fine.sigma > t.clock,
        }
        return tuple(flag for flag, yes in raised.items() if yes)


def thinned(clock: CommonClock, longest: int = 600) -> CommonClock:
    """Long clips at fewer frames per second: the search needs no more, and its time grows with their square.

    But never fewer than one in :data:`otsync.frames.scan.STRIDE` seconds: the fits that follow reach little further.
    """
    every = -(-max(clock.a.shape[1], clock.b.shape[1]) // longest)
    every = max(1, min(every, int(STRIDE * clock.fps)))
    return CommonClock(clock.a[:, ::every], clock.b[:, ::every], clock.fps / every, clock.origin)


def different(shifts: Shifts, clock: CommonClock, n: int) -> list[Candidate]:
    """The ``n`` best answers that are not the same: (score, offset in seconds, similarity)."""
    found: list[Candidate] = []
    for q in np.argsort(-shifts.scores, axis=None, kind="stable"):
        k, h = divmod(int(q), shifts.scores.shape[1])
        if len(found) == n or shifts.scores[k, h] <= 0:
            break
        S, offset = shifts.similarity(k, h), float(clock.seconds(shifts.lags[k]))
        # the fits that follow reach a third of a second and some 25 degrees: nearer answers are one
        turn = math.degrees(math.acos(APART))
        near = [abs(offset - o) for _, o, s in found if S.degrees_from(s) <= turn]
        if len(near) < SHIFTS_A_TURN and all(late > 10 / 30 for late in near):
            found.append((float(shifts.scores[k, h]), offset, S))
    return found


def moved(tracks: TrackSet, by: Similarity, frame: str) -> TrackSet:
    """The tracks in the frame that ``by`` leads to."""
    xyz = by(np.nan_to_num(tracks.positions()))
    sigma = None if tracks.sigma is None else by.scale * tracks.sigma
    camera = None if tracks.camera is None else by.camera(tracks.camera)
    return replace(tracks, xyz=xyz, sigma=sigma, camera=camera, frame=frame)


def nothing(why: Status) -> Matches:
    return Matches(np.zeros((0, 2), int), flags=(why,))


def _inverse_clock(clock: Clock) -> Clock:
    return Clock(-clock.offset / clock.rate, 1 / clock.rate)


def _exchanged(found: Alignment) -> Alignment:
    """The same answer for the exchanged pair."""

    def flip(x: np.ndarray | None) -> np.ndarray | None:
        return None if x is None else np.stack([-x[:, 0], x[:, 1]], 1)

    curve = flip(found.curve)
    stats = {k: -v if k == "joint_offset" else v for k, v in found.stats.items()}
    hypotheses = flip(found.hypotheses)
    assert hypotheses is not None
    return replace(
        found,
        offset=-found.offset,
        hypotheses=hypotheses,
        curve=None if curve is None else curve[::-1].copy(),
        transform=None if found.transform is None else found.transform.inverse(),
        stats=stats,
    )
