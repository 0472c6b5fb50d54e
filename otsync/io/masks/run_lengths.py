"""Run lengths as COCO counts them, in JSON: a file a frame (SA-1B), or one of a whole video (COCO, YouTube-VIS)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from ...files.arrays import read_json
from ...files.strict import shown
from ..frames import ImageFrames, LazyFrames, file_digest
from ..images import MAX_PIXELS
from ..order import natural

Region = tuple[tuple[int, int], Any]
"""(height, width), and the counts as the file holds them."""


@dataclass(frozen=True)
class RunLengths:
    """Run lengths as COCO counts them, in JSON: numbers, or the text that pycocotools packs them into."""

    name: str = "coco"
    suffixes: tuple[str, ...] = (".json",)

    def one_a_frame(self, paths: Sequence[Path], ids: Sequence[int]) -> LazyFrames:
        refuse_ids(ids, self.name)

        def read(path: Path) -> Bool[np.ndarray, "H W"]:
            told = _object(path)
            regions = [(_run(a, path, n)) for n, a in enumerate(_list(told, "annotations", path))]
            return union(regions, _size_of(told.get("image"), path) if "image" in told else None, path)

        return ImageFrames(paths, read, "mask of run lengths")

    def of_all(self, path: Path, ids: Sequence[int]) -> LazyFrames:
        refuse_ids(ids, self.name)
        return RunFrames(path)


class RunFrames(LazyFrames):
    """Masks of a COCO file whose images are the frames, or of a YouTube-VIS file of one video."""

    def __init__(self, path: Path):
        self.path = path
        told = _object(path)
        annotations = _list(told, "annotations", path)
        if any(isinstance(a, dict) and "segmentations" in a for a in annotations):
            self.regions = _by_track(annotations, path)
            sizes: list[tuple[int, int] | None] = [None] * len(self.regions)
        else:
            self.regions, sizes = _by_image(annotations, _list(told, "images", path), path)
        known = [r[0] for regions in self.regions for r in regions] + [s for s in sizes if s is not None]
        if not known:
            raise ValueError(f"{path}: expected run lengths; found none of any frame. Write it again.")
        self.sizes = [size or known[0] for size in sizes]

    def __len__(self) -> int:
        return len(self.regions)

    def frame(self, k: int) -> Bool[np.ndarray, "H W"]:
        return union(self.regions[k], self.sizes[k], self.path)

    def digest(self) -> str:
        return f"{file_digest(self.path)} mask of run lengths"


def refuse_ids(ids: Sequence[int], kind: str) -> None:
    if ids:
        raise ValueError(f"masks.ids: expected them beside labels or stack; found {kind}. Leave them out.")


def union(regions: Sequence[Region], size: tuple[int, int] | None, path: Path) -> Bool[np.ndarray, "H W"]:
    """What any of the regions covers. ValueError where they are of several sizes, or of none."""
    sizes = {region[0] for region in regions} | ({size} if size is not None else set())
    if len(sizes) != 1:
        found = " and ".join(f"{w} x {h}" for h, w in sorted(sizes)) or "none"
        raise ValueError(f"{path}: size: expected one size of all masks of a frame; found {found}. Write it again.")
    out = np.zeros(next(iter(sizes)), bool)
    for own, counts in regions:
        out |= decoded(counts, own, path)
    return out


def decoded(counts: Any, size: tuple[int, int], path: Path) -> Bool[np.ndarray, "H W"]:
    """A mask of its run lengths: down the columns, first what is background. ValueError where they do not fill it."""
    height, width = size
    runs = unpacked(counts, path) if isinstance(counts, str) else counts
    if not (isinstance(runs, list) and all(type(n) is int and n >= 0 for n in runs)):
        raise ValueError(f"{path}: counts: expected whole numbers or packed text; found {shown(counts)}.")
    if sum(runs) != height * width:  # before memory is taken
        raise ValueError(
            f"{path}: counts: expected runs of {height * width} pixels in all, {width} x {height}; found {sum(runs)}. "
            "Write it again."
        )
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T


def unpacked(text: str, path: Path) -> list[int]:
    """Numbers of pycocotools' text: five bits a character, the lowest first, from the third on as differences."""
    out: list[int] = []
    value = bits = 0
    for character in text:
        code = ord(character) - 48
        if not 0 <= code < 64 or bits > 35:
            raise ValueError(f"{path}: counts: expected text as pycocotools packs it; found {shown(text[:40])}.")
        value |= (code & 31) << bits
        bits += 5
        if not code & 32:
            if code & 16:
                value -= 1 << bits
            out.append(value + out[-2] if len(out) > 2 else value)
            value = bits = 0
    if bits:
        raise ValueError(f"{path}: counts: expected whole numbers; the text ends within one. Write it again.")
    return out


