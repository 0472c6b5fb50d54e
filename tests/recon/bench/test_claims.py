"""What docs/reconstruction.md says of the rows of ``recon bench``, measured again on the real scene by its commands.

Every bar lies between what two rows came to, several times their spread over draws away from either. What was measured
stands beside it. On two quiet cores this takes a quarter of an hour, most of it fits.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from recon.bench.fits import Protocol, Row, run
from recon.cli.bench import known_scene
from recon.fit.options import FitOptions
from recon.pipeline.plan import Plan

pytestmark = pytest.mark.slow

MANY: dict[str, Any] = {"held_out": ("0",), "steps": 1500}
FAR = MANY | {"amplitudes": (30.0,)}
FEW: dict[str, Any] = {"held_out": ("0", "12", "21"), "cameras": ("5", "23", "29"), "amplitudes": (0.0,), "steps": 1000}


@pytest.fixture(scope="module")
def measured(data, tmp_path_factory):
    """Rows of 48 frames of the basketball scene by name; tracks and depth are made once."""
    scene: Path = data / "panoptic_basketball"
    if not scene.is_dir():
        pytest.skip(f"no {scene}: it holds the recording that the page's figures are of")
    folder = tmp_path_factory.mktemp("basketball")

    def ask(*rows: str, steps: int, **protocol: Any) -> dict[str, Row]:
        wanted = Protocol(Plan(views=16, frames=(20, 68), fit=FitOptions(steps=steps)), **protocol)
        recording, truth = known_scene(scene, None, wanted.held_out, False)
        out = folder / f"{len(wanted.held_out)}-held-out-{wanted.amplitudes[0]:g}-frames"
        found = run(recording, truth, out, protocol=wanted, rows=rows, cache=folder / "stages")
        return {row["configuration"]: row for row in found if row["configuration"] in rows}

    return ask


def test_refinement_is_worth_having(measured):
    rows = measured("ours", "fixed", "true time", **MANY)
    ours, fixed, ceiling = (rows[name] for name in ("ours", "fixed", "true time"))
    assert fixed["mean"] == fixed["start"] == ours["start"]
    assert ours["mean"] < 0.1 and ours["max"] < 0.2  # .044, .061; .003 over draws
    assert ours["mask_psnr"] > fixed["mask_psnr"] + 0.7  # 24.6, 22.6; .2 and .6 over draws
    assert abs(ours["mask_psnr"] - ceiling["mask_psnr"]) < 0.6  # 24.8


def test_with_many_cameras_a_scaffold_gives_coherence_and_costs_decibels(measured):
    rows = measured("ours", "w/o scaffold", "scaffold per video", **MANY)
    ours, without, each = (rows[name] for name in ("ours", "w/o scaffold", "scaffold per video"))
    assert without["neighbour_change"] > 4 * ours["neighbour_change"]  # 2.7, .33; .01 over draws
    assert without["neighbour_change"] > 1.2 * each["neighbour_change"] > 2.4 * ours["neighbour_change"]  # 1.6
    assert without["mask_psnr"] > ours["mask_psnr"] + 0.5  # 25.9, 24.6; .2 over draws
    assert each["mask_psnr"] > ours["mask_psnr"] + 0.4  # 25.7
    assert without["mean"] < 0.1  # .053: offsets are refined without one, too


def test_a_spline_costs_no_quality_at_true_time(measured):
    rows = measured("true time", "w/o spline, true time", **MANY)
    spline, without = rows["true time"], rows["w/o spline, true time"]
    assert spline["psnr"] > without["psnr"] - 0.2  # 30.1, 30.0
    assert spline["mask_psnr"] > without["mask_psnr"] - 0.2  # 24.8, 24.3


def test_rigidity_holds_free_gaussians_together_less_than_a_scaffold(measured):
    rows = measured("true time", "w/o scaffold, true time", "Dynamic3DGaussians", **MANY)
    scaffold, without, rigid = (rows[n] for n in ("true time", "w/o scaffold, true time", "Dynamic3DGaussians"))
    assert 2 * scaffold["neighbour_change"] < rigid["neighbour_change"]  # .33, 1.2
    assert rigid["neighbour_change"] < 0.75 * without["neighbour_change"]  # 2.5
    assert rigid["mask_psnr"] > scaffold["mask_psnr"] + 0.3  # 25.7, 24.8


def test_images_alone_refine_small_errors_and_do_not_find_clips_that_begin_far_apart(measured):
    rows, far = measured("ours", "Sync-NeRF style", **MANY), measured("Sync-NeRF style", **FAR)["Sync-NeRF style"]
    near = rows["Sync-NeRF style"]
    assert near["mean"] < 0.2  # .067, from .53
    assert near["mask_psnr"] < rows["ours"]["mask_psnr"] - 1  # 22.3, 24.6
    assert far["mean"] > 8 and far["mean"] > 0.7 * far["start"]  # 16.1, from 16.0


def test_with_three_cameras_a_scaffold_is_worth_decibels(measured):
    """Offsets held at the truth in both rows, then learnt at one rate in both: the scaffold is the only difference."""
    rows = measured("true time", "w/o scaffold, true time", "ours", "w/o scaffold", **FEW)
    for scaffold, without in (("true time", "w/o scaffold, true time"), ("ours", "w/o scaffold")):
        assert rows[scaffold]["psnr"] > rows[without]["psnr"] + 0.15  # 26.9, 26.5; .01 over seeds
        assert rows[scaffold]["mask_psnr"] > rows[without]["mask_psnr"] + 0.25  # 21.7, 21.2
        assert rows[without]["neighbour_change"] > 4 * rows[scaffold]["neighbour_change"]  # 2.6, .27
