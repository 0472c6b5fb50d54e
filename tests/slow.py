"""Which tests are slow, by what they took: `make test` leaves them out, `make test-all` runs them.

Tests that are slow by design say so themselves (``@pytest.mark.slow``). Others are found slow, case by case: they are
listed in slow.txt beside this file, and marked when they are collected. A report of tests, of a machine that does
nothing else, adds to the list:

    make test MORE="--junitxml report.xml"
    python -m tests.slow report.xml

What is listed stays: the time of what all cases of a file share is that of whichever comes first.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence, Set
from pathlib import Path
from xml.etree import ElementTree

import pytest

LIST = Path(__file__).with_name("slow.txt")

SLOW = 1.5
"""Seconds from which a case is slow, unless it is the fastest of its test."""

TOO_SLOW = 4.0
"""Seconds from which the fastest case of a test is slow, too."""

KEPT = (
    "tests/test_import_graph.py",  # says at once that a file lies in the wrong folder
    "tests/otsync/sync/test_breaks.py::test_a_break_is_found_named_and_mended[freeze of 30]",
    "tests/docs/test_code_blocks.py::test_the_code_of_a_page_runs_in_order[README.md]",
    "tests/recon/cli/test_recon_cli.py::test_fit_writes_offsets_scene_metrics_and_report",
    "tests/otsync/sync/test_witnesses.py::test_without_it_the_same_worlds_are_trusted[41001]",
    "tests/otsync/epipolar/test_breaks.py::"
    "test_times_that_say_what_is_missing_are_heard_and_wrong_ones_doubted[600-0.0]",
    "tests/otsync/sync/test_breaks.py::"
    "test_the_video_that_shows_something_again_is_the_one_that_goes_back[0-1.0-87205]",
    "tests/otsync/clocks/test_cuts.py::test_a_clock_that_is_mended_elsewhere_than_its_video_is_cut_is_not_trusted",
    "tests/recon/cli/test_recon_cli.py::test_a_clock_that_the_fit_alone_doubts_is_told_and_exits_with_one[True]",
    "tests/recon/backdrop/test_colours.py::test_a_new_view_of_dark_corners",
    # in a new clone these are the first that need kernels, which another test would have to compile in their place
    "tests/otsync/align/test_align.py::"
    "test_sign_and_size_of_an_integer_offset[-17-DTW(cost='position', open_ends=False)]",
    "tests/otsync/frames/test_fit.py::test_points_fit_as_scipy_fits_them[0]",
    "tests/otsync/frames/test_solver.py::test_a_pair_is_right_and_knows_how_well",
    "tests/otsync/priors/test_priors.py::test_stereo_of_every_second_moment_fills_in_what_lies_between",
    "tests/otsync/priors/test_stereo.py::test_the_sweep_is_the_correlation_of_every_patch",
    "tests/recon/raster/test_raster_hard_cases.py::test_hard_case[cpu-on the near plane]",
)
"""Cases, and files of them, that run always, however slow: each goes a way of its own from end to end, or compiles."""


def listed() -> set[str]:
    """Node ids of slow.txt."""
    return {line for line in LIST.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")}


def kept(name: str) -> bool:
    """Whether a case is one of :data:`KEPT`."""
    return name in KEPT or name.split("::")[0] in KEPT


def mark(items: Sequence[pytest.Item], whole_files: bool) -> None:
    """Mark the listed among the collected items.

    UsageError names one that is listed, or kept, and does not exist, where files were collected as a whole.
    """
    slow = listed()
    for item in items:
        if item.nodeid in slow:
            item.add_marker(pytest.mark.slow)
    files = {item.nodeid.split("::")[0] for item in items} if whole_files else set()
    for name in sorted({*slow, *KEPT} - {item.nodeid for item in items} - files):
        if name.split("::")[0] in files:
            where = "slow.py" if name in KEPT else "slow.txt"
            raise pytest.UsageError(f"tests/{where}: {name} does not exist. Take it out, or give its new name.")


def slow_cases(times: dict[str, float], old: Set[str] = frozenset()) -> set[str]:
    """The slow ones of cases that took so many seconds, and those that were slow before.

    See :data:`SLOW`, :data:`TOO_SLOW` and :data:`KEPT`. The fastest of a test is that of those that were not slow.
    """
    tests: dict[str, list[str]] = defaultdict(list)
    for name in times:
        tests[name.split("[")[0]].append(name)
    slow = set(old)
    for cases in tests.values():
        left = [c for c in cases if c not in old]
        fastest = min(left, key=lambda name: times[name], default="")
        slow |= {c for c in left if times[c] >= (TOO_SLOW if c == fastest else SLOW)}
    return {name for name in slow if not kept(name)}


def times_of(report: Path) -> dict[str, float]:
    """Seconds of every case of a JUnit report, by node id."""
    cases = ElementTree.parse(report).iter("testcase")
    return {f"{c.attrib['classname'].replace('.', '/')}.py::{c.attrib['name']}": float(c.attrib["time"]) for c in cases}


def main(arguments: Sequence[str] | None = None) -> None:
    """Write slow.txt anew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path, help="JUnit report of a run of all tests")
    times = times_of(parser.parse_args(arguments).report)
    old = listed() if LIST.exists() else set()
    names = sorted(slow_cases(times, old))
    head = "# Cases that `make test` leaves out. Made by `python -m tests.slow`, see slow.py.\n"
    LIST.write_text(head + "".join(f"{name}\n" for name in names), encoding="utf-8")
    left = sum(seconds for name, seconds in times.items() if name not in names)
    print(f"{len(names)} slow cases; the others of the report took {left:.0f} s")


if __name__ == "__main__":
    main()
