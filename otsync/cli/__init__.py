"""Synchronise videos of one moving scene: ``otsync demo | simulate | match | init | check | sync | run | bench``.

Exit codes: 0 done; 1 an answer was refused (its status is printed); 2 bad arguments or files; 130 interrupted, by
Ctrl-C or SIGTERM.
"""

from __future__ import annotations

import os
import sys

from ..types import Refused
from .commands import commands
from .shell import run_command


def main(args: list[str] | None = None) -> int:
    """Entry point of the ``otsync`` command."""
    if args is None and not any("device" in word for word in sys.argv):
        # POT imports every tensor library that is installed: torch costs two seconds and a quarter of a gigabyte
        for library in ("PYTORCH", "JAX", "CUPY", "TENSORFLOW"):
            os.environ.setdefault(f"POT_BACKEND_DISABLE_{library}", "1")
    return run_command(
        "otsync",
        commands,
        args,
        description=__doc__ or "",
        refused=(Refused,),
        interrupted="nothing half-written is left, and the same command may be given again.",
    )
