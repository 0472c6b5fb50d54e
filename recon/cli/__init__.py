"""Reconstruct a moving scene from synchronised videos: ``recon fit | render | eval | export | simulate | bench |
lifting``.

Exit codes: 0 done; 1 an answer is not to be trusted (it is written all the same); 2 bad arguments or files; 130
interrupted: the same command continues where it stopped.
"""

from __future__ import annotations

from contextlib import suppress

from otsync.cli.shell import run_command
from recon.cli.commands import commands


def main(args: list[str] | None = None) -> int:
    """Entry point of the ``recon`` command."""
    refused: tuple[type[Exception], ...] = (FloatingPointError,)
    # without torch the commands say what to install; the help and the version need none
    with suppress(ModuleNotFoundError):
        from recon.fit.run import Diverged

        refused = (Diverged, FloatingPointError)
    return run_command(
        "recon",
        commands,
        args,
        description=__doc__ or "",
        refused=refused,
        interrupted="the same command continues from here.",
    )
