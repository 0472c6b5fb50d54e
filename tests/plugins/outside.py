"""Things that come from outside the packages: in a file, and in an installed package, as pip leaves one."""

from __future__ import annotations

import importlib
import io
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from otsync import plugins
from otsync.plugins import short_name
from otsync.progress import be_quiet

ROOT = Path(__file__).parents[2]


def file_with(folder: Path, text: str, kinds: dict[str, str], name: str = "my_things") -> Path:
    """A file in ``folder`` that registers the things of ``text``; arguments as of :func:`shell_with`."""
    lines = {group: f'@register("{group}")' for group in kinds}
    path = folder / f"{name}.py"
    path.write_text("from otsync.plugins import register\n" + text.format(**lines))
    return path


@dataclass
class Shell:
    """The commands with things added: ``shell("otsync", "sync", ...)`` runs one in this process, as a user's would be.

    ``shell.alone(...)`` runs one in a process of its own, which takes seconds to start: once a test is enough.
    """

    folder: Path
    first: list[str]
    environment: dict[str, str]

    def __call__(self, program: str, *args: str) -> subprocess.CompletedProcess:
        main = importlib.import_module(f"{program}.cli").main
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            try:
                code = main([*self.first, *args])
            except SystemExit as stop:
                code = int(stop.code or 0)
        be_quiet(False)
        return subprocess.CompletedProcess([program, *args], code, out.getvalue(), err.getvalue())

    def alone(self, program: str, *args: str) -> subprocess.CompletedProcess:
        return subprocess.run(
            [sys.executable, "-m", f"{program}.cli", *self.first, *args],
            capture_output=True,
            text=True,
            cwd=ROOT,
            env=os.environ | self.environment,
        )


@contextmanager
def shell_with(way: str, folder: Path, text: str, kinds: dict[str, str]) -> Iterator[Shell]:
    """A shell with the things of ``text`` added; they are gone at the end.

    Args:
        way: "file" (``--plugin``) or "installed" (a package with entry points, on the path).
        text: source with a line ``{group}`` over each class. kinds: the class of each group.
    """
    environment, first = {"COLUMNS": "2000"}, []
    module = f"{way}_things_{abs(hash(str(folder)))}"  # modules of one name would be taken for each other
    if way == "file":
        path = file_with(folder, text, kinds, module)
        first = ["--plugin", str(path)]
    else:
        (folder / f"{module}.py").write_text(text.format(**dict.fromkeys(kinds, "")))
        metadata = folder / "theirs-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
        points = "".join(
            f"[otsync.{group}]\n{short_name(type(name, (), {}))} = {module}:{name}\n\n" for group, name in kinds.items()
        )
        (metadata / "entry_points.txt").write_text(points)
        environment["PYTHONPATH"] = os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])
        sys.path.append(str(folder))
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)  # worker processes read it too
        try:
            yield Shell(folder, first, environment)
        finally:
            loaded = sys.modules.pop(module, None)
            if loaded is not None:
                plugins.forget(*vars(loaded).values())
            plugins._files.pop(folder.resolve() / f"{module}.py", None)
            sys.path[:] = [p for p in sys.path if p != str(folder)]


OF_SCENES = '''
from dataclasses import dataclass, replace

from recon.losses import ImageLoss
from recon.observe import Effect
from recon.result import Exporter

{losses}
@dataclass(frozen=True)
class Colourless(ImageLoss):
    """Grey levels alone."""

    weight: float = 0.5

    def __call__(self, seen):
        return (seen.rendered.mean(-1) - seen.image.mean(-1)).square().mean()


{effects}
@dataclass(frozen=True)
class Dimmed(Effect):
    """Less light than there is."""

    share: float = 0.9
    instant = True

    def wrap(self, observe, params):
        def dimmed(shot):
            seen = observe(shot)
            return replace(seen, rgb=seen.rgb * self.share)

        return dimmed


{exporters}
class Counted(Exporter):
    """The number of Gaussians."""

    name, file, holds = "counted", "count.txt", "everything"

    def write(self, scene, out, times, frame):
        out.write_text(str(len(scene)))
'''

KINDS_OF_SCENES = {"losses": "Colourless", "effects": "Dimmed", "exporters": "Counted"}
"""The class of each group in ``OF_SCENES``."""
