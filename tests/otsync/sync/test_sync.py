"""Many videos on one clock: gauge, cycles, contradictions, components, clocks, workers, refusals."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from otsync import DTW, Graph, Matches, NearestNeighbor, Status, TrackSet, Unrefined, synchronize
from otsync.match.synchronous import SynchronousMatching
from otsync.simulate import simulate
from tests.conftest import wiggle


def world(motion="tennis", videos=4, preset="mid", seed=5, n=60, **options):
    tracks, truth = simulate(motion, preset=preset, videos=videos, seed=seed, **options)
    pairs = Graph().pairs(videos, 0)
    return tracks, truth, {pair: truth.matches(*pair, n=n) for pair in pairs}


@pytest.fixture(scope="module")
def four():
    tracks, truth, given = world()
    return tracks, truth, given, synchronize(tracks, matches=given)


def test_offsets_sigma_and_residuals(four):
    _, truth, given, found = four
    assert found.ok and found.reference == 0
    assert found.seconds[0] == found.sigma[0] == 0
    error = np.abs(found.seconds - truth.offsets)[1:]
    assert error.max() < 0.2 / 30
    assert (error < 4 * found.sigma[1:]).all()
    assert set(found.alignments) == set(given)
    for (a, b), pair in found.alignments.items():
        assert pair.stats["used"] == 1
        assert pair.stats["residual"] == pytest.approx(found.between(a, b) - pair.offset)
    assert found.stats["cycle_max"] < 0.2 / 30
    assert found.stats["components"] == 1


def test_cycles_sum_to_zero(four):
    found = four[3]
    assert found.between(0, 1) + found.between(1, 3) + found.between(3, 0) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("reference", [2, -1, "auto"])
def test_the_reference_only_sets_the_origin(four, reference):
    tracks, _, given, found = four
    other = synchronize(tracks, matches=given, reference=reference)
    chosen = other.reference
    assert other.seconds[chosen] == 0 and (other.component == chosen).all()
    if reference != "auto":
        assert chosen == reference % 4
    np.testing.assert_allclose(other.seconds, found.seconds - found.seconds[chosen], atol=0.01 / 30)


def test_equal_for_one_and_two_workers_and_for_repeats(four):
    tracks, _, given, found = four
    with ThreadPoolExecutor(2) as pool:
        other = synchronize(tracks, matches=given, map=pool.map)
    for a, b in ((found, other), (found, synchronize(tracks, matches=given))):
        np.testing.assert_array_equal(a.seconds, b.seconds)
        np.testing.assert_array_equal(a.sigma, b.sigma)


def test_units_and_rigid_motion_change_nothing(four):
    tracks, _, given, found = four
    q = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    moved = [dataclasses.replace(t, xyz=1e-3 * (t.xyz @ q.T) + 4.0) for t in tracks]
    other = synchronize(moved, matches=given)
    np.testing.assert_allclose(other.seconds, found.seconds, atol=1e-3 / 30)


def test_a_wrong_pair_is_outvoted_and_fitted_anew(four):
    """One pair's matches come from elsewhere; a given answer far off is contradicted by the cycles."""
    tracks, _, given, found = four

    class Misled:
        """The default scan, led astray on one pair."""

        def __call__(self, a, b, matches):
            from otsync import LikelihoodScan

            answer = LikelihoodScan()(a, b, matches)
            if (a.name, b.name) == ("video0", "video2"):
                return dataclasses.replace(answer, offset=answer.offset + 0.5)
            return answer

    other = synchronize(tracks, matches=given, aligner=Misled())
    np.testing.assert_allclose(other.seconds, found.seconds, atol=0.05 / 30)
    assert "relocated" in other.alignments[0, 2].stats
    assert other.stats["pairs_relocated"] == 1
    assert other.status[2].ok


def test_two_scenes_are_two_components():
    one, truth_one, given = world(videos=3, seed=5)
    two, truth_two, more = world("football", videos=3, seed=6)
    rng = np.random.default_rng(0)
    given |= {(a + 3, b + 3): m for (a, b), m in more.items()}
    for a in range(3):
        for b in range(3, 6):
            given[a, b] = Matches(rng.integers(0, 100, (60, 2)))
    found = synchronize([*one, *two], matches=given)
    assert (found.component[:3] == 0).all()
    own = found.component[3]
    assert own >= 3 and (found.component[3:] == own).all()
    error = found.seconds[3:] - (truth_two.offsets - truth_two.offsets[own - 3])
    assert np.abs(error).max() < 0.2 / 30
    assert np.isnan(found.between(0, 4))
    assert all(Status.DISCONNECTED in flags for flags in found.flags[3:])
    assert all(s.ok for s in found.status[:3])
    assert found.stats["components"] == 2
    assert np.abs(found.seconds[:3] - truth_one.offsets).max() < 0.2 / 30


def test_a_video_without_answers_is_alone():
    tracks, _, given = world(videos=3)
    for pair in ((0, 2), (1, 2)):
        given[pair] = Matches(np.zeros((0, 2), int))
    found = synchronize(tracks, matches=given)
    assert np.isnan(found.seconds[2]) and found.component[2] == 2
    assert found.flags[2][0] == Status.DISCONNECTED and Status.FEW_MATCHES in found.flags[2]
    assert found.status[1].ok


