"""Results of the verbs: matches of a pair, alignment of a pair, offsets of all videos."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..files.arrays import read_json, write_json
from . import drawing
from .camera import Video
from .clock import Clock
from .similarity import Similarity
from .status import Status, gravest, in_order
from .tracks import TrackSet

Stats = dict[str, float]

FORMAT, VERSION = "otsync.offsets", 1
SIGN = (
    "t_world = rate * t_video + offset_seconds, t_video in seconds on the video's own clock; a positive offset means "
    "that the video started later than its reference; offset_frames = offset_seconds * fps of the reference"
)

FRAMES = (
    "every video has a frame of reference of its own; transform: x_reference = scale * R(quaternion w, x, y, z) * x_video "
    "+ translation, in units of the reference (of pairs: from b's frame to a's); covariance: of a small rotation vector "
    "(3, radians), relative scale (1) and translation (3) that act after it"
)


@dataclass(frozen=True, eq=False)
class Matches:
    """Corresponding tracks of two videos. ``Matches(pairs, score)`` alone is valid: bring your own.

    Args:
        pairs: (M,2) indices into a's and b's tracks; a track may appear in several pairs.
        score: (M,), larger is better; None: all equal.
        plan: the transport plan, dense (Na,Nb) or scipy.sparse, when the matcher has one.
        flags: what there is to know about the answer, gravest first. ``status`` is the gravest, OK without any.
        stats: objective, iterations, seconds, marginal_error, mass, ...
    """

    pairs: Int[np.ndarray, "M 2"]
    score: Float[np.ndarray, " M"] | None = None
    plan: Any = None
    flags: tuple[Status, ...] = ()
    stats: Stats = field(default_factory=dict)

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
        order = np.argsort(-self.score, kind="stable")[:n]
        return replace(self, pairs=self.pairs[order], score=self.score[order])

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

    def __post_init__(self) -> None:
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

    @property
    def frames(self) -> Float[np.ndarray, " V"]:
        """Offsets in frames of each video's reference."""
        return self.seconds * self.fps[self.component]

    @property
    def ok(self) -> bool:
        """Whether every video's offset is to be trusted."""
        return all(s.ok for s in self.status)

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
        videos = [
            {
                "name": self.names[v],
                "fps": _number(self.fps[v]),
                "rate": _number(self.rates[v]),
                "offset_seconds": _number(self.seconds[v]),
                "offset_frames": _number(self.frames[v]),
                "sigma_seconds": _number(self.sigma[v]),
                "reference": self.names[self.component[v]],
                "status": self.status[v].code,
                "flags": [f.code for f in self.flags[v]],
                **({"transform": _transform(self.transforms[v])} if self.transforms else {}),
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
        data = read_json(path)
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise ValueError(f"{path}: expected an offsets file written by otsync (format {FORMAT!r}); found another.")
        if data.get("version") != VERSION:
            raise ValueError(
                f"{path}: expected version {VERSION}; found {data.get('version')!r}. Read it with the otsync release "
                "that wrote it, or write it anew with this one."
            )
        try:
            return cls._from_dict(data)
        except (KeyError, TypeError, IndexError, AttributeError, OverflowError) as error:
            detail = f"{type(error).__name__}: {error}"
        except ValueError as error:
            detail = str(error)
        raise ValueError(f"{path}: not a sound offsets file; {detail}. Write it anew.")

    @classmethod
    def _from_dict(cls, data: dict[str, Any]) -> Offsets:
        videos = data["videos"]
        index = {video["name"]: v for v, video in enumerate(videos)}
        if len(index) != len(videos) or not videos or not all(isinstance(name, str) and name for name in index):
            raise ValueError("videos: expected at least one, with unique names")

        def column(key: str, **bounds: float) -> np.ndarray:
            return np.array([_float(video[key], f"videos, {video['name']}: {key}", **bounds) for video in videos])

        def place(name: Any, what: str) -> int:
            if name not in index:
                raise ValueError(f"{what}: expected one of {', '.join(index)}; found {name!r}")
            return index[name]

        alignments: dict[tuple[int, int], Alignment] = {}
        for p in data["pairs"]:
            pair = place(p["a"], "pairs: a"), place(p["b"], "pairs: b")
            what = f"pairs, {p['a']}-{p['b']}"
            if pair[0] == pair[1] or pair in alignments:
                raise ValueError(f"{what}: expected two videos, each pair once; found it again or with itself")
            alignments[pair] = Alignment(
                offset=_float(p["offset_seconds"], f"{what}: offset_seconds"),
                rate=_float(p["rate"], f"{what}: rate", above=0),
                sigma=_float(p["sigma_seconds"], f"{what}: sigma_seconds", least=0),
                hypotheses=_rows_of_two(p["hypotheses"], f"{what}: hypotheses"),
                fps=_float(p["fps"], f"{what}: fps", above=0),
                flags=_flags(p["flags"], p["status"], what),
                stats={str(k): _float(x, f"{what}: stats, {k}") for k, x in p["stats"].items()},
                transform=_transform_from(p.get("transform"), what),
            )
        reference = place(data["reference"], "reference")
        component = np.array([place(video["reference"], f"videos, {video['name']}: reference") for video in videos])
        astray = np.flatnonzero(component[component] != component)
        if len(astray) or component[reference] != reference:
            v = int(astray[0]) if len(astray) else reference
            raise ValueError(
                f"videos, {videos[v]['name']}: reference: expected a video that is its own reference; found "
                f"{videos[v]['reference']!r}"
            )
        seconds, rates, fps = column("offset_seconds"), column("rate", above=0), column("fps", above=0)
        for key, values in (("rate", rates), ("fps", fps)):
            for v in np.flatnonzero(np.isfinite(seconds) & np.isnan(values)).tolist():
                raise ValueError(
                    f"videos, {videos[v]['name']}: {key}: expected a number, since it has an offset; found null"
                )
        for v in np.flatnonzero(component == np.arange(len(videos))).tolist():
            # one that hangs together with no other may have no answer; the reference is where the world's clock begins
            if seconds[v] != 0 and (v == reference or np.isfinite(seconds[v])):
                none = "" if v == reference else " or null"
                raise ValueError(
                    f"videos, {videos[v]['name']}: offset_seconds: expected 0{none} of a video that is its own "
                    f"reference; found {json.dumps(videos[v]['offset_seconds'])}"
                )
        if rates[reference] != 1:
            raise ValueError(
                f"videos, {videos[reference]['name']}: rate: expected 1, since the clock of the reference is the "
                f"world's; found {rates[reference]:g}"
            )
        return cls(
            names=tuple(index),
            fps=fps,
            seconds=seconds,
            rates=rates,
            sigma=column("sigma_seconds", least=0),
            reference=reference,
            component=component,
            flags=tuple(_flags(video["flags"], video["status"], f"videos, {video['name']}") for video in videos),
            alignments=alignments,
            stats={str(k): _float(x, f"stats, {k}") for k, x in data["stats"].items()},
            transforms=tuple(_transform_from(video["transform"], f"videos, {video['name']}") for video in videos)
            if any("transform" in video for video in videos)
            else (),
        )


def _transform(found: Similarity | None) -> dict[str, Any] | None:
    return None if found is None else found.to_dict()


def _transform_from(data: Any, what: str) -> Similarity | None:
    """A similarity of the file, None for null. ValueError begins with ``what``."""
    if data is None:
        return None
    try:
        return Similarity.from_dict(data)
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{what}: {error}") from None


def _number(x: Any) -> float | None:
    """A JSON number, or None for nan and infinities."""
    x = float(x)
    return x if math.isfinite(x) else None


def _float(x: Any, what: str, *, above: float = -math.inf, least: float = -math.inf) -> float:
    """A finite number > above and >= least; nan for null. ValueError begins with ``what``."""
    if x is None:
        return math.nan
    if isinstance(x, bool) or not isinstance(x, int | float):
        raise ValueError(f"{what}: expected a number or null; found {x!r}")
    if not math.isfinite(x) or x <= above or x < least:
        bound = f" above {above:g}" if above > -math.inf else f" of {least:g} or more" if least > -math.inf else ""
        raise ValueError(f"{what}: expected a finite number{bound}, or null; found {x!r}")
    return float(x)


def _status(code: Any, what: str) -> Status:
    """The status of this code. ValueError begins with ``what``."""
    try:
        return Status.from_code(code)
    except ValueError as error:
        raise ValueError(f"{what}: {str(error).removeprefix('status: ').removesuffix('.')}") from None


def _flags(codes: Any, status: Any, what: str) -> tuple[Status, ...]:
    """The flags of these codes, the gravest of which the status must be."""
    if not isinstance(codes, list):
        raise ValueError(f"{what}: flags: expected a list of codes; found {str(codes)[:80]!r}")
    flags = in_order(_status(code, f"{what}: flags") for code in codes)
    if _status(status, f"{what}: status") is not gravest(flags):
        raise ValueError(
            f"{what}: status: expected {gravest(flags).code!r}, the gravest of its flags; found {status!r}"
        )
    return flags


def _rows_of_two(rows: Any, what: str) -> np.ndarray:
    if not isinstance(rows, list) or any(not isinstance(row, list) or len(row) != 2 for row in rows):
        raise ValueError(f"{what}: expected a list of pairs of an offset and a score; found {str(rows)[:80]}")
    return np.array([[_float(x, what) for x in row] for row in rows]).reshape(-1, 2)
