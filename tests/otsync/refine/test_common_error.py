"""Errors that tracks have in common: what they do to an offset, against offsets that such errors moved."""

import numpy as np
import pytest

from otsync import Alignment, Matches, SplineRefine, Status, TrackSet, refine
from otsync.clocks.splines import TrackSplines
from otsync.epipolar import EpipolarRefine
from otsync.refine import samples as module
from otsync.refine.common_error import Sums, autocorrelation, common_error
from otsync.refine.gauss_newton import fit_clock
from otsync.types import Clock
from tests.recording_world import ring

WINDOW, FPS = 14 / 30, 30.0
GROUPS, EACH, FRAMES = 6, 8, 90


def smooth(rng, *shape, over=6):
    """Noise of size 1 that is alike over some frames; time is the last axis but one."""
    x = rng.standard_normal((*shape[:-2], shape[-2] + 8 * over, shape[-1]))
    kernel = np.exp(-0.5 * (np.arange(-4 * over, 4 * over + 1) / over) ** 2)
    x = np.apply_along_axis(np.convolve, -2, x, kernel / np.sqrt((kernel**2).sum()), "valid")
    return x[..., : shape[-2], :]


def draw(rng, *, of_all=0.0, of_group=0.0, own=0.0):
    """Residuals, velocities and groups of matches, some of whose errors are those of all or of a neighbourhood."""
    group = np.repeat(np.arange(GROUPS), EACH)
    v = smooth(rng, 1, FRAMES, 3) + smooth(rng, GROUPS, FRAMES, 3)[group]
    r = of_all * smooth(rng, 1, FRAMES, 3) + of_group * smooth(rng, GROUPS, FRAMES, 3)[group]
    return r + own * smooth(rng, len(group), FRAMES, 3), v, group


@pytest.mark.parametrize("kind", ["of_all", "of_group"])
def test_common_errors_are_as_large_as_said(kind):
    """Errors of the offset over many worlds against the claim, before anything has been fitted."""
    rng = np.random.default_rng(1)
    wrong, said, alike = [], [], []
    for _ in range(150):
        r, v, group = draw(rng, **{kind: 0.3}, own=0.1)
        wrong.append((r * v).sum() / (v * v).sum())
        sums = Sums.of(r, v, np.ones(r.shape[:2]), group, 40)
        said.append(sums.variance())
        alike.append(sums.variance_of_motion())
    assert np.sqrt(np.mean(np.square(wrong)) / np.mean(said)) == pytest.approx(1, abs=0.25)
    # here errors change as the motion does; of one short clip their size is the surer part
    assert np.sqrt(np.mean(np.square(wrong)) / np.mean(alike)) == pytest.approx(1, abs=0.25)
    assert np.std(alike) / np.mean(alike) < np.std(said) / np.mean(said)


def test_errors_of_single_tracks_are_left_to_the_jackknife():
    rng = np.random.default_rng(2)
    alone, common = ([], [])
    for _ in range(60):
        for found, errors in ((alone, {"own": 0.3}), (common, {"of_all": 0.3})):
            r, v, group = draw(rng, **errors)
            sums = Sums.of(r, v, np.ones(r.shape[:2]), group, 40)
            found.append((sums.variance(), sums.variance_of_motion()))
    assert np.all(np.sqrt(np.mean(alone, 0) / np.mean(common, 0)) < 0.2)


def curves(rng, frames=FRAMES, error=0.05, shift=0.0):
    """Two videos of the same points, the second's with an error that all have in common."""
    t = np.arange(frames) / FPS
    x = smooth(rng, 30, frames, 3) + smooth(rng, 1, frames, 3)
    wrong = error * smooth(rng, 1, frames, 3)
    noise = 0.005 * rng.standard_normal((2, *x.shape))
    return TrackSplines(t, x + noise[0]), TrackSplines(t - shift, x + wrong + noise[1])


def test_exchanging_the_videos_changes_nothing():
    a, b = curves(np.random.default_rng(3), shift=0.21)
    weight, group = np.random.default_rng(4).random(30), np.arange(30) % 5
    clock = Clock(0.2, 1.001)
    back = Clock(-0.2 / 1.001, 1 / 1.001)
    there, here = (common_error(x, y, c, weight, group, WINDOW) for x, y, c in ((a, b, clock), (b, a, back)))
    assert there == pytest.approx(here, rel=0.01)
    assert there > 0.002


