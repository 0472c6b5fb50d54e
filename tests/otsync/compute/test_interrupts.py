"""Interrupts: sections that they may not tear, pools and kernels that outlive them, and one that is swallowed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from otsync.cli.shell import run_command
from otsync.compute.interrupts import uninterrupted
from otsync.compute.jit import kernel
from otsync.compute.threads import pool_of


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_waits_for_the_end_of_the_block(number):
    came, before = [], signal.getsignal(signal.SIGTERM)
    own = signal.signal(number, lambda n, frame: came.append(n))
    try:
        with uninterrupted():
            signal.raise_signal(number)
            assert not came
        assert came == [number]
    finally:
        signal.signal(number, own)
    assert signal.getsignal(signal.SIGTERM) is before
    with pytest.raises(KeyboardInterrupt), uninterrupted():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)


def test_a_terminated_process_ends_though_nobody_handles_the_signal():
    code = (
        "import signal; from otsync.compute.interrupts import uninterrupted\n"
        "with uninterrupted():\n    signal.raise_signal(signal.SIGTERM); print('whole', flush=True)\nprint('not')"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert told.returncode == -signal.SIGTERM and told.stdout == "whole\n"


def test_another_thread_is_told_nothing():
    def inside() -> None:
        with uninterrupted():
            handlers.append(signal.getsignal(signal.SIGINT))

    handlers: list[object] = []
    thread = threading.Thread(target=inside)
    thread.start()
    thread.join()
    assert handlers == [signal.getsignal(signal.SIGINT)]


def test_all_threads_of_a_pool_have_begun():
    with pool_of(3, "begun") as pool:
        named = [t.name for t in threading.enumerate() if t.name.startswith("begun")]
        assert len(named) == 3
        assert list(pool.map(lambda x: x + 1, range(5))) == [1, 2, 3, 4, 5]


def test_an_interrupt_waits_for_a_kernel_to_be_compiled():
    """A lock of LLVM that stayed closed would let the next kernel wait without end."""

    def slowly(x):
        total = 0.0
        for i in range(len(x)):
            total += np.sqrt(x[i])
        return total

    compiled = kernel()(slowly)
    timer = threading.Timer(0.05, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        compiled(np.ones(4))
        time.sleep(5)
    assert compiled.signatures  # the compilation that the signal came into was finished
    assert compiled(np.ones(4)) == 4


class Command:
    """What a command is to the shell."""

    what = staticmethod(lambda: 0)

    def run(self) -> int:
        return self.what()


def ran(what) -> int:
    chosen = type("Chosen", (Command,), {"what": staticmethod(what)})
    made = lambda: chosen()  # noqa: E731 - tyro reads its annotations: there are none
    return run_command(
        "prog", lambda: {"x": lambda: made}, ["x"], description="", refused=(), interrupted="nothing is left"
    )


@pytest.mark.parametrize(("patience", "clearing"), [(0.1, 1.0), (1.0, 0.0)])
def test_a_command_that_takes_long_to_end_says_what_it_waits_for(patience, clearing, monkeypatch, capfd):
    monkeypatch.setattr("otsync.cli.shell.PATIENCE", patience)

    def slow_to_end() -> int:
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            time.sleep(clearing)
        return 0

    assert ran(slow_to_end) == 130
    time.sleep(max(0.0, 1.2 * (patience - clearing)))  # one that has ended says nothing afterwards
    told = capfd.readouterr().err
    assert told.count("waits for what is under way") == (clearing > patience)
    assert told.rstrip().endswith("prog: interrupted; nothing is left")


def test_an_interrupt_that_can_begin_no_thread_is_one_all_the_same(monkeypatch, capsys):
    def none_left(*_: object) -> int:
        raise RuntimeError("can't start new thread")

    def stubborn() -> int:
        try:
            signal.raise_signal(signal.SIGINT)
        except RuntimeError:
            return 0
        return 0

    monkeypatch.setattr("otsync.cli.shell._thread.start_new_thread", none_left)
    assert ran(stubborn) == 130
    assert "prog: interrupted; nothing is left" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_that_a_callback_swallows_comes_again(number, capsys):
    import weakref

    class Thing:
        pass

    def swallowing() -> int:
        thing = Thing()
        kept = weakref.ref(thing, lambda _: signal.raise_signal(number))
        del thing  # the callback's error cannot be raised here
        assert kept() is None
        time.sleep(30)
        return 0

    started = time.perf_counter()
    assert ran(swallowing) == 130
    assert time.perf_counter() - started < 20
    assert "prog: interrupted; nothing is left" in capsys.readouterr().err


def test_what_a_library_makes_of_an_interrupt_is_one(capsys):
    def other() -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise RuntimeError("generator raised StopIteration") from None
        return 0

    assert ran(other) == 130 and "interrupted" in capsys.readouterr().err
    with pytest.raises(RuntimeError, match="of its own"):
        ran(lambda: (_ for _ in ()).throw(RuntimeError("of its own")))
