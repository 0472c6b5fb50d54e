"""Things from outside: a file, and an installed package. Each stands in the help, runs, and is on the lists."""

from __future__ import annotations

import json

import pytest

from otsync import plugins
from otsync.simulate import simulate
from tests.plugins.outside import shell_with

ALGORITHMS = '''
from dataclasses import dataclass, field

from otsync import DTW, Matches, NearestNeighbor, SplineRefine
from otsync.align import Aligner
from otsync.match import Matcher
from otsync.refine import Refiner

{matchers}
@dataclass(frozen=True)
class EveryOther(Matcher):
    """Keeps every other one of the nearest neighbours."""

    first: int = 0

    def __call__(self, a, b):
        matches = NearestNeighbor()(a, b)
        return Matches(matches.pairs[self.first :: 2], matches.score[self.first :: 2])


{aligners}
@dataclass(frozen=True)
class MyWarping(Aligner):
    """The paper's warping, seven seconds late."""

    late: float = 7.0

    def __call__(self, a, b, matches):
        from dataclasses import replace

        alignment = DTW()(a, b, matches)
        return replace(alignment, offset=alignment.offset + self.late)


{refiners}
@dataclass(frozen=True)
class MyRefiner(Refiner):
    """Splines, a tenth of a second late."""

    def __call__(self, a, b, matches, alignment):
        from dataclasses import replace

        refined = SplineRefine()(a, b, matches, alignment)
        return replace(refined, offset=refined.offset + 0.1)


{commands}
@dataclass
class Greet:
    """Say hello.

    Example: otsync greet
    """

    name: str = "you"

    def run(self) -> int:
        print(f"hello {{self.name}}")
        return 0
'''

KINDS = {"matchers": "EveryOther", "aligners": "MyWarping", "refiners": "MyRefiner", "commands": "Greet"}


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> list[str]:
    """Two videos of 80 frames as files."""
    folder = tmp_path_factory.mktemp("world")
    tracks, _ = simulate("softball", preset="mid", videos=2, frames=90, seed=3)
    for t in tracks:
        t.save(folder / f"{t.name}.npz")
    return [str(path) for path in sorted(folder.glob("*.npz"))]


@pytest.fixture(scope="module", params=[pytest.param("file", marks=pytest.mark.slow), "installed"])
def shell(request, tmp_path_factory):
    """The commands with the things in a file (``--plugin``; slow: test_other_kinds.py does so every time), or in a
    package with entry points.
    """
    with shell_with(request.param, tmp_path_factory.mktemp(request.param), ALGORITHMS, KINDS) as shell:
        yield shell


def test_they_stand_in_the_help(shell, world):
    words = shell.alone("otsync", "sync", "--help").stdout
    for name in ("matcher:every-other", "aligner:my-warping", "refiner:my-refiner"):
        assert name in words
    assert "Keeps every other one of the nearest neighbours." in words
    assert "matcher:every-other" in shell("otsync", "match", "--help").stdout
    assert "greet" in shell("otsync", "--help").stdout and "Say hello." in shell("otsync", "--help").stdout


def test_they_run_from_the_shell_with_their_options(shell, world, tmp_path):
    def pairs(*args: str) -> list:
        done = shell("otsync", "match", *world, "--json", *args)
        assert done.returncode in (0, 1), done.stderr
        return json.loads(done.stdout)["pairs"]

    every, odd = pairs("matcher:nearest-neighbor"), pairs("matcher:every-other", "--matcher.first", "1")
    assert odd == every[1::2] and len(odd) > 5
    assert shell("otsync", "greet", "--name", "world").stdout == "hello world\n"

    def offset(*args: str) -> float:
        done = shell("otsync", "sync", *world, "--out", str(tmp_path), "--json", "--rematch", "0", *args)
        assert done.returncode in (0, 1), done.stderr
        return json.loads(done.stdout)["pairs"][0]["offset_seconds"]

    plain = ("matcher:nearest-neighbor",)
    late = offset(*plain, "aligner:my-warping", "refiner:unrefined")
    assert late - offset(*plain, "aligner:dtw", "refiner:unrefined") == pytest.approx(7.0)
    later = offset(*plain, "aligner:likelihood-scan", "refiner:my-refiner")
    assert later - offset(*plain, "aligner:likelihood-scan", "refiner:spline-refine") == pytest.approx(0.1)
    # worker processes find them too
    workers = offset("--workers", "2", *plain, "aligner:my-warping", "refiner:unrefined")
    assert workers == late


def test_they_are_on_the_lists_of_benchmarks_and_of_hard_cases(shell, tmp_path):
    listed = json.loads(shell("otsync", "plugins", "--json").stdout)["plugins"]
    assert {(row["group"], row["name"]) for row in listed} >= {
        ("matchers", "every-other"),
        ("aligners", "my-warping"),
        ("refiners", "my-refiner"),
        ("commands", "greet"),
    }
    done = shell(
        "otsync", "bench", "hard-cases", "--only", "every-other", "my-warping", "my-refiner", "--out", str(tmp_path)
    )
    assert done.returncode in (0, 1), done.stderr
    ran = json.loads((tmp_path / "hard_cases.json").read_text())["rows"]
    assert {row["solver"] for row in ran} == {"every-other", "my-warping", "my-refiner"}
    assert len(ran) > 60


def test_a_file_that_does_not_import_is_named(tmp_path):
    broken = tmp_path / "broken_things.py"
    broken.write_text("raise RuntimeError('no')")
    with pytest.raises(ValueError, match=r"broken_things\.py: does not import: RuntimeError: no"):
        plugins.load_files([broken])
    with pytest.raises(ValueError, match="expected a Python file"):
        plugins.load_files([tmp_path / "nowhere.py"])


def test_names_are_told_apart():
    class Twice:
        """A name that is taken."""

    plugins.register("matchers", "nearest-neighbor")(Twice)
    try:
        from otsync.match import MATCHERS

        with pytest.raises(ValueError, match="two things are named 'nearest-neighbor'"):
            plugins.available("matchers", MATCHERS)
    finally:
        plugins.forget(Twice)
    with pytest.raises(ValueError, match="group: expected one of matchers"):
        plugins.register("marchers")


def test_objects_are_made_as_the_shell_spells_them():
    from otsync.simulate.effects import Gaps

    choices = {"gaps": Gaps}
    assert plugins.made("gaps:share=0.4,longest=2", choices, "--effects") == Gaps(0.4, longest=2)
    for text, says in (
        ("gap", "--effects: expected some of gaps; found 'gap'"),
        ("gaps:share", "expected gaps:field=value"),
        ("gaps:size=1", "cannot be made"),
    ):
        with pytest.raises(ValueError, match=says):
            plugins.made(text, choices, "--effects")


def test_a_foreign_callable_needs_nothing():
    """A function in the slot: no base class, no attributes."""
    from otsync import NearestNeighbor, synchronize

    tracks, truth = simulate("softball", preset="clean", videos=2, frames=90, seed=3)
    offsets = synchronize(tracks, matcher=lambda a, b: NearestNeighbor()(a, b))
    assert offsets.seconds[1] == pytest.approx(truth.offsets[1] - truth.offsets[0], abs=0.05)
    with pytest.raises(ValueError, match="fits no rates"):
        synchronize(tracks, refiner=lambda a, b, m, alignment: alignment, rate="fit")
