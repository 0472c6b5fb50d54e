"""Reading ``offsets.json``: every field is checked, and an error names the file and the field."""

from __future__ import annotations

import json
import math
import os
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import UNSET, Meta, UnsetType

from ..files.arrays import read_json
from ..files.strict import Document, Name, Text, all_on_one_line, checked
from .clock import Break
from .similarity import Similarity
from .status import Status, gravest, in_order

FORMAT, VERSION = "otsync.offsets", 1
SIGN = (
    "t_world = rate * t_video + offset_seconds, t_video in seconds on the video's own clock; a positive offset means "
    "that the video started later than its reference; offset_frames = offset_seconds * fps of the reference"
)

FRAMES = (
    "every video has a frame of reference of its own; transform: x_reference = scale * R(quaternion w, x, y, z) * "
    "x_video + translation, in units of the reference (of pairs: from b's frame to a's); covariance: of a small "
    "rotation vector (3, radians), relative scale (1) and translation (3) that act after it"
)


BREAKS = (
    "a video whose clock breaks: from at_seconds of its own clock on, jump_seconds are added to t_video before rate "
    "and offset; frames within still_seconds before at_seconds stood still and tell no time"
)

Number = float | None
"""A number, or null where it is not known."""


class TransformFile(Document, frozen=True, kw_only=True):
    """A similarity; see :data:`FRAMES`."""

    scale: float
    quaternion: Annotated[list[float], Meta(min_length=4, max_length=4)]
    translation: Annotated[list[float], Meta(min_length=3, max_length=3)]
    covariance: list[list[float]] | None = None
    rotation_sigma_degrees: Number = None
    scale_sigma: Number = None


class BreakFile(Document, frozen=True, kw_only=True):
    """Where a clock breaks; see :data:`BREAKS`."""

    at_seconds: float
    jump_seconds: float
    still_seconds: float
    sigma_seconds: Number


class VideoOffset(Document, frozen=True, kw_only=True):
    """The clock of one video."""

    name: Name
    fps: Number
    rate: Number
    offset_seconds: Number
    offset_frames: Number | UnsetType = UNSET
    sigma_seconds: Number
    steps_heard_seconds: Annotated[list[Number], Meta(min_length=2, max_length=2)] | UnsetType = UNSET
    reference: Name
    status: Text
    flags: list[Text]
    transform: TransformFile | None = None
    breaks: list[BreakFile] | UnsetType = UNSET


class PairOffset(Document, frozen=True, kw_only=True):
    """The answer of one pair."""

    a: Name
    b: Name
    fps: Number
    rate: Number
    offset_seconds: Number
    offset_frames: Number | UnsetType = UNSET
    sigma_seconds: Number
    status: Text
    flags: list[Text]
    hypotheses: list[Annotated[list[Number], Meta(min_length=2, max_length=2)]]
    stats: dict[str, Number]
    transform: TransformFile | None = None


class OffsetsFile(Document, frozen=True, kw_only=True):
    """The content of offsets.json and truth.json."""

    format: Literal["otsync.offsets"]
    version: Literal[1]
    unit: Literal["seconds"] = "seconds"
    sign: Text = SIGN
    frames: Text | UnsetType = UNSET
    breaks: Text | UnsetType = UNSET
    reference: Name
    videos: Annotated[list[VideoOffset], Meta(min_length=1)]
    pairs: list[PairOffset]
    stats: dict[str, Number]


def read_offsets(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[tuple[int, int], dict[str, Any]]]:
    """(fields of ``Offsets`` but for alignments, fields of the ``Alignment`` of every pair (i, j)) of a file.

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
    all_on_one_line(data, path, "")  # first: errors show names as they are
    try:
        fields = _fields(data)
    except (KeyError, TypeError, IndexError, AttributeError, OverflowError) as error:
        checked(data, OffsetsFile, path, remedy="Write it anew.")  # it knows the field, where the error does not
        detail = f"{type(error).__name__}: {error}"
    except ValueError as error:
        detail = str(error)
    else:
        checked(data, OffsetsFile, path, remedy="Write it anew.")
        return fields
    raise ValueError(f"{path}: not a sound offsets file; {detail}. Write it anew.")


def _fields(data: dict[str, Any]) -> tuple[dict[str, Any], dict[tuple[int, int], dict[str, Any]]]:
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

    alignments: dict[tuple[int, int], dict[str, Any]] = {}
    for p in data["pairs"]:
        pair = place(p["a"], "pairs: a"), place(p["b"], "pairs: b")
        what = f"pairs, {p['a']}-{p['b']}"
        if pair[0] == pair[1] or pair in alignments:
            raise ValueError(f"{what}: expected two videos, each pair once; found it again or with itself")
        alignments[pair] = dict(
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
    fields = dict(
        names=tuple(index),
        fps=fps,
        seconds=seconds,
        rates=rates,
        sigma=column("sigma_seconds", least=0),
        reference=reference,
        component=component,
        flags=tuple(_flags(video["flags"], video["status"], f"videos, {video['name']}") for video in videos),
        stats={str(k): _float(x, f"stats, {k}") for k, x in data["stats"].items()},
        transforms=tuple(_transform_from(video.get("transform"), f"videos, {video['name']}") for video in videos)
        if any("transform" in video for video in videos)
        else (),
        breaks=tuple(_breaks(video.get("breaks", []), f"videos, {video['name']}: breaks") for video in videos),
    )
    return fields, alignments


def _breaks(data: Any, what: str) -> tuple[Break, ...]:
    if not isinstance(data, list):
        raise ValueError(f"{what}: expected a list; found {data!r}")
    found = []
    for one in data:
        at, jump, sigma = (_float(one[f"{n}_seconds"], f"{what}: {n}_seconds") for n in ("at", "jump", "sigma"))
        found.append(Break(at, jump, _float(one["still_seconds"], f"{what}: still_seconds", least=0), sigma))
    return tuple(found)


def _transform_from(data: Any, what: str) -> Similarity | None:
    """A similarity of the file, None for null. ValueError begins with ``what``."""
    if data is None:
        return None
    try:
        return Similarity.from_dict(data)
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{what}: {error}") from None


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
