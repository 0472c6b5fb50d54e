"""What the allocator does with memory that was freed."""

from __future__ import annotations

import subprocess
import sys

import pytest

from otsync.compute.memory import LARGE

PROGRAM = """
import sys
import numpy as np
from otsync.compute.memory import give_back_large_arrays

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096

assert sys.argv[2] == "as it is" or give_back_large_arrays() or sys.exit(3)
np.ones(3 * int(sys.argv[1]) // 8)  # freed at once: from now on what is smaller goes to the heap, unless told otherwise
before = resident()
kept, gone = [], []
for k in range(20):  # what is freed lies between what is kept
    gone.append(np.ones(2 * int(sys.argv[1]) // 8))
    kept.append(np.ones(1000))
gone.clear()
print(resident() - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_large_arrays_go_back_to_the_system_when_they_are_freed():
    def left(how: str) -> int:
        done = subprocess.run([sys.executable, "-c", PROGRAM, str(LARGE), how], capture_output=True, text=True)
        if done.returncode == 3:
            pytest.skip("the C library has no mallopt")
        assert done.returncode == 0, done.stderr
        return int(done.stdout)

    assert left("given back") < LARGE
    assert left("given back") <= left("as it is")
