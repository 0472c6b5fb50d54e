"""The commands of ``recon``."""

from __future__ import annotations

from otsync.cli.shell import Load, from_places

OWN = {
    "fit": "recon.cli.fit:Fit",
    "render": "recon.cli.show:Render",
    "eval": "recon.cli.show:Eval",
    "export": "recon.cli.show:Export",
    "simulate": "recon.cli.simulate:Simulate",
    "bench": "recon.cli.bench:Bench",
    "lifting": "recon.cli.bench:LiftingBench",
}


def commands() -> dict[str, Load]:
    """What loads each command, by name."""
    return from_places(OWN)
