"""What others add: algorithms, readers, exporters, losses, effects, commands, from installed packages or from a file.

Three ways to add a thing to a group of :data:`GROUPS`:

* one of otsync's own: one file, and one line in its folder's ``__init__``;
* an installed package: an entry point in the group ``otsync.matchers`` (or another of :data:`GROUPS`);
* a single file: ``@register("matchers")`` over the class, and ``otsync --plugin my_matcher.py ...`` or
  ``OTSYNC_PLUGINS=my_matcher.py`` (several: separated as in PATH) in the environment.

The help of the commands, the benchmarks and the catalogue of hard cases then list it beside our own.
"""

from __future__ import annotations

import ast
import importlib
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_type_hints

T = TypeVar("T")

GROUPS: dict[str, str] = {
    "matchers": "callables (a, b) -> Matches",
    "aligners": "callables (a, b, matches) -> Alignment",
    "refiners": "callables (a, b, matches, alignment) -> Alignment",
    "costs": "terms that matchers minimise: objects with matrix(a, b) and pairs(a, b, i, j)",
    "methods": "what stands in every slot under one name: objects of otsync.Method",
    "maskers": "what moves in a video: callables (WorkingFrames) -> masks",
    "trackers": "callables (WorkingFrames, masks, fps) -> point tracks",
    "flows": "optical flow: objects with pair(before, after) -> flow there, flow back",
    "describers": "callables (WorkingFrames, masks, uv, fps) -> a feature per track",
    "depths": "depth up to scale: callables (images, cameras) -> a map per image, with gives",
    "readers": "layouts of recordings: objects with claims(folder) and describe(folder)",
    "exporters": "formats of a reconstruction: objects with write(scene, out, ...)",
    "losses": "what a fit of the 4D scene minimises",
    "effects": "what a camera does to the light",
    "commands": "commands of the shell: dataclasses with run() -> exit code",
    "benchmarks": "modules with run(out, gate=..., rebase=...)",
}

ENVIRONMENT = "OTSYNC_PLUGINS"

_registered: dict[str, dict[str, Any]] = {group: {} for group in GROUPS}
_files: dict[Path, None] = {}


def register(group: str, name: str | None = None) -> Callable[[T], T]:
    """Decorator: add a class, function or object to a group, for this process.

    Args:
        group: one of :data:`GROUPS`.
        name: as the shell spells it; default: the class's name, ``MyMatcher`` becoming ``my-matcher``.

    Example:
        >>> from otsync.plugins import register
        >>> @register("matchers")                     # doctest: +SKIP
        ... class Mine: ...
    """
    _check(group)

    def add(thing: T) -> T:
        _registered[group][name or short_name(thing)] = thing
        return thing

    return add


def load_files(paths: Iterable[str | os.PathLike[str]]) -> None:
    """Import files that register things. ValueError names a file that is not there or does not import.

    The file's folder joins ``sys.path``, so that worker processes find the file too.
    """
    for path in map(Path, paths):
        path = path.resolve()
        if path in _files:
            continue
        if path.suffix != ".py" or not path.is_file():
            raise ValueError(f"{path}: expected a Python file that registers something; found none.")
        if path.stem in sys.modules:
            raise ValueError(f"{path}: a module named {path.stem!r} is loaded already. Rename the file.")
        sys.path.append(str(path.parent))
        try:
            importlib.import_module(path.stem)
        except Exception as error:
            sys.path.remove(str(path.parent))
            sys.modules.pop(path.stem, None)
            raise ValueError(f"{path}: does not import: {type(error).__name__}: {error}") from error
        _files[path] = None


def loaded_files() -> tuple[Path, ...]:
    """The files that :func:`load_files` imported: for processes that are to know the same plugins."""
    return tuple(_files)


def load_environment() -> None:
    """Import the files that ``OTSYNC_PLUGINS`` names."""
    load_files(filter(None, os.environ.get(ENVIRONMENT, "").split(os.pathsep)))


def made(text: str, choices: Mapping[str, Any], what: str) -> Any:
    """The object that the shell spells ``name`` or ``name:field=value,field=value``.

    Args:
        choices: what there is, by name: as :func:`available` gives it. Classes are called with the fields, everything
            else is taken as it is.
        what: the option, for errors: ValueError names it, what was expected and what was found.

    Example:
        >>> made("mine:weight=0.5", {"mine": dict}, "--losses")
        {'weight': 0.5}
    """
    name, _, rest = text.partition(":")
    if name not in choices:
        raise ValueError(f"{what}: expected some of {', '.join(choices)}; found {name!r}.")
    thing, fields = choices[name], {}
    for part in filter(None, re.split(r",(?![^(\[]*[)\]])", rest)):  # commas within brackets are the value's own
        field, equals, value = part.partition("=")
        if not equals:
            raise ValueError(f"{what}: expected {name}:field=value,field=value; found {text!r}.")
        fields[field.strip().replace("-", "_")] = _value(value.strip())
    if not isinstance(thing, type) and not fields:
        return thing
    _refuse_other_types(thing, fields, f"{what}: {name}")
    try:
        return thing(**fields)
    except TypeError as error:
        raise ValueError(f"{what}: {text!r} cannot be made: {error}") from None


