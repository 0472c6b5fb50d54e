"""Many videos without a common frame: averaging against brute force, contradictions, and the verb."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from otsync import LikelihoodScan, OwnFrames, SplineRefine, synchronize
from otsync.costs import Cosine, CurveDistance
from otsync.frames import PoseTrust
from otsync.match import UnbalancedOT
from otsync.simulate import simulate
from otsync.sync.own_frames import better
from otsync.sync.poses import Link, place, triangles
from otsync.sync.verdict import Answer
from otsync.types import Alignment, Clock, Matches, Offsets, Similarity, Status


def frames_of(n: int, seed: int) -> list[Similarity]:
    rng = np.random.default_rng(seed)
    made = [
        Similarity(float(rng.uniform(0.5, 2)), Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3))
        for _ in range(n)
    ]
    return [Similarity(1.0, np.eye(3), np.zeros(3)), *made[1:]]


def links_of(frames: list[Similarity], noise: float = 0.0, seed: int = 0, drop: tuple = ()) -> list[Link]:
    rng = np.random.default_rng(seed)
    links = []
    for i in range(len(frames)):
        for j in range(i + 1, len(frames)):
            S = frames[i].inverse().after(frames[j]).moved(noise * rng.normal(size=7))
            S = S.with_covariance(max(noise, 1e-3) ** 2 * np.eye(7))
            if (i, j) not in drop:
                links.append(Link(i, j, S, True, frames[j].inverse()(np.zeros(3)), 1 / frames[i].scale))
    return links


@pytest.mark.parametrize("reference", [0, 2])
def test_exact_links_give_exact_frames(reference):
    true = frames_of(5, 1)
    poses = place(5, links_of(true, drop=((0, 3), (1, 4))), [reference] * 5)
    for v, frame in enumerate(poses.frames):
        expected = true[reference].inverse().after(true[v])
        np.testing.assert_allclose(frame.R, expected.R, atol=1e-7)
        np.testing.assert_allclose(frame.t, expected.t, atol=1e-6)
        assert frame.scale == pytest.approx(expected.scale)
    assert np.nanmax(poses.errors) < 1e-3


def test_a_link_that_no_triangle_confirms_is_left_out():
    true = frames_of(6, 2)
    links = links_of(true, noise=0.005)
    wrong = [k for k, l in enumerate(links) if (l.a, l.b) in ((0, 1), (2, 4))]
    for k in wrong:
        l = links[k]
        turned = l.transform.moved(np.r_[0, 0, 3.0, 0, 0, 0, 0])
        links[k] = Link(l.a, l.b, turned, True, l.middle, l.extent)
    closed, _ = triangles(links)
    assert not closed[wrong].any() and closed.sum() == len(links) - 2
    poses = place(6, links, [0] * 6)
    for v, frame in enumerate(poses.frames):
        assert frame.degrees_from(true[v]) < 1.0
    assert (poses.errors[wrong] > 4).all()


def test_averaging_is_better_than_one_link_and_says_how_good_it_is():
    errors, z = [], []
    for seed in range(20):
        true = frames_of(6, seed)
        poses = place(6, links_of(true, noise=0.02, seed=seed), [0] * 6)
        away = [true[v].difference(poses.frames[v])[:3] for v in range(1, 6)]
        errors += [np.linalg.norm(a) for a in away]
        z += [a / np.sqrt(np.diag(poses.frames[v + 1].covariance)[:3]) for v, a in enumerate(away)]
    assert np.mean(errors) < 0.8 * 0.02 * np.sqrt(3)
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 1.2  # sigmas are inflated by 1.5


def test_videos_that_no_link_reaches_have_no_frame():
    true = frames_of(4, 3)
    links = [l for l in links_of(true) if 3 not in (l.a, l.b)]
    poses = place(4, links, [0, 0, 0, 3])
    assert poses.frames[3] is not None and poses.frames[3].scale == 1  # a reference of its own
    assert place(4, links, [0, 0, 0, 0]).frames[3] is None
    assert place(4, links, [0] * 4).between(0, 3) is None


@pytest.fixture(scope="module")
def film():
    return simulate("basketball", preset="mid", videos=3, own_frames=True, seed=5)


def test_three_videos_without_a_common_frame(film, tmp_path):
    tracks, truth = film
    offsets = synchronize(tracks, frames="own")
    assert offsets.ok, offsets.flags
    assert np.abs(offsets.seconds - truth.offsets).max() * 30 < 0.15
    for v in range(3):
        T = truth.transform(0, v)
        assert offsets.transforms[v].degrees_from(T) < 2
        assert offsets.transforms[v].scale == pytest.approx(T.scale, rel=0.03)
    offsets.save(tmp_path / "offsets.json")
    again = Offsets.load(tmp_path / "offsets.json")
    for one, other in zip(offsets.transforms, again.transforms, strict=True):
        np.testing.assert_allclose(one.R, other.R, atol=1e-9)
        np.testing.assert_allclose(one.covariance, other.covariance)
    pair = again.alignments[0, 1]
    assert pair.transform.scale == pytest.approx(offsets.alignments[0, 1].transform.scale)


def test_another_reference_is_another_frame(film):
    tracks, truth = film
    offsets = synchronize(tracks[:2], frames=OwnFrames(seed=1), reference=1)
    assert offsets.transforms[1].degrees_from(Similarity(1.0, np.eye(3), np.zeros(3))) == 0
    assert offsets.transforms[0].degrees_from(truth.transform(1, 0)) < 2


def test_an_unrelated_video_is_flagged(film):
    tracks, _ = film
    (stranger, _), _ = simulate("boxes", preset="mid", own_frames=True, seed=77)
    offsets = synchronize([tracks[0], tracks[1], stranger], frames="own")
    assert offsets.status[1].ok and not offsets.status[2].ok


def test_pairs_with_loose_poses_still_tie_videos_together(film):
    """Who asks for firmer poses gets flags, of pairs and videos, and the same clocks."""
    tracks, _ = film
    usual = synchronize(tracks, frames="own")
    strict = synchronize(tracks, frames=OwnFrames(trust=PoseTrust(rotation=1e-3)))
    np.testing.assert_array_equal(strict.seconds, usual.seconds)
    others = [v for v in range(len(tracks)) if v != strict.reference]
    assert usual.ok and all(strict.flags[v] == (Status.LOOSE_POSE,) for v in others)
    assert all(Status.LOOSE_POSE in pair.flags for pair in strict.alignments.values())


def test_different_frames_are_refused_with_the_remedy(film):
    with pytest.raises(ValueError, match="frames='own'"):
        synchronize(film[0])


@pytest.mark.parametrize(
    ("name", "value"),
    [("aligner", LikelihoodScan()), ("refiner", SplineRefine()), ("rate", "fit"), ("rematch", 0), ("matches", {})],
)
def test_what_only_a_common_frame_can_use_is_refused(name, value, film):
    with pytest.raises(ValueError, match=name):
        synchronize(film[0], frames="own", **{name: value})


def test_frames_that_there_are_not_are_refused(film):
    with pytest.raises(ValueError, match="frames"):
        synchronize(film[0], frames="mine")
    assert Status.from_code("loose_pose") is Status.LOOSE_POSE


def test_a_fit_from_the_graph_has_the_free_answer_as_its_rival():
    """Begun where the graph puts it, a fit looks at nothing else: what the search found before is not forgotten."""
    there = Similarity(1.0, np.eye(3), np.zeros(3))
    turned = Similarity(1.0, Rotation.from_rotvec([0, 0, np.pi]).as_matrix(), np.zeros(3))
    none = Matches(np.zeros((0, 2), int))

    def answer(transform: Similarity, agreement: float, *flags: Status) -> Answer:
        found = Alignment(0.1, transform=transform, flags=flags, stats={"agreement": agreement})
        return Answer((0, 1), none, found, found)

    before, start = answer(turned, 0.17, Status.AMBIGUOUS), (Clock(0.1), there)
    assert better(before, answer(there, 0.2), start, OwnFrames()) is before
    fresh = better(before, answer(there, 0.4), start, OwnFrames())
    assert fresh.refined.transform is there and fresh.refined.stats["rival"] == pytest.approx(0.17 / 0.4)
    assert better(before, answer(there, 0.4, Status.WEAK), start, OwnFrames()) is before


def test_costs_of_positions_are_refused_without_a_common_frame(film):
    tracks, _ = film
    matcher = UnbalancedOT(costs=(Cosine(), CurveDistance()))
    with pytest.raises(ValueError, match=r"matcher, frames: expected costs that compare no positions.*CurveDistance"):
        synchronize(tracks, frames="own", matcher=matcher)


@pytest.mark.slow
def test_clips_of_a_minute_are_found_as_those_of_seconds():
    """A track is seen for a part of a long clip; moments are as dense as in a short one."""
    (a, b), truth = simulate(
        "basketball", preset="mid", videos=2, own_frames=True, frames=1800, offsets=[0.0, 3.3], seed=5
    )
    lives = np.random.default_rng(0).integers(0, 1650, len(a)), np.random.default_rng(1).integers(0, 1650, len(b))
    brief = [
        replace(t, visible=t.seen & ((np.arange(1800) >= s[:, None]) & (np.arange(1800) < s[:, None] + 150)))
        for t, s in zip((a, b), lives, strict=True)
    ]
    _, found = OwnFrames()(*brief)
    assert found.transform is not None and abs(found.offset - 3.3) < 0.3 / 30, found
    assert found.transform.degrees_from(truth.transform(0, 1)) < 3


def test_a_chain_of_links_that_do_not_close_is_followed_to_its_end():
    true = frames_of(5, 3)
    drop = tuple((i, j) for i in range(5) for j in range(i + 1, 5) if (i, j) not in ((0, 1), (1, 3), (3, 4), (1, 4)))
    links = links_of(true, drop=drop)
    for k, l in enumerate(links):
        if (l.a, l.b) == (1, 4):  # the triangle 1, 3, 4 does not close
            links[k] = Link(l.a, l.b, l.transform.moved(np.r_[0, 0, 3.0, 0, 0, 0, 0]), True, l.middle, l.extent)
    for root in (4, 3, 0):
        frames = place(5, links, [root] * 5).frames
        assert [v for v in range(5) if frames[v] is not None] == [0, 1, 3, 4]
