"""Readers: which layouts of recordings can be opened. A new one is one file, and one line in :data:`READERS`."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from ..plugins import available
from .datasets import DATASETS
from .footage import ImageFolders, VideoFiles, VideosAndImages
from .panoptic import Panoptic
from .pose2sim import Pose2Sim

SHOWN = 6
"""Entries of a folder that an error names."""


class Reader(Protocol):
    """A layout of recordings in a folder.

    Two attributes may be missing: ``brings``, what it takes from there, in words, for the table in the docs; and
    ``insists``, whether it describes a folder that it does not claim where it is named (it does not).
    """

    name: str
    """As ``otsync init --reader`` spells it."""
    looks_for: str
    """What the reader expects in a folder, in one line."""

    def claims(self, folder: Path) -> bool:
        """Whether the folder has this layout; cheap, nothing is decoded."""
        ...

    @property
    def describe(self) -> Callable[..., dict[str, Any]]:
        """``describe(folder, **options)``: the folder as a scene document (see :mod:`otsync.io.scene`).

        Options have defaults, and only those that the reader uses. Nothing is guessed: what no file tells is null, and
        ``missing`` lists it in words; ``notes`` says what was assumed.
        """
        ...


READERS: tuple[Reader, ...] = (Panoptic(), Pose2Sim(), *DATASETS, VideosAndImages(), VideoFiles(), ImageFolders())
"""otsync's own readers, in the order in which they are asked; plugins are asked before them."""


def readers() -> dict[str, Reader]:
    """Every reader by name, in the order in which they are asked.

    Plugins come first: their layouts are the more special ones, while many a folder holds images.
    """
    by_name = {
        name: thing() if isinstance(thing, type) else thing for name, thing in available("readers", READERS).items()
    }
    own = {reader.name: by_name.pop(reader.name) for reader in READERS}
    return by_name | own


def find_reader(folder: str | os.PathLike[str], name: str | None = None) -> tuple[str, Reader]:
    """The named reader, or the first that claims the folder; with its name.

    ValueError where there is no such folder or reader, or none claims the folder: then it lists them all.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of recordings; found none. Check the path.")
    known = readers()
    if name is not None and name not in known:
        raise ValueError(f"reader: expected one of {', '.join(known)}; found {name!r}.")
    asked = list(known) if name is None else [name]
    for each in asked:
        if known[each].claims(folder) or (name is not None and getattr(known[each], "insists", False)):
            return each, known[each]
    there = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    if not there and name is None:
        raise ValueError(f"{folder}: expected videos, or a recording in a known layout; found nothing in it.")
    wanted = "; ".join(f"{each}: {_looks_for(known[each])}" for each in asked)
    raise ValueError(
        f"{folder}: expected a layout that a reader knows ({wanted}); found {_listed(there)}. Check the path."
    )


def _listed(names: Sequence[str]) -> str:
    """The first few of a folder's entries."""
    shown = ", ".join(repr(name) for name in names[:SHOWN])
    return f"{shown} and {len(names) - SHOWN} more" if len(names) > SHOWN else shown or "nothing"


def claiming(folder: str | os.PathLike[str]) -> list[str]:
    """The names of all readers that claim the folder, in the order in which they are asked."""
    return [name for name, reader in readers().items() if reader.claims(Path(folder))]


def options_of(reader: Reader) -> list[str]:
    """The names of the options that a reader takes."""
    parameters = list(inspect.signature(reader.describe).parameters.values())[1:]
    return [p.name for p in parameters if p.kind is not p.VAR_KEYWORD]


def table() -> str:
    """otsync's own readers as a table in Markdown, of their own declarations: what docs/recording.md holds."""
    rows = ["| reader | looks for | takes from there | options |", "|---|---|---|---|"]
    for reader in READERS:
        options = ", ".join(f"`--{option}`" for option in options_of(reader)) or "–"
        brings = getattr(reader, "brings", "–")
        rows.append(f"| `{reader.name}` | {reader.looks_for} | {brings} | {options} |")
    return "\n".join(rows) + "\n"


def describe_folder(folder: str | os.PathLike[str], *, reader: str | None = None, **options: Any) -> dict[str, Any]:
    """A scene document for a folder of recordings.

    Calibration is not guessed: fields that no file tells are null, and ``missing`` lists them in words.

    Args:
        reader: the name of one of :func:`readers`; default: the first that claims the folder.
        options: what the reader takes, such as ``fps`` of images, which carry no clock. None: not given. ValueError
            for an option that it does not take.
    """
    name, chosen = find_reader(folder, reader)
    given = {option: value for option, value in options.items() if value is not None}
    takes = options_of(chosen)
    parameters = inspect.signature(chosen.describe).parameters.values()
    anything = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    for option in given:
        if option not in takes and not anything:
            raise ValueError(
                f"{option}: the reader {name} does not take it; it takes {', '.join(takes) or 'no options'}. Leave it "
                "out, or name another reader."
            )
    return chosen.describe(Path(folder), **given)


def _looks_for(reader: Reader) -> str:
    """In a line; a reader of a plugin may say it in its docstring alone."""
    return getattr(reader, "looks_for", None) or (inspect.getdoc(reader) or "a layout of its own").partition("\n")[0]