def test_a_pair_of_strangers_is_flagged():
    (a, _), _ = simulate("tennis", preset="mid", seed=1)
    (_, b), _ = simulate("boxes", preset="mid", seed=2)
    found = synchronize([a, b], matches={(0, 1): Matches(np.random.default_rng(0).integers(0, 100, (60, 2)))})
    assert not found.ok and Status.WEAK in found.flags[1]


def test_summed_curves_settle_periodic_motion():
    """Few matches of a juggler: pairs alone take the wrong period, the graph the right one."""
    tracks, truth, given = world("juggle", 8, "brutal", seed=42, n=10)
    found = synchronize(tracks, matches=given)
    alone = np.array([p.offset - p.stats.get("relocated", 0.0) - truth.offset(*k) for k, p in found.alignments.items()])
    assert (np.abs(alone) > 2 / 30).mean() > 0.2
    assert (np.abs(found.seconds - truth.offsets) <= 2 / 30).mean() >= 0.75


def test_matching_again_at_synchronised_times_is_more_precise():
    tracks, truth = simulate("football", preset="mid", videos=3, seed=8)
    matcher = NearestNeighbor()
    once, again = (synchronize(tracks, matcher=matcher, rematch=n) for n in (0, 1))

    def precision(found):
        return np.mean([(truth.match_errors(m, *k)[0] < 0.06 * truth.size).mean() for k, m in found.matches.items()])

    assert precision(again) > precision(once) + 0.05
    assert np.abs(again.seconds - truth.offsets).max() < 0.2 / 30


def test_synchronous_distances_against_numpy():
    rng = np.random.default_rng(0)
    xyz = wiggle(rng, 8, 60)
    a = TrackSet(xyz, features=rng.normal(size=(8, 4)), fps=30, frame="w")
    b = TrackSet(xyz[::-1] + 0.01, features=rng.normal(size=(8, 4)), fps=30, frame="w")
    place, motion = SynchronousMatching(0.0).distances(a, b)
    t = np.linspace(0, 59 / 30, 48)
    from otsync.clocks.splines import TrackSplines

    x, y = (TrackSplines(s.times, s.positions()).value(t) for s in (a, b))
    d = x[:, None] - y[None]
    extent = [np.sqrt(((s.mean(1) - np.median(s.mean(1), 0)) ** 2).sum(1).mean()) for s in (x, y)]
    d = d / np.mean(extent)
    np.testing.assert_allclose(place, np.minimum(np.linalg.norm(d, axis=3), 1.0).mean(2), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(motion, np.sqrt(d.var(2).sum(2)), rtol=1e-6, atol=1e-6)
    found = SynchronousMatching(0.0)(a, dataclasses.replace(b, features=a.features[::-1]))
    np.testing.assert_array_equal(
        found.pairs[np.argsort(found.pairs[:, 0])], np.stack([np.arange(8), np.arange(8)[::-1]], 1)
    )


def test_the_star_of_the_paper_and_no_refinement(four):
    tracks, _, given, _ = four
    found = synchronize(
        tracks, matches={k: m for k, m in given.items() if k[0] == 0}, aligner=DTW(), refiner=Unrefined()
    )
    frames = [found.alignments[0, v].frames for v in (1, 2, 3)]
    np.testing.assert_array_equal(np.round(np.array(frames) * 2), np.array(frames) * 2)
    np.testing.assert_allclose(found.frames[1:], frames)
    assert np.isfinite(found.seconds).all()


@pytest.mark.slow
def test_rates_of_long_clips_are_fitted_over_the_graph():
    tracks, truth = simulate(
        "softball", preset="mid", videos=3, frames=900, rates=[1, 1.001, 1], offsets=[0, 0.3, -0.2], seed=9
    )
    given = {p: truth.matches(*p) for p in Graph().pairs(3, 0)}
    found = synchronize(tracks, matches=given, rate="fit")
    np.testing.assert_allclose(found.rates, [1, 1.001, 1], atol=1.5e-4)
    assert found.rates[2] == 1.0
    np.testing.assert_allclose(found.seconds, truth.offsets, atol=0.1 / 30)
    fixed = synchronize(tracks, matches=given, rate="fixed")
    assert Status.RATE_MISMATCH in fixed.flags[1]
    # whichever video is chosen, the world's clock is its own
    chosen = synchronize(tracks, matches={p: m for p, m in given.items() if 1 in p}, rate="fit", reference="auto")
    assert chosen.reference == 1 and chosen.rates[1] == 1.0 and chosen.seconds[1] == 0
    np.testing.assert_allclose(chosen.rates, [1 / 1.001, 1, 1 / 1.001], atol=1.5e-4)
    np.testing.assert_allclose(chosen.seconds, (truth.offsets - truth.offsets[1]) / 1.001, atol=0.1 / 30)


def test_bad_arguments_are_refused_by_name(four):
    tracks, _, given, _ = four
    for options, word in (
        ({"reference": 9}, "reference"),
        ({"reference": "first"}, "reference"),
        ({"rate": "free"}, "rate"),
        ({"matches": {(0, 9): given[0, 1]}}, "matches"),
        ({"matches": {(0, 1): given[0, 1], (1, 0): given[0, 1].swapped()}}, "matches"),
    ):
        with pytest.raises(ValueError, match=word):
            synchronize(tracks, **options)
