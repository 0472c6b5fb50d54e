"""Whether built pages load anything from a network: ``python -m tests.docs.offline site``."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

LOADED = {
    "script": "src",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "audio": "src",
    "embed": "src",
    "object": "data",
    "link": "href",
}
NOT_LOADED = {"canonical", "next", "prev", "alternate", "edit"}
ELSEWHERE = re.compile(r"^\s*(?:https?:)?//", re.IGNORECASE)
IN_STYLE = re.compile(r"(?:url\(|@import)\s*['\"]?((?:https?:)?//[^'\")\s]+)", re.IGNORECASE)


class Loads(HTMLParser):
    """Addresses on a network that a page loads when it is looked at."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        address = given.get(LOADED.get(tag, "")) or ""
        if ELSEWHERE.match(address) and given.get("rel") not in NOT_LOADED:
            self.addresses.append(address)
        self.addresses += IN_STYLE.findall(given.get("style") or "")


def loaded(path: Path) -> Iterator[str]:
    """Addresses on a network that a page or a style sheet loads."""
    text = path.read_text()
    if path.suffix == ".html":
        page = Loads()
        page.feed(text)
        yield from page.addresses
    yield from IN_STYLE.findall(text)


def main(folder: Path) -> int:
    pages = sorted(p for kind in ("*.html", "*.css") for p in folder.rglob(kind))
    wrong = [f"{path}: loads {address}" for path in pages for address in loaded(path)]
    print("\n".join(wrong) if wrong else f"{len(pages)} pages and style sheets load nothing from a network")
    return 1 if wrong or not pages else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
