"""A scene that was fitted without a video tells whether its clock is right, of few videos, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from otsync.types import Offsets, Status
from recon.fit.lags import Lagged
from recon.fit.leave_one_out import FEW, SECONDS, busiest, elsewhere, shown_without_each, steps_worth
from recon.fit.options import FitOptions
from recon.fit.problem import Problem
from recon.fit.run import Diverged, Run
from recon.fit.verb import fit
from recon.simulate.capture import synthetic
from recon.simulate.recording import initial_scene

STEP = 1 / 30
LAGS = np.arange(-20, 21, 2) / 30
SIZE = (96, 64)


def shown(best: float, depth: float = 0.5, frames: int = 8, nothing: float = 2.0) -> Lagged:
    """Frames whose errors fall from 1 to ``1 - depth`` at a lag of ``best`` seconds."""
    errors = 1 - depth * np.exp(-(((LAGS - best) / 0.1) ** 2))
    return Lagged(np.arange(frames), LAGS, np.tile(errors, (frames, 1)), np.full(frames, nothing))


SURE = np.full(3, 0.01)


def told(*shown: Lagged, sigma: np.ndarray = SURE) -> list[int]:
    return elsewhere(shown, sigma[: len(shown)].copy(), 0)


def test_a_video_that_suits_another_time_is_told():
    assert told(shown(0.0), shown(0.4), shown(-0.2)) == [1, 2]


def test_a_little_better_is_not_enough():
    assert told(shown(0.0), shown(0.4, depth=0.15)) == []


def test_what_sigma_says_already_is_no_contradiction():
    unsure = np.array([0.0, 0.3, 0.1])
    assert told(shown(0.4), shown(0.4), shown(0.4), sigma=unsure) == [0, 2]  # the reference is as sure as the surest
    assert told(shown(0.4), shown(0.4), sigma=np.array([0.0, np.nan])) == []


def test_a_scene_without_what_moves_is_a_rival():
    # it is hidden there: nothing at all would suit the video as well
    assert told(shown(0.0), shown(0.4, depth=0.5, nothing=0.5)) == []


def test_one_frame_that_is_shown_badly_does_not_speak_for_a_video():
    even = shown(0.0)
    one = even.errors.copy()
    one[0] = 100 * shown(0.4, depth=0.9).errors[0]
    assert told(even, even._replace(errors=one, nothing=np.full(8, 200.0))) == []


def test_lags_that_few_frames_have_are_not_asked():
    one = shown(0.4)
    errors = one.errors.copy()
    errors[1:, LAGS > 0] = np.nan  # one frame alone has them
    assert told(shown(0.0), one._replace(errors=errors)) == []


def test_a_video_that_shares_no_time_with_the_others_is_not_doubted():
    assert told(shown(0.0), Lagged(np.zeros(0, int), np.zeros(0), np.zeros((0, 0)), np.zeros(0))) == []


@settings(max_examples=60, deadline=None)
@given(
    start=st.floats(-3, 3),
    starts=st.lists(st.floats(-3, 3), min_size=1, max_size=4),
    lengths=st.lists(st.integers(1, 150), min_size=5, max_size=5),
)
def test_the_busiest_seconds_hold_most_pairs_of_frames(start: float, starts: list[float], lengths: list[int]):
    own = start + np.arange(lengths[0]) / 30
    others = np.concatenate([s + np.arange(n) / 30 for s, n in zip(starts, lengths[1:], strict=False)])

    def pairs(begin: float) -> int:
        return int(np.prod([np.sum((t >= begin) & (t <= begin + SECONDS)) for t in (own, others)]))

    most = pairs(busiest(own, others))
    assert all(pairs(begin) <= most for begin in np.linspace(-3, 8, 45))


@pytest.fixture
def capture() -> Any:
    return synthetic(591, offsets=0.0, cameras=2, frames=24, size=SIZE)


def run_of(capture: Any, steps: int = 4, frozen: Sequence[str] = ()) -> Run:
    footage = capture.footage
    known = Offsets.known([f.name for f in footage], np.zeros(len(footage)), 30)
    options = FitOptions(steps=steps, freeze=tuple(frozen))
    run = Run(Problem.of(initial_scene(capture, known), footage, known, options), options.active_rates(), None, steps)
    for _ in range(steps):
        run.one_step(map)
    return run


def values_of(run: Run) -> dict[str, torch.Tensor]:
    return {name: value.detach() for name, value in run.values().items()}


def test_the_fit_itself_is_left_as_it_was(capture):
    run = run_of(capture)
    before = {name: value.detach().clone() for name, value in run.values().items()}
    values = values_of(run)
    first, second = (shown_without_each(run, values) for _ in range(2))
    assert all(torch.equal(value, before[name]) for name, value in run.values().items()) and run.step == 4
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.errors, b.errors, equal_nan=True) and len(a.frames) >= 3
    # clocks that are held: what they are told is what the frames are shown by
    later = shown_without_each(run, values | {"offsets": values["offsets"] + torch.tensor([0.0, 0.2])})
    assert not np.array_equal(first[1].errors, later[1].errors, equal_nan=True)


def test_a_drift_that_all_clocks_share_is_taken_out(capture, monkeypatch):
    """The scene of the start knows nothing of it: the reference stands where it began."""
    asked = []
    whole = shown_without_each

    def noted(run: Run, values: dict[str, torch.Tensor], map: Any = map) -> list[Lagged]:
        asked.append((run.values()["offsets"].detach().clone(), values["offsets"]))
        return whole(run, values, map)

    monkeypatch.setattr("recon.fit.verb.shown_without_each", noted)
    start = Offsets.known([f.name for f in capture.footage], np.zeros(2), 30)
    fit(initial_scene(capture, start), capture.footage, start, steps=6)
    (fitted, held), reference = asked[0], start.reference
    assert abs(float(fitted[reference])) > 1e-5 and abs(float(held[reference])) < 1e-9


def test_who_is_asked(capture):
    run = run_of(capture)
    assert steps_worth(run, 10**6) > steps_worth(run, 4) > 0
    for frozen in (["offsets"], [name for name in run.adam.groups if name != "offsets"]):
        held = run_of(capture, frozen=frozen)
        assert shown_without_each(held, values_of(held)) == [] and steps_worth(held, 100) == 0
    many = synthetic(591, offsets=0.0, cameras=FEW + 1, frames=4, size=SIZE)
    run = run_of(many, 1)
    assert shown_without_each(run, values_of(run)) == [] and steps_worth(run, 100) == 0


def test_a_fit_without_a_video_that_diverges_tells_nothing(capture, monkeypatch):
    run = run_of(capture)

    def diverge(self: Run, map: Any, probe: bool = False) -> None:
        raise Diverged("no number")

    monkeypatch.setattr(Run, "one_step", diverge)
    assert [len(one.frames) for one in shown_without_each(run, values_of(run))] == [0, 0]


def begun(seed: int, off: Sequence[float], steps: int = 300, **world: Any) -> list[int]:
    """Videos whose clock is doubted by a fit that is told that they all but know that they began so many frames off,
    though they began at once."""
    capture = synthetic(seed, offsets=0.0, cameras=len(off), **world)
    names = [f.name for f in capture.footage]
    known = Offsets.known(names, np.array(off) / 30, 30)
    loose = replace(known, sigma=np.r_[0, np.full(len(names) - 1, 0.2 / 30)])
    found = fit(initial_scene(capture, loose), capture.footage, loose, steps=steps).offsets
    return [v for v, flags in enumerate(found.flags) if Status.BROKEN_CLOCK in flags]


def test_of_two_videos_one_that_began_ten_frames_off_is_told():
    """The scene follows both, and shows both well."""
    assert begun(591, [0, 10], 100, frames=40, size=SIZE) == [1]


def test_two_videos_that_are_right_are_not_doubted():
    assert begun(591, [0, 0], 100, frames=40, size=SIZE) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "off"),
    [
        (631, [0, 12]),
        (633, [0, 0, 12]),
        (639, [0, -25, 0]),
        (640, [7, 0, 0]),
        (601, [0, 0, 12, 12, 0]),
        (641, [0, 9, 9, 0, 0, 0]),
    ],
)
def test_of_few_videos_those_that_began_far_off_are_told(seed, off):
    """They passed: of few videos the scene takes in one that is wrong, and two that are off alike back each other."""
    wrong = {v for v, d in enumerate(off) if d} if off[0] == 0 else {1, 2}
    assert wrong <= set(begun(seed, off, frames=60))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(660, 665))
def test_few_videos_that_are_right_are_not_doubted(seed):
    assert begun(seed, [0] * (2 + seed % 5), frames=60) == []
