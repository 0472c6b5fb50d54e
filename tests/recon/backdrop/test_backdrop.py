"""The static part: where seeds are put, what a fit of them shows from new places, and what it says when it cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from otsync.compute.threads import get_threads
from recon.backdrop.colours import Compared, first_gains
from recon.backdrop.fit import RATES, backdrop_of, colour_gain, fit_backdrop, unchanging, with_backdrop
from recon.backdrop.seeds import facing, fillers, normals_of_depth, seed_discs, surface_of, underlay
from recon.backdrop.stills import stills_of
from recon.backdrop.surroundings import (
    Floor,
    Lookup,
    Shell,
    common_focus,
    disagreement,
    find_floor,
    surroundings,
    up_axis,
)
from recon.evaluate.figures import psnr
from recon.raster import set_threads
from recon.simulate.capture import synthetic
from recon.simulate.effects import Exposure


@pytest.fixture(scope="module")
def capture():
    return synthetic(0, frames=8, size=(128, 76), offsets=0, effects=(Exposure(),))


@pytest.fixture(scope="module")
def fitted(capture):
    return fit_backdrop(capture.footage, depth=capture.depth, steps=250, progress=False)


@pytest.fixture(scope="module")
def small():
    return synthetic(1, cameras=3, held_out=0, frames=4, size=(64, 40), offsets=0)


def short(capture, **options):
    return fit_backdrop(capture.footage, depth=capture.depth, progress=False, **{"steps": 12, **options})


def discs(stills, around, near=0.6):
    return seed_discs(stills, [surface_of(s, around, near) for s in stills], around, near)


def tensors(fit):
    g = fit.gaussians
    return (g.means, g.quats, g.log_scales, g.opacity_logits, g.sh, torch.as_tensor(fit.gains))


# ---- geometry


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_rays_meet_floor_and_shell(seed):
    rng = np.random.default_rng(seed)
    center, radius = rng.normal(size=3), rng.uniform(1, 5)
    origin = center + 0.5 * radius * rng.uniform(-1, 1, (20, 3)) / 3**0.5
    rays = rng.normal(size=(20, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    shell = Shell(center, radius)
    at = origin + shell.hit(origin, rays)[:, None] * rays
    assert np.linalg.norm(at - center, axis=1) == pytest.approx(radius)
    assert (shell.normals(at) * (center - at)).sum(1) == pytest.approx(radius)
    normal = rng.normal(size=3)
    floor = Floor(normal / np.linalg.norm(normal), float(center @ normal / np.linalg.norm(normal) - radius))
    away = floor.hit(origin, rays)
    falls = rays @ floor.normal < 0
    assert np.isinf(away[~falls]).all()
    at = origin[falls] + away[falls, None] * rays[falls]
    assert at @ floor.normal == pytest.approx(floor.height)


def test_rays_from_outside_may_miss_the_shell():
    shell = Shell(np.zeros(3), 1.0)
    origin, rays = np.array([[0, 0, -5.0], [0, 0, -5]]), np.array([[0, 0, 1.0], [0, 1, 0]])
    assert shell.hit(origin, rays).tolist() == [6.0, np.inf]


def test_what_is_up_and_where_cameras_look(capture):
    stills = stills_of(capture.footage)
    assert up_axis(np.stack([s.w2c for s in stills])) @ [0, 0, 1] > np.cos(np.radians(0.5))  # these cameras do not roll
    focus, distance = common_focus(stills)
    assert focus == pytest.approx([0, 0, 0.7], abs=0.01)
    assert distance == pytest.approx(np.median([np.linalg.norm(s.center - focus) for s in stills]))
    alone = common_focus(stills[:1], np.array([[0.1, 0, 0], [0.3, 0, 0], [0.2, 0, 0]]))
    assert alone[0] == pytest.approx([0.2, 0, 0])
    with pytest.raises(ValueError, match="points: expected some of the scene"):
        common_focus(stills[:1])
    assert 1 < common_focus(stills_of(capture.footage, capture.depth)[:1])[1] < 8  # depth tells as well


def test_parallel_cameras_ask_for_points(small):
    stills = stills_of(small.footage)
    w2c = stills[0].w2c
    row = [replace(s, w2c=w2c + np.eye(4)[:, [3]] * np.array([0, 0, 0, 0.0])) for s in stills]
    for k, still in enumerate(row):
        still.w2c[0, 3] += 0.3 * k
    with pytest.raises(ValueError, match="do not look at one place"):
        common_focus(row)


@pytest.mark.parametrize("with_points", [False, True])
def test_the_floor_is_found_however_the_world_is_turned(capture, with_points):
    """The height and the tilt of the floor, to a footprint or so, in units and axes of any kind."""
    turn, scale, shift = Rotation.from_rotvec([0.4, -2.0, 1.0]).as_matrix(), 250.0, np.array([3.0, -70, 11])
    points = capture.world.positions([0.0, 0.2])[:, 0]
    moved = []
    for s in stills_of(capture.footage):
        w2c = np.eye(4)
        w2c[:3, :3] = s.w2c[:3, :3] @ turn.T
        w2c[:3, 3] = scale * s.w2c[:3, 3] - w2c[:3, :3] @ shift
        moved.append(replace(s, w2c=w2c))
    around = surroundings(moved, scale * points @ turn.T + shift if with_points else None)
    plain = surroundings(stills_of(capture.footage), points if with_points else None)
    assert around.floor is not None and plain.floor is not None
    assert plain.floor.normal @ [0, 0, 1] > np.cos(np.radians(2)) and abs(plain.floor.height) < 0.08
    assert around.floor.normal == pytest.approx(turn @ plain.floor.normal, abs=1e-3)
    assert around.floor.height == pytest.approx(scale * plain.floor.height + around.floor.normal @ shift, abs=0.3)
    assert around.shell.radius == pytest.approx(scale * plain.shell.radius, rel=1e-3)
    assert plain.shell.radius == pytest.approx(3.2, rel=0.15)  # the room's wall is upright, the shell is round


@pytest.mark.parametrize("tilt", [(0.03, 0, 0), (0, -0.03, 0)])
def test_a_floor_tilts_to_where_cameras_agree(capture, tilt):
    up = Rotation.from_rotvec(tilt).apply([0, 0, 1])
    views = [Lookup.of(s) for s in stills_of(capture.footage)]
    floor = find_floor(views, up, np.array([0, 0, 0.7]), 2.7)
    assert floor is not None and np.linalg.norm(floor.normal - [0, 0, 1]) < 0.02  # .03 at first


def test_cameras_agree_about_true_surfaces_only(capture):
    views = [Lookup.of(s) for s in stills_of(capture.footage)]
    grid = np.stack([*np.meshgrid(*[np.linspace(-1.2, 1.2, 30)] * 2), np.zeros((30, 30))], -1).reshape(-1, 3)
    true, wrong = disagreement(views, grid), disagreement(views, grid + np.array([0, 0, 0.4]))
    assert true < 0.4 and wrong > true + 0.2
    assert disagreement(views, grid + np.array([0, 0, 50])) == 1.0  # nobody sees that
    assert disagreement(views[:1], grid) == 1.0


def test_without_a_floor_none_is_made_up(capture):
    noise = np.random.default_rng(0)
    views = [
        replace(Lookup.of(s), colors=noise.normal(size=Lookup.of(s).colors.shape)) for s in stills_of(capture.footage)
    ]
    assert find_floor(views, np.array([0, 0, 1.0]), np.array([0, 0, 0.7]), 2.7) is None


# ---- seeds


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_discs_face_their_normals(seed):
    normals = np.random.default_rng(seed).normal(size=(8, 3))
    normals[0] = 0, 0, -1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turned = Rotation.from_quat(facing(normals)[:, [1, 2, 3, 0]]).apply([0, 0, 1])
    assert turned == pytest.approx(normals, abs=1e-6)


def test_seeds_stand_on_the_surfaces_that_depth_shows(capture):
    stills = stills_of(capture.footage, capture.depth)
    around = surroundings(stills)
    fine = discs(stills, around)
    at = fine.at[fine.measured & (fine.opacity < 0.9)]
    floor, wall = np.abs(at[:, 2]), np.abs(np.hypot(at[:, 0], at[:, 1]) - 3.2)
    assert np.percentile(np.minimum(floor, wall), 90) < 0.09
    inner = fine.measured & (np.hypot(fine.at[:, 0], fine.at[:, 1]) < 2.5) & (fine.opacity < 0.9)
    assert np.median(fine.normal[inner][:, 2]) > 0.98  # the floor's discs lie flat
    for s in stills:  # nothing before the near plane of the camera that shows it, and colours of the pictures
        assert fine.color.min() >= 0 and fine.color.max() <= 1
        assert s.depth is not None and (s.depth[s.where] > 0).mean() > 0.9
    with pytest.raises(ValueError, match="background beyond the near plane"):
        discs(stills, around, 100.0)


def test_coarse_discs_lie_behind_and_only_where_depth_was_given(capture):
    stills = stills_of(capture.footage, capture.depth)
    fine = discs(stills, surroundings(stills))
    fine = type(fine)(**{k: v[fine.opacity < 0.9] for k, v in vars(fine).items()})
    below = underlay(fine)
    assert 0.01 < len(below.at) / len(fine.at) < 0.2
    assert np.median(below.at[np.hypot(below.at[:, 0], below.at[:, 1]) < 2, 2]) < np.median(
        fine.at[np.hypot(fine.at[:, 0], fine.at[:, 1]) < 2, 2]
    )
    guessed = replace(fine, measured=np.zeros(len(fine.at), bool))
    assert len(underlay(guessed).at) == 0


def test_fillers_are_where_nothing_else_is(capture):
    stills = stills_of(capture.footage, capture.depth)
    around = surroundings(stills)
    fine = discs(stills, around)
    more = fillers(fine, around)
    apart = np.linalg.norm(more.at[:, None] - fine.at[None, ::7], axis=-1).min(1)
    assert len(more.at) == 0 or (apart > 0.1).all()  # seed_discs has put them already
    half = type(fine)(**{k: v[fine.at[:, 0] > 0] for k, v in vars(fine).items()})
    assert (fillers(half, around).at[:, 0] < 0.5).all() and len(fillers(half, around).at) > 100


def test_normals_of_a_slanted_plane(capture):
    still = stills_of(capture.footage, capture.depth)[0]
    normal = still.w2c[:3, :3].T @ np.array([0.3, -0.5, -0.8]) / np.linalg.norm([0.3, -0.5, -0.8])
    u, v = np.meshgrid(np.arange(128), np.arange(76))
    rays = still.lift(u.ravel(), v.ravel(), np.ones(u.size)) - still.center
    depth = (-3.0 / (rays @ normal)).reshape(76, 128)  # the plane 3 before the camera along its normal
    plane = replace(still, depth=depth)
    found = normals_of_depth(plane, np.array([20, 60, 100]), np.array([30, 40, 20]))
    assert found == pytest.approx(np.tile(normal, (3, 1)), abs=1e-6)


# ---- fits


def test_a_new_view_shows_the_room(capture, fitted):
    assert (fitted.psnr > 38).all()
    held = capture.held_out[0]
    drawn = backdrop_of(fitted, held)
    gain = colour_gain(drawn, held.background, held.background_seen)
    assert psnr(drawn * gain, held.background, held.background_seen) > 31
    assert drawn.shape == (76, 128, 3) and drawn.dtype == np.float32


def test_gains_of_the_cameras_are_found(capture, fitted):
    true = capture.gains[:5]
    assert fitted.gains / fitted.gains.mean(0) == pytest.approx(true / true.mean(0), abs=0.02)


def test_nothing_is_see_through_between_the_cameras(capture, fitted):
    held = capture.held_out[0].camera
    alpha = fitted.gaussians.render(held, near_plane=fitted.near).alphas
    assert alpha.mean() > 0.98 and (alpha > 0.9).float().mean() > 0.98


def test_first_gains_need_no_fit(capture):
    stills = stills_of(capture.footage, capture.depth)
    around = surroundings(stills)
    points = np.concatenate([surface_of(s, around, 0.6).at for s in stills])
    true = capture.gains[:5]
    found = first_gains(Compared.of(stills, points), 6)
    assert found[:5] / found[:5].mean(0) == pytest.approx(true / true.mean(0), abs=0.04) and (found[5] == 1).all()
    assert (first_gains(Compared.of(stills[:1], points), 1) == 1).all()


def test_what_a_fit_says(capture, fitted):
    assert fitted.near == pytest.approx(0.22 * 2.75, rel=0.05)
    assert fitted.stats["steps"] == 250 and fitted.stats["seeds"] == len(fitted.gaussians)
    assert all(not t.requires_grad and t.isfinite().all() for t in tensors(fitted))


def test_without_depth_floor_and_shell_do(capture):
    found = fit_backdrop(capture.footage, steps=150, progress=False)
    held = capture.held_out[0]
    drawn = backdrop_of(found, held)
    gain = colour_gain(drawn, held.background, held.background_seen)
    assert found.floor is not None and psnr(drawn * gain, held.background, held.background_seen) > 20


def test_the_seed_decides_whatever_the_threads(small):
    before = get_threads()
    try:
        set_threads(1)
        one = short(small)
        set_threads(2)
        two = short(small)
    finally:
        set_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(tensors(one), tensors(two), strict=True))
    assert not torch.equal(short(small, seed=5).gaussians.means, one.gaussians.means)


def test_a_group_without_a_rate_is_frozen(small):
    start = short(small, steps=0)
    held = short(small, rates={k: v for k, v in RATES.items() if k not in ("gains", "means")})
    assert torch.equal(start.gaussians.means, held.gaussians.means) and np.array_equal(start.gains, held.gains)
    assert not torch.equal(start.gaussians.sh, held.gaussians.sh)


def test_a_budget_becomes_steps(small):
    assert short(small, steps=None, budget=0.8).stats["steps"] >= 30


def test_view_dependent_colours_are_fitted_when_asked_for(small):
    found = short(small, sh_degree=1)
    assert found.gaussians.sh.shape[1] == 4 and found.gaussians.sh[:, 1:].abs().max() > 0


def test_a_camera_that_moves_gives_masked_frames(small):
    f = small.footage[1]
    moving = replace(f, w2c=np.tile(f.w2c, (4, 1, 1)), background=None, background_seen=None)
    stills = stills_of([small.footage[0], moving, replace(f, masks=None, background=None)], small.depth)
    assert [s.video for s in stills] == [0, 1, 1, 1, 1]
    assert not (stills[1].where & (f.masks[0] > 128)).any() and stills[1].where.any()
    found = fit_backdrop([small.footage[0], moving, small.footage[2]], depth=small.depth, steps=30, progress=False)
    assert np.isfinite(found.psnr).all()


def test_one_camera_is_fitted_with_depth(small):
    found = fit_backdrop(small.footage[:1], depth=small.depth[:1], steps=60, progress=False)
    assert found.psnr[0] > 28
    with pytest.raises(ValueError, match="points: expected"):
        fit_backdrop(small.footage[:1], steps=1, progress=False)
    points = small.world.positions([0.0])[:, 0]
    assert fit_backdrop(small.footage[:1], points=points, steps=60, progress=False).psnr[0] > 22


def test_videos_without_a_background_take_no_part(small):
    blind = replace(small.footage[1], masks=None, background=None, background_seen=None)
    found = fit_backdrop([small.footage[0], blind, small.footage[2]], depth=small.depth, steps=5, progress=False)
    assert np.isnan(found.psnr).tolist() == [False, True, False] and (found.gains[1] == 1).all()
    with pytest.raises(ValueError, match=r"expected a video whose background shows.*Give masks"):
        fit_backdrop([blind], progress=False)


def test_bad_arguments(small):
    for options, message in (
        ({"rates": {"colour": 1.0}}, "rates: expected some of"),
        ({"steps": 5, "budget": 1.0}, "steps, budget: expected one"),
        ({"steps": None, "budget": 0.0}, "budget: expected a finite number above 0"),
        ({"steps": -1}, "steps: expected a whole number, 0 or more"),
    ):
        with pytest.raises(ValueError, match=message):
            short(small, **options)


def test_a_fit_that_diverges_says_so(small):
    with pytest.raises(FloatingPointError, match="expected a finite loss; found nan"):
        short(small, rates={"gains": 1e30})


# ---- backgrounds for the fit of what moves


def test_unseen_background_is_filled_from_the_fit(capture, fitted):
    f = capture.footage[2]
    seen = f.background_seen.copy()
    seen[20:40, 50:70] = False
    holed = replace(f, background=np.where(seen[..., None], f.background, 0).astype(np.uint8), background_seen=seen)
    filled = with_backdrop(fitted, holed, fitted.gains[2])
    assert np.array_equal(filled.background[seen], f.background[seen]) and filled.background_seen.all()
    where = f.background_seen & ~seen
    assert psnr(filled.background, f.background, where) > 30
    # the gain that nobody told is found
    assert np.abs(with_backdrop(fitted, holed).background[where].astype(int) - filled.background[where]).mean() < 2
    whole = with_backdrop(fitted, f, fitted.gains[2], everywhere=True)
    assert np.array_equal(whole.background, np.rint(255 * backdrop_of(fitted, f, fitted.gains[2])).astype(np.uint8))


def test_a_moving_camera_has_no_cached_background(small, fitted):
    f = small.footage[0]
    with pytest.raises(ValueError, match="expected a fixed camera"):
        with_backdrop(fitted, replace(f, w2c=np.tile(f.w2c, (4, 1, 1))))


def test_a_camera_without_masks_uses_what_never_changes(capture, fitted):
    held = capture.held_out[0]
    blind = replace(held, masks=None, background=None, background_seen=None)
    _, same = unchanging(blind, threshold=30)
    assert not (same & (held.masks > 0).any(0) & ~held.background_seen).all() and 0.2 < same.mean() < 0.9
    own = colour_gain(backdrop_of(fitted, held), held.background, held.background_seen)
    drawn = with_backdrop(fitted, blind)
    assert drawn.background == pytest.approx(255 * backdrop_of(fitted, held, own), abs=8)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 999))
def test_colour_gain_is_the_least_squares_factor(seed):
    rng = np.random.default_rng(seed)
    x, true = rng.uniform(0, 1, (6, 5, 3)), rng.uniform(0.5, 2, 3)
    mask = rng.random((6, 5)) < 0.5
    mask[0, 0] = True
    y = np.where(mask[..., None], x * true, rng.uniform(0, 1, x.shape))
    assert colour_gain(x, y, mask) == pytest.approx(true)
    noisy = y + 0.1 * rng.normal(size=y.shape)
    best = colour_gain(x, noisy, mask)
    for step in (-1e-3, 1e-3):
        assert ((x * best - noisy)[mask] ** 2).sum() <= ((x * (best + step) - noisy)[mask] ** 2).sum()
    with pytest.raises(ValueError, match="mask: expected some pixels"):
        colour_gain(x, y, np.zeros((6, 5)))


@pytest.mark.slow
def test_the_studio_of_the_paper(data):
    """Train cameras to 35 dB (the study: 33.2 with twice as many cameras), the held-out one's static part to 30."""
    from otsync.io import open_scene
    from recon.footage.footage import footage_of

    scene = open_scene(data / "panoptic_basketball")
    footage = [footage_of(v, m) for v, m in zip(scene.videos, scene.masks, strict=True)]
    train, held = [f for f in footage if f.masks is not None], [f for f in footage if f.masks is None]
    found = fit_backdrop(train, progress=False)
    assert found.psnr.mean() > 35
    median, same = unchanging(held[0])
    drawn = backdrop_of(found, held[0])
    assert psnr(drawn * colour_gain(drawn, median, same), median, same) > 30
    assert found.floor is not None and found.floor.normal @ [0, -1, 0] > 0.999 and abs(found.floor.height) < 0.06
