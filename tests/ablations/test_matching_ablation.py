"""The paper's ablation where the world makes it true: structure resolves what features confuse."""

from __future__ import annotations

import numpy as np
import pytest

from otsync import FusedGromovWasserstein, NearestNeighbor, OptimalTransport, PartialFGW, match
from otsync.metrics import match_quality
from otsync.simulate import matching_world

MATCHERS = {
    "nearest": NearestNeighbor(),
    "features": OptimalTransport(),
    "fused": FusedGromovWasserstein(),
    "partial": PartialFGW(),
}


@pytest.fixture(scope="module")
def quality():
    """Mean quality of each matcher over the same four worlds of 300 tracks."""
    worlds = [matching_world(300, seed=seed) for seed in range(40, 44)]
    result = {}
    for name, matcher in MATCHERS.items():
        each = [match_quality(match(a, b, matcher), truth) for a, b, truth in worlds]
        result[name] = {key: float(np.mean([q[key] for q in each])) for key in each[0]}
    return result


def test_structure_adds_to_features(quality):
    assert quality["fused"]["p50"] > quality["features"]["p50"] + 0.05
    assert quality["fused"]["recall"] > quality["features"]["recall"] + 0.05


def test_structure_removes_left_right_flips(quality):
    assert quality["fused"]["flips"] < 0.6 * quality["features"]["flips"]


def test_leaving_mass_out_is_what_outliers_call_for(quality):
    assert quality["partial"]["precision"] > quality["fused"]["precision"] + 0.15
    assert quality["partial"]["recall"] > quality["fused"]["recall"] - 0.05


def test_transport_matches_more_than_mutual_neighbours(quality):
    assert quality["features"]["recall"] > quality["nearest"]["recall"]


@pytest.mark.slow
def test_the_papers_figure_at_two_thousand_tracks():
    """P50 gains at least .10 and flips at most halve: the ablation of the paper's figure at its own size."""
    each = {"features": [], "fused": []}
    for seed in (50, 51):
        a, b, truth = matching_world(2000, seed=seed)
        for name, rows in each.items():
            rows.append(match_quality(match(a, b, MATCHERS[name]), truth))
    p50, flips = ({n: np.mean([q[key] for q in rows]) for n, rows in each.items()} for key in ("p50", "flips"))
    assert p50["fused"] >= p50["features"] + 0.10 and flips["fused"] <= 0.5 * flips["features"]
