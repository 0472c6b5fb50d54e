"""Scaffolds from tracks: what they follow, what they refuse, and worlds that are hardly any."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from otsync.types import TrackSet
from recon.motion import ScaffoldOptions, build_scaffold
from recon.motion.solve import FRAME
from recon.rotations import rotation_matrices, unit
from tests.recon.motion.worlds import FOOTPRINT, Bodies, filmed, random_rotation

UNITS = {"footprint": FOOTPRINT, "frame_step": FRAME}


@pytest.fixture(scope="module")
def world():
    return filmed()


@pytest.fixture(scope="module")
def scaffold(world):
    return build_scaffold(*world, **UNITS)


def followed(scaffold, bodies, times, **where):
    """Errors [n,T] of points of the bodies, bound at the first of `times`."""
    places = bodies.over(times)
    bound = scaffold.bind(places[:, 0], times[0], **where)
    means = torch.from_numpy(places[:, 0]).float()
    upright = torch.tensor([1.0, 0, 0, 0]).repeat(len(means), 1)
    carried = np.stack([bound.warp(means, upright, t)[0].numpy() for t in times], 1)
    return np.linalg.norm(carried - places, axis=2)


def test_points_that_no_track_saw_are_followed(scaffold):
    """The measure of the study: 1.8, 2.7 and 3.1 cm after 10, 20 and 30 frames of tracks that drift by 3 to 5."""
    errors = followed(scaffold, Bodies(400, seed=77), np.array([0.05, 0.38, 0.72, 1.05]))
    assert errors[:, 0].max() < 1e-5
    medians = np.median(errors, axis=0)
    assert medians[1] < 0.010 and medians[2] < 0.013 and medians[3] < 0.016
    still = Bodies(400, seed=77).over(np.array([0.05, 0.38, 0.72, 1.05]))
    assert np.median(np.linalg.norm(still - still[:, :1], axis=2)[:, 3]) > 0.3


def test_orientations_turn_with_the_bodies(scaffold):
    """Both bodies turn by 1.2 radians a second about y."""
    a, b = (rotation_matrices(scaffold.nodes(t)[1]).numpy() for t in (0.2, 0.9))
    turn = b @ a.transpose(0, 2, 1)
    angle = np.arctan2(turn[:, 0, 2], turn[:, 0, 0])
    assert np.median(np.abs(angle - 1.2 * 0.7)) < 0.1


@pytest.mark.parametrize("spline", ["b-spline", "hermite"])
def test_nodes_of_a_bar_that_swings_turn_with_it(spline):
    """To and fro at 1.2 Hz; knots of a B-spline are no poses: taken for such they are .17 radians off."""
    t = np.arange(75) / 30
    at = np.random.default_rng(3).uniform(-1, 1, (120, 3)) * [0.1, 0.6, 0.1]

    def angles(t):
        return 0.8 * np.sin(2 * np.pi * 1.2 * t)

    c, s = np.cos(angles(t)), np.sin(angles(t))
    xyz = np.stack(
        [at[:, :1] * c - at[:, 1:2] * s, at[:, :1] * s + at[:, 1:2] * c, np.repeat(at[:, 2:], len(t), 1)], -1
    )
    found = build_scaffold([tracks_of(xyz)], np.zeros(1), options=ScaffoldOptions(spline=spline), **UNITS)
    times = np.linspace(0.4, 2.0, 97)
    R = rotation_matrices(found.nodes(torch.from_numpy(times))[1]).numpy()
    R = R @ R[:1].transpose(0, 1, 3, 2)
    turned = np.arctan2(R[..., 1, 0], R[..., 0, 0]) - (angles(times) - angles(times[:1]))[:, None]
    assert np.median(np.abs(turned), 1).max() < 0.03


def test_sizes_and_shapes(scaffold, world):
    P, M = scaffold.path.count, len(scaffold)
    assert int(np.ceil((36 + 8) / (8 / 3))) + 1 == P and 60 < M < 400
    assert scaffold.knots.dtype == scaffold.knot_quats.dtype == torch.float32
    assert scaffold.edges.shape == scaffold.edge_weights.shape == (M, 10)
    assert 2 * FOOTPRINT <= scaffold.unit < 7.5 * FOOTPRINT  # small bodies: closer nodes, so that limbs have some
    assert (scaffold.edges != torch.arange(M)[:, None])[scaffold.edge_weights > 0].all()
    # neighbouring quaternions lie in one hemisphere: that is what a spline through them needs
    q = unit(scaffold.knot_quats)
    assert ((q[1:] * q[:-1]).sum(-1) > 0).all()
    # two bodies a metre or two apart share no edge
    side = np.sign(scaffold.path.at(scaffold.knots, 0.5)[:, 0].numpy())
    ends = side[scaffold.edges.numpy()]
    assert (ends == side[:, None])[scaffold.edge_weights.numpy() > 0].mean() > 0.99


def test_the_same_world_gives_the_same_scaffold(scaffold, world):
    again = build_scaffold(*world, **UNITS)
    assert torch.equal(scaffold.knots, again.knots) and torch.equal(scaffold.knot_quats, again.knot_quats)
    assert torch.equal(scaffold.edges, again.edges)


def test_other_units_and_another_frame_give_the_same_scaffold(scaffold, world):
    """A law of the whole fit: millimetres instead of metres, a world turned and far from its origin."""
    R, shift = random_rotation(5), np.array([30.0, -20.0, 10.0])
    sets, offsets = filmed(scale=64.0)
    scaled = build_scaffold(sets, offsets, footprint=64 * FOOTPRINT, frame_step=FRAME)
    assert len(scaled) == len(scaffold) and torch.allclose(scaled.knots / 64, scaffold.knots, atol=1e-4)
    assert torch.allclose(scaled.knot_quats, scaffold.knot_quats, atol=1e-4)
    assert scaled.unit == pytest.approx(64 * scaffold.unit)
    sets, _ = filmed(rigid=(R, shift))
    turned = build_scaffold(sets, offsets, **UNITS)
    assert len(turned) == len(scaffold)
    moved = scaffold.knots.double() @ torch.from_numpy(R).T + torch.from_numpy(shift)
    assert (turned.knots - moved).norm(dim=-1).quantile(0.99) < 1e-3
    # rotations are relative to the middle knot, in world axes: they are conjugated
    a, b = (rotation_matrices(unit(s.knot_quats)).numpy() for s in (scaffold, turned))
    away = np.abs(b - R @ a @ R.T).max((0, 2, 3))
    assert np.quantile(away, 0.95) < 1e-2


def test_a_common_shift_of_the_offsets_shifts_the_scaffold_in_time(scaffold, world):
    sets, offsets = world
    later = build_scaffold(sets, offsets + 5.0, **UNITS)
    assert later.path.start == pytest.approx(scaffold.path.start + 5)
    assert torch.allclose(later.nodes(5.4)[0], scaffold.nodes(0.4)[0], atol=1e-4)


def test_true_offsets_leave_the_smallest_residual():
    """Offsets enter by the sign of conventions.md: a positive one means a later start."""
    offsets = np.array([0.0, 0.15, -0.1])
    sets, _ = filmed(offsets=offsets, noise=0.002)
    errors = {}
    for name, believed in (("true", offsets), ("none", 0 * offsets), ("opposite", -offsets)):
        scaffold = build_scaffold(sets, believed, **UNITS)
        errors[name] = np.median(followed(scaffold, Bodies(200, seed=9), np.array([0.3, 0.8]))[:, 1])
    assert 3 * errors["true"] < errors["none"] < errors["opposite"]


def test_rates_and_timestamps_are_heeded():
    """One video at 25 frames a second, one whose clock runs slow, one with irregular timestamps."""
    rng = np.random.default_rng(0)
    rates, offsets, n = np.array([1.0, 1.4, 1.0]), np.array([0.0, 0.05, -0.02]), 34
    clocks = [np.arange(n) / 25, np.arange(n) / 30, np.cumsum(rng.uniform(0.02, 0.05, n))]
    sets = []
    for v, own in enumerate(clocks):
        xyz = Bodies(200, seed=v).over(rates[v] * own + offsets[v])
        given = {"timestamps": own} if v == 2 else {"fps": [25, 30][v]}
        sets.append(TrackSet(xyz, np.ones(xyz.shape[:2], bool), **given))
    scaffold = build_scaffold(sets, offsets, rates=rates, **UNITS)
    assert np.median(followed(scaffold, Bodies(200, seed=9), np.array([0.3, 0.8]))[:, 1]) < 0.012
    wrong = build_scaffold(sets, offsets, **UNITS)
    assert np.median(followed(wrong, Bodies(200, seed=9), np.array([0.3, 0.8]))[:, 1]) > 0.02


def test_one_scaffold_per_video_lives_on_own_clocks():
    offsets = np.array([0.4, 0.0, -0.3])
    sets, _ = filmed(offsets=offsets)
    scaffold = build_scaffold(sets, offsets, options=ScaffoldOptions(per_video=True, fewest=32), **UNITS)
    assert scaffold.clock is not None and set(scaffold.clock.tolist()) == {0, 1, 2}
    same = scaffold.clock[scaffold.edges] == scaffold.clock[:, None]
    assert same[scaffold.edge_weights > 0].all()
    for v in range(3):
        errors = followed(scaffold, Bodies(200, seed=9), np.array([0.5, 0.8]), video=v)
        assert np.median(errors[:, 1]) < 0.02
    # other offsets move the videos' nodes against each other, and the motion of each on its own clock stays
    believed = torch.from_numpy(offsets + np.array([0.0, 0.1, 0.0]))
    before, after = scaffold.nodes(0.6)[0], scaffold.nodes(0.7, believed)[0]
    mine = scaffold.clock == 1
    assert torch.allclose(before[mine], after[mine], atol=1e-5) and not torch.allclose(before[~mine], after[~mine])


def test_the_spacing_adapts_to_the_scene(world):
    sets, offsets = world
    capped = build_scaffold(sets, offsets, options=ScaffoldOptions(fewest=32, most=40), **UNITS)
    assert len(capped) <= 40 and capped.unit > 7.5 * FOOTPRINT
    small = build_scaffold(sets, offsets, footprint=20 * FOOTPRINT, frame_step=FRAME)  # 40 pixels tall
    assert 2 * 20 * FOOTPRINT <= small.unit < 7.5 * 20 * FOOTPRINT
    given = build_scaffold(sets, offsets, options=ScaffoldOptions(unit=15.0), **UNITS)
    assert given.unit == pytest.approx(15 * FOOTPRINT) and len(given) < len(build_scaffold(*world, **UNITS))


def tracks_of(xyz, **fields):
    return TrackSet(np.asarray(xyz, float), np.isfinite(np.asarray(xyz, float)[..., 0]), fps=30, **fields)


def sound(scaffold):
    for value in (scaffold.knots, scaffold.knot_quats, scaffold.edge_weights, scaffold.nodes(0.2)[1]):
        assert value.isfinite().all()
    bound = scaffold.bind(np.zeros((2, 3)), 0.1)
    x, _ = bound.warp(torch.zeros(2, 3), torch.tensor([[1.0, 0, 0, 0]] * 2), 0.3)
    assert x.isfinite().all()


def test_one_track():
    t = np.arange(30) / 30
    scaffold = build_scaffold([tracks_of(np.stack([t, 0 * t, t**2], 1)[None])], np.zeros(1), **UNITS)
    sound(scaffold)
    assert len(scaffold) == 1 and (scaffold.edge_weights == 0).all()
    assert torch.allclose(scaffold.nodes(0.5)[0], torch.tensor([[0.5, 0, 0.25]]), atol=2e-3)
    bound = scaffold.bind(np.array([[0.1, 0.2, 0.0]]), 0.1)
    x, q = bound.warp(torch.tensor([[0.1, 0.2, 0.0]]), torch.tensor([[1.0, 0, 0, 0]]), 0.5)
    assert torch.allclose(x, torch.tensor([[0.5, 0.2, 0.24]]), atol=5e-3) and torch.allclose(q[0, 0], torch.tensor(1.0))


def test_one_sample():
    xyz = np.full((1, 5, 3), np.nan)
    xyz[0, 2] = 1.0
    scaffold = build_scaffold([tracks_of(xyz)], np.zeros(1), **UNITS)
    sound(scaffold)
    assert torch.allclose(scaffold.nodes(0.3)[0], torch.ones(1, 3), atol=1e-5)


def test_tracks_that_are_never_seen_together():
    """Each lives for its own ten frames: none has a neighbour to learn from at first, each goes on by itself."""
    xyz = np.full((4, 40, 3), np.nan)
    for n in range(4):
        xyz[n, 10 * n : 10 * n + 10] = [n, 0, 0] + 0.01 * np.arange(10)[:, None]
    scaffold = build_scaffold([tracks_of(xyz)], np.zeros(1), **UNITS)
    sound(scaffold)
    assert len(scaffold) == 4
    for n in range(4):
        found = scaffold.nodes((10 * n + 5) / 30)[0][:, 0]
        assert (found - (n + 0.05)).abs().min() < 5e-3


def test_more_short_lives_than_nodes(caplog):
    """Tracks of one frame each, none seen with another: no spacing makes them fewer."""
    xyz = np.full((40, 40, 3), np.nan)
    xyz[np.arange(40), np.arange(40)] = np.random.default_rng(0).normal(size=(40, 3))
    with caplog.at_level(logging.WARNING, "recon.motion"):
        scaffold = build_scaffold([tracks_of(xyz)], np.zeros(1), options=ScaffoldOptions(fewest=1, most=10), **UNITS)
    sound(scaffold)
    assert len(scaffold) <= 10 and "never seen together" in caplog.text


def test_nothing_moves():
    place = np.random.default_rng(0).normal(size=(60, 1, 3))
    scaffold = build_scaffold([tracks_of(np.repeat(place, 20, 1))], np.zeros(1), **UNITS)
    sound(scaffold)
    a, b = scaffold.nodes(-0.3), scaffold.nodes(1.5)
    assert torch.allclose(a[0], b[0], atol=1e-4) and torch.allclose(a[1], b[1], atol=1e-3)


def test_all_in_one_point():
    scaffold = build_scaffold([tracks_of(np.zeros((50, 20, 3)))], np.zeros(1), **UNITS)
    sound(scaffold)
    assert len(scaffold) == 1


def test_garbage_where_nothing_is_visible_is_not_read(world, scaffold):
    sets, offsets = world
    filled = []
    for s in sets:
        xyz = s.xyz.copy()
        xyz[~s.visible] = [np.inf, 1e30, np.nan]
        filled.append(TrackSet(xyz, s.visible, fps=30))
    assert torch.equal(build_scaffold(filled, offsets, **UNITS).knots, scaffold.knots)
    xyz = sets[0].xyz.copy()
    xyz[np.nonzero(sets[0].visible)[0][0], np.nonzero(sets[0].visible)[1][0]] = np.nan
    with pytest.raises(ValueError, match=r"tracks\[0\]\.xyz"):
        build_scaffold([TrackSet(xyz, sets[0].visible, fps=30)], np.zeros(1), **UNITS)


def test_a_video_without_tracks_is_no_obstacle(world):
    sets, offsets = world
    none = sets[1].take(slice(0, 0))
    blind = TrackSet(sets[2].xyz, np.zeros(sets[2].visible.shape, bool), fps=30)
    for options in (ScaffoldOptions(), ScaffoldOptions(per_video=True)):
        sound(build_scaffold([sets[0], none, blind], offsets, options=options, **UNITS))
        with pytest.raises(ValueError, match="visible sample"):
            build_scaffold([none, blind], offsets[:2], options=options, **UNITS)


def test_a_wild_track_among_many(world):
    """One that jumps about by a thousand metres takes no one with it."""
    sets, offsets = world
    wild = np.random.default_rng(0).normal(size=(1, sets[0].n_frames, 3)) * 1e3
    xyz = np.concatenate([sets[0].xyz, wild])
    visible = np.concatenate([sets[0].visible, np.ones(wild.shape[:2], bool)])
    scaffold = build_scaffold([TrackSet(xyz, visible, fps=30), *sets[1:]], offsets, **UNITS)
    sound(scaffold)
    assert np.median(followed(scaffold, Bodies(200, seed=9), np.array([0.3, 0.8]))[:, 1]) < 0.02


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"offsets": np.array([0.0, 1e6, 0.0])}, "offsets"),
        ({"offsets": np.array([0.0, 1e300, 0.0])}, "offsets"),
        ({"offsets": np.array([0.0, np.nan, 0.0])}, "offsets"),
        ({"offsets": np.zeros(2)}, "offsets"),
        ({"rates": np.array([1.0, 0.0, 1.0])}, "rates"),
        ({"footprint": 0.0}, "footprint"),
        ({"footprint": float("nan")}, "footprint"),
        ({"frame_step": -1.0}, "frame_step"),
        ({"tracks": []}, "tracks"),
    ],
)
@pytest.mark.parametrize("per_video", [False, True])
def test_bad_input_is_named(world, change, name, per_video):
    sets, offsets = world
    given = {"tracks": sets, "offsets": offsets, "options": ScaffoldOptions(per_video=per_video), **UNITS} | change
    with pytest.raises(ValueError, match=name):
        build_scaffold(**given)


def test_tracks_in_pixels_or_in_two_worlds_are_refused(world):
    sets, offsets = world
    flat = TrackSet(None, uv=np.zeros((3, 36, 2)), fps=30)
    with pytest.raises(ValueError, match="Lift"):
        build_scaffold([sets[0], flat], offsets[:2], **UNITS)
    here, there = (TrackSet(sets[0].xyz, sets[0].visible, fps=30, frame=f) for f in ("here", "there"))
    with pytest.raises(ValueError, match="frame"):
        build_scaffold([here, there], offsets[:2], **UNITS)


def test_videos_far_apart_in_time_are_bridged_with_a_warning(world, caplog):
    sets, _ = world
    with caplog.at_level(logging.WARNING, "recon.motion"):
        sound(build_scaffold([s.take(slice(0, 40)) for s in sets[:2]], np.array([0.0, 4.0]), **UNITS))
    assert "show no track" in caplog.text


@pytest.mark.parametrize("field", ["unit", "second_pick", "spacing", "margin", "neighbours", "spline", "blend"])
def test_options_are_checked(field):
    with pytest.raises(ValueError, match=field):
        ScaffoldOptions(**{field: -1})


@pytest.mark.slow
def test_many_long_tracks_take_seconds():
    """6000 tracks over 150 frames: 61 knots."""
    sets, offsets = filmed(videos=10, tracks=600, frames=150, life=50)
    scaffold = build_scaffold(sets, offsets, **UNITS)
    assert 60 <= scaffold.path.count <= 62 and 200 < len(scaffold) <= 900
    truth = Bodies(500, seed=9).over(np.array([2.0, 2.7]))
    errors = followed(scaffold, Bodies(500, seed=9), np.array([2.0, 2.7]))
    assert np.median(errors[:, 1]) < 0.02 < np.median(np.linalg.norm(truth[:, 1] - truth[:, 0], axis=1))
    near = cKDTree(scaffold.nodes(2.0)[0].numpy()).query(truth[:, 0])[0]
    assert np.quantile(near, 0.95) < 2 * scaffold.unit
