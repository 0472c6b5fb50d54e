"""Figures of the report say what they were given, and nothing where there is nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from otsync import Offsets
from otsync.report.figures import effort

FIRST = replace(
    Offsets.known(("a", "b", "c"), [0.0, 0.5, 1.0], 25.0), sigma=np.array([0.0, 0.02, 0.04]), flags=((),) * 3
)


def test_effort_has_a_point_for_each_answer_at_the_end_of_its_stage():
    better = replace(FIRST, sigma=np.array([0.0, 0.002, np.nan]))
    text = effort({"tracks": 10.0, "epipolar": 5.0, "synchronise": 2.5}, {"epipolar": FIRST, "synchronise": better})
    assert text.startswith("<svg") and "epipolar, 15 s" in text and "synchronise, 17.5 s" in text
    assert "true: mean" not in text


def test_effort_shows_true_errors_where_they_are_known():
    assert "true: mean" in effort({"fit": 3.0}, {"": FIRST, "fit": FIRST}, np.array([0.0, 0.5, 1.02]))


def test_effort_is_empty_without_a_sigma():
    unsure = replace(FIRST, sigma=np.array([0.0, np.nan, np.nan]))
    assert effort({"tracks": 1.0, "synchronise": 2.0}, {"synchronise": unsure}) == ""
