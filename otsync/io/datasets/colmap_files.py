"""COLMAP's models from files, text and binary: cameras and posed images, every size checked before it is read.

Read here and not by pycolmap: a damaged binary file ends pycolmap's process, and a folder is described without the
extra that brings it. Points are not read.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...files.arrays import existing
from ...files.strict import shown
from .common import numbers, pinhole, pixels, rigid

MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
          "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE")  # fmt: skip
"""By COLMAP's number."""

PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "FULL_OPENCV": 12}
"""How many parameters the models have that are OpenCV's; the others are not read."""

COUNTS = {"OPENCV_FISHEYE": 8, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12}

MOST = 2**31
"""Bytes of a file of images: a model of a hundred thousand images has as many."""

LONGEST_NAME = 1000
UNIT = 1e-3
"""How far the length of a quaternion may be from 1: text has some digits only."""


@dataclass(frozen=True, eq=False)
class Lens:
    """One camera of a model: K (centre of the first pixel at 0.5, as COLMAP has it), size and OpenCV's distortion."""

    K: np.ndarray
    size: tuple[int, int]
    distortion: list[float] | None


@dataclass(frozen=True, eq=False)
class Posed:
    """One registered image: its name, its camera's number and world-to-camera (4,4)."""

    name: str
    camera: int
    w2c: np.ndarray


def read_model(folder: Path) -> tuple[dict[int, Lens], list[Posed]]:
    """The model in a folder, binary where there is one (as COLMAP does), sorted by name."""
    binary = (folder / "cameras.bin").is_file()
    suffix = "bin" if binary else "txt"
    for path in (existing(folder / f"cameras.{suffix}"), existing(folder / f"images.{suffix}")):
        if path.stat().st_size > MOST:
            raise ValueError(f"{path}: expected at most {MOST} bytes; found {path.stat().st_size}. Another file?")
    read_cameras, read_images = (_cameras_bin, _images_bin) if binary else (_cameras_txt, _images_txt)
    cameras = read_cameras(folder / f"cameras.{suffix}")
    images = read_images(folder / f"images.{suffix}")
    for image in images:
        if image.camera not in cameras:
            raise ValueError(
                f"{folder / f'images.{suffix}'}: {shown(image.name)}: expected a camera of cameras.{suffix}; found "
                f"{image.camera}. Bring both files of one model."
            )
    names = [image.name for image in images]
    if len(set(names)) < len(names):
        raise ValueError(
            f"{folder / f'images.{suffix}'}: expected every image once; some occur twice. Export it again."
        )
    if not images:
        raise ValueError(f"{folder / f'images.{suffix}'}: expected posed images; found none. Map the recording first.")
    return cameras, images


def lens_of(model: str, width: int, height: int, values: np.ndarray, where: str) -> Lens:
    """ValueError for a model that is not OpenCV's, with the remedy."""
    if model not in PARAMETERS:
        raise ValueError(
            f"{where}: expected one of {', '.join(PARAMETERS)}; found {shown(model)}. Undistort the images (colmap "
            "image_undistorter), which writes a model of pinholes."
        )
    p = numbers(values, (PARAMETERS[model],), f"{where}: parameters of {model}")
    one = model.startswith(("SIMPLE", "RADIAL"))
    fx, fy, cx, cy = (p[0], p[0], p[1], p[2]) if one else p[:4]
    rest = p[3:] if one else p[4:]
    if fx <= 0 or fy <= 0:
        raise ValueError(f"{where}: expected positive focal lengths; found {fx:g} and {fy:g}. Map it again.")
    lens = [*rest.tolist(), *([0.0] * (4 - len(rest)))] if len(rest) <= 4 else rest.tolist()
    return Lens(pinhole(fx, fy, cx, cy), (width, height), lens if any(lens) else None)


def posed(name: str, camera: int, q: np.ndarray, t: np.ndarray, where: str) -> Posed:
    """Of a quaternion wxyz and a translation, world to camera."""
    numbers(q, (4,), f"{where}: quaternion")
    numbers(t, (3,), f"{where}: translation")
    length = float(np.linalg.norm(q))
    if abs(length - 1) > UNIT:
        raise ValueError(
            f"{where}: expected a unit quaternion w x y z; found one of length {length:.4g}. Export it again."
        )
    w, x, y, z = q / length
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return Posed(name, camera, rigid(np.concatenate([R, t.reshape(3, 1)], 1), where))


