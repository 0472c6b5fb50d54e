"""Gaussians in the file formats of 3DGS viewers: .ply (read and written) and .splat (written).

Files are not trusted: nothing is allocated before the header has been checked against the size of the file.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch

from otsync.files.arrays import atomic_write
from recon.raster import sh
from recon.scene.gaussians import Gaussians

MAX_HEADER_BYTES = 64 * 1024


def ply_fields(k: int) -> list[str]:
    """Names of the vertex properties of a 3DGS .ply with K coefficients, in their standard order."""
    return [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * (k - 1))),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]


def save_ply(gaussians: Gaussians, path: str | os.PathLike[str]) -> None:
    """Write the binary little-endian .ply of 3DGS: float32 in the order of :func:`ply_fields`, normals zero.

    f_rest holds the higher coefficients channel by channel: all of red, then green, then blue.
    """
    from plyfile import PlyData, PlyElement

    g = gaussians.detach().finite()
    names = ply_fields(g.sh.shape[1])
    rest = g.sh[:, 1:].transpose(1, 2).flatten(1)
    parts = [g.means, torch.zeros_like(g.means), g.sh[:, 0], rest, g.opacity_logits[:, None], g.log_scales, g.quats]
    columns = torch.cat(parts, 1).numpy()
    vertex = np.empty(len(g), dtype=[(name, "<f4") for name in names])
    for name, column in zip(names, columns.T, strict=True):
        vertex[name] = column
    ply = PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<")
    with atomic_write(path) as file:
        ply.write(file)


def load_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read a 3DGS .ply, in any order of its properties; normals and properties of other tools are ignored.

    Raises ValueError, with the path and what was expected, for a file that is no such .ply, is shorter than its header
    promises, lacks properties, or holds a NaN or an infinity.
    """
    from plyfile import PlyData, PlyParseError

    path = Path(path)
    n, names = _check_ply_header(path)
    rest = sum(name.startswith("f_rest_") for name in names)
    k = rest // 3 + 1
    missing = [name for name in ply_fields(k) if name not in names and not name.startswith("n")]
    if rest % 3 or k not in (1, 4, 9, 16, 25) or missing:
        raise ValueError(
            f"{path}: expected the properties of 3DGS with 0, 9, 24, 45 or 72 f_rest; found {rest} f_rest"
            + (f" and no {', '.join(missing[:4])}" if missing else "")
            + ". Export it as standard 3DGS."
        )
    try:
        vertex = PlyData.read(str(path), mmap=False)["vertex"].data
    except (PlyParseError, ValueError, KeyError) as error:
        raise ValueError(f"{path}: expected a .ply file; found one that cannot be parsed ({error}).") from error

    def columns(*wanted: str) -> np.ndarray:
        return np.stack([np.asarray(vertex[name], np.float32) for name in wanted], -1).reshape(n, len(wanted))

    dc = columns(*(f"f_dc_{i}" for i in range(3)))[:, None]
    higher = (
        columns(*(f"f_rest_{i}" for i in range(rest))).reshape(n, 3, k - 1) if rest else np.empty((n, 3, 0), np.float32)
    )
    arrays = {
        "means": columns("x", "y", "z"),
        "quats": columns(*(f"rot_{i}" for i in range(4))),
        "log_scales": columns(*(f"scale_{i}" for i in range(3))),
        "opacity_logits": columns("opacity")[:, 0],
        "sh": np.concatenate([dc, higher.transpose(0, 2, 1)], 1),
    }
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            bad = int((~np.isfinite(array)).reshape(n, -1).any(-1).sum())
            raise ValueError(
                f"{path}: expected finite {name}; found NaN or infinity in {bad} of {n} Gaussians. "
                "The fit that wrote it has diverged."
            )
    return Gaussians(**{name: torch.from_numpy(np.ascontiguousarray(a)) for name, a in arrays.items()})


def _check_ply_header(path: Path) -> tuple[int, list[str]]:
    """Number and property names of the vertices, once the header has been checked against the size of the file."""
    sizes = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
    sizes |= {"int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float32": 4, "float64": 8}

    def refuse(problem: str) -> ValueError:
        return ValueError(
            f"{path}: expected a 3DGS .ply with one element 'vertex' of scalar properties; found {problem}."
        )

    with open(path, "rb") as file:
        head = file.read(MAX_HEADER_BYTES)
        total = os.fstat(file.fileno()).st_size
    end = head.find(b"end_header\n")
    if not head.startswith(b"ply") or end < 0:
        raise refuse("no .ply header in its first 64 KiB")
    n, names, bytes_each, ascii_format = -1, [], 0, False
    for line in head[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"]:
            if len(words) < 2 or words[1] not in ("ascii", "binary_little_endian", "binary_big_endian"):
                raise refuse(f"the line {line[:80]!r}")
            ascii_format = words[1] == "ascii"
        elif words[:1] == ["element"]:
            if n >= 0 or len(words) != 3 or words[1] != "vertex" or not words[2].isdecimal():
                raise refuse(f"the line {line[:80]!r}")
            n = int(words[2])
        elif words[:1] == ["property"]:
            if n < 0 or len(words) != 3 or words[1] not in sizes or words[2] in names:
                raise refuse(f"the line {line[:80]!r}")
            names.append(words[2])
            bytes_each += 2 if ascii_format else sizes[words[1]]  # a digit and a space at the least
    if n < 0:
        raise refuse("no element")
    body = total - end - len(b"end_header\n")
    if n * bytes_each > body + ascii_format:
        raise ValueError(
            f"{path}: expected {n} Gaussians of {bytes_each} bytes as its header says; found {body} bytes. "
            "The file is cut off or its header is wrong."
        )
    return n, names


def save_splat(gaussians: Gaussians, path: str | os.PathLike[str]) -> None:
    """Write the .splat of web viewers: 32 bytes a Gaussian, the largest and most opaque first. Lossy.

    float32 position [3], float32 scales [3], uint8 rgb and opacity, uint8 quaternion wxyz as 128 + 128 q. Only the
    constant part of the colour is kept.
    """
    g = gaussians.detach().finite()
    record = np.zeros(len(g), dtype=[("xyz", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("wxyz", "u1", 4)])
    record["xyz"], record["scales"] = g.means.numpy(), g.scales.numpy()
    rgba = torch.cat([sh.C0 * g.sh[:, 0] + 0.5, g.opacities[:, None]], 1)
    unit = torch.nn.functional.normalize(g.quats, dim=-1)
    record["rgba"] = (rgba * 255).round().clamp(0, 255).numpy()
    record["wxyz"] = (unit * 128 + 128).round().clamp(0, 255).numpy()
    weight = g.log_scales.sum(-1) + g.opacities.log()
    record = record[weight.argsort(descending=True, stable=True).numpy()]
    with atomic_write(path) as file:
        file.write(record.tobytes())
