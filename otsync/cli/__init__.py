"""Synchronise videos of one moving scene: ``otsync demo | simulate | match | init | check | sync | run | bench``.

Exit codes: 0 done; 1 an answer was refused (its status is printed); 2 bad arguments or files; 130 interrupted, by
Ctrl-C or SIGTERM.
"""

from __future__ import annotations

from ..types import Refused
from .commands import commands
from .shell import run_command


def main(args: list[str] | None = None) -> int:
    """Entry point of the ``otsync`` command."""
    return run_command(
        "otsync",
        commands,
        args,
        description=__doc__ or "",
        refused=(Refused,),
        interrupted="nothing half-written is left.",
    )
