"""``--features``: maps by name, features of a scene's Gaussians, dense tracks of every video and what they answer."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from otsync.cli import main as otsync
from otsync.files.cache import Cache
from otsync.io import open_scene
from otsync.recordings.routes import INHERITED
from otsync.recordings.stages import Stages
from otsync.recordings.synchronized import Synchronized
from otsync.recordings.tracking import Selection
from otsync.types import Offsets, Status
from recon.features.maps import Backbone, DaisyMaps, KeptMaps, LabMaps
from recon.features.tracks import Alone, fit_alone
from recon.pipeline.dense_tracks import NoDenseTracks, dense_tracks, synchronized_by_features, thinned
from recon.pipeline.feature_maps import choices, key_of, maps_from, with_features
from recon.pipeline.stages import NoDepth
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture

FRAMES, SIZE, LATE = 40, (96, 64), (0.0, 3.0, -2.0)
SHORT = Alone(steps=40)
FEW = Stages(selection=Selection(count=80, min_life=8))


@dataclass(frozen=True)
class Colours:
    """A backbone of cells of 8 x 8 pixels: their mean colours."""

    def dense(self, image):
        h, w = image.shape[0] // 8, image.shape[1] // 8
        return image[: h * 8, : w * 8].reshape(h, 8, w, 8, 3).mean((1, 3)) / 255 + 0.1


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dense") / "world"
    write_capture(synthetic(9, cameras=3, held_out=0, frames=FRAMES, size=SIZE, offsets=list(LATE)), folder)
    return folder


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return Cache(tmp_path_factory.mktemp("stages"))


@pytest.fixture(scope="module")
def known(recording):
    return Offsets.load(recording / "truth.json")


def test_maps_by_name():
    assert maps_from("lab") == LabMaps() and maps_from("daisy:radius=9") == DaisyMaps(radius=9)
    assert {"dinov3", "dinov2", "transformers", "onnx"} <= set(choices())
    assert key_of(LabMaps()) != key_of(LabMaps(bins=3))
    with pytest.raises(ValueError, match="--features: expected some of lab"):
        maps_from("nothing")
    with pytest.raises(ValueError, match="--features"):
        maps_from("lab:edges=3")


def test_a_backbone_is_read_between_its_cells():
    image = np.zeros((32, 48, 3), np.uint8)
    image[..., 0] = np.linspace(0, 255, 48).astype(np.uint8)
    found = Backbone(Colours())(image, np.zeros(image.shape[:2], np.uint8))
    assert found.shape == (32, 48, 3)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1, atol=1e-6)
    share = found[16, :, 0] / found[16, :, 1]  # red beside green, which is the same everywhere
    expected = (np.linspace(0, 1, 48) + 0.1) / 0.1
    np.testing.assert_allclose(share[4:-4], expected[4:-4], rtol=0.06)
    with pytest.raises(ValueError, match="2 x 2 cells"):
        Backbone(Colours())(image[:8], np.zeros((8, 48), np.uint8))


def test_maps_are_kept_within_their_bound_and_do_not_depend_on_it():
    footage = synthetic(5, cameras=1, held_out=0, frames=6, size=(40, 24), offsets=[0]).footage[0]
    footage = replace(footage, bad=np.arange(6) == 2)
    asked: list[int] = []

    def maps(image, mask):
        asked.append(len(asked))
        return LabMaps()(image, mask)

    small, large = KeptMaps(footage, maps, most=1), KeptMaps(footage, maps)
    assert list(large) == [0, 1, 3, 4, 5] and len(large) == 5 and 2 not in large
    with pytest.raises(KeyError):
        large[2]
    for k in (0, 1, 0, 1):
        np.testing.assert_array_equal(small[k], large[k])
        np.testing.assert_allclose(small[k], LabMaps()(footage.images[k], footage.masks[k]), atol=1e-3)
    assert len(asked) == 4 + 2


def test_features_of_a_scene_are_those_of_its_surfaces():
    capture = synthetic(5, cameras=3, held_out=0, frames=12, size=(112, 72), offsets=[0] * 3)
    scene = fit_alone(capture.footage[0], capture.tracks[0], capture.depth[0].__getitem__, options=Alone(steps=20))

    def colours(image, mask):
        """Those of the foreground; something loud behind it, which must not be lifted."""
        return np.where(mask[..., None] > 0, image / np.float32(255) - 0.5, np.float32([30, -30, 30]))

    names = [f.name for f in capture.footage]
    offsets = Offsets.known(names, np.zeros(3), 30.0)
    found = with_features(scene, capture.footage, offsets, colours).features
    length = found.norm(dim=1)
    assert torch.all((length - 1).abs().lt(1e-5) | length.eq(0)) and (length > 0).float().mean() > 0.8
    own = scene.dynamic.sh[:, 0] * 0.28209479177387814
    alike = torch.nn.functional.cosine_similarity(found, own, dim=1)[length > 0]
    by_chance = torch.nn.functional.cosine_similarity(found, own.flip(0), dim=1)[length > 0]
    assert alike.median() > 0.9 and alike.median() > by_chance.median() + 0.2
    # what is told by an offset may as well be told by the frames' times
    late = Offsets.known(names, np.array([0.0, 0.1, -0.05]), 30.0)
    moved = [replace(f, times=f.times + s) for f, s in zip(capture.footage, late.seconds, strict=True)]
    by_offset, by_times = (
        with_features(scene, footage, clock, colours).features
        for footage, clock in ((capture.footage, late), (moved, offsets))
    )
    np.testing.assert_allclose(by_offset, by_times, atol=1e-5)
    assert not np.allclose(by_offset, found, atol=1e-3)
    with pytest.raises(ValueError, match="features: expected masks"):
        with_features(scene, [replace(f, masks=None) for f in capture.footage], offsets, colours)


def test_dense_tracks_answer_by_the_method_of_lifted_ones(recording, known, cache):
    scene = open_scene(recording)
    nothing = Offsets.known(scene.names, np.zeros(3), 30.0)  # given depth needs no clock
    coarse = Synchronized(nothing, (), "tracks", ("as asked",))
    found = synchronized_by_features(scene, coarse, LabMaps(), width=SIZE[0], options=SHORT, stages=FEW, cache=cache)
    assert found.route == "tracks, dense features" and "dense feature tracks" in found.why[-1]
    assert found.first is nothing and all(len(t) >= 20 for t in found.tracks)
    true = known.seconds - known.seconds[0]
    off = np.abs(found.offsets.seconds - true) * 30
    sigma = found.offsets.sigma * 30
    assert (off[1:] < np.maximum(0.5, 3 * sigma[1:])).all(), (off, sigma)
    again = dense_tracks(scene, nothing, LabMaps(), width=SIZE[0], options=SHORT, stages=FEW, cache=cache)
    chosen = [thinned(t, FEW.selection) for t in again]
    for a, b in zip(chosen, found.tracks, strict=True):
        np.testing.assert_array_equal(a.xyz, b.xyz)
        np.testing.assert_array_equal(a.features, b.features)
    with pytest.raises(ValueError, match="dense tracks that live and move enough"):
        thinned(again[0], replace(FEW.selection, extent=1e4))


def test_doubts_of_cameras_and_of_measured_depth_are_in_the_answer(recording, known, cache, monkeypatch):
    """Depth that was measured at offsets carries their errors; a camera in doubt is in doubt whatever was tracked."""
    scene = replace(open_scene(recording), doubtful={"cam1": "its focal length is a guess"})
    options = {"width": SIZE[0], "options": SHORT, "stages": FEW, "cache": cache}
    given = Synchronized(known, (), "tracks", ("as asked",))
    plain = synchronized_by_features(scene, given, LabMaps(), **options).offsets
    assert [Status.MISPLACED in f for f in plain.flags] == [False, True, False]
    flat = replace(scene, videos=tuple(replace(v, depth=None) for v in scene.videos))
    unsure = replace(known, sigma=np.array([0.0, 0.5, 0.5]) / 30)
    dense = dense_tracks(scene, known, LabMaps(), **options)
    asked: list[Offsets] = []

    def measured(scene, at, maps, **rest):
        asked.append(at)
        return dense

    monkeypatch.setattr("recon.pipeline.dense_tracks.dense_tracks", measured)
    stereo = Synchronized(known, (), "stereo", ("static rig",), first=unsure)
    found = synchronized_by_features(flat, stereo, LabMaps(), **options).offsets
    np.testing.assert_allclose(found.sigma[1:], np.hypot(plain.sigma[1:], INHERITED * unsure.sigma[1:]))
    assert asked[-1] is unsure
    pixels = Synchronized(known, (), "epipolar", ("no stereo: the epipolar offsets are doubtful",))
    with pytest.raises(NoDenseTracks, match="the epipolar offsets are doubtful"):
        synchronized_by_features(flat, pixels, LabMaps(), **options)


def test_videos_without_depth_are_named(recording, cache):
    scene = open_scene(recording)
    flat = replace(scene, videos=tuple(replace(v, depth=None) for v in scene.videos))
    nothing = Offsets.known(scene.names, np.zeros(3), 30.0)
    with pytest.raises(NoDepth, match="depth: none was given"):
        dense_tracks(flat, nothing, LabMaps(), width=SIZE[0], stages=FEW, cache=cache)
    some = replace(scene, videos=(*scene.videos[:2], replace(scene.videos[2], depth=None)))
    with pytest.raises(ValueError, match=f"--features: expected tracks in space of every video; {scene.names[2]}"):
        dense_tracks(some, nothing, LabMaps(), width=SIZE[0], stages=FEW, cache=cache)


def shown_by(command, args, out):
    """The features of the scene that a run writes."""
    assert command([*args, "--out", str(out)]) in (0, 1)
    assert json.loads((out / "sync.json").read_text())["route"] == "tracks, dense features"
    return np.load(out / "scene.npz")["features"]


@pytest.mark.slow
def test_a_run_with_features_from_the_shell(recording, tmp_path):
    args = [
        "run",
        str(recording),
        "--recording.cache",
        str(tmp_path / "stages"),
        "--width",
        str(SIZE[0]),
        "--features",
        "lab",
    ]
    args += ["--steps", "8", "--backdrop-steps", "5", "--views", "2"]
    losses = ["photometric", "mask", "scale-hinge", "arap", "length", "velocity", "acceleration", "feature"]
    trained, held = (
        shown_by(otsync, [*args, *more, "--losses", *losses], tmp_path / f"{len(more)}")
        for more in ([], ["--freeze", "features"])
    )
    assert trained.shape == held.shape and not np.array_equal(trained, held)
    lengths = np.linalg.norm(held, axis=1)
    assert np.all((np.abs(lengths - 1) < 1e-4) | (lengths == 0))
