"""Arrays in files without a name: what is written is read, memory is given back, and no file stays."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from otsync.files.scratch import Scratch, release


@pytest.mark.parametrize("in_file", [True, False])
def test_rows_are_read_as_they_were_written(tmp_path, in_file):
    rng = np.random.default_rng(0)
    rows = rng.integers(0, 255, (7, 5, 4, 3), np.uint8)
    kept = Scratch((5, 4, 3), folder=tmp_path / "new" if in_file else None)
    for row in rows:
        kept.append(row)
    kept.append(None)
    array = kept.array()
    assert array.shape == (8, 5, 4, 3) and array.dtype == np.uint8
    for _ in range(2):
        assert np.array_equal(array[:7], rows) and not array[7].any()
        release(array[2:])
    assert not in_file or not os.listdir(tmp_path / "new")
    with pytest.raises(ValueError, match=r"row: expected shape \(5, 4, 3\); found \(5, 4\)"):
        Scratch((5, 4, 3)).append(np.zeros((5, 4)))


def test_nothing_is_an_array_too(tmp_path):
    assert Scratch((3, 2), np.float32, tmp_path).array().shape == (0, 3, 2)
    assert Scratch((3, 2)).array().shape == (0, 3, 2)
    release(None)
    release(np.zeros(3))


LOOK = """
import sys
from pathlib import Path
import numpy as np
from otsync.files.scratch import Scratch, release

def pages():
    lines = Path("/proc/self/status").read_text().splitlines()
    return {line.split(":")[0]: int(line.split()[1]) for line in lines if line.startswith("Rss")}

kept = Scratch((2**20,), folder=Path(sys.argv[1]))
for k in range(64):
    kept.append(np.full(2**20, k, np.uint8))
array = kept.array()
before = pages()
assert int(array[::1, ::4096].sum(dtype=int)) == 256 * sum(range(64))
seen = pages()
release(array)
after = pages()
print(seen["RssFile"] - before["RssFile"], after["RssFile"] - before["RssFile"], seen["RssAnon"] - before["RssAnon"])
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory by kind is told by Linux alone")
def test_memory_is_the_file_s_and_is_given_back(tmp_path):
    told = subprocess.run([sys.executable, "-c", LOOK, str(tmp_path)], capture_output=True, text=True, check=True)
    seen, after, own = map(int, told.stdout.split())
    assert seen > 60_000 and after < 4000 and own < 4000  # kB; the file has 65536


def test_a_full_disk_is_an_error_of_writing(tmp_path):
    """A file that may not grow stands for a disk that is full: an error, not a fault of the process later."""
    code = (
        "import resource, signal, sys; from pathlib import Path; from otsync.files.scratch import Scratch\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, 2**20))\n"
        "kept = Scratch((2**19,), folder=Path(sys.argv[1]))\n"
        "try:\n    [kept.append(None) for _ in range(3)]\nexcept OSError as error:\n    print('refused', error.errno)\n"
    )
    told = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert told.stdout.startswith("refused")
