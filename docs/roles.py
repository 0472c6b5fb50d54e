"""Docstrings are written for a terminal: their roles, double colons and lists of files become Markdown for the API
pages.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

ROLE = re.compile(r":(?:func|class|meth|mod|data|attr):`~?([^`]+)`")
LITERAL = re.compile(r"::(?=\n\n)")
FILES = re.compile(r"^(\S+(?:\.py|/))  +(\S.*)$", re.MULTILINE)


def as_markdown(text: str) -> str:
    """Roles become code, double colons before an indented block single ones, and lists of files lists."""
    return FILES.sub(r"- `\1`: \2", LITERAL.sub(":", ROLE.sub(r"`\1`", text)))


class Roles(griffe.Extension):
    """Applied to every docstring that griffe reads."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
