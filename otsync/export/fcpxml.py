"""The timeline as FCPXML, for Final Cut Pro and DaVinci Resolve: Apple's "FCPXML Reference", version 1.9."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np

from ..files.arrays import atomic_write
from ..types import Camera
from .slot import Aligned, Clip, Export

WHOLE = 1e-3
"""How far from a whole number, or from one of NTSC's, a rate may be to count as such."""


class FinalCut(Export):
    """A timeline with a lane for every video. Editors want whole frames there: the exact offsets stand in metadata."""

    name = "fcpxml"

    def targets(self, videos: Aligned, folder: Path) -> list[Path]:
        return [folder / "timeline.fcpxml"]

    def write(self, videos: Aligned, folder: Path, *, width: int, fps: float) -> list[str]:
        kept = [clip for clip in videos.clips if clip.file is not None]
        notes = [
            f"{c.name}: its frames are images, which FCPXML cannot name; timeline.otio has them"
            for c in videos.clips
            if c.file is None
        ]
        notes += [
            f"{c.name}: its clock breaks; the timeline holds the clock before the break" for c in kept if c.broken
        ]
        if not kept:
            return [*notes, "timeline.fcpxml is not written: no video is a file"]
        document = _document(kept, videos.span, frame_length(videos.fps))
        with atomic_write(self.targets(videos, folder)[0], "w") as stream:
            stream.write('<?xml version="1.0" encoding="UTF-8"?>\n<!DOCTYPE fcpxml>\n')
            stream.write(xml.tostring(document, encoding="unicode") + "\n")
        return notes


def frame_length(fps: float) -> Fraction:
    """Seconds of a frame as editors write them: 1001/30000 for 29.97."""
    for base in (1000, 1001):
        whole = round(fps * base / 1000)
        if whole and abs(fps * base / 1000 - whole) < WHOLE:
            return Fraction(base, 1000 * whole)
    return 1 / Fraction(fps).limit_denominator(1000)


def _document(clips: list[Clip], span: tuple[float, float], step: Fraction) -> xml.Element:
    root = xml.Element("fcpxml", version="1.9")
    resources = xml.SubElement(root, "resources")
    camera = clips[0].video.camera
    _format(resources, "r1", step, camera)
    total = _whole(span[1] - span[0], step) + step
    event = xml.SubElement(xml.SubElement(root, "library"), "event", name="otsync")
    project = xml.SubElement(event, "project", name="synchronised")
    sequence = xml.SubElement(project, "sequence", format="r1", duration=_time(total), tcStart="0s")
    ground = xml.SubElement(
        xml.SubElement(sequence, "spine"), "gap", name="clock", offset="0s", start="0s", duration=_time(total)
    )
    for n, clip in enumerate(clips, 1):
        own, own_step = clip.video.times, frame_length(clip.video.fps or float(1 / step))
        _format(resources, f"f{n}", own_step, clip.video.camera)
        first, length = _whole(float(own[0]), own_step), _whole(float(own[-1] - own[0]), own_step) + own_step
        assert clip.file is not None
        asset = xml.SubElement(
            resources, "asset", id=f"a{n}", name=clip.name, start=_time(first), duration=_time(length), hasVideo="1"
        )
        asset.set("format", f"f{n}")
        xml.SubElement(asset, "media-rep", kind="original-media", src=clip.file.resolve().as_uri())
        begins = float(clip.clock.world(own[0])) - span[0]
        slow = Fraction(clip.clock.rate).limit_denominator(10**6)
        shown = xml.SubElement(
            ground,
            "asset-clip",
            ref=f"a{n}",
            name=clip.name,
            lane=str(n),
            offset=_time(_whole(begins, step)),
            start=_time(first),
            duration=_time(_whole(float(length * slow), step)),
        )
        if slow != 1:
            warp = xml.SubElement(shown, "timeMap")
            xml.SubElement(warp, "timept", time="0s", value=_time(first), interp="linear")
            xml.SubElement(warp, "timept", time=_time(length * slow), value=_time(first + length), interp="linear")
        known = {
            "offset_seconds": repr(clip.clock.offset),
            "rate": repr(clip.clock.rate),
            "begins_seconds": repr(begins),
            "sigma_seconds": repr(clip.sigma) if np.isfinite(clip.sigma) else "",
            "status": clip.status,
        }
        metadata = xml.SubElement(shown, "metadata")
        for key, value in known.items():
            xml.SubElement(metadata, "md", key=f"otsync.{key}", value=value)
    return root


def _format(resources: xml.Element, name: str, step: Fraction, camera: Camera) -> None:
    made = xml.SubElement(resources, "format", id=name, frameDuration=_time(step))
    made.set("width", str(camera.width))
    made.set("height", str(camera.height))


def _whole(seconds: float, step: Fraction) -> Fraction:
    """The nearest whole number of frames, in seconds."""
    return round(Fraction(seconds) / step) * step


def _time(seconds: Fraction) -> str:
    return f"{seconds.numerator}/{seconds.denominator}s" if seconds.denominator != 1 else f"{seconds.numerator}s"
