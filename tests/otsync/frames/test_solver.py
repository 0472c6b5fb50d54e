"""Clock and similarity of a pair: laws, exact worlds, and what must be flagged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from otsync.frames import OwnFrames, PoseTrust
from otsync.frames.clouds import clouds, in_units
from otsync.frames.solver import moved
from otsync.frames.weighing import FITTED, Pair
from otsync.simulate import simulate
from otsync.types import Clock, Similarity, Status

SOLVER = OwnFrames()


def world(motion: str = "tennis", preset: str = "mid", seed: int = 3, offset: float = 0.3):
    (a, b), truth = simulate(motion, preset=preset, offsets=[0.0, offset], own_frames=True, seed=seed)
    return a, b, truth


@pytest.fixture(scope="module")
def pair():
    a, b, truth = world()
    return a, b, truth, SOLVER(a, b)


def assert_right(found, truth, offset, frames, degrees, percent):
    T = truth.transform(0, 1)
    assert found.status.ok, found.flags
    assert abs(found.offset - offset) * 30 < frames
    assert found.transform.degrees_from(T) < degrees
    assert abs(found.transform.scale / T.scale - 1) * 100 < percent


def test_a_pair_is_right_and_knows_how_well(pair):
    _, _, truth, (matches, found) = pair
    assert_right(found, truth, 0.3, 0.1, 2.0, 3.0)
    assert len(matches) > 50
    assert 0 < found.transform.rotation_sigma < 3 and 0 < found.sigma * 30 < 0.3


@pytest.mark.parametrize("motion", ["boxes", "basketball"])
def test_clean_worlds_are_found(motion):
    a, b, truth = world(motion, "clean", seed=1, offset=-0.4)
    assert_right(SOLVER(a, b)[1], truth, -0.4, 0.05, 1.0, 1.5)


@pytest.mark.parametrize("which", [0, 1])
def test_no_similarity_of_either_video_changes_the_offset(pair, which):
    a, b, _, (_, found) = pair
    rng = np.random.default_rng(which)
    change = Similarity(3.7, Rotation.from_quat(rng.normal(size=4)).as_matrix(), 50 * rng.normal(size=3))
    _, other = SOLVER(*(moved(t, change, "elsewhere") if which == k else t for k, t in enumerate((a, b))))
    assert other.offset == pytest.approx(found.offset, abs=1e-3 / 30)
    assert other.flags == found.flags
    expected = change.after(found.transform) if which == 0 else found.transform.after(change.inverse())
    assert other.transform.degrees_from(expected) < 0.1
    assert other.transform.scale == pytest.approx(expected.scale, rel=1e-3)
    assert other.transform.rotation_sigma == pytest.approx(found.transform.rotation_sigma, rel=0.05)


def test_exchanging_the_videos_inverts_the_answer(pair):
    a, b, _, (matches, found) = pair
    turned, back = SOLVER(b, a)
    assert back.offset == -found.offset
    assert np.array_equal(turned.pairs, matches.pairs[:, ::-1])
    np.testing.assert_allclose(back.transform.after(found.transform).R, np.eye(3), atol=1e-12)
    assert back.flags == found.flags


def test_the_same_answer_twice(pair):
    a, b, _, (_, found) = pair
    assert SOLVER(a, b)[1].offset == found.offset


def test_a_start_from_elsewhere_ends_at_the_same_place(pair):
    a, b, _, (_, found) = pair
    x = a.positions().reshape(-1, 3)
    middle = np.mean(x[np.isfinite(x[:, 0])], 0)
    turn = Similarity(1.05, Rotation.from_rotvec([0.15, -0.1, 0.1]).as_matrix(), np.zeros(3))
    there, back = (Similarity(1.0, np.eye(3), sign * middle) for sign in (1, -1))
    near = there.after(turn).after(back).after(found.transform)
    _, again = SOLVER(a, b, (Clock(found.offset + 4 / 30), near))
    assert abs(again.offset - found.offset) * 30 < 0.05
    assert again.transform.degrees_from(found.transform) < 0.5


@pytest.mark.parametrize("seed", [11, 12])
def test_mirrored_videos_are_flagged(seed):
    a, b, _ = world("softball", seed=seed)
    assert SOLVER(a, replace(b, xyz=b.xyz * [1, 1, -1]))[1].flags


@pytest.mark.parametrize("seed", [11, 12])
def test_unrelated_videos_are_flagged(seed):
    a, _, _ = world("boxes", seed=seed)
    _, b, _ = world("tennis", seed=seed + 50)
    assert SOLVER(a, b)[1].flags


def test_scenes_where_nothing_moves_are_flagged():
    a, b, _ = world("static", seed=0)
    assert SOLVER(a, b)[1].flags


def test_tracks_on_a_line_leave_the_pose_loose():
    """One thing on a straight way: the turn about the way is open, whatever the offset."""
    t = np.arange(120) / 30
    way = (np.sin(2.1 * t) + 0.5 * np.sin(5.3 * t + 1))[None, :, None] * np.array([1.0, 0, 0])
    start = np.linspace(0, 2, 40)[:, None, None] * np.array([1.0, 0, 0])
    rng = np.random.default_rng(0)
    a, b, _ = world()
    x = start + way
    tracks = [
        replace(
            v,
            xyz=x + 0.01 * rng.normal(size=x.shape),
            visible=np.ones(x.shape[:2], bool),
            features=rng.normal(size=(40, 8)) * 0.1 + np.eye(40, 8),
            uv=None,
            camera=None,
            timestamps=None,
            frame=name,
        )
        for v, name in ((a, "a"), (b, "b"))
    ]
    assert SOLVER(*tracks)[1].flags


@pytest.mark.parametrize("n", [1, 3])
def test_too_few_tracks_are_flagged(n, pair):
    a, b, _, _ = pair
    matches, found = SOLVER(a.take(slice(0, n)), b)
    assert Status.FEW_MATCHES in found.flags and np.isnan(found.offset) and len(matches) == 0


@pytest.mark.parametrize("bad", [{"best": 0}, {"near": -1.0}, {"seed": -1}, {"max_lag": -2.0}, {"draws": 0}])
def test_unsound_options_are_refused(bad):
    with pytest.raises(ValueError, match=f"OwnFrames.{next(iter(bad))}"):
        OwnFrames(**bad)


def test_what_is_not_known_as_well_as_needed_is_flagged():
    a, b, _ = world()
    _, found = SOLVER(a, b)
    for need in ({"seconds": found.sigma}, {"degrees": found.transform.rotation_sigma}, {"scale": 1e-4}):
        _, again = OwnFrames(trust=PoseTrust.within(**need))(a, b)
        assert again.offset == found.offset
        assert again.flags == ((Status.COARSE,) if "seconds" in need else (Status.LOOSE_POSE,))
    roomy = PoseTrust.within(seconds=3 * found.sigma, degrees=3 * found.transform.rotation_sigma)
    assert OwnFrames(trust=roomy)(a, b)[1].flags == ()
    assert roomy.scale == PoseTrust().scale
    with pytest.raises(ValueError, match=r"within, degrees: expected a number > 0"):
        PoseTrust.within(degrees=0)


def test_candidates_that_are_not_fitted_change_nothing():
    """What is left out of many candidates is what few tracks agree with."""
    a, b, truth = world()
    pair = Pair.of(*clouds(a, b, 300))
    right = (0.0, 0.3, in_units(truth.transform(0, 1), pair.a, pair.b))
    wrong = [(0.0, 0.3 + 0.1 * k, right[2]) for k in range(3, 3 + 2 * FITTED)]
    assert pair.weigh_all([*wrong, right])[0].agreement == pair.weigh_all([right])[0].agreement
