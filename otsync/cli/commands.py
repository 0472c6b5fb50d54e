"""The commands of ``otsync``: our own, and those that other packages bring (entry points in ``otsync.commands``)."""

from __future__ import annotations

from ..plugins import entries, registered
from .shell import Load, from_places

OWN = {
    "simulate": "otsync.cli.simulate:Simulate",
    "match": "otsync.cli.match:Match",
    "init": "otsync.cli.recordings:Init",
    "film": "otsync.cli.calibrate:Film",
    "calibrate": "otsync.cli.calibrate:Calibrate",
    "check": "otsync.cli.recordings:Check",
    "sync": "otsync.cli.sync:Sync",
    "audit": "otsync.cli.audit:Audit",
    "import-offsets": "otsync.cli.import_offsets:ImportOffsets",
    "export": "otsync.cli.export:Export",
    "bench": "otsync.cli.bench:Bench",
    "plugins": "otsync.cli.plugins:Plugins",
}


def commands() -> dict[str, Load]:
    """What loads each command, by name. ``run`` and ``demo`` come from :mod:`recon`, as any package's could."""
    installed = {name: point.load for name, point in entries("commands").items()}
    added = {name: (lambda thing=thing: thing) for name, thing in registered("commands").items()}
    return from_places(OWN) | installed | added
