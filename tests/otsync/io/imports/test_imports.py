"""Offsets from elsewhere: each kind with its sign, set against the pictures, refused where it is unsound."""

from __future__ import annotations

import json
import re
from fractions import Fraction

import av
import numpy as np
import pytest

from otsync import Offsets, Status
from otsync.cli import main
from otsync.io.document import document
from otsync.io.imports import IMPORTERS, Filmed, Known
from otsync.io.imports.timecode import seconds_of
from otsync.sync.prior import from_told, with_told
from otsync.types import Alignment

FILMED = Filmed(("left", "middle", "right"), (30.0, 25.0, 30.0), (None, None, None))


def edges(tmp_path, name: str, text: str, kind: str | None = None) -> list[Known]:
    path = tmp_path / name
    path.write_text(text)
    importer = next(i for i in IMPORTERS if (i.name == kind if kind else i.claims(path)))
    return importer.edges(path, FILMED)


CLAPS = "event,video,at_seconds\nclap,left,4.0\nclap,middle,3.5\nclap,right,1\nflash,left,9\nflash,right,6.02\n"


def test_a_table_is_taken_with_its_sign_and_unit(tmp_path):
    told = edges(tmp_path, "a.csv", "video,frames,sigma\nleft,0,\nmiddle,5,1\nright,-3,\n")
    assert [(k.a, k.b) for k in told] == [(0, 1), (0, 2)]
    np.testing.assert_allclose([k.seconds for k in told], [0.2, -0.1])
    np.testing.assert_allclose([k.sigma for k in told], [0.04, 0.5 / 30])
    told = edges(tmp_path, "a.csv", "video,reference,milliseconds\nright,middle,40\n")
    assert (told[0].a, told[0].b, told[0].seconds) == (1, 2, pytest.approx(0.04))


def test_who_shows_the_clap_early_began_late(tmp_path):
    told = edges(tmp_path, "claps.csv", CLAPS)
    assert [(k.a, k.b, round(k.seconds, 6)) for k in told] == [(0, 1, 0.5), (0, 2, 3.0), (0, 2, 2.98)]
    assert told[0].sigma == pytest.approx(np.hypot(1 / 30, 1 / 25) / np.sqrt(12))
    by_frame = edges(tmp_path, "frames.csv", "event,video,at_frame\nx,left,30\nx,middle,50\n")
    assert by_frame[0].seconds == pytest.approx(-1.0)


def test_timecodes_count_dropped_frames_and_pass_midnight(tmp_path):
    told = edges(tmp_path, "tc.csv", "video,timecode\nleft,23:59:59:15\nmiddle,00:00:00:05\nright,23:59:58:00\n")
    np.testing.assert_allclose([k.seconds for k in told], [0.7, -1.5])
    rate = 30000 / 1001
    # an hour of dropped-frame timecode is an hour but for 3.6 ms
    assert seconds_of("01:00:00;00", rate, "") == pytest.approx(3600, abs=0.004)
    assert seconds_of("00:01:00;02", rate, "") - seconds_of("00:00:59;29", rate, "") == pytest.approx(1 / rate)


