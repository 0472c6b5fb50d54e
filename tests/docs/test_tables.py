"""Tables in the docs list what there is in the code: statuses, groups, commands, public names, fields of files."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

import otsync
from otsync import Alignment, Camera, Offsets, Status, TrackSet, plugins
from otsync.bench import suites
from otsync.cli.commands import commands as otsync_commands
from recon.cli.commands import commands as recon_commands
from tests.docs.pages import PAGES, ROOT


def rows(name: str, section: str | None = None) -> dict[str, list[str]]:
    """The rows of a page's tables, or of those below a heading, by the names in their first cell."""
    text = (ROOT / name).read_text()
    if section is not None:
        assert f"\n## {section}\n" in text
        text = text.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    out: dict[str, list[str]] = {}
    for line in text.splitlines():
        if line.startswith("| `"):
            first, *rest = [cell.strip() for cell in line.strip("|").split(" | ")]
            for key in re.findall(r"`([^`]+)`", first):
                out.setdefault(key, []).append(" | ".join(rest).strip(" |"))
    return out


def test_every_status_is_in_the_concepts_with_its_text():
    listed = rows("docs/concepts.md", "Flags")
    assert {name: text[0] for name, text in listed.items()} == {status.code: str(status) for status in Status}


def test_every_group_of_plugins_is_in_the_page_about_them():
    listed = rows("docs/extending.md")
    assert {group: listed[group][0] for group in plugins.GROUPS} == plugins.GROUPS


def test_every_command_is_listed():
    there = {f"otsync {name}" for name in otsync_commands()} | {f"recon {name}" for name in recon_commands()}
    assert {name for name in rows("docs/commands.md") if name.startswith(("otsync ", "recon "))} == there


def test_every_suite_is_listed():
    assert {*suites(), "all"} <= set(rows("docs/benchmarks.md"))


def test_every_public_name_is_listed():
    listed = set(re.findall(r"`(\w+)`", (ROOT / "docs/api/otsync.md").read_text().partition("| kind |")[2]))
    assert listed == set(otsync.__all__)


@pytest.mark.parametrize("slot", ["MATCHERS", "ALIGNERS", "REFINERS"])
def test_every_algorithm_has_a_row_or_a_word(slot):
    folder = {"MATCHERS": "match", "ALIGNERS": "align", "REFINERS": "refine"}[slot]
    module = __import__(f"otsync.{folder}", fromlist=[slot])
    text = (ROOT / ("docs/matching.md" if slot == "MATCHERS" else "docs/synchronisation.md")).read_text()
    assert not [kind.__name__ for kind in getattr(module, slot) if f"`{kind.__name__}`" not in text]


def test_the_fields_of_offsets_json():
    pair = Alignment(0.5, fps=30.0, stats={"heard_begin": 1.0, "heard_end": 2.0})
    offsets = Offsets.known(["a", "b"], np.array([0.0, 0.5]), fps=30, transforms=[None, None])
    document = Offsets(**{**vars(offsets), "alignments": {(0, 1): pair}}).to_dict()
    fields = {*document, *document["videos"][0], *document["pairs"][0]}
    assert set(rows("docs/formats.md", "offsets.json")) == fields


def test_the_arrays_of_a_track_set(tmp_path):
    camera = Camera(np.eye(3), np.eye(4), 64, 48, distortion=np.zeros(4), readout=0.01)
    tracks = TrackSet(
        np.zeros((2, 3, 3)),
        features=np.ones((2, 4)),
        fps=30,
        timestamps=np.arange(3) / 30,
        uv=np.zeros((2, 3, 2)),
        sigma=np.ones((2, 3)),
        labels=np.zeros(2, int),
        camera=camera,
        frame="world",
    )
    tracks.save(tmp_path / "tracks.npz")
    with np.load(tmp_path / "tracks.npz") as written:
        assert set(rows("docs/formats.md", "Track sets")) == set(written)


def test_the_scene_of_the_page_opens_and_its_fields_are_those_that_are_read():
    from otsync.files.strict import fields_of
    from otsync.io.layout import CalibratedFile, CalibrationFile, CameraFile, DepthFile, SceneFile, VideoFile
    from otsync.io.scene import camera_from

    page = (ROOT / "docs/recording.md").read_text()
    document = json.loads(page.partition("```json\n")[2].partition("```")[0])
    for video in document["videos"]:
        camera_from(video["camera"])
    kinds = (SceneFile, VideoFile, CameraFile, CalibrationFile, CalibratedFile)
    read = {name for kind in kinds for name in fields_of(kind)}
    assert set(rows("docs/formats.md", "scene.json")) == read
    assert set(fields_of(DepthFile)) == {"frames", "file", "scale"}


def test_the_fields_of_a_reconstruction(tmp_path):
    pytest.importorskip("torch")
    from otsync.types import Clock
    from recon.evaluate.views import ViewScore
    from recon.result.folder import FilmedBy, metrics_of, save_run

    camera, gain, times = Camera(np.eye(3), np.eye(4), 64, 48), np.ones(3), np.arange(3) / 30
    filmed = FilmedBy("a", camera, Clock(), gain, times)
    save_run(tmp_path, [filmed], options={}, frame="world", notes=(), seconds={})
    document = json.loads((tmp_path / "run.json").read_text())
    listed = set(rows("docs/formats.md", "run.json of a reconstruction"))
    assert listed == {*document, *document["videos"][0]}

    names = ("psnr", "ssim", "lpips", "mask_psnr", "mask_ssim")
    score = ViewScore("a", Clock(), gain, times, (), dict.fromkeys(names, 1.0))
    metrics = metrics_of([score], {"steps": 1.0}, "no weights")
    listed = set(rows("docs/formats.md", "metrics.json"))
    assert listed == {*metrics, *metrics["views"][0], "offset_error", "motion"}


def test_the_readme_is_short_and_begins_with_what_it_is():
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) < 120
    assert any(line.startswith("![") for line in lines[:12])


def test_prose_fits_into_120_columns():
    """Tables, headings of links and code apart, where a line cannot be broken."""
    for page in PAGES:
        if page.name == "stability.md":  # generated
            continue
        for number, line in enumerate(page.read_text().splitlines(), 1):
            broken = line.startswith(("|", "![", "otsync ", "recon ", "error: "))
            assert broken or len(line) <= 120, f"{page.name}, line {number}: {len(line)} characters"
