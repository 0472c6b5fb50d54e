"""Readers of motion capture: BVH, and ASF with AMC (the formats of the CMU database). Files are not trusted.

Refused with ValueError, naming the file: what is no such file, too large or too long, too many joints, numbers that are
not finite, channels that do not fit the skeleton, frame times that make no sense.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

MAX_BYTES = 64 * 2**20
MAX_JOINTS = 200
MAX_FRAMES = 200_000
MAX_LENGTH = 1e4  # of an offset or a translation, in the file's own unit


@dataclass(frozen=True, eq=False)
class Clip:
    """A captured motion in the file's own units and axes.

    Args:
        names: of the J joints; the first is the root, parents come before children.
        parents: (J,) -1 for the root.
        offsets: (J,3) from the parent's joint, in the parent's frame.
        tips: (J,3) the far end of the joint's bone, in its own frame; zero where it has none.
        rotations: (F,J,3,3) of every joint in its parent's frame.
        root: (F,3) position.
        fps: captured frames per second.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: Float[np.ndarray, "J 3"]
    tips: Float[np.ndarray, "J 3"]
    rotations: Float[np.ndarray, "F J 3 3"]
    root: Float[np.ndarray, "F 3"]
    fps: float


def read_text(path: Path, what: str) -> str:
    """The file as text, its size checked first."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise ValueError(f"{path}: expected a {what} file; cannot read it ({error.strerror}).") from None
    if size > MAX_BYTES:
        raise ValueError(f"{path}: expected at most {MAX_BYTES >> 20} MB of {what}; found {size >> 20} MB. Cut it.")
    if not path.is_file():
        raise ValueError(f"{path}: expected a {what} file; found something else.")
    try:
        return path.read_bytes().decode("ascii")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: expected {what}, which is plain text; found other bytes.") from None


def axis_rotations(axes: str, degrees: Float[np.ndarray, "F C"]) -> Float[np.ndarray, "F 3 3"]:
    """The product, in the given order, of rotations about the coordinate axes, e.g. "ZYX": Rz Ry Rx."""
    R = np.broadcast_to(np.eye(3), (len(degrees), 3, 3))
    for axis, angle in zip(axes, np.radians(degrees).T, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        i, j = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
        turn = np.tile(np.eye(3), (len(degrees), 1, 1))
        turn[:, i, i], turn[:, j, j], turn[:, j, i], turn[:, i, j] = c, c, s, -s
        R = R @ turn
    return R


def _numbers(words: list[str], path: Path, where: str, limit: float = MAX_LENGTH) -> np.ndarray:
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError:
        raise ValueError(f"{path}: {where}: expected numbers; found {' '.join(words)[:60]!r}.") from None
    if not np.isfinite(values).all() or (np.abs(values) > limit).any():
        raise ValueError(f"{path}: {where}: expected finite numbers up to {limit:g}; found {' '.join(words)[:60]!r}.")
    return values


def read_bvh(path: Path) -> Clip:
    """A Biovision hierarchy. The root's position channels move it; those of other joints are refused."""
    text = read_text(path, "BVH")
    head, marker, motion = text.partition("MOTION")
    if not marker or not head.lstrip().startswith("HIERARCHY"):
        raise ValueError(f"{path}: expected BVH (HIERARCHY ... MOTION ...); found another file.")
    names, parents, offsets, tips, channels = _bvh_hierarchy(head.split(), path)
    lines = motion.split("\n", 3)
    words = [line.split() for line in lines[1:3]]
    if len(lines) < 4 or len(words[0]) != 2 or words[0][0] != "Frames:" or words[1][:2] != ["Frame", "Time:"]:
        raise ValueError(f"{path}: expected the lines 'Frames: N' and 'Frame Time: seconds' after MOTION.")
    count = _numbers(words[0][1:], path, "Frames", MAX_FRAMES)[0]
    seconds = _numbers(words[1][2:], path, "Frame Time", 10.0)
    if len(seconds) != 1 or not 1e-4 <= seconds[0] <= 1.0:
        raise ValueError(f"{path}: Frame Time: expected seconds in [0.0001, 1]; found {' '.join(words[1][2:])!r}.")
    total = sum(len(c) for c in channels)
    values = _numbers(lines[3].split(), path, "motion", 1e6)
    if count < 2 or count != int(count) or len(values) != int(count) * total:
        raise ValueError(f"{path}: expected {count:g} frames (>= 2) of {total} channels; found {len(values)} numbers.")
    table = values.reshape(int(count), total)
    rotations = np.empty((len(table), len(names), 3, 3))
    root = np.zeros((len(table), 3))
    column = 0
    for j, own in enumerate(channels):
        block = table[:, column : column + len(own)]
        column += len(own)
        turns = [k for k, c in enumerate(own) if c.endswith("rotation")]
        for k, c in enumerate(own):
            if c.endswith("position"):
                root[:, "XYZ".index(c[0])] = block[:, k]
        rotations[:, j] = axis_rotations("".join(own[k][0] for k in turns), block[:, turns])
    if (np.abs(root) > MAX_LENGTH).any():
        raise ValueError(f"{path}: motion: expected root positions up to {MAX_LENGTH:g}; found larger ones.")
    return Clip(tuple(names), np.array(parents), np.array(offsets), np.array(tips), rotations, root, 1 / seconds[0])


