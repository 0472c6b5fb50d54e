"""Every option of a command, as dotted names; slots name the algorithm: ``matcher:PartialFGW.mass``."""

from __future__ import annotations

import dataclasses
import importlib
import types
import typing
from collections.abc import Iterator
from typing import Any


def options_of(place: str) -> list[str]:
    """Options of the command at ``module:Class``."""
    module, _, name = place.partition(":")
    return list(_walk(getattr(importlib.import_module(module), name), ""))


def _walk(cls: Any, prefix: str) -> Iterator[str]:
    hints = typing.get_type_hints(cls, include_extras=True)
    for field in dataclasses.fields(cls):
        kind, name = _bare(hints[field.name]), prefix + field.name
        if dataclasses.is_dataclass(kind):
            yield from _walk(kind, prefix if field.name == "slots" else f"{name}.")  # the shell shows slots as they are
            continue
        union = typing.get_origin(kind) is typing.Union or isinstance(kind, types.UnionType)
        choices = [c for c in map(_bare, typing.get_args(kind)) if dataclasses.is_dataclass(c)] if union else []
        for choice in choices:
            yield f"{name}:{choice.__name__}"
            yield from _walk(choice, f"{name}:{choice.__name__}.")
        if not choices:
            yield name


def _bare(kind: Any) -> Any:
    while typing.get_origin(kind) is typing.Annotated:
        kind = typing.get_args(kind)[0]
    return kind
