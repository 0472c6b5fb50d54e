"""The viewer: reached from this machine alone, moved by its sliders, ended by closing it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from otsync import Matches, Offsets, TrackSet
from otsync.cli import main
from recon.result.folder import save_run
from recon.view.shown import OfScene, OfTracks, splats_of
from tests.browser import Opened, chromium
from tests.recon.result.filmed import reconstruction

ROOT = Path(__file__).parents[3]
PATIENCE = 120.0
"""Seconds. Generous: no verdict depends on how fast the machine is."""


def scene() -> OfScene:
    result = reconstruction()
    return OfScene(result.scene, {v.name: v.camera for v in result.videos})


def listening(port: int) -> set[str]:
    """Addresses (hexadecimal, as the system writes them) that listen on a port."""
    rows = [
        line.split()
        for name in ("tcp", "tcp6")
        if (table := Path("/proc/net", name)).exists()
        for line in table.read_text().splitlines()[1:]
    ]
    return {row[1].partition(":")[0] for row in rows if row[3] == "0A" and int(row[1].partition(":")[2], 16) == port}


# what is shown


def test_a_moved_clock_shows_its_video_where_the_scene_was_then():
    shown = scene()
    rest = shown.at(0.4, np.zeros(3))
    assert rest.splats is not None and not rest.dots
    moved = shown.at(0.4, np.array([0, 0.1, 0]))
    np.testing.assert_allclose(moved.dots[1], shown.scene.moving(0.3).means.double().numpy())
    np.testing.assert_array_equal(moved.splats.centers, rest.splats.centers)
    assert list(moved.dots) == [1]


def test_splats_are_those_of_the_scene():
    gaussians = reconstruction().scene.moving(0.2)
    splats = splats_of(gaussians)
    wide = np.linalg.eigvalsh(splats.covariances)
    np.testing.assert_allclose(np.sqrt(wide), np.sort(gaussians.scales.double().numpy(), 1), rtol=1e-3)
    assert splats.rgbs.min() >= 0 and splats.rgbs.max() <= 1 and splats.opacities.shape == (len(gaussians), 1)


def pair(late: float) -> tuple[list[TrackSet], Offsets]:
    """Two videos of points that run along x at 1 unit a second; the second began ``late`` seconds later."""
    times = np.arange(30) / 30
    start = np.random.default_rng(0).normal(size=(5, 1, 3))
    sets = [
        TrackSet(start + (times + shift)[None, :, None] * [1.0, 0, 0], fps=30.0, name=name, frame="world")
        for name, shift in (("a", 0.0), ("b", late))
    ]
    offsets = Offsets.known(("a", "b"), np.array([0.0, late]), 30.0)
    return sets, replace(offsets, matches={(0, 1): Matches(np.stack([np.arange(5)] * 2, 1), np.ones(5))})


def test_matches_shrink_to_nothing_on_the_right_clock():
    shown = OfTracks(*pair(0.21))
    right, wrong = (shown.at(0.5, np.array([0, by])) for by in (0.0, 0.1))
    assert right.lines.shape == (5, 2, 3)
    np.testing.assert_allclose(right.lines[:, 0], right.lines[:, 1], atol=1e-9)
    np.testing.assert_allclose(wrong.lines[:, 1] - wrong.lines[:, 0], np.tile([-0.1, 0, 0], (5, 1)), atol=1e-9)
    assert not len(shown.at(1.1, np.zeros(2)).lines)  # the first has ended


def test_tracks_in_pixels_cannot_be_shown_in_space():
    sets, offsets = pair(0.1)
    flat = [replace(t, xyz=None, uv=np.zeros((5, 30, 2))) for t in sets]
    with pytest.raises(ValueError, match="expected two videos with tracks in space on one clock; found 0"):
        OfTracks(flat, offsets)


# the window


@pytest.fixture(scope="module")
def window() -> Iterator[Any]:
    pytest.importorskip("viser", reason="no viser: pip install 'otsync[view]'")
    from recon.view.window import Window

    shown = Window(scene(), 18431)
    yield shown
    shown.stop()


def test_the_server_listens_on_loopback_only_and_cannot_be_shared(window):
    port = int(window.address.rpartition(":")[2])
    assert listening(port) == {"0100007F"}
    assert window._server.request_share_url() is None


def test_a_moved_slider_changes_the_picture(window):
    """By keyboard, in a browser: the time, then a clock."""
    with chromium() as running:
        shown = Opened(running, (1000, 700))
        shown.page.goto(window.address)
        sliders = shown.page.get_by_role("slider")
        sliders.first.wait_for()

        def settled() -> np.ndarray:
            """The picture, left of the sliders, once two in a row are alike."""
            last = shown.picture()[:, :600]
            until = time.monotonic() + PATIENCE
            while time.monotonic() < until:
                time.sleep(0.7)
                now = shown.picture()[:, :600]
                if np.array_equal(now, last):
                    return now
                last = now
            raise AssertionError("the picture never rests")

        def changed(before: np.ndarray) -> np.ndarray:
            until = time.monotonic() + PATIENCE
            while time.monotonic() < until:
                now = settled()
                if (np.abs(now - before).max(-1) > 20).sum() > 50:
                    return now
            raise AssertionError("the picture is as it was")

        first = settled()
        assert first.std() > 5
        sliders.nth(0).press("Home")
        moved = changed(first)
        assert window.time.value == pytest.approx(window.shown.span[0])
        sliders.nth(2).press("End")
        changed(moved)
        assert window.moved()[1] > 0 and window.moved()[0] == window.moved()[2] == 0
        shown.close()


def test_closing_ends_the_wait():
    pytest.importorskip("viser", reason="no viser: pip install 'otsync[view]'")
    from recon.view.window import Window

    window = Window(scene(), 18531)
    port = int(window.address.rpartition(":")[2])
    waiting = threading.Thread(target=window.wait)
    waiting.start()
    window.close()
    waiting.join(PATIENCE)
    assert not waiting.is_alive() and not listening(port)


def test_ctrl_c_ends_the_command(tmp_path):
    pytest.importorskip("viser", reason="no viser: pip install 'otsync[view]'")
    result = reconstruction()
    result.scene.save(tmp_path / "scene.npz")
    result.offsets.save(tmp_path / "offsets.json")
    options = {"width": 160, "frames": None, "seed": 0, "freeze": [], "layered": True, "optics": []}
    save_run(tmp_path, result.videos, options=options, frame="world", notes=(), seconds={})
    code = "import sys; from otsync.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "view", str(tmp_path), "--port", "18631"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env={**os.environ}) as running:
        assert "http://127.0.0.1:" in running.stdout.readline()
        running.send_signal(signal.SIGINT)
        assert running.wait(PATIENCE) == 0


def test_mistakes_are_named(tmp_path, capsys, monkeypatch):
    assert main(["view", str(tmp_path), "--port", "0"]) == 2
    assert "--port: expected 1 to 65535; found 0" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", str(tmp_path)]) == 2
    assert "pip install 'otsync[view]'" in capsys.readouterr().err
