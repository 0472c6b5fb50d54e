"""Things that come from outside the packages: in a file, and in an installed package, as pip leaves one."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from otsync.plugins import short_name

ROOT = Path(__file__).parents[2]

Shell = Callable[..., subprocess.CompletedProcess]


def file_with(folder: Path, text: str, kinds: dict[str, str]) -> Path:
    """A file in ``folder`` that registers the things of ``text``; arguments as of :func:`shell_with`."""
    lines = {group: f'@register("{group}")' for group in kinds}
    path = folder / "my_things.py"
    path.write_text("from otsync.plugins import register\n" + text.format(**lines))
    return path


def shell_with(way: str, folder: Path, text: str, kinds: dict[str, str]) -> Shell:
    """The commands with the things of ``text`` added: ``shell("otsync", "sync", ...)``.

    Args:
        way: "file" (``--plugin``) or "installed" (a package with entry points, on the path).
        text: source with a line ``{group}`` over each class. kinds: the class of each group.
    """
    environment, first = dict(os.environ), []
    if way == "file":
        first = ["--plugin", str(file_with(folder, text, kinds))]
    else:
        (folder / "their_things.py").write_text(text.format(**dict.fromkeys(kinds, "")))
        metadata = folder / "theirs-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
        points = "".join(
            f"[otsync.{group}]\n{short_name(type(name, (), {}))} = their_things:{name}\n\n"
            for group, name in kinds.items()
        )
        (metadata / "entry_points.txt").write_text(points)
        environment["PYTHONPATH"] = os.pathsep.join([str(folder), environment.get("PYTHONPATH", "")])

    def run(program: str, *args: str) -> subprocess.CompletedProcess:
        return subprocess.run(
            [sys.executable, "-m", f"{program}.cli", *first, *args],
            capture_output=True,
            text=True,
            cwd=ROOT,
            env=environment | {"COLUMNS": "2000"},
        )

    return run


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
