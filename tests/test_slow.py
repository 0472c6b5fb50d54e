"""The list of slow cases: which it takes, and that it names no other."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from tests import conftest, slow

ROOT = Path(__file__).parents[1]


def test_slow_are_all_but_the_fastest_case_of_a_test_and_that_too_where_it_takes_long():
    times = {"a.py::one[1]": 5.0, "a.py::one[2]": 3.0, "a.py::one[3]": 1.0, "b.py::two": 3.9, "b.py::three[x]": 9.0}
    times |= {slow.KEPT[-1]: 100.0, f"{slow.KEPT[0]}::in_a_file": 9.0}
    assert slow.slow_cases(times) == {"a.py::one[1]", "a.py::one[2]", "b.py::three[x]"}


def test_the_fastest_case_stays_the_one_that_was():
    old = {"a.py::one[1]"}
    assert slow.slow_cases({"a.py::one[1]": 2.0, "a.py::one[2]": 2.1}, old) == old
    assert slow.slow_cases({"a.py::one[1]": 2.0, "a.py::one[2]": 9.1}, old) == old | {"a.py::one[2]"}


def test_the_list_is_made_of_a_report_and_keeps_what_it_has(tmp_path, monkeypatch, capsys):
    report, names = tmp_path / "report.xml", tmp_path / "slow.txt"
    cases = "".join(
        f'<testcase classname="tests.a.test_b" name="{name}" time="{seconds}"/>'
        for name, seconds in (("test_one[x-1]", 7.5), ("test_two", 0.5))
    )
    report.write_text(f"<testsuites><testsuite>{cases}</testsuite></testsuites>")
    names.write_text("tests/a/test_b.py::test_three\n")
    monkeypatch.setattr(slow, "LIST", names)
    slow.main([str(report)])
    assert slow.listed() == {"tests/a/test_b.py::test_three", "tests/a/test_b.py::test_one[x-1]"}
    assert "2 slow cases; the others of the report took 0 s" in capsys.readouterr().out


def test_a_listed_case_that_does_not_exist_is_named(tmp_path, monkeypatch):
    names = tmp_path / "slow.txt"
    monkeypatch.setattr(slow, "LIST", names)

    class Item:
        def __init__(self, nodeid: str):
            self.nodeid, self.marks = nodeid, []

        def add_marker(self, mark: object) -> None:
            self.marks.append(mark)

    items = [Item("tests/a.py::one"), Item("tests/a.py::two")]
    names.write_text("tests/a.py::two\ntests/b.py::of_a_file_that_was_not_asked_for\n")
    slow.mark(items, whole_files=True)
    assert [len(i.marks) for i in items] == [0, 1]
    names.write_text("tests/a.py::three\n")
    slow.mark(items, whole_files=False)
    with pytest.raises(pytest.UsageError, match=r"slow\.txt: tests/a\.py::three does not exist"):
        slow.mark(items, whole_files=True)


def test_the_files_of_what_is_listed_or_kept_exist():
    """Whether the cases do is told whenever their file is collected."""
    assert all((ROOT / name.split("::")[0]).is_file() for name in (*slow.KEPT, *slow.listed()))


def test_a_kept_case_that_does_not_exist_is_named(tmp_path, monkeypatch):
    (tmp_path / "slow.txt").touch()
    monkeypatch.setattr(slow, "LIST", tmp_path / "slow.txt")

    class Item:
        nodeid = slow.KEPT[-1].split("::")[0] + "::another"

    with pytest.raises(pytest.UsageError, match=r"slow\.py: "):
        slow.mark([Item()], whole_files=True)


@pytest.mark.parametrize(
    ("args", "options", "whole"),
    [
        (["tests"], {}, True),
        (["tests/a.py::one"], {}, False),
        (["tests"], {"lf": True}, False),
        (["tests"], {"stepwise": True}, False),
    ],
)
def test_files_are_whole_but_where_a_part_of_them_was_asked_for(args, options, whole, monkeypatch):
    """``pytest --lf`` collects what failed last: it says nothing of cases that it leaves out."""
    asked = []
    monkeypatch.setattr(conftest, "mark", lambda items, whole_files: asked.append(whole_files))
    config = SimpleNamespace(args=args, getoption=lambda name, default: options.get(name, default))
    conftest.pytest_collection_modifyitems(config, [])
    assert asked == [whole]
