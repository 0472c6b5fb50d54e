"""What the commands ``otsync`` and ``recon`` share: options into an object that runs, errors into exit codes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import tyro

from . import __version__

EXTRAS = {
    "torch": "recon", "plyfile": "recon", "av": "video", "cv2": "video", "PIL": "video", "gsplat": "cuda",
    "ott": "rivals", "jax": "rivals",
}  # fmt: skip
"""The extra of otsync (pyproject.toml) that brings a package, by the name that it is imported by."""


def lacking(error: ModuleNotFoundError) -> str:
    """Which package is not there, and what to install."""
    if not error.name:
        return f"needs a package that is not installed: {error}"
    package = error.name.partition(".")[0]
    extra = EXTRAS.get(package)
    what = "otsync" if extra is None else f"'otsync[{extra}]'"
    return f"needs {error.name}. Install it: pip install {what}."


def run_command(
    prog: str,
    commands: Mapping[str, Callable[..., Any]],
    args: Sequence[str] | None,
    *,
    description: str | None,
    refused: tuple[type[Exception], ...],
    interrupted: str,
) -> int:
    """Run the subcommand that ``args`` (default: the process's) name; the exit code.

    Args:
        commands: dataclasses with a ``run`` method that gives the exit code, by name.
        refused: errors that mean an answer is not to be trusted: exit code 1. Bad arguments or files (ValueError,
            OSError, a package that is not installed) give 2, an interrupt 130.
        interrupted: what an interrupted run leaves behind, in words.
    """
    args = sys.argv[1:] if args is None else list(args)
    if args == ["--version"]:
        print(f"{prog} {__version__}")
        return 0
    command = tyro.extras.subcommand_cli_from_dict(
        dict(commands), prog=prog, description=description, args=args,
        config=(tyro.conf.AvoidSubcommands,) if not args else (),
    )  # fmt: skip
    try:
        return command.run()
    except refused as error:
        code, said = 1, str(error)
    except ModuleNotFoundError as error:
        code, said = 2, lacking(error)
    except (ValueError, OSError) as error:
        code, said = 2, str(error)
    except KeyboardInterrupt:
        code, said = 130, f"interrupted; {interrupted}"
    print(f"{prog}: {said}", file=sys.stderr)
    return code
