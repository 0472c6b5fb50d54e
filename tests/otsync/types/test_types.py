"""Nouns: what they refuse, what files keep, what an interruption leaves."""

from __future__ import annotations

import dataclasses
import json
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync import Alignment, Camera, Matches, Offsets, Status, TrackSet, Video
from otsync.files.arrays import atomic_write, read_npz
from otsync.types import gravest, in_order


def full_set() -> TrackSet:
    rng = np.random.default_rng(0)
    w2c = np.tile(np.eye(4), (6, 1, 1))
    camera = Camera(np.diag([500.0, 500, 1]), w2c, 640, 480, distortion=np.zeros(5), readout=0.01)
    visible = rng.random((4, 6)) > 0.2
    return TrackSet(
        rng.normal(size=(4, 6, 3)),
        visible,
        rng.normal(size=(4, 8)),
        timestamps=np.cumsum(rng.uniform(0.03, 0.04, 6)),
        name="küche",
        uv=rng.normal(size=(4, 6, 2)),
        sigma=rng.random((4, 6)),
        labels=np.arange(4),
        camera=camera,
        frame="room",
    )


def offsets() -> Offsets:
    pair = Alignment(0.5, sigma=0.01, hypotheses=np.array([[0.5, 3.0], [0.1, 2.0]]), fps=30, stats={"matches": 5.0})
    return Offsets(
        names=("a", "b", "c"),
        fps=np.array([30.0, 25, 30]),
        seconds=np.array([0, 0.5, np.nan]),
        rates=np.ones(3),
        sigma=np.array([0, 0.01, np.nan]),
        reference=0,
        component=np.array([0, 0, 2]),
        flags=((), (Status.WEAK, Status.SPREAD), (Status.DISCONNECTED,)),
        alignments={(0, 1): pair},
        stats={"seconds": 1.0},
    )


def test_trackset_round_trip(tmp_path):
    before = full_set()
    before.save(tmp_path / "a.npz")
    after = TrackSet.load(tmp_path / "a.npz")
    for field in ("xyz", "visible", "features", "timestamps", "uv", "sigma", "labels"):
        np.testing.assert_array_equal(getattr(after, field), getattr(before, field))
        assert getattr(after, field).dtype == getattr(before, field).dtype
    assert (after.name, after.frame, after.fps) == (before.name, before.frame, before.fps)
    for field in ("K", "w2c", "width", "height", "distortion", "readout"):
        np.testing.assert_array_equal(getattr(after.camera, field), getattr(before.camera, field))


def test_minimal_trackset_round_trip(tmp_path):
    TrackSet(np.zeros((1, 2, 3), np.float32), fps=25).save(tmp_path / "a.npz")
    after = TrackSet.load(tmp_path / "a.npz")
    assert after.xyz.dtype == np.float32 and after.visible.all() and after.features is None and after.fps == 25


def test_offsets_round_trip(tmp_path):
    offsets().save(tmp_path / "o.json")
    after = Offsets.load(tmp_path / "o.json")
    assert after.to_dict() == offsets().to_dict()
    text = json.loads((tmp_path / "o.json").read_text())
    assert text["unit"] == "seconds" and "later" in text["sign"] and text["reference"] == "a"
    assert text["videos"][1]["offset_frames"] == 15 and text["videos"][2]["offset_seconds"] is None
    assert after.status[1] is Status.WEAK and np.isnan(after.between(0, 2))


@pytest.mark.parametrize("version", [None, 0, 2, "1", 1.5])
def test_offsets_of_another_version_are_refused_with_the_remedy(tmp_path, version):
    data = offsets().to_dict() | {"version": version}
    if version is None:
        del data["version"]
    (tmp_path / "o.json").write_text(json.dumps(data))
    if version == "1":
        assert json.loads((tmp_path / "o.json").read_text())["version"] == "1"
    with pytest.raises(ValueError, match=r"o\.json: expected version 1.*release"):
        Offsets.load(tmp_path / "o.json")


def changed(where, value):
    data = json.loads(json.dumps(offsets().to_dict()))
    part = data
    for key in where[:-1]:
        part = part[key]
    part[where[-1]] = value
    return data


