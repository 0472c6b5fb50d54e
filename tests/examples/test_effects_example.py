"""The example of effects runs for each of them, and tells both fits apart."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def figures(effect: str, steps: int) -> dict[str, list[float]]:
    command = [sys.executable, ROOT / "examples" / "08_effects.py", "--effect", effect, "--steps", str(steps)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=3600, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stderr[-2000:]
    rows = [line.split() for line in done.stdout.splitlines()[1:]]
    return {row[1]: [float(x) for x in row[2:]] for row in rows}


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["none", "blur", "sheen", "corners"])
def test_every_effect_is_fitted(effect):
    found = figures(effect, 30)
    assert set(found) == {"with", "without"}
    assert (found["with"][:4] == found["without"][:4]) == (effect == "none")


@pytest.mark.slow
def test_a_rolling_shutter_that_is_ignored_biases_the_offsets():
    found = figures("rolling", 800)
    assert found["with"][0] < 0.7 * found["without"][0]
    assert found["with"][3] > found["without"][3] + 0.2
