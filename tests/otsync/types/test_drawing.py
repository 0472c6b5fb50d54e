"""Nouns in a notebook: a line, a table that a name cannot break out of, and pictures that show the numbers."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

from otsync import Alignment, Camera, Matches, Offsets, Status, TrackSet, Video

mpl.use("Agg")

ROOT = Path(__file__).parents[3]

EVIL = "<script>alert('$x^2$')</script>" + "\nend" * 40
POSE = np.eye(4)
CAMERA = Camera(np.diag([1100.0, 1100, 1]), POSE, 1920, 1080)
PAIR = Alignment(
    0.41,
    sigma=0.002,
    hypotheses=np.array([[0.41, 9.0], [-1.2, 3.0]]),
    curve=np.array([[-1.2, 3.0], [0.0, 1.0], [0.41, 9.0], [0.5, -np.inf]]),
    fps=30.0,
)


def offsets(*names: str, fps: float = 30.0) -> Offsets:
    n = len(names)
    known = Offsets.known(names, 0.5 * np.arange(n), fps)
    return replace(known, sigma=np.full(n, 0.01), flags=((),) * (n - 1) + ((Status.WEAK, Status.ALIAS),))


def nouns(name: str) -> list:
    frames = [np.zeros((1080, 1920, 3), np.uint8)] * 3
    moving = replace(CAMERA, w2c=np.stack([POSE] * 3), distortion=np.zeros(5), readout=0.012)
    return [
        CAMERA,
        moving,
        Video(frames, moving, 29.97, name=name, depth=frames),
        Video(frames[:1], CAMERA, None, np.zeros(1), name=name),
        TrackSet(np.zeros((2, 3, 3)), features=np.ones((2, 4)), fps=30.0, name=name),
        Matches([[0, 1], [2, 3]], [0.25, 0.5], np.zeros((4, 5))),
        Matches([], flags=(Status.NO_MATCH,)),
        PAIR,
        replace(PAIR, offset=float("nan"), flags=(Status.NO_OVERLAP,)),
        replace(PAIR, fps=float("nan"), rate=1.001),
        offsets(name, "b", "c", "d", "e"),
        offsets(name),
    ]


@pytest.mark.parametrize("name", ["left", "", EVIL], ids=["plain", "none", "strange"])
def test_every_noun_fits_a_line(name):
    for noun in nouns(name):
        text = repr(noun)
        assert text.startswith(type(noun).__name__ + "(") and text.endswith(")")
        assert "\n" not in text and len(text) <= 120, text


def test_lines_say_what_matters():
    assert repr(PAIR) == "Alignment(12.30 ± 0.06 frames = 0.4100 ± 0.0020 s; ok)"
    weak = replace(PAIR, sigma=float("nan"), rate=1.001, flags=(Status.ALIAS, Status.WEAK))
    assert repr(weak) == "Alignment(12.30 frames = 0.4100 s, rate 1.001000; weak, alias)"
    assert repr(replace(PAIR, offset=float("nan"), flags=(Status.STATIC,))) == "Alignment(no offset; static)"
    assert repr(offsets("a", "b")) == "Offsets(frames: 'a' +0.00, 'b' +15.00; 0 of 1 to be trusted)"
    assert "2 more; 3 of 4 to be trusted" in repr(offsets(*"abcde"))
    assert repr(Matches([[0, 1], [2, 3]], [0.25, 0.5])) == "Matches(2 pairs, scores 0.25 to 0.5; ok)"
    assert repr(CAMERA) == "Camera(1920 x 1080, focal 1100 px, static)"


def test_tables_are_escaped_and_hold_the_numbers():
    for noun in nouns(EVIL)[5:]:
        html = noun._repr_html_()
        assert html.startswith("<table>") and html.endswith("</table>") and "<script>" not in html
    html = offsets("a&b", EVIL)._repr_html_()
    assert "<td>a&amp;b</td>" in html and "&lt;script&gt;" in html and "<td>15.00</td>" in html
    assert "<td>weak, alias</td>" in html
    assert "<td>12.30</td><td>0.4100</td><td>9</td>" in PAIR._repr_html_()
    best = Matches([[0, 1], [2, 3]], [0.25, 0.5])._repr_html_()
    assert best.index("<td>2</td><td>3</td><td>0.5</td>") < best.index("<td>0</td><td>1</td>")
    missing = replace(offsets("a", "b"), seconds=np.array([0, np.nan]), sigma=np.array([0, np.nan]))
    assert "<td>b</td><td>–</td><td>–</td><td>–</td>" in missing._repr_html_()


def test_the_score_is_drawn_in_frames_with_its_peaks():
    ax = PAIR.plot(truth=0.4)
    curve, peaks, chosen, true = ax.lines
    np.testing.assert_allclose(curve.get_xydata(), [[-36, 3], [0, 1], [12.3, 9]])
    np.testing.assert_allclose(peaks.get_xdata(), [12.3, -36])
    assert chosen.get_xdata()[0] == pytest.approx(12.3) and true.get_xdata()[0] == pytest.approx(12.0)
    other = PAIR.plot(ax=ax)
    assert other is ax and len(ax.lines) == 7
    assert len(replace(PAIR, curve=None).plot().lines) == 2  # as it comes from a file
    with pytest.raises(ValueError, match="neither curve nor peaks"):
        Alignment(0.4, fps=30).plot()


def test_bars_stand_on_the_common_clock():
    tracks = [TrackSet(np.zeros((1, n, 3)), fps=10.0) for n in (10, 20)]
    ax = offsets("a", "$b$").plot(tracks)
    ax.figure.canvas.draw()
    assert [(bar.get_x(), bar.get_width()) for bar in ax.patches] == [(0.0, 1.0), (0.5, 2.0)]
    assert [label.get_text() for label in ax.get_yticklabels()] == ["a", "$b$"]
    assert not any(label.get_parse_math() for label in ax.get_yticklabels())
    assert [bar.get_width() for bar in offsets("a", "b").plot(ax=ax).patches[2:]] == [1.0, 1.0]
    with pytest.raises(ValueError, match="videos: expected 2, one per name; found 1"):
        offsets("a", "b").plot(tracks[:1])
    alone = replace(offsets("a", "b"), component=np.array([0, 1]))
    assert [text.get_text() for text in alone.plot().texts] == ["b: on a clock of its own group"]


def moving(name: str, late: float = 0.0, camera: Camera | None = None) -> TrackSet:
    """Points that run along x at a unit a second."""
    times = np.arange(20) / 10
    xyz = np.arange(4.0)[:, None, None] + (times + late)[None, :, None] * [1.0, 0, 0]
    return TrackSet(xyz, uv=xyz[..., :2], fps=10.0, name=name, camera=camera)


def test_matches_are_drawn_where_they_are_seen():
    a, b = moving("$a$"), moving("b", 0.3)
    matches = Matches([[0, 0], [1, 1], [3, 2]], [3, 2, 1])
    ax = matches.plot(a, b, offset=0.3)
    (lines,) = (c for c in ax.collections if hasattr(c, "_segments3d"))
    np.testing.assert_allclose(
        [end[1] - end[0] for end in lines._segments3d], [[0, 0, 0], [0, 0, 0], [-1, -1, -1]], atol=1e-9
    )
    assert not any(text.get_parse_math() for text in ax.get_legend().get_texts())
    flat = matches.plot(replace(a, xyz=None), replace(b, xyz=None), offset=0.3, most=2)
    assert len(flat.lines) == 2 + 2 and flat.yaxis_inverted()
    with pytest.raises(ValueError, match="found none at 9 s"):
        matches.plot(a, b, offset=9.0)
    with pytest.raises(ValueError, match="found one of each"):
        matches.plot(replace(a, uv=None), replace(b, xyz=None), offset=0.3)
    with pytest.raises(ValueError, match="Are a and b swapped"):
        Matches([[9, 0]]).plot(a, b)


def test_paths_end_where_they_are_last_seen():
    tracks = moving("a")
    seen = np.ones((4, 20), bool)
    seen[1, 5:] = seen[2] = False
    ax = replace(tracks, visible=seen).plot()
    assert len(ax.lines) == 4
    x = np.array(ax.collections[0]._offsets3d[0])
    np.testing.assert_allclose(sorted(x[np.isfinite(x)]), sorted([1.9, 1.4, 4.9]))
    assert len(replace(tracks, xyz=None).plot(most=2).lines) == 2


def test_words_and_tables_load_no_drawing():
    code = (
        "import sys, numpy as np; from otsync import Offsets; o = Offsets.known(('a',), np.zeros(1), 30.0);"
        "repr(o), o._repr_html_(); print('matplotlib' in sys.modules)"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT).stdout.strip() == "False"
    )