@pytest.mark.parametrize(
    "where, value, says",
    [
        (("videos", 1, "fps"), -30, r"videos, b: fps: expected a finite number above 0, or null; found -30"),
        (("videos", 1, "fps"), 0, r"videos, b: fps: expected .* above 0"),
        (("videos", 1, "fps"), True, r"videos, b: fps: expected a number or null; found True"),
        (("videos", 1, "rate"), 0.0, r"videos, b: rate: expected .* above 0"),
        (("videos", 2, "sigma_seconds"), -0.1, r"videos, c: sigma_seconds: expected .* of 0 or more"),
        (
            ("videos", 2, "offset_seconds"),
            float("inf"),
            r"videos, c: offset_seconds: expected a finite number, or null",
        ),
        (
            ("videos", 2, "offset_seconds"),
            10**400,
            r"videos\[2\]\.offset_seconds \(of 'c'\): expected a number below 1e308",
        ),
        (("videos", 2, "offset_seconds"), "1", r"videos, c: offset_seconds: expected a number or null; found '1'"),
        (("videos", 1, "name"), "a", r"videos: expected at least one, with unique names"),
        (("videos", 2, "name"), 7, r"videos: expected at least one, with unique names"),
        (("videos", 1, "reference"), "d", r"videos, b: reference: expected one of a, b, c; found 'd'"),
        (("videos", 1, "reference"), "c", None),
        (
            ("videos", 2, "reference"),
            "b",
            r"videos, c: reference: expected a video that is its own reference; found 'b'",
        ),
        (("videos", 0, "reference"), "c", r"videos, b: reference: expected a video that is its own reference"),
        (("reference",), "d", r"reference: expected one of a, b, c; found 'd'"),
        (("reference",), "b", r"videos, b: reference: expected a video that is its own reference; found 'a'"),
        (("videos", 1, "status"), "splendid", r"videos, b: status: expected one of ok.*; found 'splendid'\. "),
        (("videos", 1, "flags"), "ok", r"videos, b: flags: expected a list of codes; found 'ok'\. "),
        (("videos", 1, "flags"), ["ok", "odd"], r"videos, b: flags: expected one of ok.*; found 'odd'\. "),
        (("pairs", 0, "status"), None, r"pairs, a-b: status: expected one of ok.*; found None\. "),
        (("pairs", 0, "flags"), {"ok": 1}, r"pairs, a-b: flags: expected a list of codes"),
        (("videos", 1, "rate"), None, r"videos, b: rate: expected a number, since it has an offset; found null\. "),
        (("videos", 2, "rate"), None, None),
        (("videos", 2, "fps"), None, None),
        (
            ("videos", 0, "offset_seconds"),
            0.25,
            r"videos, a: offset_seconds: expected 0 of a video that is its own reference; found 0.25",
        ),
        (("videos", 0, "offset_seconds"), None, r"videos, a: offset_seconds: expected 0 of .*; found null"),
        (("videos", 2, "offset_seconds"), 0.25, r"videos, c: offset_seconds: expected 0 or null of .*; found 0.25"),
        (("videos", 2, "offset_seconds"), 0, None),
        (("videos", 0, "rate"), 1.001, r"videos, a: rate: expected 1, since .*; found 1.001"),
        (("pairs", 0, "b"), "a", r"pairs, a-a: expected two videos, each pair once"),
        (("pairs", 0, "b"), "d", r"pairs: b: expected one of a, b, c; found 'd'"),
        (("pairs", 0, "fps"), -1, r"pairs, a-b: fps: expected .* above 0"),
        (("pairs", 0, "rate"), -1, r"pairs, a-b: rate: expected .* above 0"),
        (("pairs", 0, "sigma_seconds"), -1, r"pairs, a-b: sigma_seconds: expected .* of 0 or more"),
        (("pairs", 0, "hypotheses"), [[1, 2, 3, 4]], r"pairs, a-b: hypotheses: expected a list of pairs"),
        (("pairs", 0, "stats"), {"matches": "many"}, r"pairs, a-b: stats, matches: expected a number"),
        (("stats",), {"seconds": [1]}, r"stats, seconds: expected a number"),
        (("pairs",), [offsets().to_dict()["pairs"][0]] * 2, r"pairs, a-b: expected two videos, each pair once"),
        (("videos", 1, "fps"), None, r"videos, b: fps: expected a number, since it has an offset; found null\. "),
    ],
)
def test_offsets_that_make_no_sense_are_refused_with_the_field(tmp_path, where, value, says):
    (tmp_path / "o.json").write_text(json.dumps(changed(where, value)))
    if says is None:
        Offsets.load(tmp_path / "o.json")
        return
    with pytest.raises(ValueError, match=rf"o\.json: (not a sound offsets file; )?.*{says}.*Write it anew"):
        Offsets.load(tmp_path / "o.json")


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=5),
        lambda c: st.lists(c, max_size=3) | st.dictionaries(st.text(max_size=8), c, max_size=3),
        max_leaves=8,
    ),
    st.sampled_from(["videos", "pairs", "reference", "stats"]),
)
@settings(max_examples=60, deadline=None)
def test_any_damaged_offsets_file_is_a_value_error_that_names_it(tmp_path_factory, value, key):
    path = tmp_path_factory.mktemp("o") / "damaged.json"
    path.write_text(json.dumps(offsets().to_dict() | {key: value}))
    try:
        Offsets.load(path)
    except ValueError as error:
        assert "damaged.json" in str(error)