class Bytes:
    """A binary file, read from front to back; what goes beyond its end is refused."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, form: str) -> tuple:
        size = struct.calcsize("<" + form)
        self.need(size)
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += size
        return values

    def need(self, size: int) -> None:
        if size > len(self.data) - self.at:
            raise ValueError(f"{self.path}: expected {size} bytes more at {self.at}; the file ends. Copy it again.")

    def skip(self, size: int) -> None:
        self.need(size)
        self.at += size

    def text(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + LONGEST_NAME)
        if end < 0:
            raise ValueError(f"{self.path}: expected a name at {self.at}; found none that ends. Copy the file again.")
        try:
            name = self.data[self.at : end].decode("utf-8")
        except UnicodeDecodeError:
            raise ValueError(f"{self.path}: expected a name in UTF-8 at {self.at}; found other bytes.") from None
        self.at = end + 1
        return name

    def done(self) -> None:
        if self.at != len(self.data):
            raise ValueError(
                f"{self.path}: expected its end at {self.at}; {len(self.data) - self.at} bytes are left. Another file?"
            )


def _cameras_bin(path: Path) -> dict[int, Lens]:
    file, out = Bytes(path), {}
    (count,) = file.take("Q")
    file.need(24 * count)
    for _ in range(count):
        number, model, width, height = file.take("iiQQ")
        where = f"{path}: camera {number}"
        name = MODELS[model] if 0 <= model < len(MODELS) else f"number {model}"
        if name not in PARAMETERS:
            lens_of(name, 1, 1, np.zeros(0), where)  # which refuses it
        values = np.array(file.take(f"{PARAMETERS[name]}d"))
        size = pixels(width, f"{where}: width"), pixels(height, f"{where}: height")
        out[number] = lens_of(name, *size, values, where)
    file.done()
    return out


def _images_bin(path: Path) -> list[Posed]:
    file, out = Bytes(path), []
    (count,) = file.take("Q")
    file.need(65 * count)
    for _ in range(count):
        number, *pose, camera = file.take("i7di")
        name = file.text()
        (points,) = file.take("Q")
        file.skip(24 * points)
        out.append(posed(name, camera, np.array(pose[:4]), np.array(pose[4:]), f"{path}: image {number}"))
    file.done()
    return out


def _lines(path: Path) -> list[str]:
    try:
        return [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    except UnicodeDecodeError:
        raise ValueError(
            f"{path}: expected text; found other bytes. Is it a binary model with the wrong name?"
        ) from None


def _numbers(words: list[str], where: str) -> np.ndarray:
    try:
        return np.array([float(w) for w in words])
    except ValueError:
        raise ValueError(f"{where}: expected numbers; found {shown(' '.join(words))}. Export it again.") from None


def _cameras_txt(path: Path) -> dict[int, Lens]:
    out = {}
    for line in _lines(path):
        words = line.split()
        if not words:
            continue
        where = f"{path}: camera {words[0][:20]}"
        if len(words) < 5:
            raise ValueError(
                f"{where}: expected ID MODEL WIDTH HEIGHT PARAMETERS; found {shown(line)}. Export it again."
            )
        number, width, height = _numbers([words[0], words[2], words[3]], where)
        size = pixels(width, f"{where}: width"), pixels(height, f"{where}: height")
        if int(number) in out:
            raise ValueError(f"{where}: expected every camera once; it occurs twice. Export it again.")
        out[int(number)] = lens_of(words[1], *size, _numbers(words[4:], where), where)
    return out


def _images_txt(path: Path) -> list[Posed]:
    lines = _lines(path)
    while lines and not lines[-1].strip():
        lines.pop()
    out = []
    for n in range(0, len(lines), 2):
        words = lines[n].split(maxsplit=9)
        where = f"{path}: image {words[0][:20] if words else ''}"
        if len(words) < 10:
            raise ValueError(
                f"{where}: expected ID QW QX QY QZ TX TY TZ CAMERA NAME on every second line; found {shown(lines[n])}. "
                "Export it again."
            )
        values = _numbers(words[:9], where)
        out.append(posed(words[9].strip(), int(values[8]), values[1:5], values[5:8], where))
    return out
