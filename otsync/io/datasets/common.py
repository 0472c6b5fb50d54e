"""What the readers of datasets share: videos and images in folders, strict numbers, sound rotations, axes.

A reader refuses rather than guesses. Things are paired by name wherever names tell; where a layout pairs by order, the
counts must agree and the order must be the same whether 10 is sorted before 2 or after it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...files.strict import in_words, shown
from ..document import document, missing_fields
from ..footage import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from ..images import MAX_PIXELS, image_size
from ..order import natural

ORTHONORMAL = 1e-3
"""How far R Rᵀ may be from the identity: files hold six digits and fewer."""

HALF = 0.5
"""Pixels from OpenCV's convention (centre of the first pixel at 0) to ours (at 0.5)."""

MIRRORED = (
    "an axis points the wrong way. OpenGL and Blender turn two axes: negate columns 1 and 2 of camera-to-world "
    "(counted from 0), not one of them. otsync check tries which readings of the matrices fit"
)

DISTORTIONS = (4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV's model takes."""


def numbers(value: Any, shape: tuple[int | None, ...], what: str) -> np.ndarray:
    """``value`` as finite numbers of a shape (None: any length). ValueError begins with ``what``."""
    told = "x".join("n" if n is None else str(n) for n in shape) or "one number"
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "iuf":
            raise TypeError
        array = array.astype(float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what}: expected numbers ({told}); found {shown(value)}. Correct it.") from None
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        found = "x".join(map(str, array.shape)) or "one number"
        raise ValueError(f"{what}: expected numbers ({told}); found {found}. Correct it.")
    if not np.isfinite(array).all():
        raise ValueError(f"{what}: expected finite numbers; found nan or infinity. Calibrate that camera again.")
    return array


def positive(value: Any, what: str) -> float:
    """A number above 0."""
    number = float(numbers(value, (), what))
    if number <= 0:
        raise ValueError(f"{what}: expected a number above 0; found {number:g}. Correct it.")
    return number


def pixels(value: Any, what: str) -> int:
    """A whole number of pixels, at most what is ever decoded."""
    number = positive(value, what)
    if number != int(number) or number > MAX_PIXELS:
        raise ValueError(f"{what}: expected a whole number of pixels; found {number:g}. Correct it.")
    return int(number)


def pinhole(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """Intrinsics in pixels, the centre of the first pixel at (0.5, 0.5)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def intrinsics(value: Any, what: str, shift: float = 0.0) -> Float[np.ndarray, "3 3"]:
    """K of a file. ``shift``: what to add to the principal point to come to our pixels.

    ValueError for focal lengths that are not positive, for a skew, and for a matrix that is transposed.
    """
    K = numbers(value, (3, 3), what)
    if np.abs(K[2, :2]).max() > np.abs(K[:2, 2]).max():
        raise ValueError(
            f"{what}: expected the principal point in the last column; found it in the last row. Transpose."
        )
    if not np.allclose(K[2], [0, 0, 1], atol=1e-9) or abs(K[1, 0]) > 1e-9:
        raise ValueError(f"{what}: expected [[fx,0,cx],[0,fy,cy],[0,0,1]]; found {shown(K.tolist())}. Correct it.")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError(f"{what}: expected positive focal lengths; found {K[0, 0]:g} and {K[1, 1]:g}. Correct it.")
    if abs(K[0, 1]) > 1e-3 * K[0, 0]:
        raise ValueError(
            f"{what}: expected no skew, which otsync's cameras lack; found {K[0, 1]:g}. Calibrate without skew."
        )
    return pinhole(K[0, 0], K[1, 1], K[0, 2] + shift, K[1, 2] + shift)


def rigid(matrix: np.ndarray, what: str) -> Float[np.ndarray, "4 4"]:
    """The matrix (3x4 or 4x4) as a rigid motion. ValueError for a mirrored one, with the remedy, and for a scale."""
    full = np.eye(4)
    full[:3] = matrix[:3]
    if len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-4):
        raise ValueError(f"{what}: expected a last row of 0 0 0 1; found {shown(matrix[3].tolist())}. Transposed?")
    R = full[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        turns = np.allclose(R @ R.T, np.eye(3), atol=ORTHONORMAL)
    if not turns:
        size = float(np.cbrt(abs(np.linalg.det(R)))) if np.abs(R).max() < 1e90 else np.inf
        raise ValueError(
            f"{what}: expected a rotation in the upper 3x3; its rows are not orthonormal (scale about {size:.4g}). "
            "Take scale and shear out of it."
        )
    if np.linalg.det(R) < 0:
        raise ValueError(f"{what}: expected det(R) = +1; found -1, a mirrored frame: {MIRRORED}.")
    return full


def from_opengl(c2w: Any, what: str) -> Float[np.ndarray, "4 4"]:
    """World to camera with OpenCV axes, of camera-to-world with OpenGL ones (x right, y up, z back)."""
    given = numbers(c2w, (None, 4), what)
    if len(given) not in (3, 4):
        raise ValueError(f"{what}: expected 3 or 4 rows; found {len(given)}. Correct it.")
    return np.linalg.inv(rigid(given, what) @ np.diag([1.0, -1.0, -1.0, 1.0]))


def to_opengl(w2c: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The other way round: camera-to-world with OpenGL axes."""
    return np.linalg.inv(w2c) @ np.diag([1.0, -1.0, -1.0, 1.0])


def world_to_camera(R: np.ndarray, t: np.ndarray, what: str) -> Float[np.ndarray, "4 4"]:
    """``x_camera = R x_world + t`` as a matrix, checked."""
    return rigid(np.concatenate([R, np.reshape(t, (3, 1))], 1), what)


def distortion(value: Any, what: str) -> list[float] | None:
    """OpenCV's coefficients, padded with zeros to a number that it takes; None where all are 0."""
    flat = np.asarray(value).reshape(-1)
    given = numbers(flat, (None,), what)
    if not given.any():
        return None
    fitting = next((n for n in DISTORTIONS if n >= len(given)), None)
    if fitting is None:
        raise ValueError(f"{what}: expected at most {DISTORTIONS[-1]} coefficients; found {len(given)}. Correct it.")
    return [*given.tolist(), *([0.0] * (fitting - len(given)))]


def camera(K: np.ndarray, w2c: np.ndarray, size: tuple[int, int], lens: list[float] | None = None) -> dict[str, Any]:
    """A camera of the document. ``w2c``: (4,4), or (T,4,4), which becomes one pose where all are the same."""
    if w2c.ndim == 3 and np.ptp(w2c, axis=0).max() < 1e-9:
        w2c = w2c[0]
    told: dict[str, Any] = {"K": K.tolist(), "w2c": w2c.tolist(), "width": size[0], "height": size[1]}
    return told if lens is None else told | {"distortion": lens}


def scene(videos: Sequence[dict[str, Any]], frame: str, notes: Iterable[str] = ()) -> dict[str, Any]:
    """The document with what its videos miss. Names that occur twice are refused by whoever opens it."""
    missing = missing_fields(videos)
    more: dict[str, Any] = {"notes": list(notes)}
    return document(videos, frame, **(more | {"missing": missing} if missing else more))


def videos_in(folder: Path) -> list[Path]:
    """Video files in a folder, in natural order (9 before 10)."""
    if not folder.is_dir():
        return []
    return sorted((p for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES and p.is_file()), key=natural)


def images_in(folder: Path) -> list[Path]:
    """Image files in a folder, in natural order."""
    if not folder.is_dir():
        return []
    return sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()), key=natural)