@given(st.integers(0, 100_000), st.integers(0, 255))
@settings(max_examples=150, deadline=None)
def test_any_damaged_npz_is_a_value_error_that_names_it(tmp_path_factory, position, byte):
    path = tmp_path_factory.mktemp("n") / "damaged.npz"
    full_set().save(path)
    raw = bytearray(path.read_bytes())
    raw[position % len(raw)] ^= byte
    path.write_bytes(raw[: len(raw) - (position % 3) * 100])
    try:
        TrackSet.load(path)
    except ValueError as error:
        assert "damaged.npz" in str(error)


def test_foreign_npz_is_refused(tmp_path):
    np.savez(tmp_path / "x.npz", xyz=np.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match=r"x\.npz: expected a track set"):
        TrackSet.load(tmp_path / "x.npz")


def test_pickles_are_never_read(tmp_path):
    np.savez(tmp_path / "x.npz", format=np.array({"a": 1}, dtype=object))
    with pytest.raises(ValueError, match="pickled objects, which are never read"):
        TrackSet.load(tmp_path / "x.npz")


def test_sizes_are_checked_before_memory_is_taken(tmp_path):
    """A header that claims 10^13 numbers, and an honest file larger than allowed."""
    import io

    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**13,)})
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w") as archive:
        archive.writestr("xyz.npy", header.getvalue() + b"\0" * 80)
    with pytest.raises(ValueError, match=r"bomb\.npz.*declares 80000000000000 bytes but holds 80"):
        read_npz(tmp_path / "bomb.npz")
    full_set().save(tmp_path / "big.npz")
    with pytest.raises(ValueError, match="more than the 100 allowed"):
        TrackSet.load(tmp_path / "big.npz", max_bytes=100)


def test_missing_file_says_what_lies_beside(tmp_path):
    full_set().save(tmp_path / "video_a.npz")
    with pytest.raises(FileNotFoundError, match=r"video_b\.npz: no such file; beside it lie video_a\.npz"):
        TrackSet.load(tmp_path / "video_b.npz")


def test_an_interrupted_write_leaves_the_old_file_and_no_other(tmp_path):
    (tmp_path / "a.json").write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_write(tmp_path / "a.json", "w") as stream:
        stream.write("half")
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"] and (tmp_path / "a.json").read_text() == "old"


