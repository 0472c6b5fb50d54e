"""Seeds lie on the surfaces that the depth maps show, once each."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from otsync.types import Offsets
from recon.motion import ScaffoldOptions, build_scaffold
from recon.scene.seed import Seeding, cloud_at, moments, seed, thinned
from recon.simulate.capture import synthetic


@pytest.fixture(scope="module")
def capture():
    return synthetic(5, cameras=3, held_out=0, frames=12, size=(80, 48), offsets=[0, 0, 0])


def known(capture):
    return Offsets.known([f.name for f in capture.footage], capture.offsets, 30)


def maps(capture):
    return [stack.__getitem__ for stack in capture.depth]


def planted(capture, **options):
    footprint = 2.6 / capture.footage[0].K[0, 0]
    scaffold = build_scaffold(
        capture.tracks, capture.offsets, footprint=footprint, frame_step=1 / 30, options=options.pop("scaffold", None)
    )
    return seed(
        scaffold,
        capture.footage,
        known(capture),
        options.pop("depth", maps(capture)),
        footprint=footprint,
        frame_step=1 / 30,
        span=(0.0, 11 / 30),
        **options,
    )


def test_moments_begin_in_the_middle_and_reach_both_ends():
    t = moments((0.0, 47 / 30), 1 / 30) * 30
    assert t[0] == pytest.approx(24, abs=0.51) and set(np.round(t)) >= {0, 47}
    assert np.diff(np.sort(t)).max() <= 8 + 1e-6 and len(set(np.round(t, 6))) == len(t)
    assert moments((1.0, 1.0), 1 / 30).tolist() == [1.0]


def test_clouds_lie_on_the_surface(capture):
    points, colors = cloud_at(capture.footage, maps(capture), known(capture), 5 / 30, 1 / 30)
    true = capture.world.positions([5 / 30])[:, 0]
    assert np.median(cKDTree(true).query(points)[0]) < 0.05  # the true points stand 4 cm apart
    assert len(points) == len(colors) > 300 and colors.min() >= 0 and colors.max() <= 1


def test_gains_are_taken_out_of_the_colours(capture):
    gains = np.array([[0.5, 1, 1]] * 3)
    plain = cloud_at(capture.footage, maps(capture), known(capture), 0.1, 1 / 30)[1]
    told = cloud_at(capture.footage, maps(capture), known(capture), 0.1, 1 / 30, gains)[1]
    assert told[:, 0] == pytest.approx(np.minimum(2 * plain[:, 0], 1)) and np.array_equal(told[:, 1:], plain[:, 1:])


def test_frames_that_are_too_far_away_say_nothing(capture):
    assert len(cloud_at(capture.footage, maps(capture), known(capture), 3.0, 1 / 30)[0]) == 0


def test_thinning_keeps_means_and_needs_support():
    points = np.array([[0.1, 0, 0], [0.3, 0, 0], [5.0, 5, 5], [-0.1, 0, 0], [-0.2, 0, 0]])
    at, color = thinned(points, points / 10, 1.0, 2)
    assert sorted(at[:, 0].tolist()) == pytest.approx([-0.15, 0.2]) and len(color) == 2


def test_a_thick_shell_is_thinned_to_its_middle():
    rng = np.random.default_rng(1)
    flat = np.stack([*rng.uniform(0, 20, (2, 60_000)), rng.normal(0, 1.5, 60_000)], 1)  # a surface, seen unsurely
    edge = np.stack([*rng.uniform(30, 40, (2, 900)), np.full(900, 0.5)], 1)  # another one, which few pixels show
    points = np.concatenate([flat, edge])
    thick, _ = thinned(points, points, 1.0, 2)
    thin, _ = thinned(points, points, 1.0, 2, 0.25)
    thick_by, thin_by = (np.percentile(np.abs(found[:, 2]), 90) for found in (thick, thin))
    assert thick_by > 3 > thin_by > 1.5
    assert len(thin) < 0.7 * len(thick)

    def at_edge(found):
        return (found[:, 0] > 29).sum()

    assert at_edge(thin) > 0.97 * at_edge(thick) > 90  # only what stands beside something fuller is left out
    assert thinned(points[:0], points[:0], 1.0, 2, 0.25)[0].shape == (0, 3)


def test_later_moments_add_only_what_is_new(capture):
    whole = planted(capture)
    count = np.bincount(whole.motion.binding.rest.numpy())
    assert count[0] > count[1:].max() and len(whole) == count.sum()
    # at the moment they were seeded at, Gaussians stand where the depth saw them
    times = whole.motion.binding.times.numpy()
    for r, t in enumerate(times):
        here = whole.tracks([t])[whole.motion.binding.rest.numpy() == r, 0]
        assert np.median(cKDTree(capture.world.positions([t])[:, 0]).query(here)[0]) < 0.05


def test_a_scaffold_per_video_carries_what_its_video_saw(capture):
    whole = planted(capture, scaffold=ScaffoldOptions(per_video=True))
    motion = whole.motion
    clock = motion.clock.numpy()[motion.binding.nodes.numpy()]
    assert (clock == clock[:, :1]).all()  # a Gaussian's nodes live on one clock
    assert len(set(clock[:, 0])) == 3 and np.bincount(clock[:, 0]).min() > 20
    alone = planted(
        capture, scaffold=ScaffoldOptions(per_video=True), depth=[lambda k: None, capture.depth[1], lambda k: None]
    ).motion
    assert set(alone.clock.numpy()[alone.binding.nodes.numpy()].ravel()) == {1}
    t = float(motion.binding.times[0])
    here = whole.tracks([t])[motion.binding.rest.numpy() == 0, 0]
    assert np.median(cKDTree(capture.world.positions([t])[:, 0]).query(here)[0]) < 0.05


def test_depth_may_be_arrays_of_any_size(capture):
    arrays = planted(capture, depth=list(capture.depth))
    assert torch.equal(arrays.dynamic.means, planted(capture).dynamic.means)
    double = [np.repeat(np.repeat(z, 2, 1), 2, 2) for z in capture.depth]
    assert torch.equal(arrays.dynamic.means, planted(capture, depth=double).dynamic.means)


def test_a_video_without_depth_is_named(capture):
    with pytest.raises(ValueError, match="depth of 'cam1': expected depth maps"):
        planted(capture, depth=[capture.depth[0], None, capture.depth[2]])


def test_one_camera_plants_what_it_sees(capture):
    footprint = 2.6 / capture.footage[0].K[0, 0]
    scaffold = build_scaffold(capture.tracks[:1], capture.offsets[:1], footprint=footprint, frame_step=1 / 30)
    one = seed(
        scaffold,
        capture.footage[:1],
        known(capture),
        list(capture.depth[:1]),
        footprint=footprint,
        frame_step=1 / 30,
        span=(0.0, 11 / 30),
    )
    assert 50 < len(one) < len(planted(capture))


def test_nothing_that_moves_is_a_clear_error(capture):
    still = [replace(f, masks=np.zeros_like(f.masks)) for f in capture.footage]
    with pytest.raises(ValueError, match="expected depth where something moves"):
        planted(replace(capture, footage=tuple(still)))


def test_a_finer_voxel_plants_more(capture):
    assert len(planted(capture, options=Seeding(voxel=2.0))) > 1.3 * len(planted(capture, options=Seeding(voxel=3.5)))


def test_no_depth_is_a_clear_error(capture):
    with pytest.raises(ValueError, match="expected depth where something moves"):
        planted(capture, depth=[lambda k: None] * 3)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"voxel": 0}, "voxel: expected a finite number above 0; found 0"),
        ({"voxel": math.inf}, "voxel: expected a finite number above 0; found inf"),
        ({"reach": math.nan}, "reach: expected a finite number above 0; found nan"),
        ({"scale": "1"}, "scale: expected a finite number above 0; found '1'"),
        ({"support": 0}, "support: expected a whole number, 1 or more; found 0"),
        ({"support": 1.5}, "support: expected a whole number, 1 or more; found 1.5"),
        ({"opacity": 1}, "opacity: expected a number between 0 and 1; found 1"),
        ({"sh_degree": 5}, "sh_degree: expected a whole number, 0 to 4; found 5"),
        ({"sh_degree": True}, "sh_degree: expected a whole number, 0 to 4; found True"),
        ({"sh_degree": 1.0}, "sh_degree: expected a whole number, 0 to 4; found 1.0"),
    ],
)
def test_options_that_make_no_sense_are_refused_by_name(options, says):
    with pytest.raises(ValueError, match=f"^{says}"):
        Seeding(**options)
    assert Seeding(voxel=np.float32(2.0), sh_degree=np.int64(4)).sh_degree == 4


def test_room_for_colours_that_depend_on_the_view(capture):
    plain, shiny = planted(capture), planted(capture, options=Seeding(sh_degree=2))
    assert shiny.dynamic.sh.shape == (len(plain), 9, 3) and plain.dynamic.sh_degree == 0
    assert torch.equal(shiny.dynamic.sh[:, :1], plain.dynamic.sh) and not shiny.dynamic.sh[:, 1:].any()