def folders_in(folder: Path) -> list[Path]:
    """Folders in a folder, in natural order, without hidden ones."""
    if not folder.is_dir():
        return []
    return sorted((p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")), key=natural)


def image_folders(folder: Path) -> list[Path]:
    """Folders with images below a folder, in natural order."""
    return [p for p in folders_in(folder) if images_in(p)]


def sorted_alike(names: Sequence[str], what: str) -> None:
    """ValueError where the order of names depends on how numbers are sorted: then nobody knows who is paired with whom.

    The authors' own programs sort letter by letter, otsync by numbers.
    """
    if sorted(names) != sorted(names, key=lambda name: natural(Path(name))):
        raise ValueError(
            f"{what}: expected names that sort alike by letters and by numbers, because this layout pairs them with "
            f"poses by order; found {', '.join(names[:4])}, ... Pad the numbers with zeros (cam02, cam10)."
        )


def same_count(found: int, expected: int, what: str, remedy: str) -> None:
    """ValueError unless two counts agree."""
    if found != expected:
        raise ValueError(f"{what}: expected {expected}; found {found}. {remedy}")


def video_size(path: Path) -> tuple[int, int]:
    """Width and height of a video, of its header."""
    from ..frames import VideoFrames

    video = VideoFrames(path)
    return video.width, video.height


def clip(path: Path, home: Path, fps: float | None = None) -> tuple[dict[str, Any], tuple[int, int]]:
    """The fields ``file`` or ``frames`` of a video file or of a folder of images, and its size.

    ValueError for images of several kinds in one folder, of which a pattern would leave some out.
    """
    inside = path.relative_to(home).as_posix()
    if path.is_file():
        own = {} if fps is None else {"fps": fps}
        return {"file": inside, **own}, video_size(path)
    images = images_in(path)
    if not images:
        raise ValueError(f"{path}: expected images ({', '.join(IMAGE_SUFFIXES)}); found none. Put them there.")
    kinds = sorted({p.suffix for p in images})
    if len(kinds) > 1:
        raise ValueError(f"{path}: expected images of one kind; found {', '.join(kinds)}. Take the others out.")
    return {"frames": f"{inside}/*{kinds[0]}", "fps": fps}, image_size(images[0])


def named_clips(folder: Path, places: Sequence[str]) -> dict[str, Path]:
    """Video files, or folders of images, by name, in the first of some places that has any ("": the folder itself)."""
    for place in places:
        home = folder / place if place else folder
        videos = videos_in(home)
        if videos:
            return {p.stem: p for p in videos}
        if place and (stills := image_folders(home)):
            return {p.name: p for p in stills}
    return {}


def clip_of(name: str, clips: dict[str, Path], where: str) -> Path:
    """The clip of a camera by its name: the same name, else the only one that has it as a word of its own.

    ValueError names what there is where none or several fit.
    """
    if name in clips:
        return clips[name]
    fitting = [own for own in clips if name in re.split(r"[-_. ]", own)]
    if len(fitting) == 1:
        return clips[fitting[0]]
    there = ", ".join(list(clips)[:8]) or "no videos"
    found = f"several ({', '.join(fitting)})" if fitting else f"{there}"
    raise ValueError(
        f"{where}: expected one video of the camera {shown(name)}; found {found}. Name each video as its camera."
    )


def every_clip_taken(taken: Iterable[Path], clips: dict[str, Path], where: str) -> None:
    """ValueError for videos that no camera has: they would be dropped in silence."""
    left = sorted(set(clips.values()) - set(taken))
    if left:
        raise ValueError(
            f"{where}: expected a camera for every video; found none for {', '.join(p.name for p in left[:8])}. Move "
            "these videos away, or calibrate them."
        )


def told(where: Path, what: str, read: Callable[[], Any]) -> Any:
    """What ``read`` gives; whatever a stranger's file makes it raise becomes a ValueError with the file's name."""
    try:
        return read()
    except FileNotFoundError:
        raise
    except (KeyError, TypeError, IndexError, ValueError, AttributeError, OverflowError) as error:
        text = str(error)
        if isinstance(error, ValueError) and text.startswith(str(where.parent)):
            raise
        raise ValueError(f"{where}: expected {what}; {in_words(error)}. Mend the file.") from None
