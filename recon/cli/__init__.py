"""Reconstruct a moving scene from synchronised videos: ``recon fit | render | eval | export | simulate | bench |
lifting``.

Exit codes: 0 done; 1 an answer is not to be trusted (it is written all the same); 2 bad arguments or files; 130
interrupted: the same command continues where it stopped.
"""

from __future__ import annotations

import sys

from otsync.cli.shell import missing_package, run_command
from recon.cli.commands import commands


def main(args: list[str] | None = None) -> int:
    """Entry point of the ``recon`` command."""
    try:
        from recon.fit.run import Diverged
    except ModuleNotFoundError as error:  # torch, most likely
        print(f"recon: {missing_package(error)}", file=sys.stderr)
        return 2
    return run_command(
        "recon",
        commands,
        args,
        description=__doc__ or "",
        refused=(Diverged, FloatingPointError),
        interrupted="the same command continues from here.",
    )