def test_timecodes_of_the_files_themselves(tmp_path):
    for name, code in (("left", "10:00:00:00"), ("right", "10:00:01:15")):
        with av.open(str(tmp_path / f"{name}.mov"), "w", options={"write_tmcd": "1"}) as out:
            stream = out.add_stream("mpeg4", rate=Fraction(30))
            stream.width, stream.height = 48, 32
            stream.metadata["timecode"] = code
            for k in range(3):
                out.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((32, 48, 3), 40 * k, np.uint8))))
            out.mux(stream.encode())
    assert main(["import-offsets", str(tmp_path), str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    offsets = Offsets.load(tmp_path / "out/offsets.json")
    np.testing.assert_allclose(offsets.seconds, [0, 1.5])
    assert offsets.sigma[1] == pytest.approx(np.sqrt(2 / 12) / 30)


def test_polysyncs_sidecars_and_pose2sims_log(tmp_path):
    sidecar = {"schema_version": 1, "source": "right.mp4", "reference": "left.mp4", "delta_seconds": 0.25}
    verified = {"verification": {"residual_spread_ms": 4.0}}
    told = edges(tmp_path, "right.mp4.sync.json", json.dumps(sidecar | verified))
    assert told == [Known(0, 2, 0.25, pytest.approx(0.014), str(tmp_path / "right.mp4.sync.json"))]
    log = "text\n--> Camera left and right: 9 frames offset, correlation 0.9.\n"
    log += "--> Camera left and right: 6 frames offset (4 on the selected section), correlation 0.93.\n"
    log += "--> Camera left and middle: -5 frames offset, correlation 0.2.\n"
    told = edges(tmp_path, "logs.txt", log)
    # frame k of theirs becomes k - offset: 6 frames on, right shows what left shows at 0, so it began before
    assert [(k.a, k.b, k.seconds) for k in told] == [(0, 2, -0.2), (0, 1, 0.2)]
    np.testing.assert_allclose([k.sigma for k in told], [1 / 30, 10 / 25])


@pytest.mark.parametrize(
    "name, kind, text, says",
    [
        ("a.csv", "table", "video,frames\nlefd,0\n", r"line 2: expected one of left, .*Did you mean 'left'"),
        ("a.csv", "table", "video,frames,seconds\n", r"one of seconds, milliseconds, frames"),
        ("a.csv", "table", "video,seconds\nmiddle,x\n", r"line 2: seconds: expected a number; found 'x'"),
        ("a.csv", "table", "video,seconds\nmiddle,1\nmiddle,2\n", r"line 3: .*middle occurs twice"),
        ("a.csv", "table", "video,seconds\nleft,1\n", r"expected 0 of the reference itself; found 1"),
        ("a.csv", "table", "video,seconds,sigma\nmiddle,1,0\n", r"sigma: expected a number above 0"),
        ("a.csv", "events", "event,video,at_seconds\nclap,left,1\n", r"two videos or more; found 1"),
        ("a.csv", "events", "event,video,at_seconds\nclap,left,1\nclap,left,2\n", r"every video once"),
        ("a.csv", "events", "event,video,at_seconds\nclap,left,-1\n", r"0 or more; found -1"),
        ("a.csv", "timecode", "video,timecode\nleft,1:00:00:30\nright,0\n", r"FF below 30; found '1:00:00:30'"),
        ("a.csv", "timecode", "video,timecode\nleft,1:00:00;01\nmiddle,01:00:00;01\n", r"no dropped frames at 25 fps"),
        ("x.sync.json", "polysync", '{"schema_version": 2}', r"schema_version: expected 1"),
        ("x.sync.json", "polysync", '{"schema_version": 1, "source": "left"}', r"reference: expected a value"),
        ("logs.txt", "pose2sim", "nothing\n", r"expected lines '--> Camera"),
    ],
)
def test_what_is_unsound_is_refused_with_the_line(tmp_path, name, kind, text, says):
    with pytest.raises(ValueError, match=says):
        edges(tmp_path, name, text, kind)


def found(seconds, flags=((), (), ()), sigma=0.003) -> Offsets:
    """An answer of pictures, with the pairs behind it."""
    seconds = np.asarray(seconds, float)
    pairs = {
        (a, b): Alignment(float(seconds[b] - seconds[a]), sigma=sigma, fps=30.0, flags=(*flags[a], *flags[b]))
        for a, b in ((0, 1), (0, 2), (1, 2))
    }
    known = Offsets.known(["left", "middle", "right"], seconds, 30)
    return Offsets(**{**vars(known), "alignments": pairs, "flags": flags, "sigma": np.array([0, sigma, sigma])})


def test_what_contradicts_the_pictures_is_said_and_left_out():
    told = [Known(0, 1, 0.41, 0.01, "clap"), Known(0, 2, 0.9, 0.01, "table")]
    answer, contradictions = with_told(found([0, 0.4, 1.0]), told)
    assert [(c.a, c.b, c.source, c.against) for c in contradictions] == [("left", "right", "table", "the pictures")]
    assert answer.flags == ((), (), (Status.INCONSISTENT,))
    assert answer.seconds[2] == pytest.approx(1.0, abs=2e-3)
    assert 0.4 < answer.seconds[1] < 0.402  # weighed by the variances


def test_where_the_pictures_doubt_what_was_told_decides_and_the_flag_stays():
    pictures = found([0, 0.4, 5.0], flags=((), (), (Status.AMBIGUOUS,)))
    answer, contradictions = with_told(pictures, [Known(0, 2, 0.9, 0.01, "clap")])
    assert not contradictions
    assert answer.seconds[2] == pytest.approx(0.9, abs=1e-6)
    assert answer.flags[2] == (Status.AMBIGUOUS,)


def test_a_video_without_an_answer_is_linked_by_what_was_told():
    known = found([0, 0.4, np.nan])
    cut = {pair: a for pair, a in known.alignments.items() if 2 not in pair}
    alone = Offsets(
        **{
            **vars(known),
            "alignments": cut,
            "seconds": np.array([0, 0.4, 0.0]),
            "component": np.array([0, 0, 2]),
            "flags": ((), (), (Status.DISCONNECTED,)),
        }
    )
    answer, _ = with_told(alone, [Known(1, 2, 0.1, 0.01, "clap")])
    assert answer.seconds[2] == pytest.approx(0.5) and list(answer.component) == [0, 0, 0]
    assert answer.flags[2] == () and answer.sigma[2] > 0.01


def test_what_was_told_may_contradict_itself():
    told = [Known(0, 1, 0.1, 0.001, "a"), Known(1, 2, 0.1, 0.001, "b"), Known(0, 2, 0.2, 0.001, "c")]
    answer, contradictions = from_told(["x", "y", "z"], [30.0] * 3, told)
    np.testing.assert_allclose(answer.seconds, [0, 0.1, 0.2])
    assert not contradictions and answer.ok
    _, contradictions = from_told(["x", "y", "z"], [30.0] * 3, [*told, Known(0, 2, 0.9, 0.001, "d")])
    assert "d" in {c.source for c in contradictions} and all(c.against == "the others" for c in contradictions)
    answer, _ = from_told(["x", "y", "z"], [30.0] * 3, told[:1])
    assert answer.flags[2] == (Status.DISCONNECTED,)


def test_the_shell_lists_contradictions_and_exits_with_one(tmp_path, capsys):
    entries = [{"name": n, "frames": f"{n}/*.png", "fps": 30} for n in FILMED.names]
    (tmp_path / "scene.json").write_text(json.dumps(document(entries)))
    (tmp_path / "claps.csv").write_text(CLAPS)
    found([0, 0.5, 2.0]).save(tmp_path / "offsets.json")
    args = ["import-offsets", str(tmp_path / "claps.csv"), str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*args, "--offsets", str(tmp_path / "offsets.json")]) == 1
    said = capsys.readouterr().out
    assert re.search(r"contradiction: left and right: told \+3\.0000 s, the pictures say \+2\.0000 s", said)
    assert Offsets.load(tmp_path / "out/offsets.json").flags[2] == (Status.INCONSISTENT,)
    assert main([*args, "--kind", "table"]) == 2 and main([*args, "--sigma", "0"]) == 2
    assert main([*args, "--sigma", "0.5"]) == 0
    assert Offsets.load(tmp_path / "out/offsets.json").sigma[1] > 0.4