good = {"xyz": np.zeros((2, 3, 3)), "fps": 30.0}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"xyz": None}, "TrackSet.xyz: expected positions"),
        (
            {"xyz": np.zeros((2, 3))},
            r"TrackSet.xyz: expected real numbers of shape \(2,3,3\); found float64 of shape \(2, 3\)",
        ),
        ({"xyz": np.zeros((2, 3, 2))}, "TrackSet.xyz"),
        ({"visible": np.ones((2, 4), bool)}, "TrackSet.visible"),
        ({"features": np.ones((3, 4))}, "TrackSet.features"),
        ({"features": np.array([["a", "b"], ["c", "d"]])}, "TrackSet.features"),
        ({"uv": np.zeros((2, 3, 3))}, "TrackSet.uv"),
        ({"sigma": np.zeros((2, 2))}, "TrackSet.sigma"),
        ({"labels": np.zeros(3, int)}, "TrackSet.labels"),
        ({"fps": 0.0}, "TrackSet.fps: expected a positive number"),
        ({"fps": -30.0}, "TrackSet.fps"),
        ({"fps": np.nan}, "TrackSet.fps"),
        ({"fps": None}, "TrackSet.fps: expected frames per second, or timestamps"),
        ({"timestamps": np.array([0.0, 0.1])}, "TrackSet.timestamps: expected 3 finite seconds"),
        (
            {"timestamps": np.array([0.0, 33.3, 66.7])},
            "expected seconds about 1/fps = 0.03333 apart; found a median step of 33",
        ),
        ({"timestamps": np.array([0.0, 0.033, 86400.0])}, "expected"),
        ({"timestamps": np.array([0.0, 0.1, 0.1])}, "frames 1 and 2 are at 0.1 and 0.1"),
    ],
)
def test_trackset_refuses(change, message):
    with pytest.raises(ValueError, match=message):
        TrackSet(**(good | change))


def test_check_names_argument_track_and_frame():
    xyz = np.zeros((3, 4, 3))
    xyz[1, 2, 0] = np.nan
    with pytest.raises(ValueError, match=r"tracks\[4\]\.xyz.*1 are not, the first in track 1, frame 2"):
        TrackSet(xyz, fps=30).check("tracks[4]")
    hidden = np.ones((3, 4), bool)
    hidden[1, 2] = False
    TrackSet(xyz, hidden, fps=30).check("a")
    features = np.ones((3, 2))
    features[[0, 2]] = 0
    with pytest.raises(ValueError, match=r"b\.features: expected non-zero.*tracks 0, 2"):
        TrackSet(np.zeros((3, 4, 3)), features=features, fps=30).check("b", features=True)
    with pytest.raises(ValueError, match="a: expected at least one track"):
        TrackSet(np.zeros((0, 4, 3)), fps=30).check("a")
    with pytest.raises(ValueError, match=r"a\.xyz: expected 3D positions; found pixels only"):
        TrackSet(None, uv=np.zeros((2, 3, 2)), fps=30).check("a")


@pytest.mark.parametrize("dtype", [np.int32, np.float16, np.float32, np.float64, np.uint8])
def test_any_real_dtype_layout_and_flag_is_taken(dtype):
    xyz = np.asfortranarray(np.arange(2 * 3 * 3).reshape(2, 3, 3).astype(dtype))
    xyz.flags.writeable = False
    t = TrackSet(xyz, fps=30)
    assert t.xyz.dtype in (np.float32, np.float64)
    np.testing.assert_array_equal(t.xyz, xyz)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": np.eye(4)}, "Camera.K"),
        ({"K": -np.eye(3)}, "positive focal"),
        ({"w2c": np.eye(3)}, "Camera.w2c"),
        ({"w2c": 2 * np.eye(4)}, "not orthonormal"),
        ({"w2c": np.diag([1.0, 1, -1, 1])}, r"det\(R\) = \+1; found -1.*otsync check tries"),
        ({"width": 0}, "Camera.width"),
        ({"distortion": np.zeros(3)}, "Camera.distortion"),
        ({"readout": -1.0}, "Camera.readout"),
    ],
)
def test_camera_refuses(change, message):
    with pytest.raises(ValueError, match=message):
        Camera(**({"K": np.eye(3), "w2c": np.eye(4), "width": 4, "height": 4} | change))


def test_camera_projects_a_point_on_its_axis_to_the_principal_point():
    rng = np.random.default_rng(0)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    R *= np.sign(np.linalg.det(R))
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = R, rng.normal(size=3)
    camera = Camera(np.array([[500.0, 0, 321], [0, 510, 242], [0, 0, 1]]), w2c, 640, 480)
    on_axis = camera.center + 2.5 * R[2]
    np.testing.assert_allclose(camera.project(on_axis[None, None]), [[[321, 242]]], atol=1e-9)
    assert np.isnan(camera.project((camera.center - R[2])[None, None])).all()


