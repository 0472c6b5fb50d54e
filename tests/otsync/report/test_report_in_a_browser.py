"""The report in a real browser: quiet, inert, readable on a phone, in the dark and on paper."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from otsync import Camera, ConstantShift, Status, TrackSet, Video, synchronize
from otsync.recordings.synchronized import Synchronized
from otsync.report.frames import write_recording_report
from tests.browser import Opened, chromium
from tests.otsync.align.test_align import films

HOSTILE = (
    "left",
    "</script><script>document.title='hit'</script>",
    "\"'><img src=x onerror=\"document.title='hit'\">",
    "a_very_long_name_without_a_single_space_in_it_" * 3,
)
SIZES = {"desktop": (1280, 900), "phone": (390, 844), "narrow": (340, 700)}


def video_of(tracks: TrackSet, name: str) -> Video:
    """A square that wanders, as long as the tracks."""
    frames = []
    for k in range(tracks.n_frames):
        image = np.full((90, 160, 3), 70, np.uint8)
        image[30:60, k : k + 30] = 240, 180, 40
        frames.append(image)
    camera = Camera(np.array([[150.0, 0, 80], [0, 150, 45], [0, 0, 1]]), np.eye(4), 160, 90)
    return Video(frames, camera, timestamps=tracks.times, name=name)


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    """Of four videos, one of them doubtful, with strangers' names."""
    a, b, matches = films(0, 0.4)
    sets = [replace(t, name=n) for t, n in zip((a, b, films(0, -0.3)[1], b), HOSTILE, strict=True)]
    uv = np.random.default_rng(0).uniform(10, 80, (len(a), a.n_frames, 2))
    sets = [replace(t, uv=uv[: len(t), : t.n_frames]) for t in sets]
    offsets = synchronize(sets, matches={(0, v): matches for v in range(1, 4)}, aligner=ConstantShift())
    doubt = ((), (), (Status.AMBIGUOUS, Status.SPREAD), ())
    offsets = replace(offsets, flags=doubt, seconds=np.array([0, 0.4, -0.3, np.nan]))
    videos = [video_of(t, t.name) for t in sets]
    answer = Synchronized(
        offsets, tuple(sets), "tracks", ("because of <b>",), None, {"<i>tracks": 3.0, "synchronise": 1.0}
    )
    path = tmp_path_factory.mktemp("report") / "report.html"
    scene: Any = type("Scene", (), {"videos": tuple(videos)})
    write_recording_report(path, scene, answer, truth=[0, 0.4, -0.3, 0])
    return path


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as running:
        yield running


@pytest.mark.parametrize("size", SIZES)
def test_the_page_is_quiet_and_nothing_sticks_out(browser, page, size):
    shown = Opened(browser, SIZES[size]).look(page)
    shown.page.evaluate("document.querySelectorAll('details').forEach((d) => (d.open = true))")
    assert shown.too_wide() == []
    assert shown.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert shown.page.title() == "Synchronisation of a recording"  # no name became a script
    assert shown.page.locator("script").count() == 0
    assert shown.page.locator("img").count() == shown.page.locator("img[src^='data:image/webp']").count() >= 6
    shown.close()
    assert not shown.complaints
    assert shown.requests[0].startswith("file:") and all(u.startswith(("file:", "data:")) for u in shown.requests)


def test_words_can_be_read_by_day_by_night_and_on_paper(browser, page):
    """Contrast of every word with the page: 4.5 and more, as WCAG asks."""
    code = """() => {
        const lum = (c) => {
            const [r, g, b] = c.match(/[\\d.]+/g).map(Number).map((x) => x / 255)
                .map((x) => (x <= 0.03928 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4));
            return 0.2126 * r + 0.7152 * g + 0.0722 * b;
        };
        const ground = lum(getComputedStyle(document.body).backgroundColor);
        const tags = 'h1,h2,p,td,th,span:not(.mosaic span),b,dt,dd,figcaption,text';
        const words = [...document.querySelectorAll(tags)];
        return Math.min(...words.map((e) => {
            const style = getComputedStyle(e);
            const ink = lum(e.tagName === 'text' ? style.fill : style.color);
            return (Math.max(ink, ground) + 0.05) / (Math.min(ink, ground) + 0.05);
        }));
    }"""
    for scheme, media in (("light", "screen"), ("dark", "screen"), ("light", "print")):
        shown = Opened(browser, color_scheme=scheme).look(page)
        shown.page.emulate_media(media=media)
        assert shown.page.evaluate(code) >= 4.5, (scheme, media)
        shown.close()


def test_a_pair_unfolds_by_keyboard(browser, page):
    shown = Opened(browser).look(page)
    first = shown.page.locator("details:has(svg)").first
    assert not first.evaluate("e => e.open")
    first.locator("summary").focus()
    shown.page.keyboard.press("Enter")
    assert first.evaluate("e => e.open") and first.locator("svg").count() >= 1
    shown.close()
