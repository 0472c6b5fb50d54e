"""``otsync audit``."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro

from ..compute.threads import pool_of
from ..progress import tell


@dataclass
class Audit:
    """Is a rig that is said to be synchronised so? Says of each camera whether it is off, by how much, with sigma.

    Example: otsync audit recording/ --out audit
    """

    scene: tyro.conf.Positional[Path]
    """A scene.json, a folder that holds one, or a calibrated folder that a reader knows."""
    out: Path = Path("audit")
    """Folder for audit.json, and the stages of the work, from which a killed run continues."""
    tolerance: float = 0.25
    """Frames that a camera may be off by."""
    cameras: tuple[str, ...] = ()
    """Names of the videos to judge; default: all."""
    allow_outside: bool = False
    """Let the scene name files outside its folder."""
    json: bool = False
    """Print the content of audit.json instead of the table."""

    def run(self) -> int:
        from ..files.claim import claimed

        if not 0 < self.tolerance < 1e6:
            raise ValueError(f"--tolerance: expected frames above 0; found {self.tolerance:g}.")
        with claimed(self.out, "otsync audit"):
            return self._run()

    def _run(self) -> int:
        from ..files.arrays import write_json
        from ..files.cache import Cache
        from ..io import open_scene
        from ..recordings.audit import REMEDIES, audit_scene
        from .tables import print_json

        scene = open_scene(self.scene, allow_outside=self.allow_outside)
        if self.cameras:
            scene = scene.take(self.cameras)
        with pool_of(os.cpu_count() or 1) as pool:
            told = audit_scene(
                scene, tolerance=self.tolerance, cache=Cache(self.out / "stages"), map=pool.map, tell=tell
            )
        rows = [asdict(c) | {"flags": [f.code for f in c.flags], "remedy": REMEDIES[c.finding]} for c in told.cameras]
        document: dict[str, Any] = {
            "format": "otsync.audit",
            "version": 1,
            "unit": "frames; positive: late against the majority",
            "tolerance": self.tolerance,
            "cameras": [{k: _finite(v) for k, v in row.items()} for row in rows],
        }
        write_json(self.out / "audit.json", document)
        if self.json:
            print_json(document)
        else:
            width = max(6, *(len(c.name) for c in told.cameras))
            print(f"{'camera':{width}}  {'frames':>8} {'sigma':>7} {'jitter':>7}  verdict")
            for c in told.cameras:
                verdict = " ".join(filter(None, [c.finding.replace("_", " "), c.why and f"({c.why})"]))
                print(f"{c.name:{width}}  {c.frames:+8.3f} {c.sigma:7.3f} {c.jitter:7.3f}  {verdict}")
            for finding in ("off", "unsure"):
                if any(c.finding == finding for c in told.cameras):
                    print(f"{finding}: {REMEDIES[finding]}")
            print(f"{len(told.alarms)} off, {len(told.unsure)} unsure; wrote {self.out / 'audit.json'}")
        return 1 if told.alarms or told.unsure else 0


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and value != value else value
