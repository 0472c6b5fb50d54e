"""Strict documents: JSON against one schema, types and fields alike, with errors that name file and field.

A document is a :class:`Document`; what it may hold stands in its annotations, and :func:`json_schema` writes the same
as JSON Schema. Nothing is converted: true is no number, 160.9 no count of pixels, " 3 " no number.
"""

from __future__ import annotations

import difflib
import os
import re
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from .arrays import write_json

UNSEEN = r"\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff"
"""Characters that move a terminal's cursor, turn its text around, or cannot be written: a class of a pattern."""

LONGEST_TEXT = 1000
"""Characters of a name or a path: file systems take fewer."""

ONE_LINE = rf"^[^{UNSEEN}]*$"
"""Pattern of every text of a document. It is asked here and not by msgspec, of which 0.20 to 0.22 free a pattern twice
where it stands in a union with a list."""

Text = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]
"""Text on one line, without control characters."""

Name = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
"""The name of a video: it stands in tables, in reports and in file names."""

Count = Annotated[int, msgspec.Meta(ge=0, le=2**31)]

WORDS = {
    "int": "a whole number",
    "float": "a number",
    "str": "text",
    "bool": "true or false",
    "null": "null",
    "array": "a list",
    "object": "an object",
}
"""How an error names the types of JSON."""

T = TypeVar("T")


class Document(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True, omit_defaults=True):
    """An object of a document: its fields and their types, no others."""


def checked(value: Any, kind: type[T], where: str | os.PathLike[str], at: str = "$", remedy: str = "") -> T:
    """``value``, what a JSON file holds, as a ``kind``.

    Args:
        where: the file, for errors. at: the field that ``value`` stands in; default: the whole of the file.
        remedy: what to do about it, where the field alone does not tell.

    ValueError names the file, the field, what was expected and what was found: of a field that there is not the nearest
    one that there is.
    """
    all_on_one_line(value, where, "" if at == "$" else at)  # first: msgspec stumbles over what cannot be encoded
    try:
        return msgspec.convert(value, kind, strict=True)
    except msgspec.ValidationError as error:
        said, _, path = str(error).partition(" - at ")
        steps = _steps(path.strip("`").removeprefix("$"), value)
        field, found, names = _walk(value, steps)
        field = f"{'' if at == '$' else at}{field}".lstrip(".")
        unknown = re.match(r"Object contains unknown field `(.*)`$", said, re.DOTALL)
        absent = re.match(r"Object missing required field `(\w+)`$", said)
        if unknown:
            known = tuple(name for each in _kinds_at(kind, steps) for name in getattr(each, "__struct_fields__", ()))
            expected, found_text = _unknown(unknown[1], known)
            field = f"{field}.{shown(unknown[1])[1:-1]}".lstrip(".")
        elif absent:
            field, expected, found_text = f"{field}.{absent[1]}".lstrip("."), "a value", "none. Add it"
        else:
            choices = [
                repr(x) for each in _kinds_at(kind, steps) if get_origin(each) is Literal for x in get_args(each)
            ]
            expected, found_text = " or ".join(choices) or _expected(said), shown(found)
        of = f" (of {shown(names)})" if names is not None else ""
        advice = "" if unknown or absent else f" {remedy or 'Correct it; docs/formats.md lists the fields.'}"
        raise ValueError(
            f"{where}: {field or 'the whole of it'}{of}: expected {expected}; found {found_text}.{advice}"
        ) from None
    except RecursionError:
        raise ValueError(f"{where}: expected a document of a few levels; found too many. Write it anew.") from None


def on_one_line(text: str, field: str) -> None:
    """ValueError, beginning with the field, for a text with characters that a terminal heeds or none can write."""
    if re.search(rf"[{UNSEEN}]", text):
        raise ValueError(
            f"{field}: expected text on one line, without control characters; found {shown(text)}. Take them out."
        )


def all_on_one_line(value: Any, where: str | os.PathLike[str], at: str) -> None:
    """The same of every text and key of a document, however deep."""
    left = [(value, at)]
    while left:
        part, at = left.pop()
        if isinstance(part, str):
            on_one_line(part, f"{where}: {at.lstrip('.')}")
        elif isinstance(part, dict):
            for key in part:
                on_one_line(key, f"{where}: {at.lstrip('.') or 'a key'}")
            left += [(item, f"{at}.{key}") for key, item in part.items()]
        elif isinstance(part, list):
            left += [(item, f"{at}[{n}]") for n, item in enumerate(part) if not isinstance(item, float)]


def in_words(error: Exception) -> str:
    """An error that Python raised over the content of a file, in the words that our own have."""
    if isinstance(error, KeyError):
        return f"{shown(str(error.args[0]))[1:-1]}: expected a value; found none"
    if isinstance(error, ValueError) and "expected" in str(error):
        return str(error)
    return f"expected another content; found what gives {type(error).__name__} ({shown(str(error))[1:-1]})"


