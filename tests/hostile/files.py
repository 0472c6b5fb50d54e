"""Sound files of every kind that is read, how each is read, and damage: by bytes, by values, by structure."""

from __future__ import annotations

import copy
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from otsync import Alignment, Offsets, TrackSet
from otsync.io import VideoFrames, open_scene
from otsync.io.document import write_document
from otsync.io.frames import ArrayFrames
from otsync.io.images import read_depth, read_image, read_labels, read_mask
from otsync.recordings.check import check_scene
from otsync.simulate.skeleton_files import read_amc, read_bvh
from tests.otsync.simulate.test_simulate_mocap import AMC, ASF, BVH
from tests.recording_world import ring

CAMERA = ring(3, width=32, height=24)[0]


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Args:
        file: its name in the folder that ``write`` fills. read: reads the file of this path, as commands do.
        others: beginnings of names of other files of the folder that an error may name instead.
    """

    name: str
    file: str
    write: Callable[[Path], None]
    read: Callable[[Path], Any]
    others: tuple[str, ...] = ()
    sound: bool = True
    """Whether the file is one that is read, before it is damaged."""


def tracks(folder: Path) -> None:
    rng = np.random.default_rng(0)
    TrackSet(
        rng.normal(size=(4, 9, 3)),
        visible=rng.random((4, 9)) < 0.8,
        features=rng.normal(size=(4, 5)),
        timestamps=np.arange(9) / 30,
        uv=rng.normal(size=(4, 9, 2)),
        sigma=rng.random((4, 9)),
        labels=np.arange(4),
        name="left",
        camera=CAMERA,
        frame="world",
    ).save(folder / "tracks.npz")


def offsets(folder: Path) -> None:
    known = Offsets.known(["left", "right"], np.array([0.0, 0.5]), fps=30)
    pair = Alignment(0.5, fps=30.0, sigma=0.01, hypotheses=np.array([[0.5, 2.0], [0.1, 1.0]]), stats={"matches": 9.0})
    Offsets(**{**vars(known), "alignments": {(0, 1): pair}}).save(folder / "offsets.json")


def entry(name: str, **more: Any) -> dict[str, Any]:
    told = {"K": CAMERA.K.tolist(), "w2c": CAMERA.w2c.tolist(), "width": 32, "height": 24, "readout": 0.01}
    return {"name": name, "frames": f"{name}/*.png", "fps": 30, "camera": told, **more}


def images(folder: Path) -> None:
    for name in ("left", "right", "depth"):
        (folder / name).mkdir()
        for k in range(3):
            mode = np.full((24, 32), 3000, np.uint16) if name == "depth" else np.full((24, 32, 3), 80 * k, np.uint8)
            Image.fromarray(mode).save(folder / name / f"f{k}.png")


def scene(folder: Path) -> None:
    images(folder)
    depth = {"frames": "depth/*.png", "scale": 0.001}
    right = entry("right", timestamps=[0, 0.1, 0.2], fps=None, range=[0, 2], depth=depth, masks="left/*.png")
    write_document(folder / "scene.json", [entry("left"), right])


def read_scene(path: Path) -> None:
    check_scene(path, every_frame=False)
    found = open_scene(path)
    for video in found.videos:
        video.frames[0]
        repr(video)


def panoptic(folder: Path) -> None:
    for c in range(2):
        (folder / "ims" / str(c)).mkdir(parents=True)
        for t in range(2):
            Image.new("RGB", (32, 24)).save(folder / "ims" / str(c) / f"{t}.jpg")
    meta = {
        "w": 32,
        "h": 24,
        "fn": [[f"{c}/{t}.jpg" for c in range(2)] for t in range(2)],
        "k": [[CAMERA.K.tolist()] * 2] * 2,
        "w2c": [[CAMERA.w2c.tolist()] * 2] * 2,
        "cam_id": [[0, 1]] * 2,
    }
    (folder / "train_meta.json").write_text(json.dumps(meta))


def picture(file: str, dtype: type, *size: int) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        values = np.random.default_rng(1).integers(0, 200, size).astype(dtype)
        Image.fromarray(values).save(folder / file)

    return write


def array(file: str, *size: int) -> Callable[[Path], None]:
    return lambda folder: np.save(folder / file, np.random.default_rng(2).uniform(1, 5, size).astype(np.float32))


def video(folder: Path) -> None:
    import av

    with av.open(str(folder / "left.mp4"), "w") as out:
        stream = out.add_stream("libx264", rate=30, options={"bf": "2", "g": "6"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 30)
        for k in range(12):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 9 * k, np.uint8), format="rgb24")
            frame.pts, frame.time_base = k, Fraction(1, 30)
            out.mux(stream.encode(frame))
        out.mux(stream.encode())


def read_video(path: Path) -> None:
    found = VideoFrames(path)
    for k in range(min(len(found), 14)):
        found[k]


def exr(folder: Path) -> None:
    """The beginning of an OpenEXR file: a format that is not read, and must be refused as such."""
    (folder / "depth.exr").write_bytes(b"\x76\x2f\x31\x01\x02\0\0\0channels\0chlist\0" + bytes(200))


def text(file: str, content: str, beside: dict[str, str] | None = None) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        for name, words in {file: content, **(beside or {})}.items():
            (folder / name).write_text(words)

    return write


KINDS = (
    Kind("tracks", "tracks.npz", tracks, TrackSet.load),
    Kind("offsets", "offsets.json", offsets, Offsets.load),
    Kind("scene", "scene.json", scene, read_scene, ("left", "right", "depth")),
    Kind("panoptic", "train_meta.json", panoptic, lambda path: open_scene(path.parent), ("scene.json", "ims")),
    Kind("image", "image.jpg", picture("image.jpg", np.uint8, 24, 32, 3), read_image),
    Kind("mask", "mask.png", picture("mask.png", np.uint8, 24, 32), read_mask),
    Kind("labels", "labels.png", picture("labels.png", np.uint16, 24, 32), read_labels),
    Kind("depth png", "depth.png", picture("depth.png", np.uint16, 24, 32), lambda path: read_depth(path, 0.001)),
    Kind("depth npy", "depth.npy", array("depth.npy", 24, 32), lambda path: read_depth(path, 1.0)),
    Kind("depth exr", "depth.exr", exr, lambda path: read_depth(path, 1.0), sound=False),
    Kind("depth stack", "stack.npy", array("stack.npy", 3, 24, 32), lambda path: ArrayFrames(path)[2]),
    Kind("video", "left.mp4", video, read_video),
    Kind("bvh", "walk.bvh", text("walk.bvh", BVH), read_bvh),
    Kind(
        "amc",
        "01_01.amc",
        text("01_01.amc", AMC, {"01.asf": ASF}),
        lambda path: read_amc(path, path.with_name("01.asf")),
    ),
    Kind(
        "asf",
        "01.asf",
        text("01.asf", ASF, {"01_01.amc": AMC}),
        lambda path: read_amc(path.with_name("01_01.amc"), path),
        ("01_01.amc",),
    ),
)

HOSTILE: tuple[Any, ...] = (
    None,
    True,
    False,
    -1,
    0,
    1e308,
    -1e308,
    10**30,
    10**4000,
    float("nan"),
    float("inf"),
    160.9,
    " 3_0 ",
    "",
    "\x1b[2J\x07",
    "a\nb",
    "\ud800",
    "x" * 5000,
    "../../etc/passwd",
    "*",
    "**/*",
    [],
    [[]],
    {},
    {"a": 1},
    [None],
    [[[[[1]]]]],
    [0] * 5000,
    ["a", 1],
)
"""Values that have no business in a field."""


def damaged(content: bytes, file: str, rng: np.random.Generator) -> tuple[bytes, tuple[str, ...]]:
    """The content with damage drawn by ``rng``; and the names of fields, one of which an error must name, if any."""
    if file.endswith(".json") and rng.random() < 0.7:
        return _other_json(json.loads(content), rng)
    if file.endswith(".npz") and rng.random() < 0.6:
        return _other_arrays(content, rng)
    if file.endswith(".npy") and rng.random() < 0.5:
        return _other_header(content, rng), ()
    out = bytearray(content)
    for _ in range(int(rng.integers(1, 4))):
        at, many = int(rng.integers(0, max(1, len(out)))), int(rng.integers(1, 40))
        match int(rng.integers(0, 6)):
            case 0:
                out[at:] = b""
            case 1:
                out[at : at + many] = rng.bytes(many)
            case 2:
                out[at:at] = rng.bytes(many)
            case 3:
                del out[at : at + many]
            case 4:
                out[at : at + many] = bytes(min(many, len(out) - at))
            case 5 if out:
                out[at % len(out)] ^= 1 << int(rng.integers(0, 8))
    return bytes(out), ()


def _other_json(document: Any, rng: np.random.Generator) -> tuple[bytes, tuple[str, ...]]:
    """A value replaced, a key renamed, dropped or added, anywhere."""
    places: list[tuple[Any, Any, tuple[str, ...]]] = []

    def visit(part: Any, way: tuple[str, ...]) -> None:
        items = part.items() if isinstance(part, dict) else enumerate(part) if isinstance(part, list) else ()
        for key, value in items:
            here = (*way, key) if isinstance(key, str) else way
            places.append((part, key, here))
            visit(value, here)

    visit(document, ())
    part, key, _ = places[int(rng.integers(0, len(places)))]
    names = tuple({name for *_, way in places for name in way})
    fate = int(rng.integers(0, 5)) if isinstance(part, dict) else 0
    if fate == 1:
        part[f"{key}s"] = part.pop(key)
    elif fate == 2:
        del part[key]
    elif fate == 3:
        part[f"{key}_"] = copy.deepcopy(part[key])
    else:
        part[key] = copy.deepcopy(HOSTILE[int(rng.integers(0, len(HOSTILE)))])
    return _dumped(document).encode("utf-8", "surrogatepass"), names


def _dumped(value: Any) -> str:
    """JSON, of huge integers too, which Python refuses to write."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)}: {_dumped(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_dumped, value)) + "]"
    return "9" * 5000 if isinstance(value, int) and value > 10**3000 else json.dumps(value)


