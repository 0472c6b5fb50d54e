"""The report page: complete, self-contained, honest about doubt, safe with strangers' names."""

from __future__ import annotations

import re
import tracemalloc
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from otsync import DTW, Alignment, ConstantShift, Matches, Offsets, Status, TrackSet, synchronize
from otsync.report import write_report
from otsync.report.page import late_starts
from tests.otsync.align.test_align import films


@pytest.fixture(scope="module")
def answer():
    a, b, matches = films(0, 0.4)
    c = films(0, -0.3)[1]
    tracks = [replace(t, name=n) for t, n in ((a, "left"), (b, "<script>alert(1)</script>"), (c, "right & far $x_{$"))]
    given = {(0, 1): matches, (0, 2): matches}
    return tracks, synchronize(tracks, matches=given, aligner=ConstantShift())


class Outline(HTMLParser):
    """Tags and references of a page; fails on tags that do not nest."""

    def __init__(self):
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [v for k, v in attrs if k in ("src", "href", "xlink:href") and v]


def test_a_file_whose_clock_begins_late_is_told(answer):
    _, offsets = answer
    own = [np.arange(5) / 30 for _ in offsets.names]
    assert late_starts(offsets, own) == ""
    own[0] = own[0] + 0.5
    own[1] = own[1] + 0.25
    told = late_starts(offsets, own)
    assert "left's first frame is at 0.500 s" in told and "0.250 s" in told and "<script" not in told


def test_page_is_self_contained_small_and_deterministic(tmp_path, answer):
    tracks, offsets = answer
    pages = []
    for n in range(2):
        write_report(tmp_path / f"{n}.html", offsets, tracks, truth=[0, 0.4, -0.3], title="A <title>")
        pages.append((tmp_path / f"{n}.html").read_text())
    assert pages[0] == pages[1] and len(pages[0]) < 400_000
    outline = Outline()
    outline.feed(pages[0])
    assert "script" not in outline.tags and outline.tags.count("svg") >= 3
    assert all(link.startswith(("data:", "#")) for link in outline.links)
    assert not re.search(r"url\((?!#)", pages[0]) and "A &lt;title&gt;" in pages[0]
    assert "&lt;script&gt;alert" in pages[0] and "right &amp; far" in pages[0]
    assert "12.0" in pages[0]  # frames of offset


def test_doubt_is_said_with_its_remedy(tmp_path, answer):
    tracks, offsets = answer
    doubtful = replace(
        offsets,
        flags=((), (Status.AMBIGUOUS, Status.SPREAD), (Status.FAILED,)),
        seconds=np.array([0, 0.4, np.nan]),
    )
    write_report(tmp_path / "r.html", doubtful, tracks)
    page = (tmp_path / "r.html").read_text()
    assert "0 of 2 offsets are to be trusted; 1 doubtful, 1 missing" in page  # the reference's own is no answer
    assert "ambiguous, spread" in page and "Look at the hypotheses" in page and "no answer" in page


def test_a_page_from_a_file_alone(tmp_path, answer):
    """Without tracks, matches and curves there are tables and bars."""
    _, offsets = answer
    offsets.save(tmp_path / "o.json")
    write_report(tmp_path / "r.html", Offsets.load(tmp_path / "o.json"))
    assert "On the common clock" in (tmp_path / "r.html").read_text()


def test_many_pairs_stay_small_and_show_residuals(tmp_path):
    a, b, matches = films(3, 0.1)
    tracks = [replace(t, name=f"v{n}") for n, t in enumerate([a, b] * 3)]
    offsets = synchronize(tracks, matches={(0, v): matches for v in range(1, 6)}, aligner=DTW())
    pairs = {(i, j): offsets.alignments[0, 1] for i in range(6) for j in range(i + 1, 6)}
    more = replace(offsets, alignments=pairs, matches=dict.fromkeys(pairs, Matches([[0, 0]])))
    write_report(tmp_path / "r.html", more, tracks)
    page = (tmp_path / "r.html").read_text()
    assert (
        "15 pairs, each measured by itself; median |residual|" in page
        and "10 further pairs" in page
        and len(page) < 400_000
    )


def test_a_long_clip_costs_its_picture_alone(tmp_path):
    """The map of costs of all frames against all would have 3 GB here, and 87 GB of an hour."""
    rng, frames = np.random.default_rng(0), 20_000
    x = np.cumsum(0.01 * rng.standard_normal((6, frames, 3)), 1)
    tracks = [TrackSet(x + 0.01 * rng.standard_normal(x.shape), fps=30.0, name=n, frame="world") for n in "ab"]
    matches = Matches(np.stack([np.arange(6)] * 2, 1), np.ones(6))
    offsets = Offsets.known(("a", "b"), [0.0, 0.0], 30.0)
    pair = Alignment(0.0, sigma=0.01, fps=30.0)
    offsets = replace(offsets, alignments={(0, 1): pair}, matches={(0, 1): matches})
    tracemalloc.start()
    try:
        write_report(tmp_path / "report.html", offsets, tracks)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert "cost of frames against each other" in (tmp_path / "report.html").read_text()
    assert peak < 100e6