def test_video_keeps_time_and_checks_counts():
    camera = Camera(np.eye(3), np.eye(4), 4, 4)
    video = Video([0, 1, 2], camera, timestamps=np.array([0.0, 0.1, 0.4]))
    np.testing.assert_array_equal(video.times, [0, 0.1, 0.4])
    with pytest.raises(ValueError, match=r"Video\.depth: expected 3 maps; found 1"):
        Video([0, 1, 2], camera, fps=30, depth=[0])


@pytest.mark.parametrize(
    ("pairs", "score", "message"),
    [
        ([[0, 1, 2]], None, "Matches.pairs"),
        ([[0.5, 1]], None, "Matches.pairs"),
        ([[-1, 1]], None, "Matches.pairs"),
        ([[0, 1]], [1, 2], "Matches.score"),
        ([[0, 1]], [np.nan], "Matches.score.*nan"),
    ],
)
def test_matches_refuse(pairs, score, message):
    with pytest.raises(ValueError, match=message):
        Matches(np.array(pairs), score)


def test_matches_alone_are_valid_and_may_repeat_a_track():
    m = Matches(np.array([[0, 1], [0, 2], [3, 1]]), np.array([1.0, 3.0, 2.0]))
    assert m.best(2).pairs.tolist() == [[0, 2], [3, 1]] and m.status.ok
    assert m.swapped().pairs.tolist() == [[1, 0], [2, 0], [1, 3]]
    with pytest.raises(ValueError, match=r"matches\.pairs: expected indices of b below 2; found 2.*swapped"):
        m.check("matches", 4, 2)
    assert len(Matches([])) == 0


def test_status_is_a_code_and_a_remedy():
    assert Status.OK.ok and not Status.WEAK.ok
    assert Status.from_code("short_overlap") is Status.SHORT_OVERLAP and Status.WEAK.code == "weak"
    assert all(len(str(s)) > 10 for s in Status)
    assert gravest([]) is Status.OK and gravest([Status.WEAK, Status.SPREAD]) is Status.WEAK
    assert in_order([Status.SPREAD, Status.OK, Status.WEAK, Status.SPREAD]) == (Status.WEAK, Status.SPREAD)
    with pytest.raises(ValueError, match="expected one of ok"):
        Status.from_code("nonsense")


def test_coarse_is_what_three_sigmas_leave_open_by_a_frame_of_the_slower_video():
    known = Offsets.known(["a", "b", "c", "d", "e"], np.zeros(5), 30.0)
    found = dataclasses.replace(
        known,
        fps=np.array([30.0, 30.0, 30.0, 120.0, 15.0]),
        sigma=np.array([0.0, 0.3, 0.4, 0.3, 0.6]) / 30,
        flags=((), (Status.COARSE,), (Status.WEAK,), (), (Status.COARSE,)),
    ).judged_by_sigma()
    assert found.flags == ((), (), (Status.WEAK, Status.COARSE), (), ())
    lost = dataclasses.replace(known, sigma=np.full(5, np.nan)).judged_by_sigma()
    assert lost.ok, "what has no answer has a flag of its own"


def test_sigma_at_both_ends_is_that_of_the_pairs_and_tells_where_it_is_uneven(tmp_path):
    stats = {"sigma_begin": 0.01, "sigma_end": 0.04}
    known = Offsets.known(("a", "b", "c"), np.array([0.0, 1.0, 2.0]), 30.0)
    pairs = {(0, 1): Alignment(1.0, sigma=0.04, stats=stats), (0, 2): Alignment(2.0, sigma=0.05)}
    offsets = dataclasses.replace(known, sigma=np.array([0.0, 0.02, 0.05]), alignments=pairs)
    np.testing.assert_allclose(offsets.sigma_ends, [[0, 0], [0.005, 0.02], [0.05, 0.05]])
    assert (offsets.sigma_ends.max(1) == offsets.sigma).all()
    offsets.save(tmp_path / "offsets.json")
    again = Offsets.load(tmp_path / "offsets.json")
    np.testing.assert_allclose(again.sigma_ends, offsets.sigma_ends)
    (note,) = again.clock_notes()
    assert note.startswith("b: one sigma is 0.150 frames at the beginning") and "0.600 at the end" in note
