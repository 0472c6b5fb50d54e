"""Applying breaks to copies of the packages, and asking the tests about them.

Every break gets a folder of its own with the packages and the tests, which stands first on the path of a fresh
process; the working tree is never touched. Compiled kernels come along with the copy. They are stamped with the times
and sizes of the sources in their folder, which copying keeps; so that of the broken folder all kernels are compiled
anew, and nothing broken ever gets back (:mod:`otsync.compute.jit`).
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tests.mutation.breaks import BREAKS, Break

ROOT = Path(__file__).parents[2]

COPIED = ("otsync", "recon", "tests", "pyproject.toml")
"""What a copy holds: the packages, their tests, and what configures them."""

HANGS = 1800.0
"""Seconds after which tests count as hung: dozens of times what they take where nothing is broken."""

PROMISED = 0.95
"""Share of the breaks that tests must catch."""

LATER = 10
"""Seconds by which a broken file is younger than it was: code that was compiled from the sound one is stale."""

NOT_PASSED_ON = ("NUMBA_CACHE_DIR", "OTSYNC_DATA", "OTSYNC_PLUGINS", "PYTEST_ADDOPTS")
"""Of the environment: a cache that copies would share; and what would make the answer depend on the machine."""

PASSED, FAILED, INTERRUPTED = 0, 1, 2
"""Of pytest's exit codes; interrupted: a test file could not be imported."""


@dataclass(frozen=True)
class Outcome:
    """What became of a break. by: the first test that failed, or how it ended; seconds: of the wall."""

    slip: Break
    verdict: Literal["caught", "hung", "survived"]
    by: str
    seconds: float

    @property
    def noticed(self) -> bool:
        return self.verdict != "survived"


def broken(slip: Break, source: str) -> str:
    """``source`` with the break in it. ValueError unless its fragment stands there exactly once."""
    found = source.count(slip.old)
    if found != 1 or "\n" in slip.old:
        raise ValueError(
            f"{slip.name}: expected its fragment once in {slip.file}, on one line; found it {found} times: "
            f"{slip.old!r}. The source has changed: change the break (tests/mutation/breaks.py) with it."
        )
    return source.replace(slip.old, slip.new)


def chosen(names: Sequence[str]) -> tuple[Break, ...]:
    """The breaks of these names; all of them where none are given. ValueError for unknown ones."""
    known = {slip.name: slip for slip in BREAKS}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"--only: expected some of {', '.join(known)}; found {', '.join(unknown)}.")
    return tuple(known[name] for name in names) if names else BREAKS


def mutate(
    slips: Sequence[Break], *, workers: int = 1, whole: bool = False, tell: Callable[[str], None] = print
) -> list[Outcome]:
    """The outcome of every break, in their order.

    Args:
        workers: breaks that are tried at once. whole: ask the other fast tests of the package about what survives.
        tell: receives lines of progress.

    RuntimeError where the tests fail without a break, or run something else than the copy: they would tell nothing.
    """
    with tempfile.TemporaryDirectory(prefix="otsync-mutation-") as folder:
        sound = Path(folder) / "sound"
        copy_packages(sound)
        check_sound(sound, slips, tell)
        outcomes: dict[Break, Outcome] = {}
        with ThreadPoolExecutor(workers) as pool:
            waiting = [pool.submit(tried, slip, sound, Path(folder) / slip.name, whole) for slip in slips]
            try:
                for done in as_completed(waiting):
                    o = done.result()
                    outcomes[o.slip] = o
                    tell(f"[{len(outcomes)}/{len(slips)}] {o.verdict:<8} {o.slip.name:<36} {o.seconds:4.0f} s  {o.by}")
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    return [outcomes[slip] for slip in slips]


def copy_packages(folder: Path) -> None:
    """The working tree's packages and tests, with the times of their files and what is compiled of them."""
    folder.mkdir()
    for part in COPIED:
        copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy2
        copy(ROOT / part, folder / part)


