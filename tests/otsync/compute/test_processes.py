"""Calls in other processes: what they answer, and what happens where they end, are interrupted, or cannot begin."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from otsync.compute.processes import Processes


def double(x):
    return 2 * x, os.getpid()


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
        print("napping", os.getpid(), flush=True)
    time.sleep(seconds)


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_no_process_outlives_its_parent(tmp_path, how):
    script = tmp_path / "parent.py"
    script.write_text(CHILD.format(here=os.path.dirname(__file__)))
    parent = subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert parent.stdout is not None and parent.stderr is not None
    children = [int(parent.stdout.readline().split()[1]) for _ in range(2)]
    assert all(map(alive, children))
    if how == signal.SIGKILL:
        parent.kill()
        deadline = time.monotonic() + 60
        while any(map(alive, children)):
            assert time.monotonic() < deadline, "a process lives on"
            time.sleep(0.05)
    else:
        os.killpg(parent.pid, how)  # as a terminal does: only the parent is to hear it
        time.sleep(1)
        assert all(map(alive, children))
        os.killpg(parent.pid, signal.SIGKILL)
    parent.communicate()
