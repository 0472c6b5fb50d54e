"""COCO's JSON: a data set with images and annotations, or the list of results that detectors write."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ...files.arrays import read_json
from .detections import MAX_BYTES, Detections, number

PERSON = [
    "nose",
    "left_eye",
    "right_eye",
    "left_ear",
    "right_ear",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_ankle",
    "right_ankle",
]
"""COCO's 17 points of a person."""


class Coco:
    """Keypoints where there are some, else the middles of boxes. ``track_id`` tells who is who."""

    name = "coco"
    looks_for = "a .json file with images and annotations, or with a list of results (image_id, keypoints or bbox)"

    def claims(self, files: Sequence[Path]) -> bool:
        if len(files) != 1 or files[0].suffix.lower() != ".json":
            return False
        told = read_json(files[0], max_bytes=MAX_BYTES)
        if isinstance(told, dict):
            return isinstance(told.get("images"), list) and isinstance(told.get("annotations"), list)
        return isinstance(told, list) and bool(told) and isinstance(told[0], dict) and "image_id" in told[0]

    def read(self, files: Sequence[Path]) -> Detections:
        path = files[0]
        told = read_json(path, max_bytes=MAX_BYTES)
        try:
            return Detections.of(_rows(path, told))
        except (KeyError, TypeError, IndexError, AttributeError) as error:
            raise ValueError(
                f"{path}: expected image_id, keypoints or bbox of every annotation; {type(error).__name__}: {error}. "
                "Mend the file."
            ) from None


def _rows(path: Path, told: Any) -> Iterator[tuple[int, float, float, str, int, float]]:
    annotations = told["annotations"] if isinstance(told, dict) else told
    frames = _frames(told["images"]) if isinstance(told, dict) else {}
    kinds = {c["id"]: c for c in told.get("categories", ())} if isinstance(told, dict) else {}
    tracks: dict[Any, int] = {}
    for n, one in enumerate(annotations):
        where = f"{path}: annotation {n}"
        frame = frames[one["image_id"]] if frames else _number_of(one["image_id"], where)
        track = one.get("track_id", one.get("idx"))
        who = -1 if track is None else tracks.setdefault(str(track), len(tracks))
        kind = kinds.get(one.get("category_id"), {})
        score = number(one.get("score", 1.0), f"{where}, score")
        points = one.get("keypoints")
        if points:
            if len(points) % 3:
                raise ValueError(f"{where}: keypoints: expected x, y, v of each; found {len(points)} numbers.")
            count = len(points) // 3
            names = kind.get("keypoints") or (PERSON if count == len(PERSON) else [f"point_{i}" for i in range(count)])
            for i in range(count):
                x, y, v = (number(value, f"{where}, keypoints") for value in points[3 * i : 3 * i + 3])
                if v > 0:  # 0: not labelled; 1 and 2 in data sets, scores from 0 to 1 in results
                    yield frame, x, y, str(names[i])[:200], who, min(v, 1.0)
        elif one.get("bbox"):
            x, y, w, h = (number(value, f"{where}, bbox") for value in one["bbox"])
            yield frame, x + w / 2, y + h / 2, str(kind.get("name", ""))[:200], who, score


def _frames(images: list[dict[str, Any]]) -> dict[Any, int]:
    """The frame of every image: as it says, else in the order of the files' names."""
    for field in ("frame_id", "frame_index", "frame"):
        if images and all(isinstance(image.get(field), int) for image in images):
            first = min(image[field] for image in images)
            return {image["id"]: image[field] - (1 if first == 1 else 0) for image in images}
    ordered = sorted(images, key=lambda image: _natural(str(image.get("file_name", image["id"]))))
    return {image["id"]: n for n, image in enumerate(ordered)}


def _natural(text: str) -> list[Any]:
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", text[:255])]


def _number_of(told: Any, where: str) -> int:
    """The frame that an image's name of a list of results ends on."""
    numbers = re.findall(r"\d+", str(told))
    if not numbers or len(numbers[-1]) > 15:
        raise ValueError(f"{where}: image_id: expected the number of a frame; found {str(told)[:80]!r}. Mend the file.")
    return int(numbers[-1])