def test_it_grows_with_the_error_and_knows_no_units():
    rng = np.random.default_rng
    weight, group = np.ones(30), np.arange(30) % 5
    small, large = (
        common_error(*curves(rng(5), error=e), Clock(0.0, 1.0), weight, group, WINDOW) for e in (0.04, 0.08)
    )
    assert large / small == pytest.approx(2, rel=0.1)
    a, b = curves(rng(5), error=0.04)
    scaled = [TrackSplines(x.times, 64 * x.joined(x.times)) for x in (a, b)]
    again = [TrackSplines(x.times, x.joined(x.times)) for x in (a, b)]
    one, other = (common_error(*pair, Clock(0.0, 1.0), weight, group, WINDOW) for pair in (scaled, again))
    assert one == pytest.approx(other, rel=1e-6)


def test_pieces_of_a_long_clip_stand_for_all(monkeypatch):
    """Two minutes, looked at whole, in pieces, and in a third of the pieces."""
    a, b = curves(np.random.default_rng(6), frames=3600)
    weight, group = np.ones(30), np.arange(30) % 5
    found = []
    for piece, most in ((200.0, 24), (10.0, 24), (10.0, 4)):
        monkeypatch.setattr(module, "PIECE", piece)
        monkeypatch.setattr(module, "MOST_PIECES", most)
        found.append(common_error(a, b, Clock(0.0, 1.0), weight, group, WINDOW))
    assert found[1] == pytest.approx(found[0], rel=0.05)
    assert found[2] == pytest.approx(found[0], rel=0.4)


def test_nothing_in_common_says_nothing():
    ones, clock = np.ones(30), Clock(0.0, 1.0)
    with_error, without = (
        common_error(*curves(np.random.default_rng(7), error=e), clock, ones, np.arange(30), WINDOW)
        for e in (0.05, 0.0)
    )
    assert without < 0.2 * with_error


def test_clips_that_never_meet_say_nothing():
    a, b = curves(np.random.default_rng(7))
    assert common_error(a, b, Clock(60.0, 1.0), np.ones(30), np.arange(30), WINDOW) == 0.0


def test_autocorrelation_is_the_sum_that_it_says():
    x = np.random.default_rng(8).standard_normal((3, 20, 2))
    direct = [float((x[:, : 20 - k] * x[:, k:]).sum()) for k in range(6)]
    np.testing.assert_allclose(autocorrelation(x, 6), direct)
    assert autocorrelation(x, 30).shape == (30,)


def test_the_refiner_says_no_less():
    """Two videos whose tracks all err alike: neighbourhoods and seconds may scatter less than that by chance."""
    clip, matches = np.arange(FRAMES) / FPS, Matches(np.stack([np.arange(30)] * 2, 1), np.ones(30))
    below = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        x = smooth(rng, 30, FRAMES, 3) + smooth(rng, 1, FRAMES, 3)
        a = TrackSet(x, timestamps=clip, frame="world")
        b = TrackSet(x + 0.05 * smooth(rng, 1, FRAMES, 3), timestamps=clip, frame="world")
        found = refine(a, b, matches, Alignment(0.0, fps=FPS), SplineRefine())
        scatter = fit_clock(*SplineRefine().splines(a, b, matches), Clock(found.offset, 1.0), WINDOW).covariance[0, 0]
        assert found.sigma > found.stats["common_error"] > 0
        # what is not scatter is for the cycles to judge, and all of it is
        guessed = found.stats["tentative"] * found.sigma**2
        assert guessed > max(0.0, 0.99 * (found.stats["common_error"] ** 2 - scatter))
        assert found.stats["tentative"] < 1
        below += np.sqrt(scatter) < found.stats["common_error"]
    assert below


def test_pixels_say_no_less():
    """Points that all move alike, and whose pixels all err alike in one video."""
    below = 0
    cameras = ring(4, width=640, height=360)[:2]
    for seed in range(6):
        rng = np.random.default_rng(seed)
        x = 0.3 * smooth(rng, 1, 120, 3) + 0.1 * smooth(rng, 30, 120, 3) + rng.uniform(-0.4, 0.4, (30, 1, 3))
        wrong = 2 * smooth(rng, 1, 120, 2)
        a, b = (
            TrackSet(None, uv=camera.project(x) + e, camera=camera, fps=FPS, frame="world", features=np.eye(30))
            for camera, e in zip(cameras, (0.0, wrong), strict=True)
        )
        matches = Matches(np.stack([np.arange(30)] * 2, 1), np.ones(30))
        refiner = EpipolarRefine()
        found = refiner(a, b, matches, Alignment(0.0, fps=FPS))
        problem = refiner.scan.residuals(a, b, matches, 0.0, FPS)
        step = problem.solve(0.0, refiner.windows[0], 12, refiner.reach)[1]
        assert found.sigma >= found.stats["common_error"] >= 0 or Status.MOVED in found.flags
        below += Status.MOVED not in found.flags and problem.scatter(step) < 0.6 * found.stats["common_error"]
    assert below
