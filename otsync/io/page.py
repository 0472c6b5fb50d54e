"""The table of readers in the docs: ``python -m otsync.io.page docs/recording.md`` writes it anew."""

from __future__ import annotations

import sys
from pathlib import Path

from ..files.arrays import atomic_write
from .readers import table

BEGIN, END = "<!-- readers: written by python -m otsync.io.page -->\n", "<!-- end of readers -->\n"


def with_table(text: str) -> str:
    """The page with the table as the readers declare it now. ValueError where its place is not marked."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"page: expected the lines {BEGIN.strip()} and {END.strip()}; found none. Add them.")
    return f"{before}{BEGIN}\n{table()}\n{END}{after}"


if __name__ == "__main__":
    page = Path(sys.argv[1])
    text = with_table(page.read_text(encoding="utf-8"))
    with atomic_write(page, "w") as stream:
        stream.write(text)