def _bvh_hierarchy(words: list[str], path: Path) -> tuple[list[str], list[int], list, list, list[list[str]]]:
    names: list[str] = []
    parents: list[int] = []
    offsets: list[np.ndarray] = []
    tips: list[np.ndarray] = []
    channels: list[list[str]] = []
    open_joints: list[int] = []  # -1 is an end site
    pending = 0  # the joint whose brace comes next
    i = 1
    while i < len(words):
        word = words[i]
        if word in ("ROOT", "JOINT") and i + 1 < len(words):
            if (word == "ROOT") != (not names) or (word == "JOINT" and (not open_joints or open_joints[-1] < 0)):
                raise ValueError(f"{path}: expected one ROOT and JOINTs inside it; found {word} {words[i + 1][:40]!r}.")
            if len(names) == MAX_JOINTS:
                raise ValueError(f"{path}: expected at most {MAX_JOINTS} joints; found more.")
            names.append(words[i + 1])
            parents.append(open_joints[-1] if open_joints else -1)
            offsets.append(np.zeros(3))
            tips.append(np.zeros(3))
            channels.append([])
            pending = len(names) - 1
            i += 2
        elif words[i : i + 2] == ["End", "Site"] and open_joints:
            pending = -1
            i += 2
        elif word == "{" and names:
            open_joints.append(pending)
            i += 1
        elif word == "}" and open_joints:
            open_joints.pop()
            i += 1
        elif word == "OFFSET" and open_joints and len(words) > i + 3:
            value = _numbers(words[i + 1 : i + 4], path, "OFFSET")
            if open_joints[-1] >= 0:
                offsets[open_joints[-1]] = value
            elif len(open_joints) > 1:
                tips[open_joints[-2]] = value
            i += 4
        elif word == "CHANNELS" and open_joints and open_joints[-1] >= 0 and len(words) > i + 1:
            count = int(_numbers(words[i + 1 : i + 2], path, "CHANNELS", 6)[0])
            own = words[i + 2 : i + 2 + count]
            allowed = {f"{a}rotation" for a in "XYZ"} | ({f"{a}position" for a in "XYZ"} if len(names) == 1 else set())
            if len(own) != count or not set(own) <= allowed or len(set(own)) != count:
                raise ValueError(
                    f"{path}: CHANNELS of {names[-1][:40]!r}: expected {sorted(allowed)}; found {own[:6]}."
                )
            channels[open_joints[-1]] = own
            i += 2 + count
        else:
            raise ValueError(
                f"{path}: hierarchy: expected ROOT, JOINT, End Site, OFFSET, CHANNELS or a brace in its place; found "
                f"{word[:40]!r}. Export it again."
            )
    if not names or open_joints:
        raise ValueError(f"{path}: hierarchy: expected one ROOT with matching braces.")
    for j in range(len(names)):
        # a bone leads to the next joint: of several to the most central one
        ahead = [offsets[k] for k in range(len(names)) if parents[k] == j and offsets[k].any()]
        if ahead and not tips[j].any():
            tips[j] = min(ahead, key=lambda x: abs(x[0]) / np.linalg.norm(x))
    return names, parents, offsets, tips, channels


def read_amc(path: Path, skeleton: Path) -> Clip:
    """An AMC motion on its ASF skeleton, at the 120 frames per second of the CMU database (the file does not say)."""
    bones, degrees = _asf(skeleton)
    names = list(bones)
    blocks = _amc(path, {n: len(bones[n].dof) for n in names}, degrees)
    count = len(blocks["root"])
    rotations = np.empty((count, len(names), 3, 3))
    root = np.zeros((count, 3))
    for j, name in enumerate(names):
        bone, values = bones[name], blocks[name]
        turns = [k for k, d in enumerate(bone.dof) if d[0] == "R"]
        for k, d in enumerate(bone.dof):
            if d[0] == "T":
                root[:, "XYZ".index(d[1])] = values[:, k]
        # ASF lists rotations in order of application, and gives every bone an axis frame C: L = C M C^-1
        order = turns[::-1]
        M = axis_rotations("".join(bone.dof[k][1] for k in order), values[:, order])
        C = axis_rotations(bone.axis_order[::-1], bone.axis[None, ::-1])[0]
        rotations[:, j] = C @ M @ C.T
    parents = np.array([names.index(bones[n].parent) if bones[n].parent else -1 for n in names])
    tips = np.array([bones[n].tip for n in names])
    offsets = np.array([tips[p] if p >= 0 else np.zeros(3) for p in parents])
    return Clip(tuple(names), parents, offsets, tips, rotations, root, 120.0)


