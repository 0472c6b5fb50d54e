"""Pairs of videos kept on disk: a map-like callable for ``synchronize`` that remembers every pair's answer."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ..compute.threads import MapLike
from ..files.cache import Cache
from ..sync.own_frames import OwnJob
from ..sync.pairs import Job
from ..sync.verdict import Answer
from ..types import Alignment, Matches, Similarity, Status, TrackSet

log = logging.getLogger("otsync")

MADE_BY = 15
"""Raised when the same pair gets another answer, or more of one, than before: what was kept is then made anew."""

MANY = 12
"""Pairs of which processes are worth the seconds in which they begin: of six videos and more."""


@dataclass(frozen=True)
class KeptPairs:
    """``map`` for :func:`otsync.synchronize` that looks in ``cache`` before it computes a pair.

    The key is the content of both track sets and the algorithms with their parameters. Other work passes through.

    Args:
        map: any map-like callable, of threads. call: makes a call where it may take another process
            (:class:`~otsync.compute.processes.Processes`), if there are :data:`MANY` items.
    """

    cache: Cache
    map: MapLike = map
    call: Callable[[Callable[[Any], Any], Any], Any] | None = None

    def __call__(self, function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        items = list(items)
        if self.call is not None and len(items) >= MANY:
            function = partial(self.call, function)

        def kept(item: Any) -> Any:
            given = isinstance(item, Job) and item.matches is not None
            if self.cache.root is None or not isinstance(item, Job | OwnJob) or given:
                return function(item)
            key: tuple[Any, ...] = (MADE_BY, _without_name(item.a), _without_name(item.b))
            if isinstance(item, OwnJob):
                key = (*key, item.solver, item.start)
            else:
                key = (*key, item.matcher, item.aligner, item.refiner)
            try:
                self.cache.path("pair", key)
            except ValueError as error:  # an algorithm whose content cannot be read would be mistaken for another
                log.info("pair %s is not kept: %s", item.pair, error)
                return function(item)
            arrays = self.cache.arrays("pair", key, lambda: pack(function(item)))
            try:
                return unpack(item.pair, arrays)
            except (KeyError, ValueError, TypeError) as error:
                log.warning("pair %s: what was kept does not read (%s); computing it again", item.pair, error)
                return function(item)

        return list(self.map(kept, items))


def _without_name(tracks: TrackSet) -> TrackSet:
    """The same tracks without the name, on which no answer depends."""
    return replace(tracks, name="")


def pack(answer: Answer) -> dict[str, np.ndarray]:
    """An answer as plain arrays; plans are not kept."""
    matches = answer.matches
    told = {
        "matches": _words(matches),
        "scanned": _words(answer.scanned) | _numbers(answer.scanned),
        "refined": _words(answer.refined) | _numbers(answer.refined),
    }
    out = {"told": np.array(json.dumps(told)), "pairs": matches.pairs, "score": np.asarray(matches.score, float)}
    if matches.weight is not None:
        out["weight"] = matches.weight
    for name, alignment in (("scanned", answer.scanned), ("refined", answer.refined)):
        out[f"{name}_hypotheses"] = np.asarray(alignment.hypotheses, float)
        if len(alignment.parts):
            out[f"{name}_parts"] = np.asarray(alignment.parts, float)
        if alignment.curve is not None:
            out[f"{name}_curve"] = np.asarray(alignment.curve, float)
        if (S := alignment.transform) is not None:
            out[f"{name}_transform"] = np.concatenate([[S.scale], S.R.ravel(), S.t])
            if S.covariance is not None:
                out[f"{name}_covariance"] = S.covariance
    return out


def unpack(pair: tuple[int, int], arrays: dict[str, np.ndarray]) -> Answer:
    """The answer that :func:`pack` made arrays of."""
    told = json.loads(str(arrays["told"]))

    def words(of: dict[str, Any]) -> dict[str, Any]:
        return {
            "flags": tuple(Status.from_code(f) for f in of["flags"]),
            "stats": dict(of["stats"]),
        }

    def transform(name: str) -> Similarity | None:
        of = arrays.get(f"{name}_transform")
        if of is None:
            return None
        return Similarity(float(of[0]), of[1:10].reshape(3, 3), of[10:13], arrays.get(f"{name}_covariance"))

    def alignment(name: str) -> Alignment:
        of = told[name]
        return Alignment(
            of["offset"],
            of["rate"],
            of["sigma"],
            arrays[f"{name}_hypotheses"],
            arrays.get(f"{name}_curve"),
            fps=of["fps"],
            transform=transform(name),
            parts=arrays.get(f"{name}_parts", np.zeros((0, 2))),
            **words(of),
        )

    matches = Matches(arrays["pairs"], arrays["score"], weight=arrays.get("weight"), **words(told["matches"]))
    return Answer(pair, matches, alignment("scanned"), alignment("refined"))


def _words(result: Matches | Alignment) -> dict[str, Any]:
    stats = {k: float(v) for k, v in result.stats.items()}
    return {"flags": [f.code for f in result.flags], "stats": stats}


def _numbers(alignment: Alignment) -> dict[str, float]:
    return {k: float(getattr(alignment, k)) for k in ("offset", "rate", "sigma", "fps")}
