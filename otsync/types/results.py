"""Results of the verbs: matches of a pair, alignment of a pair, offsets of all videos."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..files.arrays import write_json
from . import drawing
from .camera import Video
from .clock import Break, Clock, mended_times
from .offsets_file import BREAKS, FORMAT, FRAMES, SIGN, VERSION, read_offsets
from .similarity import Similarity
from .status import Status, gravest, in_order
from .tracks import TrackSet

Stats = dict[str, float]


@dataclass(frozen=True, eq=False)
class Matches:
    """Corresponding tracks of two videos. ``Matches(pairs, score)`` alone is valid: bring your own.

    Args:
        pairs: (M,2) indices into a's and b's tracks; a track may appear in several pairs.
        score: (M,), larger is better; None: all equal.
        weight: (M,) >= 0, how much each pair counts in the scan and the fit, in any unit; None: all alike.
        plan: the transport plan, dense (Na,Nb) or scipy.sparse, when the matcher has one.
        flags: what there is to know about the answer, gravest first. ``status`` is the gravest, OK without any.
        stats: objective, iterations, seconds, marginal_error, mass, ...
    """

    pairs: Int[np.ndarray, "M 2"]
    score: Float[np.ndarray, " M"] | None = None
    plan: Any = None
    flags: tuple[Status, ...] = ()
    stats: Stats = field(default_factory=dict)
    weight: Float[np.ndarray, " M"] | None = None

    def __post_init__(self) -> None:
        pairs = np.asarray(self.pairs)
        if pairs.size == 0:
            pairs = pairs.reshape(0, 2).astype(np.int64)
        if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype.kind not in "iu":
            raise ValueError(
                f"Matches.pairs: expected integers of shape (M,2); found {pairs.dtype} of shape {pairs.shape}."
            )
        if (pairs < 0).any():
            raise ValueError("Matches.pairs: expected indices >= 0; found negative ones.")
        score = np.ones(len(pairs)) if self.score is None else np.asarray(self.score, float)
        if score.shape != (len(pairs),) or np.isnan(score).any():
            raise ValueError(
                f"Matches.score: expected {len(pairs)} numbers without nan; found shape {score.shape}"
                f"{' with nan' if np.isnan(score).any() else ''}."
            )
        if self.weight is not None:
            weight = np.asarray(self.weight, float)
            if weight.shape != (len(pairs),) or not (np.isfinite(weight).all() and (weight >= 0).all()):
                raise ValueError(
                    f"Matches.weight: expected {len(pairs)} finite numbers >= 0; found shape {weight.shape} or others."
                )
            object.__setattr__(self, "weight", weight)
        object.__setattr__(self, "pairs", pairs.astype(np.int64))
        object.__setattr__(self, "score", score)
        object.__setattr__(self, "flags", in_order(self.flags))

    @property
    def status(self) -> Status:
        """The gravest flag; OK when there is none."""
        return gravest(self.flags)

    def __len__(self) -> int:
        return len(self.pairs)

    def check(self, name: str, n_a: int, n_b: int) -> None:
        """ValueError, naming the argument, when a pair points beyond the tracks."""
        for column, n, side in ((0, n_a, "a"), (1, n_b, "b")):
            top = int(self.pairs[:, column].max(initial=-1))
            if top >= n:
                raise ValueError(
                    f"{name}.pairs: expected indices of {side} below {n}; found {top}. Are a and b swapped?"
                )

    def best(self, n: int) -> Matches:
        """The ``n`` best by score, ties in the given order."""
        assert self.score is not None
        return self.take(np.argsort(-self.score, kind="stable")[:n])

    def take(self, index: Any) -> Matches:
        """The pairs at ``index`` (integers, a slice or a mask), in that order."""
        assert self.score is not None
        weight = None if self.weight is None else self.weight[index]
        return replace(self, pairs=self.pairs[index], score=self.score[index], weight=weight)

    @property
    def shares(self) -> Float[np.ndarray, " M"]:
        """Weights with mean 1; ones where there are none, or only zeros."""
        if self.weight is None or not self.weight.any():
            return np.ones(len(self))
        return self.weight / self.weight.mean()

    def without_plan(self) -> Matches:
        """The same matches without the plan, which is as large as both videos' tracks multiplied."""
        return replace(self, plan=None)

    def swapped(self) -> Matches:
        """The same matches with a and b exchanged."""
        plan = None if self.plan is None else self.plan.T
        return replace(self, pairs=self.pairs[:, ::-1], plan=plan)

    def __repr__(self) -> str:
        return drawing.matches_line(self)

    def _repr_html_(self) -> str:
        return drawing.matches_table(self)

    def plot(self, a: TrackSet, b: TrackSet, *, offset: float = 0.0, most: int = 100, ax: Any = None) -> Any:
        """Draw the best matches at the moment at which most of them are seen; the matplotlib axes.

        In space where both sets have positions: points of a and b with a line between the two of each match. Else in
        pixels, b's picture beside a's.

        Args:
            a, b: the matched track sets. offset: of b against a in seconds. most: matches that are drawn.
            ax: axes to draw on, three-dimensional ones for positions; default: those of a new figure.

        ValueError where no match is seen in both at one moment.
        """
        self.check("matches", len(a), len(b))
        seen = drawing.shared_moment(a, b, self.best(most).pairs, offset)
        if seen is None:
            raise ValueError(
                f"offset: expected one at which a match is seen in both; found none at {offset:g} s. Pass "
                "alignment.offset, or more matches."
            )
        k, m, pairs = seen
        if a.xyz is not None and b.xyz is not None:
            ax = drawing.new_axes(4.6, 4.0, solid=True) if ax is None else ax
            first, second = a.positions()[pairs[:, 0], k], b.positions()[pairs[:, 1], m]
            drawing.draw_matches_in_space(ax, first, second, a.name or "a", b.name or "b")
        elif a.uv is not None and b.uv is not None:
            ax = drawing.new_axes(7.2, 2.8) if ax is None else ax
            drawing.draw_matches_in_pixels(ax, a.uv[pairs[:, 0], k], b.uv[pairs[:, 1], m], a, b)
        else:
            raise ValueError("a, b: expected both with positions, or both with pixels; found one of each. Lift both.")
        drawing.plain(ax)
        return ax


