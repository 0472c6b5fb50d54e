"""Motion capture: readers against poses known by hand, hostile files, and the real files where there are any."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from otsync.simulate import Mocap, simulate
from otsync.simulate.mocap import CMU_UNIT
from otsync.simulate.skeleton_files import read_amc, read_bvh

BVH = """HIERARCHY
ROOT Hips
{
	OFFSET 0 0 0
	CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
	JOINT LeftLeg
	{
		OFFSET 10 -5 0
		CHANNELS 3 Zrotation Yrotation Xrotation
		End Site
		{
			OFFSET 0 -80 0
		}
	}
	JOINT RightLeg
	{
		OFFSET -10 -5 0
		CHANNELS 3 Zrotation Yrotation Xrotation
		End Site
		{
			OFFSET 0 -80 0
		}
	}
	JOINT Chest
	{
		OFFSET 0 10 0
		CHANNELS 3 Xrotation Yrotation Zrotation
		End Site
		{
			OFFSET 0 75 0
		}
	}
}
MOTION
Frames: 6
Frame Time: 0.04
"""
ROWS = [[f, 90 + f, 2 * f, 10 * f, 20, 5, 3, 2, f, 0, 0, 0, 4, 5 * f, 6] for f in range(6)]
BVH += "\n".join(" ".join(map(str, row)) for row in ROWS) + "\n"

ASF = """:version 1.10
:units
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name lfemur
    direction 0 -1 0
    length 15
    axis 10 20 30 XYZ
    dof rx ry rz
  end
  begin
    id 2
    name ltibia
    direction 0 -1 0
    length 15
    axis 0 0 20 XYZ
    dof rx
  end
  begin
    id 3
    name thorax
    direction 0 1 0
    length 2
    axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root lfemur thorax
    lfemur ltibia
  end
