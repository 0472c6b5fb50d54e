"""README and the pages of docs/, cut into the blocks that the tests run.

A comment before a block says how the tests treat it:

``<!-- not run: REASON -->``   a Python block that needs what a test does not have
``<!-- run -->``               a shell block whose lines are run, in order, in the page's folder; others are only parsed
``<!-- run, flagged -->``      the same, every line ending with exit code 1: the answer carries a flag
``<!-- needs: PACKAGE -->``    skip the page's rest where a package is not installed
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").rglob("*.md")],
    key=lambda path: path.relative_to(ROOT).as_posix(),
)

FENCE = re.compile(r"^```(\w*)[ ]*(.*)$")
COMMENT = re.compile(r"^<!--\s*(.*?)\s*-->$")
TITLE = re.compile(r'title="([^"]+)"')


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, text, the line that it begins in, its file name if it has one, and its comment."""

    language: str
    text: str
    line: int
    title: str = ""
    comment: str = ""

    @property
    def skipped(self) -> bool:
        return self.comment.startswith("not run:")

    @property
    def runs(self) -> bool:
        return self.comment == "run" or self.comment.startswith("run:") or self.flagged

    @property
    def flagged(self) -> bool:
        """Whether every line ends with exit code 1, since its answer carries a flag."""
        return self.comment == "run, flagged"


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(text: str) -> list[Block]:
    """The fenced blocks of a page, in order."""
    out: list[Block] = []
    fence, comment, body, begun = None, "", [], 0
    for number, line in enumerate(text.splitlines(), 1):
        match = FENCE.match(line)
        if fence is None and match:
            fence, body, begun = match, [], number
        elif fence is not None and line.rstrip() == "```":
            title = TITLE.search(fence[2])
            out.append(Block(fence[1], "\n".join(body) + "\n", begun + 1, title[1] if title else "", comment))
            fence, comment = None, ""
        elif fence is not None:
            body.append(line)
        elif line.strip():
            told = COMMENT.match(line.strip())
            comment = told[1] if told else ""
    assert fence is None, f"line {begun}: a fence that is not closed"
    return out


def command_lines(block: Block) -> list[str]:
    """The lines of a shell block that call otsync or recon, without comments."""
    lines = [line.partition("  #")[0].strip() for line in block.text.splitlines()]
    return [line for line in lines if line.startswith(("otsync ", "recon "))]


def outside_fences(text: str) -> str:
    """The page's prose, with code in backticks left out."""
    prose, fenced = [], False
    for line in text.splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif not fenced:
            prose.append(re.sub(r"`[^`]*`", "", line))
    return "\n".join(prose)
