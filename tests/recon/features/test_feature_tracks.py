"""Feature tracks of one video: they follow the truth, on the video's own clock, where and when it sees them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from otsync.clocks.shutter import at_frame_times
from otsync.io import open_scene
from otsync.match.candidates import Candidates
from otsync.priors.features import LabHistogram
from otsync.priors.working import WorkingFrames
from otsync.types import Offsets
from recon.bench.lifting import Lifting
from recon.bench.lifting import run as measure_lifting
from recon.cli import main
from recon.features.maps import DaisyMaps, LabMaps
from recon.features.tracks import (
    Alone,
    before_black,
    feature_tracks,
    fit_alone,
    gaussian_tracks,
    lifted_frames,
    seen_weights,
)
from recon.simulate.capture import synthetic
from recon.simulate.recording import write_capture

FRAMES = 14


@pytest.fixture(scope="module")
def capture():
    return synthetic(5, cameras=5, held_out=0, frames=FRAMES, size=(112, 72), offsets=[0] * 5)


@pytest.fixture(scope="module")
def scene(capture):
    return fit_alone(*inputs(capture), options=Alone(steps=40))


def inputs(capture, v=0):
    return capture.footage[v], capture.tracks[v], capture.depth[v].__getitem__


def colours(image, mask):
    return image / np.float32(255) - 0.5


def test_tracks_follow_the_surface_on_the_videos_own_clock(capture, scene):
    footage, flow, _ = inputs(capture)
    tracks = gaussian_tracks(scene, footage, flow, colours)
    tracks.check("tracks", features=True)
    assert tracks.name == flow.name and tracks.frame == flow.frame
    assert np.array_equal(tracks.times, flow.times) and len(tracks) > 200
    np.testing.assert_allclose(np.linalg.norm(tracks.features, axis=1), 1)
    x, true = tracks.positions(), capture.world.positions(footage.times)
    np.testing.assert_allclose(tracks.camera.project(x)[tracks.seen], tracks.uv[tracks.seen], atol=1e-3)
    surface, moved = [], []
    for n in range(len(tracks)):
        seen = np.flatnonzero(tracks.seen[n])
        distance = np.linalg.norm(true[:, seen[0]] - x[n, seen[0]], axis=1)
        surface.append(distance.min())
        shift = (x[n] - true[distance.argmin()])[seen]
        moved.append(np.linalg.norm(shift[-1] - shift[0]))
    # the true points stand 4 cm apart, and limbs that swing pass within a few pixels of 2.5 cm of each other
    assert np.median(surface) < 0.05 and np.median(moved) < 0.06 < 0.3 < np.ptp(true, axis=1).max(1).mean()


def test_what_stands_behind_is_not_seen(capture, scene):
    footage, _, depth = inputs(capture)
    seen = seen_weights(scene, footage) >= 1
    x = scene.tracks(footage.times)
    z, uv = footage.camera.to_camera(x)[..., 2], footage.camera.project(x)
    column, row = np.clip(uv, 0, np.array(footage.size) - 1).astype(int).transpose(2, 0, 1)
    surface = np.stack([depth(k) for k in range(FRAMES)])[np.arange(FRAMES), row, column]
    inside = (footage.masks[np.arange(FRAMES), row, column] == 255) & (surface > 0)
    behind = z - surface
    assert 0.05 < 1 - seen[inside].mean() < 0.6
    assert (behind[inside & seen] < 0.15).mean() > 0.97
    # hidden: behind all that the pixels around show, so that no edge lets a part of it through
    around = np.stack([maximum_filter(np.where(depth(k) > 0, depth(k), np.inf), 5) for k in range(FRAMES)])
    hidden = inside & (z > around[np.arange(FRAMES), row, column] + 0.2)
    assert hidden.sum() > 15 and seen[hidden].mean() < 0.05


def test_lifted_features_are_those_of_the_surface(capture, scene):
    footage, flow, _ = inputs(capture)
    tracks = gaussian_tracks(scene, footage, flow, colours)
    x, true = tracks.positions(), capture.world.positions(footage.times)
    middle = FRAMES // 2
    at = np.flatnonzero(tracks.seen[:, middle])
    nearest = cKDTree(true[:, middle]).query(x[at, middle])[1]
    expected = capture.world.colors[nearest] - 0.5
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    agree = (tracks.features[at] * expected).sum(1)
    by_chance = (tracks.features[at] * expected[::-1]).sum(1)
    assert np.median(agree) > 0.9 > 0.5 > np.median(by_chance)


def test_two_videos_find_each_other(capture):
    a, b = (feature_tracks(*inputs(capture, v), LabMaps(), steps=0, options=Alone(every=0.1)) for v in (0, 1))
    distance = np.linalg.norm(a.positions()[:, None] - b.positions()[None], axis=-1)
    near = np.nanmean(np.where(np.isfinite(distance).any(-1)[..., None], distance, np.inf), axis=-1) < 0.15
    i, j = Candidates(2, 200)(a, b).pairs.T
    assert near[i, j].mean() > 2 * near.mean() > 0


def test_units_do_not_matter(capture):
    footage, flow, depth = inputs(capture)
    scaled = footage.w2c.copy()
    scaled[:3, 3] *= 1000
    camera = replace(flow.camera, w2c=scaled)
    options = Alone(steps=3)
    metres = feature_tracks(footage, flow, depth, colours, options=options)
    millimetres = feature_tracks(
        replace(footage, w2c=scaled),
        replace(flow, xyz=flow.xyz * 1000, camera=camera),
        lambda k: depth(k) * 1000,
        colours,
        options=options,
    )
    assert abs(len(metres) - len(millimetres)) <= 0.02 * len(metres)
    a, b = metres.positions()[:, FRAMES // 2], millimetres.positions()[:, FRAMES // 2] / 1000
    assert np.median(cKDTree(a[np.isfinite(a[:, 0])]).query(b[np.isfinite(b[:, 0])])[0]) < 1e-3


def test_the_fit_improves_the_images_and_the_clock_stays(capture):
    footage, flow, depth = inputs(capture)
    images = []
    for steps in (0, 40):
        found = fit_alone(footage, flow, depth, options=Alone(steps=steps))
        out = found.moving(float(footage.times[6])).render(replace(footage.camera, w2c=footage.pose(6)))
        rgb, alpha = out.colors[0].detach().numpy(), out.alphas[0].detach().numpy()
        whole = rgb + (1 - alpha) * footage.background / 255.0
        images.append(float(((whole - footage.images[6] / 255) ** 2)[footage.masks[6] > 128].mean()))
        assert found.span == (footage.times[0], footage.times[-1])
    assert images[1] < 0.7 * images[0]
    with pytest.raises(ValueError, match="rates: expected none for offsets"):
        Alone(rates={"means": 0.1, "offsets": 0.02})


def test_bad_frames_show_nothing_and_unknown_backgrounds_are_black(capture, scene):
    footage, flow, depth = inputs(capture)
    bad = footage.bad.copy()
    bad[3] = True
    spoiled = replace(footage, bad=bad)
    assert 3 not in lifted_frames(spoiled, 1 / 30) and len(lifted_frames(spoiled, 1 / 30)) == FRAMES - 1
    tracks = gaussian_tracks(scene, spoiled, flow, colours)
    assert not tracks.seen[:, 3].any() and tracks.seen[:, 4].any()
    black = before_black(footage)
    assert not black.background.any() and not black.images[footage.masks == 0].any()
    assert np.array_equal(black.images[footage.masks == 255], footage.images[footage.masks == 255])
    moving = replace(footage, background=None, background_seen=None, w2c=np.stack([footage.w2c] * FRAMES))
    along = replace(flow, camera=replace(flow.camera, w2c=moving.w2c))
    assert len(feature_tracks(moving, along, depth, colours, steps=2)) > 200


def test_frames_that_are_lifted_are_spread():
    footage = synthetic(5, cameras=1, held_out=0, frames=9, size=(40, 24), offsets=[0]).footage[0]
    assert lifted_frames(footage, 4 / 30) == [2, 6] and lifted_frames(footage, 9.0) == [4]


def test_what_one_video_lacks_is_said(capture, scene):
    footage, flow, depth = inputs(capture)
    for says, arguments in {
        "foreground masks": (replace(footage, masks=None), flow),
        "at the same times": (footage, replace(flow, fps=25.0)),
        "frames of the footage": (
            footage,
            replace(flow.take(slice(None)), xyz=flow.xyz[:, :5], visible=flow.seen[:, :5], uv=None),
        ),
        "Lift them first": (replace(footage, w2c=np.diag([1.0, -1, -1, 1]) @ footage.w2c), flow),
    }.items():
        with pytest.raises(ValueError, match=says):
            fit_alone(*arguments, depth)
    with pytest.raises(ValueError, match="lower least_life"):
        gaussian_tracks(scene, footage, flow, colours, options=Alone(least_pixels=1e6))


def test_lab_maps_are_otsyncs_histograms():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (8, 12, 3)).repeat(12, 0).repeat(12, 1).astype(np.uint8)
    mask = np.zeros(image.shape[:2], np.uint8)
    mask[8:80, 20:120] = 255
    h, w = mask.shape
    found = LabMaps(sigma=8 * 640 / w)(image, mask)
    assert found.shape == (h, w, 64)
    np.testing.assert_allclose(np.linalg.norm(found[mask > 0], axis=1), 1, atol=1e-5)
    uv = rng.uniform((25, 12), (115, 75), (40, 2))
    frames = WorkingFrames([image], (w, h))
    given = LabHistogram(sigma=8 * 640 / w)(frames, [mask > 0], uv[:, None], 30.0)
    mine = found[uv[:, 1].astype(int), uv[:, 0].astype(int)]
    assert (given * mine).sum(1).min() > 0.97 > 0.9 > (given * mine[::-1]).sum(1).mean()
    assert not LabMaps(sigma=8)(image, mask)[-1, -1].any()


def test_daisy_maps_cover_the_mask_and_move_with_the_image():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (15, 20, 3)).repeat(6, 0).repeat(6, 1).astype(np.uint8)
    mask = np.zeros(image.shape[:2], np.uint8)
    mask[30:60, 30:80] = 200
    found = DaisyMaps(radius=60)(image, mask)
    assert found.shape == (*mask.shape, 64) and found[mask > 0].any(1).all() and not found[mask == 0].any()
    moved = DaisyMaps(radius=60)(np.roll(image, 5, 1), np.roll(mask, 5, 1))
    np.testing.assert_allclose(moved[:, 5:], found[:, :-5], atol=1e-3)
    assert np.isfinite(DaisyMaps()(np.full_like(image, 90), mask)).all()
    assert not DaisyMaps()(image, np.zeros_like(mask)).any()


@pytest.mark.slow
def test_the_lifting_suite_writes_its_table(tmp_path, capsys):
    world = tmp_path / "world"
    write_capture(synthetic(5, cameras=3, held_out=0, frames=FRAMES, size=(96, 64), offsets=[0, 0, 0]), world)
    args = [
        "lifting",
        str(world),
        "--width",
        "96",
        "--out",
        str(tmp_path),
        "--cameras",
        "2",
        "--steps",
        "2",
        "--repeats",
        "1",
    ]
    assert main(args) == 0
    found = json.loads((tmp_path / "lifting.json").read_text())
    rows = found["rows"]
    assert (
        len(rows) == 1 + 5 * 6
        and rows[0]["all"] == 1
        and {r["tracks"] for r in rows[1:]} >= {"Gaussians, DAISY lifted"}
    )
    assert all(0 <= r["all"] <= 1 for r in rows) and found["cost"]["channels"] == 64 and found["cost"]["lift_ms"] > 0
    assert "Precision within" in capsys.readouterr().out
    other = tmp_path / "other"
    write_capture(synthetic(5, cameras=2, held_out=0, frames=4, size=(40, 24), offsets=[0, 0.5]), other)
    with pytest.raises(ValueError, match="truly synchronised"):
        measure_lifting(open_scene(other), Offsets.load(other / "truth.json"), tmp_path, lifting=Lifting())


def test_tracks_of_a_rolling_shutter_are_at_the_frames_times_and_say_so(capture, scene):
    footage, flow, _ = inputs(capture)
    tracks = gaussian_tracks(scene, replace(footage, readout=0.02), flow, colours)
    assert at_frame_times(tracks) is tracks
    np.testing.assert_array_equal(tracks.xyz, gaussian_tracks(scene, footage, flow, colours).xyz)
    plain, rolled = (
        fit_alone(replace(footage, readout=r), flow, capture.depth[0].__getitem__, options=Alone(steps=2))
        for r in (None, 0.02)
    )
    assert not np.array_equal(plain.dynamic.means.numpy(), rolled.dynamic.means.numpy())