COARSE_FRAMES = 1 / 3
"""Sigma, in frames of the slower of a video and its reference, from which an offset is not known to a frame: three
sigmas are one. Of recordings that ``recon simulate`` films (seeds 30-41), 5 of the 47 offsets from pixels that nothing
else flagged were off by more than a frame, at sigmas of .38 to 1.3."""

UNEVEN = 0.75
"""Sigma at one end of an overlap over that at the other below which tables and reports tell both."""

_NO_PEAKS = np.zeros((0, 2))


@dataclass(frozen=True, eq=False)
class Alignment:
    """When b happened on a's clock: ``t_a = rate * t_b + offset``; ``offset(a,b) = offset_b - offset_a``.

    Args:
        offset: seconds; positive when b started later than a; nan when there is no answer.
        rate: seconds of a's clock per second of b's.
        sigma: one standard deviation of ``offset`` in seconds, nan when not estimated.
        hypotheses: (H,2) peaks of the score, best first: offset in seconds, score.
        curve: (K,2) the whole score: offset in seconds, score (larger is better; -inf where not defined).
        path: (P,2) frame pairs of a warping path on the common clock.
        cost: frame-to-frame cost on the common clock, nan where no match is seen.
        fps: frames per second of the common clock: ``offset * fps`` is in frames.
        flags: what there is to know about the answer, gravest first. ``status`` is the gravest, OK without any.
        stats: seconds, matches, evidence, ...
        transform: from b's frame of reference to a's, where the videos share none (``frames="own"``); else None.
        parts: (P,2) where one offset does not suit the whole overlap: seconds of a's clock from which on, offset in
            seconds. Empty where one does.
    """

    offset: float
    rate: float = 1.0
    sigma: float = math.nan
    hypotheses: Float[np.ndarray, "H 2"] = field(default_factory=lambda: _NO_PEAKS)
    curve: Float[np.ndarray, "K 2"] | None = None
    path: Int[np.ndarray, "P 2"] | None = None
    cost: Float[np.ndarray, "Ta Tb"] | None = None
    fps: float = math.nan
    flags: tuple[Status, ...] = ()
    stats: Stats = field(default_factory=dict)
    transform: Similarity | None = None
    parts: Float[np.ndarray, "P 2"] = field(default_factory=lambda: _NO_PEAKS)

    def __post_init__(self) -> None:
        object.__setattr__(self, "flags", in_order(self.flags))

    @property
    def status(self) -> Status:
        """The gravest flag; OK when there is none."""
        return gravest(self.flags)

    @property
    def frames(self) -> float:
        """The offset in frames of the common clock."""
        return self.offset * self.fps

    def __repr__(self) -> str:
        return drawing.alignment_line(self)

    def _repr_html_(self) -> str:
        return drawing.alignment_table(self)

    def plot(self, *, truth: float | None = None, ax: Any = None) -> Any:
        """Draw the score over offsets in frames, its peaks and the chosen offset; the matplotlib axes.

        Args:
            truth: the true offset in seconds, where it is known.
            ax: axes to draw on; default: those of a new figure.

        ValueError where there is neither a curve nor a peak.
        """
        if self.curve is None and not len(self.hypotheses):
            raise ValueError("Alignment.curve: expected a score to draw; found neither curve nor peaks. Align again.")
        ax = drawing.new_axes(5.0, 2.6) if ax is None else ax
        drawing.draw_score(ax, self)
        drawing.draw_choice(ax, self, truth)
        return ax


