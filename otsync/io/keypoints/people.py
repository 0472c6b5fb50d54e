"""OpenPose's JSON: a file a frame, with the people in it and their keypoints."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ...files.arrays import read_json
from .detections import Detections, number

BODY_25 = [
    "nose",
    "neck",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "mid_hip",
    "right_hip",
    "right_knee",
    "right_ankle",
    "left_hip",
    "left_knee",
    "left_ankle",
    "right_eye",
    "left_eye",
    "right_ear",
    "left_ear",
    "left_big_toe",
    "left_small_toe",
    "left_heel",
    "right_big_toe",
    "right_small_toe",
    "right_heel",
]
"""Names of OpenPose's 25 points of a body."""

KINDS = {
    "pose_keypoints_2d": "body",
    "hand_left_keypoints_2d": "left_hand",
    "hand_right_keypoints_2d": "right_hand",
    "face_keypoints_2d": "face",
}
"""Fields of a person, and what their points are called."""


class OpenPose:
    """As ``--write_json`` writes it, also by other programs (RTMLib, AlphaPose, Pose2Sim): x, y and confidence."""

    name = "openpose"
    looks_for = "a pattern of .json files, one a frame, with people and pose_keypoints_2d"

    def claims(self, files: Sequence[Path]) -> bool:
        if any(path.suffix.lower() != ".json" for path in files):
            return False
        first = read_json(files[0])
        return isinstance(first, dict) and isinstance(first.get("people"), list)

    def read(self, files: Sequence[Path]) -> Detections:
        return Detections.of(self._rows(files))

    def _rows(self, files: Sequence[Path]) -> Iterator[tuple[int, float, float, str, int, float]]:
        frames = [frame_number(path) for path in files]
        counted = None not in frames and len(set(frames)) == len(frames)
        first = min((f for f in frames if f is not None), default=0) if counted else 0
        # programs that count from 1 write no frame 0
        first = first if first == 1 else 0
        for k, path in enumerate(files):
            told = frames[k]
            frame = told - first if counted and told is not None else k
            document = read_json(path)
            people = document.get("people") if isinstance(document, dict) else None
            if not isinstance(people, list):
                raise ValueError(f"{path}: expected an object with the list people; found none. Mend the file.")
            for person in people:
                yield from _points(path, frame, person)


def _points(path: Path, frame: int, person: Any) -> Iterator[tuple[int, float, float, str, int, float]]:
    if not isinstance(person, dict):
        raise ValueError(f"{path}: people: expected objects; found {type(person).__name__}. Mend the file.")
    told = person.get("person_id", [-1])
    told = told[0] if isinstance(told, list) and told else told
    who = int(told) if isinstance(told, int) and told >= 0 else -1
    for field, kind in KINDS.items():
        values = person.get(field) or []
        if not isinstance(values, list) or len(values) % 3:
            raise ValueError(f"{path}: {field}: expected a list of x, y, confidence; found another. Mend the file.")
        names = BODY_25 if kind == "body" and len(values) == 3 * len(BODY_25) else None
        for n in range(len(values) // 3):
            x, y, score = (number(v, f"{path}: {field}[{3 * n + i}]") for i, v in enumerate(values[3 * n : 3 * n + 3]))
            if score > 0:  # what was not found is written as 0, 0, 0
                yield frame, x, y, names[n] if names else f"{kind}_{n}", who, score


def frame_number(path: Path) -> int | None:
    """The last number in a file's name before ``_keypoints``; None without one."""
    numbers = re.findall(r"\d+", path.stem.removesuffix("_keypoints"))
    return int(numbers[-1]) if numbers and len(numbers[-1]) < 16 else None
