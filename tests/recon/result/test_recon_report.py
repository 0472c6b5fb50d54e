"""The page of a reconstruction: self-contained, small, and its curves are those of the fit."""

from __future__ import annotations

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from otsync.types import Clock, Offsets
from recon.evaluate.views import ViewScore
from recon.fit.verb import History, Reconstruction
from recon.motion import Static
from recon.result.images import rendered
from recon.result.report import convergence, offset_curves, write_reconstruction_report
from recon.scene.gaussians4d import Gaussians4D
from tests.recon.result.filmed import reconstruction as filmed
from tests.recon.result.test_export import blobs

STEP = 1 / 30


@pytest.fixture
def coarse() -> Offsets:
    return Offsets.known(("a", "b", "<c>"), np.array([0.0, 2.0, -1.0]) * STEP, 30)


def history(rows: int = 30, videos: int = 3) -> History:
    rng = np.random.default_rng(0)
    drift = np.linspace(0, 0.5, rows)[:, None] * STEP
    offsets = (
        np.array([0.0, 2.0, -1.0])[:videos] * STEP
        + drift
        + np.linspace(0, 1, rows)[:, None] * np.array([0, 0.3, -0.2])[:videos] * STEP
    )
    return History(
        np.arange(1, rows + 1) * 10, np.linspace(0, 9, rows), rng.random(rows), 20 + np.arange(rows) / 4, offsets
    )


def reconstruction(coarse: Offsets) -> Reconstruction:
    scene = Gaussians4D(blobs(20), Static(), footprint=0.01, frame_step=STEP, span=(0.0, 1.0), static=blobs(7))
    return Reconstruction(scene, coarse, {"gain": torch.ones(3, 3)}, history(), {"steps": 300.0, "seconds": 9.0})


def score(name: str, held_out: bool, pictures: int = 3) -> ViewScore:
    frames = tuple(
        {"psnr": 25.0 + k, "ssim": 0.9, "lpips": np.nan, "mask_psnr": np.nan if k else 21.0, "mask_ssim": 0.8}
        for k in range(6)
    )
    rng = np.random.default_rng(1)
    shown = tuple((rng.integers(0, 255, (90, 160, 3), dtype=np.uint8),) * 2 for _ in range(pictures))
    mean = {"psnr": 27.5, "ssim": 0.9, "lpips": np.nan, "mask_psnr": 21.0, "mask_ssim": 0.8}
    return ViewScore(
        name, Clock(0.1, 1.0, "found"), np.array([1, 0.9, 1.1]), np.arange(6) / 6, frames, mean, shown, True, held_out
    )


def test_the_page_is_one_small_file_without_a_script(coarse, tmp_path):
    views = [score("held <0>", True), score("a", False)]
    write_reconstruction_report(
        tmp_path / "r.html",
        reconstruction(coarse),
        coarse,
        ["a", "b", "<c>"],
        views,
        seconds={"fit": 9.0},
        notes=["video d is left out: it has <no> offset"],
        truth=np.array([0, 2.3, -1.2]) * STEP,
        lpips_reason="no weights given",
    )
    page = (tmp_path / "r.html").read_text()
    assert len(page) < 400_000
    assert "<script" not in page and not re.search(r"""(src|href)=["']?(?!data:|#)[a-z]+:""", page)
    assert "&lt;c&gt;" in page and "it has &lt;no&gt; offset" in page and "<c>" not in page
    for text in (
        "27.50",
        "21.00",
        "no weights given",
        "found on the frozen scene",
        "held out",
        "training",
        "300 steps",
    ):
        assert text in page, text
    assert page.count("<img") == 2 and page.count("<svg") == 3


def test_a_page_needs_no_opencv_and_goes_without_pictures_where_pillow_lacks(coarse, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    args = (reconstruction(coarse), coarse, ["a", "b", "<c>"], [score("h", True)])
    write_reconstruction_report(tmp_path / "r.html", *args)
    assert (tmp_path / "r.html").read_text().count("<img") == 1
    monkeypatch.setitem(sys.modules, "PIL", None)
    write_reconstruction_report(tmp_path / "r.html", *args)
    page = (tmp_path / "r.html").read_text()
    assert "<img" not in page and "they need pillow" in page and "27.50" in page


def test_the_page_is_the_same_for_the_same_fit(coarse, tmp_path):
    for name in ("one", "two"):
        write_reconstruction_report(
            tmp_path / name, reconstruction(coarse), coarse, ["a", "b", "<c>"], [score("h", True)]
        )
    assert (tmp_path / "one").read_text() == (tmp_path / "two").read_text()


def test_a_result_shows_itself():
    import matplotlib as mpl

    mpl.use("Agg")
    result = filmed()
    figure = result.show(camera="b", moments=3)
    pictures = [ax.images[0].get_array() for ax in figure.axes]
    times = [float(ax.get_title().split()[0]) for ax in figure.axes]
    assert len(pictures) == 3 and times == sorted(times)
    expected = next(iter(rendered(result, [np.linspace(*result.scene.span, 5)[1]], "b")))
    np.testing.assert_array_equal(pictures[0], expected)
    with pytest.raises(ValueError, match="camera: expected one of a, b, c; found 'x'"):
        result.show(camera="x")


def test_curves_are_relative_to_the_reference_and_to_the_truth(coarse):
    moved = offset_curves(history(), coarse, ["a", "b", "<c>"], None)
    assert [name for name, _, _ in moved] == ["a", "b", "<c>"] and moved[0][2] and not moved[1][2]
    # the common drift is gone
    np.testing.assert_allclose([curve[-1] / STEP for _, curve, _ in moved], [0, 0.3, -0.2], atol=1e-9)
    truth = np.array([0.0, 2.3, -1.2]) * STEP
    errors = offset_curves(history(), coarse, ["a", "b", "<c>"], truth)
    np.testing.assert_allclose([c[0] / STEP for _, c, _ in errors], [0, -0.3, 0.2], atol=1e-9)
    np.testing.assert_allclose([c[-1] for _, c, _ in errors], 0, atol=1e-9)


def test_videos_are_found_by_name_when_some_did_not_take_part(coarse):
    rows = history(videos=2)
    moved = offset_curves(rows, coarse, ["a", "b"], None)
    np.testing.assert_allclose(moved[1][1][-1] / STEP, 0.3)
    assert "<svg" in convergence(reconstruction(coarse), coarse, ["a", "b", "<c>"])


def test_a_fit_of_no_steps_and_without_views_has_a_page_too(coarse, tmp_path):
    empty = History(np.zeros(0, int), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 3)))
    found = Reconstruction(reconstruction(coarse).scene, coarse, {}, empty, {"steps": 0.0})
    write_reconstruction_report(tmp_path / "r.html", found, coarse, ["a", "b", "<c>"], [])
    page = (tmp_path / "r.html").read_text()
    assert "No camera was held out" in page and "No view was scored" in page


def test_the_page_says_what_a_fit_left_of_bends(coarse, tmp_path):
    found = reconstruction(coarse)
    write_reconstruction_report(tmp_path / "r.html", found, coarse, ["a", "b", "<c>"], [])
    assert "bent on purpose" not in (tmp_path / "r.html").read_text()
    found = replace(found, stats=found.stats | {"start_kept": 0.12, "start_kept_sigma": 0.09})
    write_reconstruction_report(tmp_path / "r.html", found, coarse, ["a", "b", "<c>"], [])
    assert "it left 12% (± 9%) of that" in (tmp_path / "r.html").read_text()
