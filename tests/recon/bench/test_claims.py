"""What docs/reconstruction.md says of the rows of ``recon bench``, measured again on the real scene, in shorter fits.

Every bar lies between what two rows came to, several times their spread over draws away from either. What was measured
stands beside it.
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

STEPS = 1000
MANY: dict[str, Any] = {"held_out": ("0",)}
FEW: dict[str, Any] = {"held_out": ("0", "12", "21"), "cameras": ("5", "23", "29"), "amplitudes": (0.0,)}


@pytest.fixture(scope="module")
def measured(data, tmp_path_factory):
    """Rows of 48 frames of the basketball scene by name; tracks and depth are made once."""
    scene: Path = data / "panoptic_basketball"
    if not scene.is_dir():
        pytest.skip(f"no {scene}: it holds the recording that the page's figures are of")
    folder = tmp_path_factory.mktemp("basketball")

    def ask(*rows: str, held_out: tuple[str, ...], **protocol: Any) -> dict[str, Row]:
        plan = Plan(views=16, frames=(20, 68), fit=FitOptions(steps=STEPS))
        out = folder / "-".join(map(str, (*held_out, *protocol.values())))
        recording, truth = known_scene(scene, None, held_out, False)
        wanted = Protocol(plan, held_out=held_out, **protocol)
        found = run(recording, truth, out, protocol=wanted, rows=rows, cache=folder / "stages")
        return {row["configuration"]: row for row in found if row["configuration"] in rows}

    return ask


def test_refinement_is_worth_having(measured):
    rows = measured("ours", "fixed", "true time", **MANY)
    ours, fixed, ceiling = (rows[name] for name in ("ours", "fixed", "true time"))
    assert ours["mean"] < 0.25 * ours["start"] and fixed["mean"] == fixed["start"] == ours["start"]
    assert ours["mask_psnr"] > fixed["mask_psnr"] + 0.5
    assert abs(ours["mask_psnr"] - ceiling["mask_psnr"]) < 0.5


def test_a_scaffold_keeps_the_motion_coherent_and_is_not_needed_for_the_offsets(measured):
    rows = measured("ours", "w/o scaffold", "scaffold per video", **MANY)
    ours, without = rows["ours"], rows["w/o scaffold"]
    assert without["neighbour_change"] > 3 * ours["neighbour_change"]
    assert without["mean"] < 0.25 * without["start"]


def test_a_spline_costs_no_quality(measured):
    rows = measured("true time", "w/o spline, true time", **MANY)
    spline, without = rows["true time"], rows["w/o spline, true time"]
    assert abs(spline["psnr"] - without["psnr"]) < 0.3


def test_rigidity_keeps_free_gaussians_together_less_than_a_scaffold(measured):
    rows = measured("true time", "w/o scaffold, true time", "Dynamic3DGaussians", **MANY)
    scaffold, rigid = rows["true time"], rows["Dynamic3DGaussians"]
    assert rigid["neighbour_change"] > 1.5 * scaffold["neighbour_change"]


def test_images_alone_do_not_find_clips_that_begin_far_apart(measured):
    near = measured("ours", "Sync-NeRF style", **MANY)["Sync-NeRF style"]
    far = measured("Sync-NeRF style", amplitudes=(30.0,), **MANY)["Sync-NeRF style"]
    assert near["mean"] < near["start"]
    assert far["mean"] > 5 and far["mean"] > 0.5 * far["start"]


def test_with_three_cameras_a_scaffold_is_worth_decibels(measured):
    """Offsets held at the truth in both rows, then learnt at one rate in both: the scaffold is the only difference."""
    rows = measured("true time", "w/o scaffold, true time", "ours", "w/o scaffold", **FEW)
    for scaffold, without in (("true time", "w/o scaffold, true time"), ("ours", "w/o scaffold")):
        assert rows[scaffold]["psnr"] > rows[without]["psnr"] + 0.3
        assert rows[scaffold]["mask_psnr"] > rows[without]["mask_psnr"] + 0.3
