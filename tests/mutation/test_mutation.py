"""The table of breaks fits the source; and the tests notice the breaks (slow)."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.mutation.breaks import BREAKS
from tests.mutation.run import (
    PROMISED,
    ROOT,
    Outcome,
    broken,
    broken_copy,
    copy_packages,
    environment,
    mutate,
    share,
    table,
)


@pytest.mark.parametrize("slip", BREAKS, ids=lambda slip: slip.name)
def test_a_break_stands_where_the_table_says(slip):
    source = (ROOT / slip.file).read_text()
    assert broken(slip, source) != source
    assert slip.tests and all((ROOT / test).exists() for test in slip.tests)


def test_there_are_enough_breaks_each_of_its_own():
    assert len(BREAKS) >= 40
    assert len({slip.name for slip in BREAKS}) == len(BREAKS) == len({(s.file, s.old, s.new) for s in BREAKS})


@pytest.mark.parametrize("source", ["x = 1", "y = 2; y = 2"])
def test_a_fragment_that_is_not_there_once_is_named(source):
    slip = replace(BREAKS[0], old="y = 2")
    with pytest.raises(ValueError, match=f"{slip.name}: expected its fragment once in {slip.file}.*'y = 2'"):
        broken(slip, source)


def test_the_table_counts_what_hung_as_caught_and_names_survivors():
    a, b, c = BREAKS[:3]
    outcomes = [Outcome(a, "survived", a.meaning, 1), Outcome(b, "hung", "", 1), Outcome(c, "caught", "test_x", 1)]
    assert share(outcomes) == 2 / 3
    lines = table(outcomes).splitlines()
    assert lines[-1] == "2 of 3 breaks caught: 66.7 %"
    assert lines[-2].startswith("survived") and a.name in lines[-2]


@pytest.mark.slow
def test_a_broken_kernel_is_compiled_anew_and_never_gets_back(tmp_path):
    """Compiled code of the sound copy goes along with every broken one: it must not be what runs."""
    slip = next(s for s in BREAKS if s.name == "costs-trimmed-largest")
    sound, folder = tmp_path / "sound", tmp_path / "broken"
    copy_packages(sound)
    code = "import numpy as np; from otsync.costs.kernels import _trimmed; print(_trimmed(np.arange(10.0), 10, 0.5))"

    def answer(root: Path) -> float:
        ran = subprocess.run(
            [sys.executable, "-c", code], cwd=root, env=environment(root), capture_output=True, check=True
        )
        return float(ran.stdout)

    assert answer(sound) == 2.0
    with broken_copy(slip, sound, folder):
        assert list(folder.glob("otsync/costs/__pycache__/kernels._trimmed*.nbc"))
        assert answer(folder) == 7.0
        assert answer(folder) == 7.0  # from the cache of its own
    assert not folder.exists()
    assert answer(sound) == 2.0


@pytest.mark.slow
def test_breaks_are_caught():
    outcomes = mutate(BREAKS)
    assert share(outcomes) >= PROMISED, "\n" + table(outcomes)
