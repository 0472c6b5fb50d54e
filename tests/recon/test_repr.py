"""Nouns of a reconstruction print as one line that says how much there is, when, and where."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from otsync.types import Clock, Offsets
from recon.backdrop.fit import StaticFit
from recon.evaluate.views import ViewScore, view
from recon.motion import HermiteSpline, PerGaussian, Sampled, Static
from recon.result.folder import FilmedBy, SavedReconstruction
from recon.scene.gaussians4d import Gaussians4D
from recon.simulate.recording import initial_scene
from tests.recon.worlds import capture

WIDTH = 160


@pytest.fixture(scope="module")
def scene() -> Gaussians4D:
    c = capture()
    return initial_scene(c, Offsets.known([f.name for f in c.footage], c.offsets - c.offsets[0], 30.0))


def line(noun) -> str:
    text = repr(noun)
    assert "\n" not in text and len(text) <= WIDTH and "tensor" not in text and "array" not in text
    return text


def test_gaussians(scene):
    n, m = len(scene), len(scene.static)
    assert line(scene.dynamic) == f"Gaussians({n}, sh_degree=0, cpu)"
    assert line(replace(scene.dynamic, sh=torch.zeros(n, 16, 3))) == f"Gaussians({n}, sh_degree=3, cpu)"
    first, last = scene.span
    assert line(scene) == f"Gaussians4D({n} moving, {m} static, Scaffold, {first:.3f} to {last:.3f} s, cpu)"
    assert ", 0 static, " in line(replace(scene, static=None))


def test_motions(scene):
    motion = scene.motion
    text = line(motion)
    assert text.startswith(f"Scaffold({len(motion)} nodes, {len(scene)} Gaussians, world time, BSpline(")
    assert line(motion.binding).startswith(f"Binding({len(scene)} Gaussians to {len(motion)} nodes, ")
    clocks = {"clock": torch.zeros(len(motion), dtype=torch.int64), "offsets": torch.zeros(1), "rates": torch.ones(1)}
    assert ", the videos' own times, " in line(replace(motion, **clocks))
    path = HermiteSpline(-0.1, 1 / 30, 10)
    assert line(path) == "HermiteSpline(10 knots, -0.100 to 0.200 s)"
    assert line(Sampled(0.0, 0.5, 5)) == "Sampled(5 knots, 0.000 to 2.000 s)"
    assert line(PerGaussian(path, torch.zeros(10, 7, 3))) == f"PerGaussian(7 Gaussians, {path}, cpu)"
    assert line(Static()) == "Static()"


def test_footage():
    footage = capture().footage[0]
    w, h = footage.size
    text = line(footage)
    assert text.startswith(f"Footage('{footage.name}', {len(footage)} frames of {w} x {h}, 0.000 to ")
    assert text.endswith("fixed camera, masks, background)")
    moving = replace(footage, w2c=np.stack([footage.w2c] * len(footage)), masks=None, background=None)
    assert line(moving).endswith("s, moving camera)")


def test_worlds_and_results(scene):
    c = capture()
    assert re.match(r"World\(\d+ moving Gaussians on 12 parts, \d+ static\)$", line(c.world))
    assert line(c).startswith(f"Capture({len(c.footage)} cameras, {len(c.held_out)} held out, ")
    videos = [FilmedBy.of(f, Clock(0.0), np.ones(3)) for f in c.footage]
    videos.append(FilmedBy.of(c.held_out[0], Clock(0.0), np.ones(3), held_out=True))
    offsets = Offsets.known([v.name for v in videos], np.zeros(len(videos)), 30.0)
    for video in videos:
        assert line(video).startswith(f"FilmedBy('{video.name}', ")
    saved = SavedReconstruction(scene, offsets, tuple(videos))
    assert line(saved) == f"SavedReconstruction({len(videos)} videos, 1 held out, {scene!r})"


def test_views_and_backdrops(scene):
    footage = capture().held_out[0]
    assert line(view(scene, footage, Clock(0.02), gain=np.ones(3))).startswith("CameraView(Footage('held0', ")
    score = ViewScore("a", Clock(0.0), np.ones(3), np.zeros(4), ({},) * 4, {"psnr": 30.123, "mask_psnr": float("nan")})
    assert line(score) == "ViewScore('a', 4 frames, held out, psnr 30.12, mask_psnr nan)"
    assert line(replace(score, held_out=False, mean={})) == "ViewScore('a', 4 frames, training)"
    fit = StaticFit(scene.static, np.ones((2, 3)), 0.5, np.array([30.0, np.nan]))
    assert line(fit) == f"StaticFit({scene.static!r}, 2 videos, 30.00 dB, no floor)"
    assert line(replace(fit, psnr=np.full(2, np.nan))) == f"StaticFit({scene.static!r}, 2 videos, nan dB, no floor)"
