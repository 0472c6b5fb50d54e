"""Metrics against counting by hand, and the gauges of offset errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otsync import Matches
from otsync.metrics import match_quality, offset_error
from otsync.simulate import matching_world, simulate


def test_match_quality_counts_as_by_hand():
    _, _, truth = matching_world(300, seed=4, n_b=200, frames=4)
    rng = np.random.default_rng(0)
    right = truth.matches(0, 1, wrong=0.3, n=150).pairs
    pairs = np.concatenate([right, np.c_[rng.integers(0, 300, 60), rng.integers(0, 200, 60)]])
    # some mirrored ones
    a, b = truth.surfaces
    reach = 0.06 * truth.size
    for i in np.flatnonzero(a.object == 0)[:40]:
        mirror = np.linalg.norm(a.mirrored[i] - b.position, axis=1)
        pairs = np.concatenate([pairs, [[i, int(np.nanargmin(mirror))]]])
    score = rng.normal(size=len(pairs))
    n_right = n_flip = n_best = 0
    hit = set()
    best = set(np.argsort(-score, kind="stable")[:100].tolist())
    for k, (i, j) in enumerate(pairs):
        one_object = a.object[i] == b.object[j] != -1
        ok = one_object and np.linalg.norm(a.position[i] - b.position[j]) <= reach
        flip = one_object and not ok and np.linalg.norm(a.mirrored[i] - b.position[j]) <= reach
        n_right += bool(ok)
        n_flip += bool(flip)
        n_best += bool(ok and k in best)
        if ok:
            hit.add(i)
    could = sum(
        any(b.object[j] == a.object[i] and np.linalg.norm(a.position[i] - b.position[j]) <= reach for j in range(200))
        for i in range(300)
        if a.object[i] >= 0
    )
    q = match_quality(Matches(pairs, score), truth, 0, 1)
    assert n_flip > 5
    assert q["precision"] == pytest.approx(n_right / len(pairs))
    assert q["recall"] == pytest.approx(len(hit) / could)
    assert q["flips"] == pytest.approx(n_flip / len(pairs))
    assert q["p50"] == pytest.approx(n_best / 100)


def test_few_sure_matches_cannot_shine():
    _, _, truth = matching_world(3000, seed=1, frames=3)
    few = truth.matches(0, 1, wrong=0, n=200)
    few = Matches(few.pairs[truth.match_errors(few, 0, 1)[0] < 0.06 * truth.size][:150])
    q = match_quality(few, truth)
    assert q["precision"] == 1 and q["p50"] == pytest.approx(150 / 1500)


def test_no_matches_and_foreign_indices():
    _, truth = simulate("boxes", frames=3, seed=0)
    q = match_quality(Matches(np.empty((0, 2), int)), truth)
    assert np.isnan(q["precision"]) and np.isnan(q["flips"]) and q["recall"] == q["p50"] == 0
    with pytest.raises(ValueError, match=r"^matches.pairs"):
        match_quality(Matches(np.array([[0, 10_000]])), truth)


def test_outliers_are_never_right():
    _, _, truth = matching_world(200, seed=2, frames=3)
    out = [np.flatnonzero(s.part < 0) for s in truth.surfaces]
    q = match_quality(Matches(np.stack(out, 1)), truth)
    assert q == {"precision": 0, "recall": 0, "flips": 0, "p50": 0}


def test_offset_error_by_hand():
    answer = offset_error([0.0, 1.1, np.nan, -0.5], [0.0, 1.0, 2.0, -0.4], 30)
    error = answer.errors
    assert (answer.mean, answer.max) == (pytest.approx(3), pytest.approx(3))  # without the reference and the unknown
    np.testing.assert_allclose(error, [0, 3, np.nan, -3])
    shifted = offset_error([1.0, 2.1, np.nan, 0.5], [0.0, 1.0, 2.0, -0.4], 30).errors
    np.testing.assert_allclose(shifted, error, atol=1e-12)
    np.testing.assert_allclose(offset_error([0, 0.1, 0.2], [0, 0, 0], 10, "median").errors, [-1, 0, 1], atol=1e-12)
    np.testing.assert_allclose(offset_error([0, 0.1, 0.2], [0, 0, 0], 10, reference=1).errors, [-1, 0, 1], atol=1e-12)
    assert np.isnan(offset_error([np.nan, 1.0], [0.0, 1.0], 30).errors).all()
    assert np.isnan(offset_error([np.nan, np.nan], [0.0, 1.0], 30, "median").errors).all()
    assert np.isnan(offset_error([0.0], [5.0], 30).mean)


@given(
    st.lists(st.floats(-100, 100), min_size=1, max_size=6),
    st.floats(-50, 50),
    st.sampled_from(["reference", "median"]),
)
def test_the_gauge_takes_out_a_common_shift(true, shift, gauge):
    errors = offset_error(np.array(true) + shift, true, 30, gauge).errors
    np.testing.assert_allclose(errors, 0, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (([0.0], [0.0, 1.0], 30), "seconds"),
        (([[0.0]], [[0.0]], 30), "seconds"),
        (([0.0], [np.nan], 30), "truth"),
        (([0.0], [0.0], 0), "fps"),
        (([0.0], [0.0], 30, "mean"), "gauge"),
        (([0.0], [0.0], 30, "reference", 3), "reference"),
    ],
)
def test_bad_arguments_are_named(arguments, name):
    with pytest.raises(ValueError, match=f"^{name}"):
        offset_error(*arguments)
