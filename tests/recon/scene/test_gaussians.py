"""The 3DGS parametrisation, its files, and files from strangers."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from otsync.types import Camera
from recon.raster import render, sh
from recon.scene.gaussians import Gaussians
from recon.scene.ply import load_ply, ply_fields, save_ply, save_splat


def some(n=20, k=16, seed=0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        torch.randn(n, 3, generator=g) + torch.tensor([0.0, 0, 5]),
        torch.randn(n, 4, generator=g),
        torch.randn(n, 3, generator=g) * 0.3 - 1,
        torch.randn(n, generator=g),
        torch.randn(n, k, 3, generator=g) * 0.3,
    )


CAMERA = Camera(np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), np.eye(4), 48, 32)


def test_activations_and_shapes():
    g = some()
    torch.testing.assert_close(g.scales.log(), g.log_scales)
    torch.testing.assert_close(g.opacities.logit(), g.opacity_logits)
    assert g.sh_degree == 3 and len(g) == 20
    same = Gaussians.from_colors(g.means, g.quats, g.scales, g.opacities, torch.rand(20, 3))
    torch.testing.assert_close(same.scales, g.scales)
    with pytest.raises(ValueError, match="log_scales: expected"):
        Gaussians(g.means, g.quats, g.log_scales[:3], g.opacity_logits, g.sh)
    with pytest.raises(ValueError, match="sh: expected"):
        Gaussians(g.means, g.quats, g.log_scales, g.opacity_logits, g.sh[:, :5])


def test_render_wraps_the_renderer():
    g = some(k=1)
    out = g.render(CAMERA, backend="torch")
    colors = (sh.C0 * g.sh[:, 0] + 0.5).clamp_min(0)
    K = torch.tensor(CAMERA.K, dtype=torch.float32)[None]
    direct = render(g.means, g.quats, g.scales, g.opacities, colors, torch.eye(4)[None], K, 48, 32, backend="torch")
    torch.testing.assert_close(out.colors, direct.colors)
    assert out.colors.shape == (1, 32, 48, 3)


def test_moving_and_several_cameras_become_images():
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 0, 3] = [0, 0.1, 0.2]
    moving = Camera(CAMERA.K, poses, 48, 32)
    g = some()
    out = g.render([moving, CAMERA], backend="torch")
    assert out.colors.shape == (4, 32, 48, 3)
    torch.testing.assert_close(out.colors[0], out.colors[3])
    with pytest.raises(ValueError, match="one image size"):
        g.render([CAMERA, Camera(CAMERA.K, np.eye(4), 24, 16)])
    with pytest.raises(ValueError, match="distortion"):
        g.render(Camera(CAMERA.K, np.eye(4), 48, 32, distortion=np.array([0.1, 0, 0, 0])))


def test_gradients_reach_the_parameters():
    g = some(k=4)
    leaves = [t.clone().requires_grad_() for t in (g.means, g.quats, g.log_scales, g.opacity_logits, g.sh)]
    Gaussians(*leaves).render(CAMERA).colors.square().sum().backward()
    assert all(t.grad is not None and t.grad.isfinite().all() and (t.grad != 0).any() for t in leaves)


@pytest.mark.parametrize("k", [1, 4, 16])
def test_ply_comes_back_unchanged(tmp_path, k):
    g = some(k=k)
    save_ply(g, tmp_path / "a.ply")
    back = load_ply(tmp_path / "a.ply")
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        assert torch.equal(getattr(g, name), getattr(back, name)), name
    assert os.listdir(tmp_path) == ["a.ply"]


def test_ply_is_the_standard_file_of_3dgs(tmp_path):
    """Byte for byte what the reference implementation writes: field order, channel-major f_rest."""
    g = some(n=2, k=16)
    save_ply(g, tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    header, body = data.split(b"end_header\n", 1)
    lines = header.decode().split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    assert names == ply_fields(16) and len(names) == 62
    assert names[:10] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_0"]
    assert names[-8:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    values = struct.unpack("<62f", body[: 62 * 4])
    assert values[9 : 9 + 15] == tuple(g.sh[0, 1:, 0].tolist())  # all of red before green
    assert values[54] == g.opacity_logits[0].item() and values[58:62] == tuple(g.quats[0].tolist())


def test_splat_bytes(tmp_path):
    g = some(n=7)
    save_splat(g, tmp_path / "a.splat")
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 7 * 32
    order = (g.log_scales.sum(-1) + g.opacities.log()).argsort(descending=True)
    first = int(order[0])
    assert struct.unpack("<6f", data[:24]) == (*g.means[first].tolist(), *g.scales[first].tolist())
    rgba = torch.cat([sh.C0 * g.sh[first, 0] + 0.5, g.opacities[first, None]])
    assert list(data[24:28]) == (rgba * 255).round().clamp(0, 255).int().tolist()
    unit = torch.nn.functional.normalize(g.quats[first], dim=0)
    assert list(data[28:32]) == (unit * 128 + 128).round().clamp(0, 255).int().tolist()


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    save_ply(some(), tmp_path / "a.ply")
    before = (tmp_path / "a.ply").read_bytes()
    monkeypatch.setattr("plyfile.PlyData.write", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        save_ply(some(seed=1), tmp_path / "a.ply")
    assert (tmp_path / "a.ply").read_bytes() == before and os.listdir(tmp_path) == ["a.ply"]


def written(path: Path, header: str, body: bytes = b"") -> Path:
    path.write_bytes(header.encode() + body)
    return path


def header(n="1", names=None, kind="float", form="binary_little_endian", before="") -> str:
    names = ply_fields(1) if names is None else names
    properties = "".join(f"property {kind} {name}\n" for name in names)
    return f"ply\nformat {form} 1.0\n{before}element vertex {n}\n{properties}end_header\n"


@pytest.mark.parametrize(
    ("head", "body", "message"),
    [
        ("", b"", "no .ply header"),
        ("PK\x03\x04", b"zip" * 100, "no .ply header"),
        ("ply\n" + "comment x\n" * 9000, b"", "no .ply header"),
        (header(n="1000000000000"), b"\0" * 68, "expected 1000000000000 Gaussians"),
        (header(n="99999999999999999999999999"), b"\0" * 68, "Gaussians of"),
        (header(n="-1"), b"", "the line 'element vertex -1'"),
        (header(n="1e3"), b"", "the line"),
        (header(n="2"), b"\0" * 68, "cut off"),
        (header(n="1000000000000", form="ascii"), b"0 " * 40, "cut off"),
        (header(names=["x", "y", "z"]), b"\0" * 12, "and no"),
        (header(names=[*ply_fields(1), "f_rest_0"]), b"\0" * 72, "1 f_rest"),
        (header(names=[*ply_fields(1), "x"]), b"\0" * 72, "the line 'property float x'"),
        (header(kind="list uchar int"), b"\0" * 900, "the line 'property list"),
        (header(kind="quad"), b"\0" * 900, "the line 'property quad"),
        (header(form="binary_middle_endian"), b"\0" * 900, "the line 'format"),
        (
            header(before="element face 1000000000\nproperty list uchar int vertex_index\n"),
            b"\0" * 900,
            "the line 'element face",
        ),
        (header().replace("end_header", "element face 5\nproperty float a\nend_header"), b"\0" * 900, "element face"),
        ("ply\nformat ascii 1.0\nend_header\n", b"", "no element"),
        (header(), struct.pack("<17f", *([0.0] * 16), float("nan")), "NaN or infinity in 1 of 1"),
        (header(), struct.pack("<17f", float("inf"), *([0.0] * 16)), "expected finite means"),
        (header(form="ascii"), b"spam " * 17, "cannot be parsed"),
    ],
)
def test_a_stranger_s_file_is_refused(tmp_path, head, body, message):
    path = written(tmp_path / "bad.ply", head, body)
    with pytest.raises(ValueError, match=message) as caught:
        load_ply(path)
    assert str(path) in str(caught.value)


def test_an_empty_scene_and_foreign_types_are_read(tmp_path):
    assert len(load_ply(written(tmp_path / "a.ply", header(n="0")))) == 0
    doubles = struct.pack("<17d", *range(17))
    g = load_ply(written(tmp_path / "b.ply", header(kind="double"), doubles))
    assert g.means.tolist() == [[0, 1, 2]] and g.means.dtype == torch.float32
    text = " ".join(str(v) for v in range(17)) + "\n"
    assert torch.equal(load_ply(written(tmp_path / "c.ply", header(form="ascii"), text.encode())).sh, g.sh)


def test_the_ends_of_opacity_and_scale_survive_a_file(tmp_path):
    n = 3
    ends = torch.tensor([0.0, 0.5, 1.0])
    g = Gaussians.from_colors(torch.zeros(n, 3), torch.ones(n, 4), ends[:, None].expand(n, 3), ends, torch.ones(n, 3))
    save_ply(g, tmp_path / "g.ply")
    torch.testing.assert_close(load_ply(tmp_path / "g.ply").opacities, ends, atol=2e-6, rtol=0)
    with pytest.raises(ValueError, match=r"opacities in 0\.\.1"):
        Gaussians.from_colors(torch.zeros(n, 3), torch.ones(n, 4), torch.ones(n, 3), 2 * ends, torch.ones(n, 3))


@pytest.mark.parametrize("save", [save_ply, save_splat])
def test_diverged_gaussians_are_not_written(save, tmp_path):
    g = Gaussians.from_colors(
        torch.full((1, 3), float("nan")), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1) / 2, torch.ones(1, 3)
    )
    with pytest.raises(ValueError, match=r"gaussians\.means: expected finite"):
        save(g, tmp_path / "g.bin")
    assert not list(tmp_path.iterdir())
