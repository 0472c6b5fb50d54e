"""Calls in other processes: what they answer, and what happens where they end, are interrupted, or cannot begin."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType, SimpleNamespace

import pytest

from otsync.compute.processes import Processes, process_pool


def double(x):
    return 2 * x, os.getpid()


def where(item):
    return os.getpid()


def refuse(x):
    raise RuntimeError(f"not {x}")


def die_elsewhere(parent):
    if os.getpid() != parent:
        os._exit(3)
    return "done here"


def test_calls_are_made_in_other_processes_and_answered_in_order():
    with Processes(2) as call, ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda x: call(double, x), range(12)))
    assert [x for x, _ in found] == list(range(0, 24, 2))
    assert 1 <= len({pid for _, pid in found} - {os.getpid()}) <= 2
    assert os.getpid() not in {pid for _, pid in found}


def test_one_worker_is_this_process_and_so_is_a_closed_block():
    with Processes(1) as call:
        assert call(double, 3) == (6, os.getpid())
    with Processes(2) as call:
        pass
    assert call(double, 3) == (6, os.getpid())


def test_exceptions_come_back():
    with Processes(2) as call, pytest.raises(RuntimeError, match="not 7"):
        call(refuse, 7)


def test_where_a_process_ends_the_work_is_done_here(caplog):
    with Processes(2) as call, ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda x: call(die_elsewhere, x), [os.getpid()] * 8))
        assert found == ["done here"] * 8
        assert call(double, 1) == (2, os.getpid())
    assert "going on in one process" in caplog.text


def test_where_the_system_gives_no_processes_the_work_is_done_here(monkeypatch):
    def refused(*args, **options):
        raise OSError("no semaphores")

    monkeypatch.setattr("otsync.compute.processes.ProcessPoolExecutor", refused)
    with Processes(2) as call:
        assert call(double, 3) == (6, os.getpid())


@pytest.mark.parametrize("item", [lambda: 5, SimpleNamespace(hold=lambda: 5)])
def test_what_cannot_be_sent_is_done_here(item):
    with Processes(2) as call:
        assert call(lambda x: os.getpid(), 1) == os.getpid()
        assert call(where, item) == os.getpid()
        assert call(where, 1) != os.getpid()


def test_what_the_other_process_does_not_know_is_done_here(monkeypatch):
    """As classes of a notebook: pickled by name, and nobody else can read them."""
    module = ModuleType("of_this_session")
    exec("class Item: pass", module.__dict__)
    monkeypatch.setitem(sys.modules, "of_this_session", module)
    module.Item.__module__ = "of_this_session"
    with Processes(2) as call:
        assert call(where, module.Item()) == os.getpid()
        assert call(where, 1) != os.getpid()


def test_fewer_than_one_are_refused():
    with pytest.raises(ValueError, match="workers: expected at least one process; found 0"):
        Processes(0)


CHILD = """
import os, sys, time
sys.path.insert(0, {here!r})
from test_processes import nap
from concurrent.futures import ThreadPoolExecutor
from otsync.compute.processes import Processes
if __name__ == "__main__":
    with Processes(2) as call, ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda s: call(nap, s), [0.0, 0.0, 60.0, 60.0]))
"""


def nap(seconds):
    if seconds:
        os.write(1, f"napping {os.getpid()}\n".encode())  # at once: two write to one pipe
    time.sleep(seconds)


def counted_nap(seconds):
    """Beside a bar of progress, whose own lock would be left behind."""
    from otsync.progress import counted

    for _ in counted([0], "naps", "nap"):
        nap(seconds)


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


POOL = """
import os, sys, time
sys.path.insert(0, {here!r})
from test_processes import counted_nap
from otsync.compute.processes import process_pool
if __name__ == "__main__":
    with process_pool(2) as pool:
        list(pool.map(counted_nap, [60.0, 60.0, 60.0]))
"""


def napping(tmp_path, code=CHILD):
    """A process of which two children nap, and these."""
    script = tmp_path / "parent.py"
    script.write_text(code.format(here=os.path.dirname(__file__)))
    parent = subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert parent.stdout is not None
    return parent, [int(parent.stdout.readline().split()[1]) for _ in range(2)]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
def test_no_process_outlives_its_parent(tmp_path):
    parent, children = napping(tmp_path)
    assert all(map(alive, children))
    parent.kill()
    deadline = time.monotonic() + 60
    while any(map(alive, children)):
        assert time.monotonic() < deadline, "a process lives on"
        time.sleep(0.05)
    parent.communicate()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
def test_ctrl_c_is_the_parents(tmp_path):
    """A terminal sends it to all: those that compare end their pair, and say nothing."""
    parent, children = napping(tmp_path)
    os.killpg(parent.pid, signal.SIGINT)
    time.sleep(1)
    assert all(map(alive, children))
    os.killpg(parent.pid, signal.SIGKILL)
    parent.communicate()


def test_a_pool_s_processes_begin_as_they_are_told_and_answer_in_order():
    with process_pool(2, begin, ("told",)) as pool:
        assert list(pool.map(begun, [1, 2, 3])) == [(1, "told"), (2, "told"), (3, "told")]


TOLD = []


def begin(word):
    TOLD.append(word)


def begun(item):
    return item, *TOLD


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
@pytest.mark.parametrize("group", [False, True], ids=["parent", "all, as a terminal does"])
def test_an_interrupted_pool_does_not_wait_for_its_jobs(tmp_path, group):
    """And its processes say nothing; the one line is the parent's own."""
    parent, children = napping(tmp_path, POOL)
    (os.killpg if group else os.kill)(parent.pid, signal.SIGINT)
    _, said = parent.communicate(timeout=50)  # naps take a minute
    assert not any(map(alive, children))
    assert said.count("Traceback") == 1 and said.rstrip().endswith("KeyboardInterrupt")
