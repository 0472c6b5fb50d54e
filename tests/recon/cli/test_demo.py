"""The demo: what its phones film, and that the whole job is done on it."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pytest

from otsync.cli import main
from otsync.io import open_scene
from otsync.io.mend import cut
from otsync.types import Offsets
from recon.simulate.phones import PHONES, PhoneFilms, film_phones, ticks


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> tuple[Path, PhoneFilms]:
    folder = tmp_path_factory.mktemp("phones")
    return folder, film_phones(folder, 3, seconds=0.5, size=(96, 54))


def test_no_two_phones_agree_on_a_clock(filmed):
    folder, films = filmed
    scene = open_scene(folder)
    rates = [1 / np.median(np.diff(v.times)) for v in scene.videos]
    np.testing.assert_allclose([rates[n] for n in (0, 1, 3, 4)], [PHONES[n].fps for n in (0, 1, 3, 4)], rtol=1e-3)
    assert np.std(np.diff(scene.videos[2].times)) > 1e-3  # variable
    assert scene.videos[3].times[0] == pytest.approx(0.5, abs=1e-4)
    assert cut(scene, 0, 3).names == ("phone0", "phone1", "phone2", "phone3", "phone4")
    truth = Offsets.load(folder / "truth.json")
    np.testing.assert_allclose(truth.seconds, films.offsets.seconds)
    first = truth.seconds + [v.times[0] for v in scene.videos]
    assert 0 < np.abs(first[1:]).max() <= 0.4 and first[0] == 0


def test_a_frame_shows_the_room_at_its_second_on_the_common_clock(filmed):
    folder, films = filmed
    for v, video in enumerate(open_scene(folder).videos):
        own = video.times[[2, -1]]
        true, _ = films.seen(video.camera, own + films.offsets.seconds[v])
        late, _ = films.seen(video.camera, own + films.offsets.seconds[v] + 0.1)
        for k, right, wrong in zip((2, len(video.times) - 1), true, late, strict=True):
            frame = np.asarray(video.frames[k]).astype(float)
            assert np.abs(frame - right).mean() < 0.8 * np.abs(frame - wrong).mean(), (v, k)


def test_phones_hear_the_ticks_when_their_sound_arrives(filmed):
    folder, films = filmed
    start = float(films.offsets.seconds[0])
    camera = films.cameras[0]
    arrivals = [t - start + np.linalg.norm(p - camera.center) / 343 for t, p in ticks(films.room, -1.0, 2.0, 3)]
    with av.open(str(folder / "phone0.mp4")) as container:
        pieces = [(f.time, np.abs(f.to_ndarray()).max(0)) for f in container.decode(audio=0)]
    sound, first = np.concatenate([p for _, p in pieces]), pieces[0][0]
    loud = first + np.flatnonzero(sound > 0.5 * sound.max()) / 48_000
    assert len(loud) and all(min(abs(t - a) for a in arrivals) < 0.005 for t in loud)


def test_films_are_the_same_every_time(filmed, tmp_path):
    folder, _ = filmed
    film_phones(tmp_path, 3, seconds=0.5, size=(96, 54))
    for name in ("phone1.mp4", "scene.json", "truth.json"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


def test_mistakes_are_named(tmp_path):
    with pytest.raises(ValueError, match="two phones and more, above 0, and 0 or more; found 1, 2 and 0"):
        film_phones(tmp_path, phones=PHONES[:1], seconds=2, late=0)


@pytest.mark.slow
def test_the_whole_job_is_done_and_judged(tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "demo"), "--steps", "300"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["clocks", "scene", "look"]
    figures = json.loads((tmp_path / "demo" / "demo.json").read_text())
    assert figures["trusted"] == figures["judged"] == 4
    assert figures["error_frames"]["max"] < 0.15 and figures["psnr"] > 17
    for name in ("scene.html", "report.html", "sync.html"):
        assert (tmp_path / "demo" / "result" / name).is_file()