WORDS = {int: "a whole number", float: "a number", bool: "True or False", str: "text", type(None): "None"}
"""How errors name the types of simple fields."""


def _refuse_other_types(thing: Any, fields: Mapping[str, Any], what: str) -> None:
    """ValueError for a value that is not of the simple types of its field, where the field declares some."""
    try:
        hints = get_type_hints(thing if is_dataclass(thing) else thing.__init__)
    except (NameError, TypeError, AttributeError):  # a stranger's, whose annotations do not resolve
        return
    for field, value in fields.items():
        hint = hints.get(field)
        kinds = get_args(hint) if isinstance(hint, UnionType) else (hint,)
        if not all(kind in WORDS for kind in kinds):
            continue
        if type(value) not in kinds and not (type(value) is int and float in kinds):
            expected = " or ".join(WORDS[kind] for kind in kinds)
            raise ValueError(f"{what}:{field}: expected {expected}; found {value!r}.")


def _value(text: str) -> Any:
    """A number, a truth value, None, or the text itself."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def spelled(thing: Any, choices: Mapping[str, Any]) -> str:
    """How the shell spells an object: what :func:`made` makes it of, as far as numbers, words and tuples tell."""
    kind = type(thing)
    name = next((n for n, choice in choices.items() if choice is kind or choice is thing), short_name(kind))
    own = fields(thing) if is_dataclass(thing) else ()
    told = {f.name: getattr(thing, f.name) for f in own if f.init and getattr(thing, f.name) is not f.default}
    values = ",".join(f"{k}={v}".replace(" ", "") for k, v in told.items())
    return f"{name}:{values}" if values else name


def named(group: str, own: Iterable[Any], option: str) -> Any:
    """Tells the shell to take a tuple of things of a group by name, as :func:`made` spells them.

    For a field of a dataclass: ``losses: Annotated[tuple[Loss, ...], named("losses", LOSSES, "--losses")]``. Where
    annotations are evaluated late, plugins are among the names. ``option`` stands in errors.
    """
    from tyro.constructors import PrimitiveConstructorSpec

    choices = available(group, own)
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar=f"[{{{'|'.join(choices)}}}[:FIELD=VALUE,...] ...]",
        instance_from_str=lambda texts: tuple(made(text, choices, option) for text in texts),
        is_instance=lambda given: isinstance(given, tuple),
        str_from_instance=lambda things: [spelled(thing, choices) for thing in things],
    )


def forget(*things: Any) -> None:
    """Take registered things out again: for tests and notebooks."""
    for group in _registered.values():
        for name in [n for n, thing in group.items() if thing in things]:
            del group[name]


def available(group: str, own: Iterable[Any] = ()) -> dict[str, Any]:
    """Everything in a group by its short name: ``own`` first, then installed packages', then registered ones.

    ValueError names two things of one name, and an entry point that does not import.
    """
    _check(group)
    found = {short_name(thing): thing for thing in own}
    others = [(point.name, _load(point)) for point in entries(group).values()]
    for name, thing in [*others, *registered(group).items()]:
        if name in found and found[name] is not thing:
            raise ValueError(f"{group}: two things are named {name!r}: {found[name]!r} and {thing!r}. Rename one.")
        found[name] = thing
    return found


def registered(group: str) -> dict[str, Any]:
    """What this process registered in a group, by short name; files of the environment included."""
    _check(group)
    load_environment()
    return dict(_registered[group])


def entries(group: str) -> dict[str, EntryPoint]:
    """Entry points of installed packages in a group, not loaded."""
    return {point.name: point for point in _entries(group, tuple(sys.path))}


@cache
def _entries(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Sorted by name. Looked for once a path: a command asks a dozen times, and each time reads every package."""
    return tuple(sorted(entry_points(group=f"otsync.{group}"), key=lambda p: p.name))


def short_name(thing: Any) -> str:
    """How the shell spells a thing: its ``name`` where it has one, else its class's or function's, with hyphens."""
    given = None if isinstance(thing, type) else getattr(thing, "name", None)  # a class's is a field's default
    if isinstance(given, str) and given:
        return given
    name = getattr(thing, "__name__", None) or type(thing).__name__
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "-", name)
    return name.replace("_", "-").lower()


def _load(point: EntryPoint) -> Any:
    try:
        return point.load()
    except Exception as error:
        where = f"{point.name} = {point.value} of {point.dist.name if point.dist else 'an installed package'}"
        raise ValueError(f"entry point {where}: does not import: {type(error).__name__}: {error}") from error


def _check(group: str) -> None:
    if group not in _registered:
        raise ValueError(f"group: expected one of {', '.join(GROUPS)}; found {group!r}.")
