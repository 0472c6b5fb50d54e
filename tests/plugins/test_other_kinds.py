"""Readers, priors, benchmarks, losses, effects and exporters from outside: in the help, at work, on the lists."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from recon.scene.gaussians4d import Gaussians4D
from tests.plugins.outside import KINDS_OF_SCENES, OF_SCENES, Shell, shell_with
from tests.recon.worlds import write_world
from tests.recording_world import write_recording

OF_RECORDINGS = '''
from dataclasses import dataclass

import numpy as np

{readers}
class Renamed:
    """A recording whose scene.json has another name."""

    name = "renamed"

    def claims(self, folder):
        return (folder / "my_scene.json").is_file()

    def describe(self, folder):
        import json

        return json.loads((folder / "my_scene.json").read_text())


{maskers}
@dataclass(frozen=True)
class Bright:
    """What is brighter than usual moves."""

    threshold: float = 20.0

    def __call__(self, frames, camera):
        images = np.stack([frames[k].mean(-1) for k in range(len(frames))])
        return np.abs(images - np.median(images, 0)) > self.threshold


{trackers}
@dataclass(frozen=True)
class FewPoints:
    """Every second track of our own."""

    def __call__(self, frames, masks, fps):
        from otsync.priors import ChainedFlow

        return ChainedFlow()(frames, masks, fps)[::2]


{describers}
@dataclass(frozen=True)
class Nothing:
    """Tracks that look alike, nearly."""

    dimensions: int = 3

    def __call__(self, frames, masks, uv, fps):
        return np.random.default_rng(0).normal(size=(len(uv), self.dimensions)) + 9.0


{benchmarks}
class Mine:
    """Writes how it was called."""

    name = "mine"

    def run(self, out, *, seeds=1):
        out.mkdir(parents=True, exist_ok=True)
        (out / "mine.txt").write_text(f"{{seeds}} seeds")
        return 0

'''

KINDS = {
    "readers": "Renamed",
    "maskers": "Bright",
    "trackers": "FewPoints",
    "describers": "Nothing",
    "benchmarks": "Mine",
}

WAYS = pytest.mark.parametrize("way", ["file", pytest.param("installed", marks=pytest.mark.slow)])
"""Algorithms are tested with an installed package every time (test_plugins.py), other kinds with a file."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    write_recording(folder, [0.0, 3.0], frames=40)
    return folder


@WAYS
def test_readers_priors_and_benchmarks(way, recording, tmp_path):
    home = tmp_path / "plugins"
    home.mkdir()
    with shell_with(way, home, OF_RECORDINGS, KINDS) as shell:
        readers_priors_and_benchmarks(shell, recording, tmp_path)


def readers_priors_and_benchmarks(shell: Shell, recording: Path, tmp_path: Path) -> None:
    words = shell("otsync", "sync", "--help").stdout
    assert "|bright" in words and "|few-points" in words and "|nothing" in words
    assert "renamed" in shell("otsync", "init", "--help").stdout
    assert ",mine," in shell("otsync", "bench", "--help").stdout

    folder = tmp_path / "recording"
    shutil.copytree(recording, folder)
    (folder / "scene.json").rename(folder / "my_scene.json")
    done = shell.alone("otsync", "init", str(folder))
    assert done.returncode == 0 and "renamed" in done.stdout + done.stderr, done.stderr

    def offsets(*args: str) -> np.ndarray:
        done = shell("otsync", "sync", str(folder), "--json", "--out", str(tmp_path / "o"), "--quiet", *args)
        assert done.returncode in (0, 1), done.stderr
        return json.loads(done.stdout)["pairs"][0]["stats"]

    own = offsets()
    for option, value in (("masks", "bright:threshold=25"), ("points", "few-points"), ("features", "nothing")):
        assert offsets(f"--recording.{option}", value) != own, option
    assert shell("otsync", "bench", "mine", "--seeds", "4", "--out", str(tmp_path / "b")).returncode == 0
    assert (tmp_path / "b" / "mine.txt").read_text() == "4 seeds"
    listed = {(row["group"], row["name"]) for row in json.loads(shell("otsync", "plugins", "--json").stdout)["plugins"]}
    names = {"readers": "renamed", "maskers": "bright", "trackers": "few-points", "describers": "nothing"}
    assert listed >= set(names.items()) | {("benchmarks", "mine")}


def test_losses_effects_and_exporters_of_a_package(tmp_path):
    """Those of a file: tests/recon/cli/test_recon_cli.py."""
    home = tmp_path / "plugins"
    home.mkdir()
    with shell_with("installed", home, OF_SCENES, KINDS_OF_SCENES) as shell:
        losses_effects_and_exporters(shell, tmp_path)


def losses_effects_and_exporters(shell: Shell, tmp_path: Path) -> None:
    world, out = tmp_path / "world", tmp_path / "r"
    write_world(world)
    words = shell("recon", "fit", "--help").stdout
    assert "colourless" in words and "dimmed" in words
    assert "counted" in shell("recon", "export", "--help").stdout
    words = shell("recon", "bench", "--help").stdout
    assert "with colourless" in words and "with dimmed" in words
    done = shell(
        "recon",
        "fit",
        str(world),
        "--offsets",
        str(world / "start.json"),
        "--out",
        str(out),
        "--width",
        "48",
        "--tracks",
        *map(str, sorted((world / "tracks").glob("*.npz"))),
        "--steps",
        "2",
        "--backdrop-steps",
        "5",
        "--losses",
        "photometric",
        "colourless:weight=0.2",
        "--effects",
        "dimmed:share=0.8",
        "--views",
        "2",
        "--quiet",
    )
    assert done.returncode == 0, done.stderr
    run = json.loads((out / "run.json").read_text())
    assert run["videos"][0]["optics"] == [{"name": "dimmed", "share": 0.8}]
    done = shell.alone("recon", "export", str(out), "--format", "counted")
    assert done.returncode == 0, done.stderr
    assert int((out / "count.txt").read_text()) == len(Gaussians4D.load(out / "scene.npz"))