def _other_arrays(content: bytes, rng: np.random.Generator) -> tuple[bytes, tuple[str, ...]]:
    """One array dropped, or replaced by one of another type, shape or content."""
    with np.load(io.BytesIO(content)) as data:
        arrays: dict[str, Any] = {name: data[name] for name in data.files}
    name = sorted(arrays)[int(rng.integers(0, len(arrays)))]
    old = arrays.pop(name)
    others = (
        np.array(7),
        np.array("text"),
        np.array([{}], object),
        old.astype("c16") if old.dtype.kind in "fiub" else old[None],
        old[None],
        old[..., :-1] if old.ndim else old[None],
        np.full(old.shape, np.nan),
        np.full((3, 0, 2), 1.0),
        np.full(old.shape, -1, np.int64),
        np.full(old.shape, 1e308),
        np.array("a\x1b[2J"),
        np.full(old.shape, True),
    )
    choice = int(rng.integers(-1, len(others)))
    if choice >= 0:
        arrays[name] = others[choice]
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=True, **arrays)
    return stream.getvalue(), (name,)


def _other_header(content: bytes, rng: np.random.Generator) -> bytes:
    """A header that claims another shape, order or type, before the data as they are."""
    stream = io.BytesIO(content)
    np.lib.format.read_magic(stream)
    np.lib.format.read_array_header_1_0(stream)
    shape = [(100_000, 100_000), (24, -32), (24,), (2**62, 8), (), (24, 32, 1), (0, 0)][int(rng.integers(0, 7))]
    kind = ["<f4", "|O", "<f8", "|V4", "<M8[s]", "<c8", "|S4", "<U1"][int(rng.integers(0, 8))]
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": kind, "fortran_order": False, "shape": shape})
    return out.getvalue() + content[stream.tell() :]