@dataclass(frozen=True, eq=False)
class Offsets:
    """The clocks of V videos: ``t_world = rates[v] * t_v + seconds[v]``.

    Args:
        names, fps: of every video.
        seconds: (V,) offsets; nan where there is no answer. The reference has 0.
        rates: (V,) 1 unless declared or fitted.
        sigma: (V,) one standard deviation in seconds, nan when not estimated; 0 for a reference.
        reference: index of the video whose clock is the world's.
        component: (V,) index of the video whose clock ``seconds[v]`` refers to. All ``reference`` when the videos
            hang together; a disconnected group has a reference of its own.
        alignments: per pair (i, j) the pair's own answer. matches: what it was made from, without plans.
        flags: per video, gravest first; ``status`` has the gravest of each. stats: of the whole.
        transforms: per video, from its own frame of reference to that of its component's reference, None where it
            could not be found; empty where all videos share one frame.
        breaks: per video, in order of time, where its clock breaks; ``seconds`` is of the clock before the first one,
            and :meth:`times` undoes them. Empty where none was looked for.
    """

    names: tuple[str, ...]
    fps: Float[np.ndarray, " V"]
    seconds: Float[np.ndarray, " V"]
    rates: Float[np.ndarray, " V"]
    sigma: Float[np.ndarray, " V"]
    reference: int
    component: Int[np.ndarray, " V"]
    flags: tuple[tuple[Status, ...], ...]
    alignments: Mapping[tuple[int, int], Alignment] = field(default_factory=dict)
    matches: Mapping[tuple[int, int], Matches] = field(default_factory=dict)
    stats: Stats = field(default_factory=dict)
    transforms: tuple[Similarity | None, ...] = ()
    breaks: tuple[tuple[Break, ...], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "breaks", self.breaks or ((),) * len(self.names))
        if len(self.breaks) != len(self.names):
            raise ValueError(
                f"Offsets.breaks: expected a tuple for each of {len(self.names)} videos; found {len(self.breaks)}."
            )
        object.__setattr__(self, "flags", tuple(in_order(flags) for flags in self.flags))
        if self.transforms and len(self.transforms) != len(self.names):
            raise ValueError(
                f"Offsets.transforms: expected one for each of {len(self.names)} videos, or none; found "
                f"{len(self.transforms)}."
            )

    @classmethod
    def known(
        cls,
        names: Sequence[str],
        seconds: Float[np.ndarray, " V"],
        fps: float,
        rates: Float[np.ndarray, " V"] | None = None,
        transforms: Sequence[Similarity | None] = (),
    ) -> Offsets:
        """Offsets that are known, not estimated: sigma 0, no flags; the first video is the reference, whatever it has.

        For truths of simulated worlds, and for clocks that come from elsewhere.
        """
        n = len(names)
        return cls(
            names=tuple(names),
            fps=np.full(n, float(fps)),
            seconds=np.asarray(seconds, float),
            rates=np.ones(n) if rates is None else np.asarray(rates, float),
            sigma=np.zeros(n),
            reference=0,
            component=np.zeros(n, int),
            flags=((),) * n,
            transforms=tuple(transforms),
        )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def status(self) -> tuple[Status, ...]:
        """The gravest flag of each video; OK where there is none."""
        return tuple(gravest(flags) for flags in self.flags)

    def clock(self, v: int) -> Clock:
        """The clock of video v against its reference's."""
        return Clock(float(self.seconds[v]), float(self.rates[v]))

    def times(self, v: int, own: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
        """What the frames of video v show, in seconds of its reference's clock, breaks undone.

        Args:
            own: (T,) seconds of the frames on the video's own clock.

        Frames that stood still have nan.
        """
        shown, tells = mended_times(own, self.breaks[v])
        return np.where(tells, self.clock(v).world(shown), np.nan)

    @property
    def sigma_ends(self) -> Float[np.ndarray, "V 2"]:
        """One standard deviation, s, of what each video shows at the beginning and at the end of what it shares.

        ``sigma`` is the larger one. The other is smaller by as much as it is in the video's pairs (``sigma_begin`` and
        ``sigma_end`` in their statistics), in the middle of these; the same where no pair tells.
        """
        ends = np.repeat(self.sigma[:, None], 2, 1)
        for v in range(len(self)):
            told = [
                [alignment.stats["sigma_begin"], alignment.stats["sigma_end"]]
                for pair, alignment in self.alignments.items()
                if v in pair and {"sigma_begin", "sigma_end"} <= set(alignment.stats)
            ]
            pairs = np.array([pair for pair in told if np.isfinite(pair).all() and max(pair) > 0]).reshape(-1, 2)
            if len(pairs):
                share = np.median(pairs / pairs.max(1, keepdims=True), 0)
                ends[v] *= share / share.max()
        return ends

    @property
    def steps_heard(self) -> Float[np.ndarray, "V 2"]:
        """From when to when, s of its reference's clock, a step of each video's clock by two frames would be heard.

        Before and behind it a clock may have stepped, by frames that were lost or stood still, without a trace that
        rises above the noise. Of any of the video's pairs that are sure (``heard_begin`` and ``heard_end`` in their
        statistics, s of the first one's clock); nan where a step would be heard nowhere, where the video is flagged,
        and where none asked, as of tracks without depth.
        """
        heard = np.full((len(self), 2), np.nan)
        for (i, j), alignment in self.alignments.items():
            ends = np.array([alignment.stats.get(f"heard_{end}", math.nan) for end in ("begin", "end")])
            world = self.clock(i).world(ends)
            for v in (i, j):
                if self.status[v].ok and self.component[v] == self.component[i] == self.component[j]:
                    heard[v] = np.fmin(heard[v, 0], world[0]), np.fmax(heard[v, 1], world[1])
        return heard

    def clock_notes(self) -> list[str]:
        """In words what is unusual about the videos' clocks: rates that are not the declared ones, breaks, and one end
        that is known much better than the other.
        """
        notes = [
            f"{name}: a second of its clock lasts {rate:.5f} s of the reference's; its declared frame rate is wrong"
            for name, rate in zip(self.names, self.rates, strict=True)
            if np.isfinite(rate) and rate != 1
        ]
        for v, (begin, end) in enumerate(self.sigma_ends * self.fps[self.component][:, None]):
            if min(begin, end) < UNEVEN * max(begin, end):
                notes.append(
                    f"{self.names[v]}: one sigma is {begin:.3f} frames at the beginning of what it shares with others, "
                    f"{end:.3f} at the end"
                )
        return notes + [f"{n}: {b}" for n, breaks in zip(self.names, self.breaks, strict=True) for b in breaks]

    @property
    def frames(self) -> Float[np.ndarray, " V"]:
        """Offsets in frames of each video's reference."""
        return self.seconds * self.fps[self.component]

    @property
    def ok(self) -> bool:
        """Whether every video's offset is to be trusted."""
        return all(s.ok for s in self.status)

    def judged_by_sigma(self) -> Offsets:
        """The same, with the flag COARSE on exactly those videos whose sigma is more than :data:`COARSE_FRAMES`."""
        frame = 1 / np.minimum(self.fps, self.fps[self.component])
        with np.errstate(invalid="ignore"):
            coarse = self.sigma > COARSE_FRAMES * frame
        flags = tuple(
            (*(f for f in own if f is not Status.COARSE), *((Status.COARSE,) if wide else ()))
            for own, wide in zip(self.flags, coarse, strict=True)
        )
        return replace(self, flags=flags)

    def between(self, a: int, b: int) -> float:
        """offset(a, b) = offset_b - offset_a in seconds; nan when no chain of pairs links them."""
        return float(self.seconds[b] - self.seconds[a]) if self.component[a] == self.component[b] else math.nan

    def __repr__(self) -> str:
        return drawing.offsets_line(self)

    def _repr_html_(self) -> str:
        return drawing.offsets_table(self)

    def plot(self, videos: Sequence[Video | TrackSet] | None = None, *, ax: Any = None) -> Any:
        """Draw every video as a bar on the common clock, two sigma at its start; the matplotlib axes.

        Args:
            videos: in the order of ``names``, to tell how long they are; without them every bar is a second long.
            ax: axes to draw on; default: those of a new figure.
        """
        if videos is not None and len(videos) != len(self):
            raise ValueError(f"videos: expected {len(self)}, one per name; found {len(videos)}.")
        ax = drawing.new_axes(7.2, 0.9 + 0.24 * len(self)) if ax is None else ax
        drawing.draw_clock_bars(ax, self, drawing.clips_of(videos, len(self)))
        drawing.plain(ax)
        return ax

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``offsets.json``: unit, sign and reference in words; atomically."""
        write_json(path, self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """The content of ``offsets.json``."""
        heard = self.steps_heard
        videos = [
            {
                "name": self.names[v],
                "fps": _number(self.fps[v]),
                "rate": _number(self.rates[v]),
                "offset_seconds": _number(self.seconds[v]),
                "offset_frames": _number(self.frames[v]),
                "sigma_seconds": _number(self.sigma[v]),
                **({"steps_heard_seconds": heard[v].tolist()} if np.isfinite(heard[v]).all() else {}),
                "reference": self.names[self.component[v]],
                "status": self.status[v].code,
                "flags": [f.code for f in self.flags[v]],
                **({"transform": _transform(self.transforms[v])} if self.transforms else {}),
                **({"breaks": [_break(b) for b in self.breaks[v]]} if self.breaks[v] else {}),
            }
            for v in range(len(self))
        ]
        pairs = [
            {
                "a": self.names[i],
                "b": self.names[j],
                "fps": _number(p.fps),
                "rate": _number(p.rate),
                "offset_seconds": _number(p.offset),
                "offset_frames": _number(p.frames),
                "sigma_seconds": _number(p.sigma),
                "status": p.status.code,
                "flags": [f.code for f in p.flags],
                "hypotheses": [[_number(x) for x in row] for row in p.hypotheses],
                "stats": {k: _number(x) for k, x in p.stats.items()},
                **({"transform": _transform(p.transform)} if self.transforms else {}),
            }
            for (i, j), p in sorted(self.alignments.items())
        ]
        return {
            "format": FORMAT,
            "version": VERSION,
            "unit": "seconds",
            "sign": SIGN,
            **({"frames": FRAMES} if self.transforms else {}),
            **({"breaks": BREAKS} if any(self.breaks) else {}),
            "reference": self.names[self.reference],
            "videos": videos,
            "pairs": pairs,
            "stats": {k: _number(x) for k, x in self.stats.items()},
        }

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Offsets:
        """Read ``offsets.json``; matches, curves, paths and cost maps are not in the file.

        A video with an offset has a rate and a frame rate; the reference's clock is the world's: offset 0, rate 1.
        ValueError names file and field.
        """
        fields, pairs = read_offsets(path)
        return cls(**fields, alignments={pair: Alignment(**one) for pair, one in pairs.items()})


def _break(found: Break) -> dict[str, float | None]:
    told = {"at": found.at, "jump": found.jump, "still": found.still, "sigma": found.sigma}
    return {f"{name}_seconds": _number(value) for name, value in told.items()}


def _transform(found: Similarity | None) -> dict[str, Any] | None:
    return None if found is None else found.to_dict()


def _number(x: Any) -> float | None:
    """A JSON number, or None for nan and infinities."""
    x = float(x)
    return x if math.isfinite(x) else None