@dataclass
class _Bone:
    tip: np.ndarray
    axis: np.ndarray
    axis_order: str
    dof: list[str]
    parent: str = ""


def _asf(path: Path) -> tuple[dict[str, _Bone], bool]:
    """Bones by name, parents first; and whether angles are in degrees."""
    text = read_text(path, "ASF")
    sections: dict[str, list[list[str]]] = {}
    current: list[list[str]] = []
    for line in text.splitlines():
        words = line.split("#")[0].split()
        if words and words[0].startswith(":"):
            current = sections.setdefault(words[0].lower(), [])
        elif words:
            current.append(words)
    if not {":root", ":bonedata", ":hierarchy"} <= set(sections):
        raise ValueError(f"{path}: expected ASF with :root, :bonedata and :hierarchy; found {sorted(sections)[:8]}.")
    degrees = ["angle", "rad"] not in sections.get(":units", [])
    unit = 1.0 if degrees else 180 / np.pi
    root = {w[0].lower(): w[1:] for w in sections[":root"]}
    order = [w.upper() for w in root.get("order", [])]
    if sorted(order) != ["RX", "RY", "RZ", "TX", "TY", "TZ"]:
        raise ValueError(f"{path}: :root: expected the six entries of order; found {order[:8]}.")
    turn = unit * _numbers(root.get("orientation", ["0"] * 3), path, "root orientation")
    bones = {"root": _Bone(np.zeros(3), turn, _axes(root.get("axis", ["XYZ"]), path), order)}
    bone: dict[str, list[str]] = {}
    for words in sections[":bonedata"]:
        key = words[0].lower()
        if key == "begin":
            bone = {}
        elif key == "end":
            name = bone.get("name", [""])[0]
            direction = _numbers(bone.get("direction", []), path, f"direction of {name[:40]!r}")
            length = _numbers(bone.get("length", []), path, f"length of {name[:40]!r}")
            axis = bone.get("axis", ["0", "0", "0", "XYZ"])
            dof = [w.upper() for w in bone.get("dof", [])]
            if not name or name in bones or len(direction) != 3 or len(length) != 1 or len(axis) != 4:
                raise ValueError(f"{path}: :bonedata: expected name, direction, length and axis; found {bone}.")
            if not set(dof) <= {"RX", "RY", "RZ"} or len(set(dof)) != len(dof) or len(bones) > MAX_JOINTS:
                raise ValueError(f"{path}: dof of {name[:40]!r}: expected rx, ry, rz; found {dof[:8]}.")
            turn = unit * _numbers(axis[:3], path, f"axis of {name[:40]!r}")
            bones[name] = _Bone(direction * length[0], turn, _axes(axis[3:], path), dof)
        else:
            bone[key] = words[1:]
    ordered = {"root": bones["root"]}
    for words in sections[":hierarchy"]:
        if words[0] in ("begin", "end"):
            continue
        for child in words[1:]:
            if words[0] not in ordered or child not in bones or child in ordered:
                raise ValueError(f"{path}: :hierarchy: expected a tree from root; found {' '.join(words)[:60]!r}.")
            bones[child].parent = words[0]
            ordered[child] = bones[child]
    return ordered, degrees


def _axes(words: list[str], path: Path) -> str:
    order = words[0].upper() if words else ""
    if sorted(order) != ["X", "Y", "Z"]:
        raise ValueError(f"{path}: axis: expected an order such as XYZ; found {order[:40]!r}.")
    return order


def _amc(path: Path, widths: dict[str, int], degrees: bool) -> dict[str, np.ndarray]:
    """(F,dof) values of every bone; angles in degrees. Bones without degrees of freedom do not occur in the file."""
    rows: dict[str, list[list[str]]] = {name: [] for name in widths}
    frames = 0
    for line in read_text(path, "AMC").splitlines():
        words = line.split("#")[0].split()
        if not words or words[0].startswith(":"):
            degrees = degrees and words[:1] != [":RADIANS"]
            continue
        if len(words) == 1 and words[0].isdigit():
            frames += 1
            if frames > MAX_FRAMES:
                raise ValueError(f"{path}: expected at most {MAX_FRAMES} frames; found more.")
            continue
        if words[0] not in rows or len(words) - 1 != widths[words[0]] or len(rows[words[0]]) != frames - 1:
            raise ValueError(
                f"{path}: frame {frames}: expected the bones of the skeleton once each, with their degrees of freedom; "
                f"found {line[:60]!r}. Give the ASF file of the same subject."
            )
        rows[words[0]].append(words[1:])
    if frames < 2 or any(len(rows[n]) != frames for n, w in widths.items() if w):
        raise ValueError(f"{path}: expected AMC with at least 2 complete frames; found {frames} frames.")
    values = {}
    for name, width in widths.items():
        flat = [w for row in rows[name] for w in row] if width else []
        values[name] = _numbers(flat, path, f"motion of {name[:40]!r}").reshape(frames, width)
        if not degrees:
            turns = slice(3, None) if name == "root" else slice(None)
            values[name][:, turns] *= 180 / np.pi
    return values