def _by_image(
    annotations: Sequence[Any], images: Sequence[Any], path: Path
) -> tuple[list[list[Region]], list[tuple[int, int] | None]]:
    """Regions of every image of a COCO file, in the natural order of the files' names, and the images' sizes."""
    ids = [image.get("id") if isinstance(image, dict) else None for image in images]
    if not images or any(type(i) not in (int, str) for i in ids) or len(set(ids)) < len(ids):
        raise ValueError(f"{path}: images: expected one a frame with an id each; found others. Write it again.")
    order = sorted(images, key=lambda i: natural(Path(str(i.get("file_name", i["id"])))))
    at = {image["id"]: k for k, image in enumerate(order)}
    regions: list[list[Region]] = [[] for _ in order]
    for n, a in enumerate(annotations):
        frame = at.get(a.get("image_id")) if isinstance(a, dict) else None
        if frame is None:
            raise ValueError(f"{path}: annotations[{n}].image_id: expected the id of an image; found {shown(a)}.")
        regions[frame].append(_run(a, path, n))
    return regions, [_size_of(image, path) if "height" in image else None for image in order]


def _by_track(annotations: Sequence[Any], path: Path) -> list[list[Region]]:
    """Regions of every frame of a YouTube-VIS file of one video, whose instances have one mask a frame, or null."""
    videos = {a.get("video_id") for a in annotations if isinstance(a, dict)}
    tracks = [a.get("segmentations") if isinstance(a, dict) else None for a in annotations]
    counts = {len(t) for t in tracks if isinstance(t, list)}
    if len(videos) != 1 or len(counts) != 1 or not all(isinstance(t, list) for t in tracks):
        raise ValueError(
            f"{path}: annotations: expected segmentations of one video, one a frame; found {len(videos)} videos, and "
            f"{sorted(counts)} frames. Write one file a video."
        )
    rows = [list(track) for track in tracks if isinstance(track, list)]
    return [
        [_run({"segmentation": r[k]}, path, n) for n, r in enumerate(rows) if r[k] is not None]
        for k in range(counts.pop())
    ]


def _run(annotation: Any, path: Path, n: int) -> Region:
    told = annotation.get("segmentation") if isinstance(annotation, dict) else None
    if isinstance(told, list):
        raise ValueError(
            f"{path}: annotations[{n}].segmentation: expected run lengths; found polygons. Convert them (pycocotools: "
            "annToRLE)."
        )
    if not isinstance(told, dict) or "counts" not in told:
        raise ValueError(f"{path}: annotations[{n}].segmentation: expected size and counts; found {shown(told)}.")
    size = told.get("size")
    if not (isinstance(size, list) and len(size) == 2 and all(type(x) is int and x > 0 for x in size)):
        raise ValueError(f"{path}: annotations[{n}].segmentation.size: expected [height, width]; found {shown(size)}.")
    return _within(size[0], size[1], path), told["counts"]


def _size_of(image: Any, path: Path) -> tuple[int, int]:
    height, width = (image.get(side) if isinstance(image, dict) else None for side in ("height", "width"))
    if not all(type(x) is int and x > 0 for x in (height, width)):
        raise ValueError(f"{path}: height, width: expected pixels of the image; found {shown((height, width))}.")
    assert isinstance(height, int) and isinstance(width, int)
    return _within(height, width, path)


def _within(height: int, width: int, path: Path) -> tuple[int, int]:
    if height * width > MAX_PIXELS:
        raise ValueError(f"{path}: size: expected at most {MAX_PIXELS} pixels; found {width} x {height}. Reduce it.")
    return height, width


def _object(path: Path) -> dict[str, Any]:
    told = read_json(path, remedy="Write it again.")
    if not isinstance(told, dict):
        raise ValueError(f"{path}: expected an object with annotations; found {type(told).__name__}. Write it again.")
    return told


def _list(told: dict[str, Any], field: str, path: Path) -> list[Any]:
    if not isinstance(told.get(field), list):
        raise ValueError(f"{path}: {field}: expected a list; found {shown(told.get(field))}. Write it again.")
    return told[field]
