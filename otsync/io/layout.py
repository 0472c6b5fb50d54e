"""What ``scene.json`` may hold: the one place that says so. Reading, checking and the JSON Schema follow from it."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import UNSET, Meta, UnsetType, field

from ..files.strict import Count, Document, Name, Text

MAX_VIDEOS, MAX_FILES = 1000, 200_000

LEAST_SCORE = 0.3
"""Of points that other programs found: below it they are guesses."""

Files = Text | Annotated[list[Text], Meta(min_length=1, max_length=MAX_FILES)]
"""A pattern with ``*`` in the file name, or a list of files."""

Row3 = Annotated[list[float], Meta(min_length=3, max_length=3)]
Pixels = Annotated[int, Meta(ge=1, le=1_000_000)]


class CameraFile(Document, frozen=True, kw_only=True):
    """A camera: null stands for what is still missing."""

    K: Annotated[list[Row3], Meta(min_length=3, max_length=3)] | None = None
    w2c: list[list[float | list[float]]] | None = None
    width: Pixels | None = None
    height: Pixels | None = None
    distortion: list[float] | None = None
    readout: float | None = None


class DepthFile(Document, frozen=True, kw_only=True):
    """Depth of a video: a map a frame, or one array of all."""

    frames: Files | UnsetType = UNSET
    file: Text | UnsetType = UNSET
    scale: float = 1.0


class MasksFile(Document, frozen=True, kw_only=True):
    """Masks of a video as segmenters write them: a file a frame, or one of all."""

    frames: Files | UnsetType = UNSET
    file: Text | UnsetType = UNSET
    kind: Literal["binary", "labels", "stack", "coco"] | UnsetType = UNSET
    ids: Annotated[list[Count], Meta(min_length=1, max_length=10_000)] | UnsetType = UNSET


class PointsFile(Document, frozen=True, kw_only=True):
    """Points of a video that another program found: a file, or one a frame."""

    files: Files
    kind: Name | UnsetType = UNSET
    least: float = LEAST_SCORE


class TracksFile(Document, frozen=True, kw_only=True):
    """Point tracks of a video, as a tracker wrote them."""

    file: Text
    kind: Literal["cotracker", "spatialtracker", "tapir", "tapvid3d"] | None = None
    size: Annotated[list[Pixels], Meta(min_length=2, max_length=2)] | None = None


class VideoFile(Document, frozen=True, kw_only=True):
    """One video of a scene."""

    name: Name | UnsetType = UNSET
    file: Text | UnsetType = UNSET
    frames: Files | UnsetType = UNSET
    fps: float | None = None
    timestamps: list[float] | None = None
    range: Annotated[list[Count], Meta(min_length=2, max_length=2)] | None = None
    camera: CameraFile | None = None
    depth: DepthFile | None = None
    masks: Files | MasksFile | None = None
    labels: Files | None = None
    points: PointsFile | None = None
    tracks: TracksFile | None = None


class CalibratedFile(Document, frozen=True, kw_only=True):
    """How sure the camera of one video is, as ``otsync calibrate`` or ``otsync sync --frames own`` found it."""

    lens: Literal["given", "board", "file", "found", "guessed"]
    sigma_degrees: float | None = None
    sigma_position: float | None = None
    inliers: Count = 0
    points: Count = 0
    bridged: float = 0.0
    doubtful: Text | None = None
    remedy: Text | None = None


class CalibrationFile(Document, frozen=True, kw_only=True):
    """What was found out about cameras that nobody calibrated, by video; videos without a camera too.

    method: how ``otsync calibrate`` mapped the scene; board: by a board that rests before the cameras; motion: by what
        moves, with depth, as ``sync --frames own`` does.
    """

    method: Literal["incremental", "global", "motion", "board"]
    unit: Literal["arbitrary", "metres"]
    cameras: Annotated[dict[Name, CalibratedFile], Meta(max_length=MAX_VIDEOS)]
    helpers: Annotated[list[Name], Meta(max_length=MAX_VIDEOS)] = field(default_factory=list)


class SceneFile(Document, frozen=True, kw_only=True):
    """A scene document."""

    format: Literal["otsync.scene"]
    version: Literal[1]
    videos: Annotated[list[VideoFile], Meta(min_length=1, max_length=MAX_VIDEOS)]
    frame: Name = "world"
    missing: list[Text] | None = None
    calibration: CalibrationFile | None = None
    notes: list[Text] = field(default_factory=list)
