"""What the gate of a real recording watches."""

from __future__ import annotations

import pytest

from otsync.bench.panoptic import WATCHED, figures_of, worse
from otsync.bench.record import baseline_of


@pytest.mark.parametrize(
    ("key", "before", "now", "told"),
    [
        ("pairs_mean", 0.08, 0.1, False),
        ("pairs_mean", 0.08, 0.11, True),
        ("trusted_wrong", 0, 1, True),
        ("flagged", 0.18, 0.2, False),
        ("flagged", 0.18, 0.61, True),  # a doubt that is raised without a cause shows in no error
    ],
)
def test_the_gate_watches_errors_and_doubts(key, before, now, told):
    assert worse(f"15 cameras, default: {key}", now, before) == told


def test_every_figure_has_a_baseline():
    row = dict.fromkeys((*WATCHED, "trusted_wrong"), 0.0)
    rows = [{"route": route, **row} for route in ("default", "depth-free")]
    assert figures_of(rows, ("camera",) * 15).keys() == baseline_of("panoptic").keys()
