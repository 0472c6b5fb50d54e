"""Scene files from strangers: what was saved comes back, and nothing else is believed, least of all by the kernels."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync.files.arrays import read_npz, write_npz
from recon.motion import BSpline, HermiteSpline, PerGaussian, Static
from recon.scene.gaussians4d import Gaussians4D, scene_arrays
from tests.recon.motion.worlds import random_scaffold, random_scene

PATH = BSpline(0.0, 0.1, 8)
MOTIONS = {
    "world": random_scaffold(),
    "videos": random_scaffold(videos=2, blend="dual-quaternion", kind=HermiteSpline),
    "own": PerGaussian(PATH, torch.randn(8, 200, 3, generator=torch.Generator().manual_seed(0))),
    "turning": PerGaussian.at_rest(PATH, 200).turning().tied(torch.arange(600.0).reshape(200, 3), 0.0),
    "none": Static(),
}
SCENES = {name: scene_arrays(random_scene(motion, features=True)) for name, motion in MOTIONS.items()}


def load(folder, arrays) -> Gaussians4D:
    write_npz(folder / "scene.npz", arrays)
    return Gaussians4D.load(folder / "scene.npz")


def headed(**changes) -> dict[str, np.ndarray]:
    """A scene with other entries in its header; what is ... is left out."""
    about = json.loads(SCENES["world"]["scene"].tobytes()) | changes
    text = json.dumps({k: v for k, v in about.items() if v is not ...})
    return SCENES["world"] | {"scene": np.frombuffer(text.encode(), np.uint8)}


@pytest.mark.parametrize("name", SCENES)
def test_scenes_survive_their_files(tmp_path, name):
    again = load(tmp_path, SCENES[name])
    found = scene_arrays(again)
    assert found.keys() == SCENES[name].keys()
    for key, array in SCENES[name].items():
        assert found[key].dtype == array.dtype and np.array_equal(found[key], array), key
    before = random_scene(MOTIONS[name])
    np.testing.assert_array_equal(again.tracks([0.1, 0.5]), before.tracks([0.1, 0.5]))


@pytest.mark.parametrize(
    ("scene", "name", "change"),
    [
        ("videos", "clock", lambda a: a + 1000),
        ("videos", "clock", lambda a: a - 1),
        ("videos", "clock", lambda a: a[:5]),
        ("videos", "rates", lambda a: 0 * a),
        ("videos", "rates", lambda a: a[:1]),
        ("videos", "offsets", lambda a: a + np.inf),
        ("world", "binding_weights", lambda a: a[:0]),
        ("world", "binding_weights", lambda a: -a),
        ("world", "binding_weights", lambda a: a.astype(np.float64)),
        ("world", "binding_nodes", lambda a: a + 40),
        ("world", "binding_nodes", lambda a: a.astype(np.int32)),
        ("world", "binding_nodes", lambda a: a[:, :3]),
        ("world", "binding_rest", lambda a: a + 2),
        ("world", "binding_rest", lambda a: a[:50]),
        ("world", "binding_times", lambda a: a[:1]),
        ("world", "binding_positions", lambda a: a[:, :7]),
        ("world", "binding_quats", lambda a: a * np.nan),
        ("world", "edges", lambda a: -1 - a),
        ("world", "edge_weights", lambda a: a[:, :2]),
        ("world", "path_knots", lambda a: np.array([0, 0.1, np.inf])),
        ("world", "path_knots", lambda a: np.array([0, 0.1, 8.5])),
        ("world", "knots", lambda a: a[..., 0]),
        ("world", "unit", lambda a: np.array(np.nan)),
        ("own", "own_knots", lambda a: a[:, :1]),
        ("own", "own_knots", lambda a: a[:6]),
        ("own", "own_knots", lambda a: a * np.inf),
        ("turning", "own_quats", lambda a: a[:, :1]),
        ("turning", "own_quats", lambda a: a.astype(np.float64)),
        ("turning", "near", lambda a: a + 1),
        ("turning", "near", lambda a: a[:1]),
        ("turning", "near", lambda a: a.astype(np.int32)),
    ],
)
def test_motions_whose_indices_or_shapes_lead_nowhere_are_refused(tmp_path, scene, name, change):
    arrays = SCENES[scene]
    with pytest.raises(ValueError, match=r"scene\.npz.*" + name.split("_")[0]):
        load(tmp_path, arrays | {f"motion.{name}": change(arrays[f"motion.{name}"])})


@pytest.mark.parametrize("name", ["dynamic.means", "dynamic.sh", "static.quats", "features"])
def test_numbers_that_are_none_are_refused(tmp_path, name):
    for change in (lambda a: a * np.nan, lambda a: a[:1], lambda a: a.astype(int), lambda a: a.astype(">f4")):
        with pytest.raises(ValueError, match=r"scene\.npz"):
            load(tmp_path, SCENES["world"] | {name: change(SCENES["world"][name])})


@pytest.mark.parametrize(
    "header",
    [
        {"span": [0.0]},
        {"span": []},
        {"span": 5},
        {"span": [1, 0]},
        {"span": [0, 10**400]},
        {"span": ...},
        {"span": [0, float("inf")]},
        {"near": float("nan")},
        {"near": -1},
        {"near": None},
        {"footprint": []},
        {"frame_step": 0},
        {"version": 2},
        {"format": {}},
    ],
)
def test_headers_of_other_things_are_refused(tmp_path, header):
    with pytest.raises(ValueError, match=r"scene\.npz"):
        load(tmp_path, headed(**header))


def test_a_header_that_is_too_deep_is_refused(tmp_path):
    for text in (b"[" * 100_000, b"", b"[]", b"\xff"):
        with pytest.raises(ValueError, match=r"scene\.npz"):
            load(tmp_path, SCENES["world"] | {"scene": np.frombuffer(text, np.uint8)})


@st.composite
def damage(draw):
    """A scene with one array damaged: dropped, cut, stretched, turned, of another type, or with one number changed."""
    arrays = dict(SCENES[draw(st.sampled_from(sorted(SCENES)))])
    name = draw(st.sampled_from(sorted(arrays)))
    array = arrays[name]
    kind = draw(st.sampled_from(["drop", "cut", "double", "turn", "type", "poke", "another"]))
    if kind == "drop":
        del arrays[name]
    elif kind == "another":
        arrays[name] = arrays[draw(st.sampled_from(sorted(arrays)))]
    elif kind == "type":
        arrays[name] = (
            array.astype(draw(st.sampled_from(["i4", "i8", "f4", "f8", "U8", ">f4", "c8", "?"])), copy=True)
            if array.dtype.kind in "iuf"
            else array[None]
        )
    elif kind == "poke" and array.size and array.dtype.kind in "iuf":
        changed = array.copy().reshape(-1)
        values = [np.nan, np.inf, -1e30, 1e30] if array.dtype.kind == "f" else [0, 39, 40, 250]
        changed[draw(st.integers(0, array.size - 1))] = draw(st.sampled_from(values))
        arrays[name] = changed.reshape(array.shape)
    elif array.ndim:
        axis = draw(st.integers(0, array.ndim - 1))
        whole = {
            "cut": np.take(array, range(draw(st.integers(0, array.shape[axis]))), axis),
            "double": np.concatenate([array, array], axis),
            "turn": array.T.copy(),
        }
        arrays[name] = whole.get(kind, array)
    return arrays


@settings(max_examples=150, deadline=None)
@given(arrays=damage(), t=st.floats(-10, 10))
def test_whatever_is_damaged_is_refused_or_moves(tmp_path_factory, arrays, t):
    """Either a ValueError that names the file, or a scene of which every Gaussian can be asked for its place."""
    path = tmp_path_factory.getbasetemp() / "damaged.npz"
    write_npz(path, arrays)
    try:
        scene = Gaussians4D.load(path)
    except ValueError as error:
        assert str(path) in str(error)
        return
    assert scene.tracks([t, *scene.span]).shape == (len(scene), 3, 3)
    assert scene_arrays(scene).keys() <= read_npz(path).keys()