"""
AMC = ":FULLY-SPECIFIED\n:DEGREES\n" + "".join(
    f"{f + 1}\nroot {f} 17 0 {5 * f} 10 20\nlfemur {10 * f} 5 7\nltibia {20 + f}\n" for f in range(6)
)


@pytest.fixture
def files(tmp_path):
    def write(**contents):
        for name, text in contents.items():
            stem, _, suffix = name.rpartition("_")
            (tmp_path / f"{stem}.{suffix}").write_text(text)
        return tmp_path

    return write


def R(order, *degrees):
    """Intrinsic rotations in the order of the letters."""
    angles = (
        degrees if len(degrees) > 1 else degrees[0]
    )  # of a single letter, scipy 1.16 takes a list for many rotations
    return Rotation.from_euler(order.upper(), angles, degrees=True).as_matrix()


def test_bvh_by_hand(files):
    clip = read_bvh(files(a_bvh=BVH) / "a.bvh")
    assert clip.names == ("Hips", "LeftLeg", "RightLeg", "Chest") and clip.fps == pytest.approx(25)
    np.testing.assert_array_equal(clip.parents, [-1, 0, 0, 0])
    np.testing.assert_array_equal(clip.offsets[1], [10, -5, 0])
    np.testing.assert_array_equal(clip.tips[3], [0, 75, 0])
    np.testing.assert_allclose(clip.root[:, 1], 90 + np.arange(6))
    np.testing.assert_allclose(clip.rotations[2, 0], R("ZYX", 20, 20, 5))
    np.testing.assert_allclose(clip.rotations[2, 1], R("ZYX", 3, 2, 2))
    np.testing.assert_allclose(clip.rotations[2, 3], R("XYZ", 4, 10, 6))


def test_amc_by_hand(files):
    folder = files(a_asf=ASF, a_01_amc=AMC)
    clip = read_amc(folder / "a_01.amc", folder / "a.asf")
    assert clip.names == ("root", "lfemur", "thorax", "ltibia") and clip.fps == 120
    np.testing.assert_array_equal(clip.offsets[3], [0, -15, 0])
    # extrinsic x, y, z: Rz Ry Rx; a bone's motion acts in its own axis frame
    np.testing.assert_allclose(clip.rotations[3, 0], R("ZYX", 20, 10, 15), atol=1e-12)
    C = R("ZYX", 30, 20, 10)
    np.testing.assert_allclose(clip.rotations[3, 1], C @ R("ZYX", 7, 5, 30) @ C.T, atol=1e-12)
    C = R("ZYX", 20, 0, 0)
    np.testing.assert_allclose(clip.rotations[3, 3], C @ R("X", 23) @ C.T, atol=1e-12)
    np.testing.assert_allclose(clip.rotations[:, 2], np.broadcast_to(np.eye(3), (6, 3, 3)), atol=1e-12)


def test_radians_read_like_degrees(files):
    names = {"root": slice(4, None), "lfemur": slice(1, None), "ltibia": slice(1, None)}

    def turn(line):
        words = line.split()
        s = names.get(words[0])
        if s is not None:
            words[s] = [repr(float(np.radians(float(w)))) for w in words[s]]
        return " ".join(words)

    amc = "\n".join(map(turn, AMC.replace(":DEGREES", ":RADIANS").splitlines()))
    folder = files(a_asf=ASF, a_01_amc=AMC, a_02_amc=amc)
    one, two = (read_amc(folder / f"a_0{i}.amc", folder / "a.asf") for i in (1, 2))
    np.testing.assert_allclose(one.rotations, two.rotations, atol=1e-12)


def test_a_capture_becomes_a_world_in_metres_with_z_up(files):
    path = files(a_bvh=BVH) / "a.bvh"
    tracks, truth = simulate(Mocap(path, start=0.0), frames=3, effects=(), seed=0)
    parts = truth.scene.parts
    assert len(parts) == 4 and parts.figure.all()
    assert len(set(parts.kind[[0, 1, 3]])) == 3 and parts.kind[1] == parts.kind[2]  # the legs are a pair
    _, p = truth.scene.pose(np.array([0.04, 0.08]))
    np.testing.assert_allclose(p[0, :, 2], [0.92, 0.93])  # the hips: centimetres found
    hinge = np.linalg.norm(p[1] - p[2], axis=1)
    np.testing.assert_allclose(hinge, 0.20, atol=1e-9)
    # the pose at a captured instant: frame 0 of the file is left out, so 0.04 s is frame 2
    legs = 0.01 * np.array([[0.0, 0, 0], [10, -5, 0], [-10, -5, 0], [0, 10, 0]]) @ R("ZYX", 20, 20, 5).T
    got = p[:, 0] - p[:1, 0]
    want = (legs - legs[0])[:, [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(np.linalg.norm(got[:, :2], axis=1), np.linalg.norm(want[:, :2], axis=1), atol=1e-9)
    np.testing.assert_allclose(got[:, 2], want[:, 2], atol=1e-9)
    assert np.isfinite(tracks[0].xyz).all()
    still = simulate(f"mocap:{path}", frames=3, effects=(), seed=0)[0]
    assert len(still[0]) == len(tracks[0])


def test_turns_past_half_a_circle_are_smooth(files):
    rows = [[0, 90, 0, 40 * f, 0, 0] + [0] * 9 for f in range(12)]
    text = BVH.split("Frames:")[0] + "Frames: 12\nFrame Time: 0.04\n" + "\n".join(" ".join(map(str, r)) for r in rows)
    _, truth = simulate(Mocap(files(a_bvh=text) / "a.bvh", start=0.0), frames=3, effects=(), seed=0)
    R_, _ = truth.scene.pose(np.linspace(0.08, 0.32, 49))  # the same speed all the way
    steps = Rotation.from_matrix(R_[0, 1:] @ R_[0, :-1].swapaxes(1, 2)).magnitude()
    np.testing.assert_allclose(np.degrees(steps), 40 / 8, atol=0.3)


def test_beyond_its_ends_a_capture_runs_backwards(files):
    _, truth = simulate(Mocap(files(a_bvh=BVH) / "a.bvh", start=0.0), frames=3, effects=(), seed=0)
    t = np.array([0.03, 0.07, 0.1])
    duration = 4 * 0.04
    for mirrored in (-t, 2 * duration - t, t + 2 * duration):
        np.testing.assert_allclose(truth.positions(0, t), truth.positions(0, mirrored), atol=1e-9)


BAD_BVH = {
    "no file": None,
    "empty": "",
    "binary": "HIERARCHY\0\xff\xfe",
    "other": "hello MOTION there",
    "no motion": BVH.split("MOTION")[0],
    "open brace": BVH.replace("}\nMOTION", "MOTION"),
    "stray brace": BVH.replace("}\nMOTION", "}}\nMOTION"),
    "two roots": BVH.replace("JOINT LeftLeg", "ROOT LeftLeg"),
    "orphan": BVH.replace("ROOT Hips", "JOINT Hips"),
    "unknown word": BVH.replace("OFFSET 10 -5 0", "OFSET 10 -5 0"),
    "nan offset": BVH.replace("OFFSET 10 -5 0", "OFFSET nan -5 0"),
    "huge offset": BVH.replace("OFFSET 10 -5 0", "OFFSET 1e30 -5 0"),
    "word offset": BVH.replace("OFFSET 10 -5 0", "OFFSET ten -5 0"),
    "moving joint": BVH.replace("CHANNELS 3 Zrotation", "CHANNELS 3 Xposition", 1),
    "same channel": BVH.replace("Zrotation Yrotation Xrotation\n\t\tEnd", "Zrotation Zrotation Xrotation\n\t\tEnd", 1),
    "many channels": BVH.replace("CHANNELS 3", "CHANNELS 999999999", 1),
    "negative frames": BVH.replace("Frames: 6", "Frames: -6"),
    "half frames": BVH.replace("Frames: 6", "Frames: 6.5"),
    "more frames": BVH.replace("Frames: 6", "Frames: 7"),
    "a billion frames": BVH.replace("Frames: 6", "Frames: 1000000000"),
    "one frame": BVH.split("Frames")[0] + "Frames: 1\nFrame Time: .04\n" + " ".join(["0"] * 15),
    "no time": BVH.replace("Frame Time: 0.04", "Frame Time: 0"),
    "nan time": BVH.replace("Frame Time: 0.04", "Frame Time: nan"),
    "nan sample": BVH.replace("90 0 0", "nan 0 0"),
    "inf sample": BVH.replace("90 0 0", "1e999 0 0"),
    "far root": BVH.replace("90 0 0", "99999 0 0"),
    "joint bomb": "HIERARCHY\n" + "ROOT a\n{\nOFFSET 0 0 0\n" + "JOINT b\n{\nOFFSET 0 0 0\n" * 5000 + "MOTION\n",
    "no size": BVH.replace(" -80 ", " -8000 "),
}


@pytest.mark.parametrize("case", BAD_BVH)
def test_hostile_bvh_is_refused_by_name(case, tmp_path):
    path = tmp_path / "evil.bvh"
    if BAD_BVH[case] is not None:
        path.write_bytes(BAD_BVH[case].encode("latin-1"))
    with pytest.raises(ValueError, match=r"evil\.bvh"):
        simulate(Mocap(path), frames=3)


BAD_AMC = {
    "unknown bone": (ASF, AMC.replace("ltibia 20", "wing 20")),
    "missing bone": (ASF, AMC.replace("ltibia 22\n", "")),
    "twice": (ASF, AMC.replace("ltibia 22\n", "ltibia 22\nltibia 22\n")),
    "wrong width": (ASF, AMC.replace("ltibia 20", "ltibia 20 3")),
    "no frame number": (ASF, AMC.replace("1\nroot", "root", 1)),
    "nan": (ASF, AMC.replace("ltibia 20", "ltibia nan")),
    "word": (ASF, AMC.replace("ltibia 20", "ltibia x")),
    "one frame": (ASF, AMC.split("2\nroot")[0]),
    "empty": (ASF, ""),
    "empty skeleton": ("", AMC),
    "no hierarchy": (ASF.split(":hierarchy")[0], AMC),
    "cycle": (ASF.replace("lfemur ltibia\n", "lfemur ltibia\nltibia lfemur\n"), AMC),
    "unknown child": (ASF.replace("root lfemur", "root lfoot"), AMC),
    "root order": (ASF.replace("TX TY TZ", "TX TX TZ"), AMC),
    "axis order": (ASF.replace("10 20 30 XYZ", "10 20 30 XXZ"), AMC),
    "nan direction": (ASF.replace("direction 0 -1 0", "direction nan -1 0"), AMC),
    "no length": (ASF.replace("length 15\n", "\n", 1), AMC),
    "dof": (ASF.replace("dof rx\n", "dof rx rx\n"), AMC),
    "length dof": (ASF.replace("dof rx\n", "dof l\n"), AMC),
}


@pytest.mark.parametrize("case", BAD_AMC)
def test_hostile_amc_is_refused_by_name(case, tmp_path):
    (tmp_path / "evil.asf").write_text(BAD_AMC[case][0])
    (tmp_path / "evil_01.amc").write_text(BAD_AMC[case][1])
    with pytest.raises(ValueError, match=r"evil"):
        simulate(Mocap(tmp_path / "evil_01.amc"), frames=3)


def test_files_of_other_kinds_and_lone_motions(tmp_path):
    with pytest.raises(ValueError, match=r"expected a \.bvh or an \.amc"):
        simulate("mocap:walk.fbx")
    (tmp_path / "a_01.amc").write_text(AMC)
    with pytest.raises(ValueError, match=r"^skeleton: expected"):
        simulate(Mocap(tmp_path / "a_01.amc"))


def test_a_file_too_large_is_not_read(tmp_path):
    path = tmp_path / "big.bvh"
    with path.open("wb") as stream:
        stream.truncate(65 * 2**20)  # sparse
    with pytest.raises(ValueError, match="at most 64 MB"):
        read_bvh(path)


@settings(max_examples=150, deadline=None)
@given(st.integers(0, len(BVH) - 1), st.integers(0, len(BVH) - 1), st.text("{}0-9 .aEJ\n", max_size=8))
def test_damaged_bvh_is_read_or_refused(tmp_path_factory, start, length, patch):
    path = tmp_path_factory.getbasetemp() / "fuzz.bvh"
    path.write_text(BVH[:start] + patch + BVH[start + length % 40 :])
    try:
        clip = read_bvh(path)
    except ValueError as error:
        assert "fuzz.bvh" in str(error)
    else:
        assert np.isfinite(clip.rotations).all() and np.isfinite(clip.root).all()


@pytest.mark.parametrize("name", ["01_01.bvh", "11_01.amc"])
def test_real_captures(data, name):
    path = data / "motion" / name
    if not path.exists():
        pytest.skip(f"no {name} among the data")
    speeds = []
    for seed in range(3):
        tracks, truth = simulate(Mocap(path), effects=(), seed=seed)
        speeds.append(np.linalg.norm(np.diff(tracks[0].xyz, axis=1), axis=2) * 30)
        assert tracks[0].xyz[..., 2].min() > -0.15  # on the floor
        assert 1.0 < tracks[0].xyz[..., 2].max() < 2.6
        R_, p = truth.scene.pose(np.linspace(-3, 30, 200))
        # a knee stays where the thigh ends
        np.testing.assert_allclose(R_ @ R_.swapaxes(-1, -2), np.broadcast_to(np.eye(3), R_.shape), atol=1e-9)
        ends = p + np.einsum("ptij,pj->pti", R_, truth.scene.parts.end)
        gaps = np.linalg.norm(ends[:, None] - p, axis=3)
        joined = gaps.max(2) < 1e-6
        assert joined.sum() > 10
    assert 0.05 < np.median(np.concatenate(speeds)) < 2
    assert np.concatenate(speeds).max() < 20
    kinds = truth.scene.parts.kind
    assert np.bincount(kinds).max() == 2  # pairs at most


def test_cmu_units_are_found(data):
    path = data / "motion" / "11_01.amc"
    if not path.exists():
        pytest.skip("no 11_01.amc among the data")
    one = simulate(Mocap(path), frames=3, effects=(), seed=0)[1]
    two = simulate(Mocap(path, unit=CMU_UNIT), frames=3, effects=(), seed=0)[1]
    assert np.array_equal(one.scene.parts.end, two.scene.parts.end)