def shown(value: Any) -> str:
    """A value as an error shows it: in one line, short, without characters that a terminal heeds."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= 10**40:
        return f"a whole number of some {int(value.bit_length() * 0.30103) + 1} digits"
    if isinstance(value, str):
        value = value[:90]  # repr alone escapes what cannot be seen
    if isinstance(value, list | tuple):
        text = f"a list of {len(value)}"
        plain = all(isinstance(x, str | float | bool | None) for x in value)
        text = repr(value) if plain and len(value) <= 8 else text
    elif isinstance(value, dict):
        text = f"an object with {', '.join(shown(str(k)) for k in list(value)[:4]) or 'no fields'}"
    else:
        text = (
            {None: "null", True: "true", False: "false"}[value]
            if value is None or isinstance(value, bool)
            else repr(value)
        )
    text = " ".join(text.split("\n"))
    return text if len(text) <= 80 else text[:77] + "..."


def json_schema(kind: type[Document], title: str) -> dict[str, Any]:
    """The JSON Schema (2020-12) of a document."""
    schema = msgspec.json.schema(kind)

    def patterned(part: Any) -> Any:
        if isinstance(part, list):
            return [patterned(each) for each in part]
        if not isinstance(part, dict):
            return part
        own = {"pattern": ONE_LINE} if part.get("type") == "string" else {}
        return {key: patterned(each) for key, each in part.items()} | own

    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **patterned(schema)}


def write_schema(path: str | os.PathLike[str], kind: type[Document], title: str) -> None:
    """Write the JSON Schema of a document, for editors and for programs that write such files."""
    write_json(path, json_schema(kind, title))


def fields_of(kind: type[Document]) -> tuple[str, ...]:
    """The names that an object of a document may have."""
    return kind.__struct_fields__


def nearest(word: str, known: Any) -> str | None:
    """The one of ``known`` that ``word`` is probably meant to be."""
    close = difflib.get_close_matches(word[:100].lower(), {k.lower(): k for k in known}, 1, 0.6)
    return next((k for k in known if close and k.lower() == close[0]), None)


def _unknown(word: str, known: tuple[str, ...]) -> tuple[str, str]:
    near = nearest(word, known)
    meant = "Take it out" if near is None else f"Did you mean {near!r}? Else take it out"
    return (
        f"one of the fields {', '.join(known)}" if near is None else "a field that there is",
        f"{shown(word)}. {meant}",
    )


def _expected(said: str) -> str:
    """msgspec's words in ours."""
    if said == "Number out of range":
        return "a number below 1e308"
    said = said.removeprefix("Expected ")
    said = said.partition(", got ")[0]
    types, _, bounds = said.partition("` ")
    words = [WORDS.get(w, w) for w in re.split(r" \| ", types.strip("`"))]
    text = " or ".join(words)
    return f"{text} {bounds}".strip() if bounds else text


def _steps(path: str, value: Any) -> list[str | int | None]:
    """The steps of msgspec's path: names, indices, and None for a key that it does not tell."""
    steps: list[str | int | None] = []
    for name, index in re.findall(r"\.(\w+)|\[(\d+|\.\.\.)\]", path):
        steps.append(name if name else None if index == "..." else int(index))
    return steps


def _walk(value: Any, steps: list[str | int | None]) -> tuple[str, Any, str | None]:
    """(the steps as text, what stands there, the innermost name that an object on the way has)."""
    text, name = "", value.get("name") if isinstance(value, dict) and isinstance(value.get("name"), str) else None
    for step in steps:
        text += f"[{step}]" if isinstance(step, int) else "[...]" if step is None else f".{step}"
        try:
            value = next(iter(value.values())) if step is None else value[step]
        except (KeyError, IndexError, TypeError, AttributeError, StopIteration):
            return text, None, name
        if isinstance(value, dict) and isinstance(value.get("name"), str):
            name = value["name"]
    return text, value, name


def _kinds_at(kind: Any, steps: list[str | int | None]) -> list[Any]:
    """What the schema asks for at the end of ``steps``: the options of a union, else one kind."""
    for step in steps:
        if isinstance(step, str):
            holders = [k for k in _options(kind) if isinstance(k, type) and issubclass(k, Document)]
            kind = next((get_type_hints(k)[step] for k in holders if step in k.__struct_fields__), None)
        else:
            kind = next((get_args(k)[-1] for k in _options(kind) if get_origin(k) in (list, dict)), None)
    return _options(kind)


def _options(kind: Any) -> list[Any]:
    """The kinds that a union is made of; of any other the kind itself."""
    if get_origin(kind) is Annotated:
        return _options(get_args(kind)[0])
    if get_origin(kind) in (Union, UnionType):
        return [own for each in get_args(kind) for own in _options(each)]
    return [kind]
