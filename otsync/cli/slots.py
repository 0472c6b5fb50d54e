"""Slots on the command line: one subcommand for each algorithm that fits, ours and others'."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import cache
from typing import Annotated, Any, Literal, Union, get_type_hints

import tyro

from ..plugins import available


def slot(group: str, own: Iterable[Any], *, optional: bool = False) -> Any:
    """The type of a dataclass field that takes any algorithm of a group.

    Args:
        own: otsync's own classes. Plugins follow, as they are found when the command line is parsed.
        optional: whether None, "the default", is a choice too.
    """
    choices: list[Any] = [None] if optional else []
    for name, thing in available(group, own).items():
        about = (thing.__doc__ or "").strip().partition("\n\n")[0]
        if isinstance(thing, type):
            choices.append(Annotated[thing, tyro.conf.subcommand(name, description=about)])
        else:  # a function or an object: nothing to set, so it is its own only choice
            choices.append(
                Annotated[type(name, (), {}), tyro.conf.subcommand(name, constructor=_maker(thing), description=about)]
            )
    return Union[tuple(choices)]  # noqa: UP007  a union that is built as the program runs


def one_of(group: str, own: Iterable[Any]) -> Any:
    """The type of a dataclass field that takes the name of a thing of a group, ours or a plugin's."""
    return Literal[tuple(available(group, own))]  # built as the program runs


def _maker(thing: Any) -> Any:
    def make() -> Any:
        return thing

    return make


@cache
def partial(cls: type) -> Any:
    """A dataclass with the fields of ``cls``, each None: "not named on the command line"."""
    hints = get_type_hints(cls)
    own = [(f.name, hints[f.name] | None, None) for f in dataclasses.fields(cls)]
    return dataclasses.make_dataclass(cls.__name__, own, frozen=True, namespace={"__doc__": cls.__doc__})
