"""Sigma of a refined clock against experiments whose spread is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recon.fit.uncertainty import MISFIT, averaged, cast, newton_sigma, sandwich, scattered, unreached, unsettled
from recon.fit.witnesses import IMAGES, reconciled, relative_sigma, repeated, share_kept, unseen


def test_sandwich_is_the_variance_of_the_weighted_step():
    rng = np.random.default_rng(0)
    h = rng.uniform(0.5, 2.0, 12)
    noise = 0.3 * rng.normal(size=(4000, 12)) * np.sqrt(h)
    steps = -noise.sum(1) / h.sum()
    told = np.array([sandwich(g, h) for g in noise])
    # the told variance holds the spread once, by the stretches that make most of it, and the step itself once more
    assert 2 * steps.var() < told.mean() < 3 * steps.var()


def test_frames_that_err_together_count_once():
    rng = np.random.default_rng(3)
    h = np.ones(48)
    runs = np.repeat(rng.normal(size=(4000, 8)), 6, axis=1)  # eight stretches, each with an error of its own
    steps = -runs.sum(1) / 48
    told = np.array([sandwich(g, h) for g in runs])
    assert 1.8 * steps.var() < told.mean() < 3 * steps.var()


def test_a_common_pull_counts_as_bias():
    h = np.ones(12)
    assert sandwich(-0.2 * h, h) == pytest.approx(0.04)
    assert np.isnan(sandwich(np.zeros(12), np.zeros(12))) and np.isnan(sandwich(np.ones(1), np.ones(1)))


def test_offset_errors_are_told():
    """Sinusoidal pixels, a wrong offset per video and errors that each frame shares among all its pixels."""
    true, frame_step = np.array([0.0, 0.002, -0.004]), 1 / 30
    phase = torch.linspace(0, 6, 400).reshape(10, 40, 1).repeat(1, 1, 3)

    def pixels(seconds: float) -> torch.Tensor:
        return torch.sin(phase + 9 * seconds)

    keys = np.array([(v, k) for v in range(3) for k in range(24)])
    wobble = np.random.default_rng(1).normal(size=(3, 24)) * 0.003
    votes = cast(
        lambda v, k, later: pixels(k * frame_step + later),
        lambda v, k: pixels(k * frame_step + true[v] + wobble[v, k]),
        keys,
        3,
        frame_step,
        frames=24,
    )
    sigma = relative_sigma(newton_sigma(votes), 0)
    expected = np.sqrt(0.003**2 / 24 * 2 + true**2)
    assert sigma[0] == 0
    assert sigma[1:] == pytest.approx(expected[1:], rel=0.5)


def test_a_video_that_shows_no_motion_has_no_sigma():
    still = torch.zeros(2, 2, 3)
    keys = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
    votes = cast(lambda v, k, later: still, lambda v, k: still, keys, 2, 1 / 30)
    assert np.isnan(newton_sigma(votes)).all()


def test_what_a_fit_could_not_reach_stays_as_unsure_as_it_was():
    sigma = np.array([0.0, 0.02, 0.001, np.nan])
    np.testing.assert_allclose(unreached(sigma, 0.002), [0, 0.018, 0, 0])
    assert not unreached(sigma, 0.1).any()


def test_the_reference_s_own_error_counts():
    """Offsets are relative to the reference: where that is wrong, all others are as unsure."""
    phase = torch.linspace(0, 6, 400).reshape(10, 40, 1).repeat(1, 1, 3)

    def pixels(seconds: float) -> torch.Tensor:
        return torch.sin(phase + 9 * seconds)

    votes = cast(
        lambda v, k, later: pixels(k / 30 + later),
        lambda v, k: pixels(k / 30 + (0.004 if v == 0 else 0.0)),
        np.array([(v, k) for v in range(2) for k in range(12)]),
        2,
        1 / 30,
    )
    sigma = relative_sigma(newton_sigma(votes), 0)
    assert sigma[0] == 0 and sigma[1] == pytest.approx(2 * 0.004, rel=0.1)  # of two videos motion takes up a half


def test_two_witnesses_that_agree_are_averaged_by_their_variances():
    start, fitted = np.array([0.0, 1.00, 2.00]), np.array([0.0, 1.02, 2.01])
    before, after = np.array([0.0, 0.02, 0.03]), np.array([0.0, 0.02, 0.01])
    offset, sigma, contradicted = reconciled(start, before, fitted, after, 0)
    assert offset == pytest.approx([0, 1.01, 2.009])
    assert sigma == pytest.approx([0, 0.02 / np.sqrt(2), 0.03 * 0.01 / np.hypot(0.03, 0.01)])
    assert not contradicted.any()


def test_two_witnesses_that_disagree_are_covered_and_said():
    offset, sigma, contradicted = reconciled(
        np.zeros(3), np.array([0, 0.1, 0.1]), np.array([0, 0.25, 0.8]), np.array([0, 0.02, 0.02]), 0
    )
    assert contradicted.tolist() == [False, False, True]
    agreed = 0.1 * 0.02 / np.hypot(0.1, 0.02)
    assert sigma[1] == pytest.approx(agreed * 0.25 / np.hypot(0.1, 0.02) / 2)  # of 2.45 sigmas, two are chance
    assert abs(offset[2] - 0.0) <= sigma[2] and abs(offset[2] - 0.8) <= sigma[2]


@pytest.mark.parametrize("sigma", [0.0, np.nan, np.inf])
def test_a_start_without_a_sigma_is_no_witness(sigma):
    before, after, fitted = np.array([0, sigma]), np.array([0, 0.01]), np.array([0, 5.0])
    offset, found, contradicted = reconciled(np.zeros(2), before, fitted, after, 0)
    assert offset.tolist() == fitted.tolist() and found.tolist() == after.tolist() and not contradicted.any()


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.7])
def test_witnesses_cover_the_truth_as_often_as_they_say(kept):
    rng = np.random.default_rng(0)
    before, after = rng.uniform(0.02, 0.1, 8000), rng.uniform(0.02, 0.1, 8000)
    start = before * rng.normal(size=8000)
    fitted = kept * start + after * rng.normal(size=8000)
    offset, sigma, contradicted = reconciled(start, before, fitted, after, 0, kept)
    inside = np.abs(offset[1:]) / sigma[1:]
    assert 0.67 < (inside < 1).mean() < 0.73 and 0.945 < (inside < 2).mean() < 0.97  # discord can only widen it
    assert contradicted.mean() < 0.01
    assert offset.std() < min(start.std(), fitted.std())


def test_what_a_fit_kept_of_its_start_is_not_averaged_away():
    """Two witnesses that share an error agree on it."""
    start, fitted = np.array([0.0, 0.3]), np.array([0.0, 0.3])
    before, after = np.array([0.0, 0.1]), np.array([0.0, 0.01])
    _, sigma, contradicted = reconciled(start, before, fitted, after, 0, 0.5)
    assert sigma[1] == pytest.approx(np.hypot(0.05, 0.01)) and not contradicted.any()
    _, sigma, _ = reconciled(start, before, fitted, after, 0, 1.0)  # a fit that has seen nothing adds nothing
    assert sigma[1] == pytest.approx(0.1)


def test_what_still_moves_is_told():
    history = np.array(
        [[0, 0, 0], [50, 0, -7], [60, 0, 0.4], [70, 0.2, 0.8], [80, 0, 0.8], [90, 0.3, 1.3], [100, 0, 0.9]]
    )
    assert unsettled(history, 0) == pytest.approx([0, 1.5 * (0.9 - 0.5)])  # from one fifth's mean to the last one's
    drifting = history + np.array([0, 1, 1]) * history[:, :1]  # the scene goes, and all clocks with it
    assert unsettled(drifting, 0) == pytest.approx([0, 0.6])
    # where nothing is known between, all of the way counts
    assert unsettled(np.array([[0, 0, 0], [100, 0.1, 1.0]]), 0) == pytest.approx([0, 1.5 * 0.9])
    # a clock that goes on as it went: three fifths of each move
    steps = np.arange(0, 1001)
    left = 0.6 ** (steps / 200)
    told = unsettled(np.column_stack([steps, np.zeros(1001), left]), 0)[1]
    found = averaged(np.column_stack([steps, np.zeros(1001), left]))
    assert told == pytest.approx(found[1] - found[0], rel=0.01)


def test_a_start_relative_to_another_video_brings_the_references_error():
    sigma = np.array([0.03, 0.0, 0.04])
    assert relative_sigma(sigma, 1).tolist() == sigma.tolist()
    assert relative_sigma(sigma, 0) == pytest.approx([0, 0.03, 0.05])
    assert np.isnan(relative_sigma(np.array([np.nan, 0.1]), 1)[0])


def test_a_fit_of_a_fit_does_not_count_its_pictures_twice():
    start, fitted = np.array([0.0, 0.010, 0.010]), np.array([0.0, 0.012, 0.110])
    before, after = np.array([0.0, 0.004, 0.004]), np.array([0.0, 0.003, 0.003])
    offset, sigma, contradicted = repeated(start, before, fitted, after, 0)
    assert offset.tolist() == fitted.tolist()
    assert sigma[0] == 0.0 and sigma[1] == 0.004  # averaged it would be .0024
    assert contradicted.tolist() == [False, False, True] and sigma[2] >= 0.1


def test_a_fit_that_has_seen_few_pictures_keeps_its_start_s_error():
    start, moved = np.array([0.0, 0.01, np.nan, np.nan]), np.array([0.0, 0.002, 0.005, -0.001])
    rms = np.sqrt((0.005**2 + 0.001**2) / 2)  # of those without a sigma: one of them has hardly moved by chance

    def left(images, epochs):
        return unseen(start, moved, 0, share_kept(images=images, epochs=epochs))

    np.testing.assert_allclose(left(1e4, 1e3), 0.0, atol=1e-12)
    few = left(2.0, 0.1)
    assert few[0] == 0 and 0.009 / 1.2 < few[1] < 0.01
    assert few[2] == few[3] > rms  # they have gone a small part of their way: most is still to go
    assert left(200.0, 0.2)[1] > left(200.0, 3.0)[1]  # a long clip has hardly been seen
    np.testing.assert_allclose(left(IMAGES * np.log(2), 10.0), [0.0, 0.005, rms, rms])  # half is kept, half is done
    assert unseen(start[:1], moved[:1], 0, 0.4).tolist() == [0.0]


def test_clocks_are_the_mean_of_the_last_steps_and_what_they_share_is_the_last_one_s():
    rng = np.random.default_rng(2)
    steps = np.arange(0, 1001, 5.0)
    own, shared = np.array([0.0, 1.0, -2.0]), 0.01 * steps[:, None]  # the scene drifts, and all clocks with it
    shaken = own + shared + 0.1 * rng.standard_normal((len(steps), 3))
    found = averaged(np.column_stack([steps, shaken]))
    assert np.abs(found - found[0] - own).max() < 0.06  # one step by itself is off by .1
    assert found.mean() == pytest.approx(shaken[-1].mean())
    early = shaken.copy()
    early[steps < 800] += [0, 50, -50]
    np.testing.assert_allclose(averaged(np.column_stack([steps, early])), found)
    np.testing.assert_allclose(averaged(np.array([[0.0, 1, 2], [0, 1, 2]])), [1, 2])  # no step at all


def test_a_scene_that_shows_its_frames_badly_is_unsure_of_their_clocks():
    """Half of the pixels are early by .02 s, half of them late: no frame pulls, and the clock may still be off."""
    phase = torch.linspace(0, 60, 4000).reshape(10, 400, 1).repeat(1, 1, 3)
    sign = torch.where(torch.arange(400) % 2 == 0, 1.0, -1.0)[:, None]
    still = torch.zeros(10, 400, 3)  # shown badly, too, but it tells nothing of time

    def pixels(seconds) -> torch.Tensor:
        return torch.cat([torch.sin(phase + 0.5 * seconds), still])

    def target(early: float) -> torch.Tensor:
        return torch.cat([torch.sin(phase + 0.5 * early * sign), still + 0.3])

    keys = np.array([(v, k) for v in range(2) for k in range(20)])

    def sigma(early: float) -> float:
        votes = cast(lambda v, k, later: pixels(later), lambda v, k: target(early), keys, 2, 1 / 30)
        return relative_sigma(newton_sigma(votes), 0)[1]

    assert sigma(0.02) == pytest.approx(
        np.sqrt(2) * 2 * 0.02**2 / MISFIT, rel=0.05
    )  # two videos: a quarter is left of what they tell
    assert sigma(0.01) == pytest.approx(sigma(0.02) / 4, rel=0.05)


@pytest.mark.parametrize("count", [2, 47, 48, 60, 75, 90, 150, 900])
def test_frames_that_vote_stand_between_knots_in_every_way(count):
    chosen = scattered(count, 48)
    assert (np.diff(chosen) > 0).all() and 0.7 * min(count, 48) < len(chosen) <= 48  # none votes twice
    assert chosen[0] >= 0 and chosen[-1] < count
    if count >= 90:  # knots stand every four frames; eight would be the even distance in a clip of 384
        phases = np.bincount(scattered(8 * 48, 48) % 4, minlength=4)
        assert phases.min() >= 10
