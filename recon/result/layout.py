"""What ``run.json`` may hold; ``python -m recon.result.layout docs/schemas`` writes its JSON Schema."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from otsync.files.strict import Document, Name, Text, write_schema

MAX_VIDEOS = 10_000
MAX_SIDE = 16_384
"""Pixels of a side of one image."""

Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
Three = Annotated[list[float], Meta(min_length=3, max_length=3)]


class RunCamera(Document, frozen=True, kw_only=True):
    """A camera at working size, without distortion."""

    K: Annotated[list[Three], Meta(min_length=3, max_length=3)]
    w2c: list[list[float | list[float]]]
    width: Side
    height: Side
    readout: float | None


class RunClock(Document, frozen=True, kw_only=True):
    """Where a video stands in world time."""

    offset_seconds: float
    rate: float
    known: Literal["given", "found", "fitted"]


class RunVideo(Document, frozen=True, kw_only=True):
    """One video of a reconstruction."""

    name: Name
    held_out: bool
    camera: RunCamera
    clock: RunClock
    gain: Three
    times: Annotated[list[float], Meta(min_length=1)]
    optics: list[dict[str, Any]]


class RunFile(Document, frozen=True, kw_only=True):
    """The cameras of a reconstruction, and how it was made."""

    format: Literal["otsync.reconstruction"]
    version: Literal[2]
    frame: Name
    options: dict[str, Any]
    videos: Annotated[list[RunVideo], Meta(min_length=1, max_length=MAX_VIDEOS)]
    notes: list[Text]
    seconds: dict[str, float]


if __name__ == "__main__":
    write_schema(Path(sys.argv[1]) / "run.schema.json", RunFile, "run.json of a reconstruction")
