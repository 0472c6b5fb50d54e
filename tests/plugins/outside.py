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


def shell_with(way: str, folder: Path, text: str, kinds: dict[str, str]) -> Shell:
    """The commands with the things of ``text`` added: ``shell("otsync", "sync", ...)``.

    Args:
        way: "file" (``--plugin``) or "installed" (a package with entry points, on the path).
        text: source with a line ``{group}`` over each class. kinds: the class of each group.
    """
    environment, first = dict(os.environ), []
    if way == "file":
        lines = {group: f'@register("{group}")' for group in kinds}
        source = "from otsync.plugins import register\n" + text.format(**lines)
        (folder / "my_things.py").write_text(source)
        first = ["--plugin", str(folder / "my_things.py")]
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