def check_sound(sound: Path, slips: Sequence[Break], tell: Callable[[str], None]) -> None:
    """RuntimeError unless the unbroken copy is what runs, and passes; it also compiles the kernels for the others."""
    show = "import otsync, recon; print(otsync.__file__, recon.__file__)"
    loaded = subprocess.run([sys.executable, "-c", show], cwd=sound, env=environment(sound), capture_output=True)
    paths = loaded.stdout.decode().split()
    if len(paths) != 2 or not all(Path(path).is_relative_to(sound) for path in paths):
        raise RuntimeError(f"path: expected the packages of {sound}; found {paths} {loaded.stderr.decode()[-500:]}")
    tests = sorted({test for slip in slips for test in slip.tests})
    tell(f"without a break: {', '.join(tests)}")
    started = time.perf_counter()
    code, text = asked(sound, tests)
    if code != PASSED:
        raise RuntimeError(f"tests: expected them to pass without a break; found exit code {code}:\n{text[-4000:]}")
    tell(f"they pass ({time.perf_counter() - started:.0f} s)")


def tried(slip: Break, sound: Path, folder: Path, whole: bool) -> Outcome:
    """Break a copy of ``sound`` at ``folder``, which is removed again, and run the tests on it."""
    started = time.perf_counter()

    def told(verdict: Literal["caught", "hung", "survived"], by: str) -> Outcome:
        return Outcome(slip, verdict, by, time.perf_counter() - started)

    with broken_copy(slip, sound, folder):
        package = f"tests/{Path(slip.file).parts[0]}"
        for tests in ([*slip.tests], [package]) if whole else ([*slip.tests],):
            code, text = asked(folder, tests)
            if code is None:
                return told("hung", f"after {HANGS:.0f} s")
            if code in (FAILED, INTERRUPTED) or code < 0:
                failed = re.search(r"^(?:FAILED|ERROR) (\S+)", text, re.MULTILINE)
                return told("caught", failed[1] if failed else f"exit code {code}")
            if code != PASSED:
                raise RuntimeError(f"{slip.name}: expected tests to pass or to fail; pytest ended with {code}:\n{text}")
        return told("survived", slip.meaning)


@contextmanager
def broken_copy(slip: Break, sound: Path, folder: Path) -> Iterator[None]:
    """A copy of ``sound`` at ``folder`` with the break in it, for as long as it is looked at."""
    try:
        shutil.copytree(sound, folder)
        file = folder / slip.file
        before = file.stat().st_mtime_ns
        file.write_text(broken(slip, file.read_text()))
        os.utime(file, ns=(before + LATER * 10**9,) * 2)
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def environment(folder: Path) -> dict[str, str]:
    """Of a process that runs the packages of ``folder`` and nobody else's."""
    own = {name: value for name, value in os.environ.items() if name not in NOT_PASSED_ON}
    behind = [own["PYTHONPATH"]] if own.get("PYTHONPATH") else []
    return own | {"PYTHONPATH": os.pathsep.join([str(folder), *behind]), "OMP_NUM_THREADS": "1"}


def asked(folder: Path, tests: Sequence[str]) -> tuple[int | None, str]:
    """Run fast tests of a copy up to the first failure: pytest's exit code, None where it hung, and what it said."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "--tb=no", "-p", "no:cacheprovider"]
    command += ["--hypothesis-seed=0"]  # the same examples whenever it is run
    process = subprocess.Popen(
        [*command, *tests],
        cwd=folder,
        env=environment(folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL,
        text=True,
        start_new_session=True,  # so that children of tests end with them
    )
    try:
        text, _ = process.communicate(timeout=HANGS)
        return process.returncode, text
    except subprocess.TimeoutExpired:
        return None, ""
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def table(outcomes: Sequence[Outcome]) -> str:
    """What the run found: a row a break, survivors last, and the share that was noticed."""
    rows = sorted(outcomes, key=lambda o: not o.noticed)
    lines = [f"{o.verdict:<8}  {o.slip.name:<36}  {o.by}" for o in rows]
    noticed = sum(o.noticed for o in outcomes)
    return "\n".join([*lines, f"{noticed} of {len(outcomes)} breaks caught: {100 * share(outcomes):.1f} %"])


def share(outcomes: Sequence[Outcome]) -> float:
    """Share of the breaks that tests noticed."""
    return sum(o.noticed for o in outcomes) / len(outcomes)
