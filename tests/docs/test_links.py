"""Links between README, docs and files lead somewhere, to the section they name."""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path

import pytest

from tests.docs.pages import PAGES, ROOT, name_of, outside_fences

LINK = re.compile(r"!?\[(?:[^\]]*)\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#{1,6} (.+?)\s*$", re.MULTILINE)


def anchor(heading: str) -> str:
    """As GitHub and Python-Markdown spell it."""
    text = unicodedata.normalize("NFKD", heading.replace("`", "")).encode("ascii", "ignore").decode()
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", text).strip().lower())


def anchors(page: Path) -> set[str]:
    text, fenced, out = page.read_text(), False, set()
    for line in text.splitlines():
        fenced ^= line.startswith("```")
        if not fenced and (heading := HEADING.match(line)):
            out.add(anchor(heading[1]))
    return out


def broken(page: Path, text: str) -> list[str]:
    """Relative links of a page that lead nowhere."""
    wrong = []
    for target in LINK.findall(outside_fences(text)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, section = target.partition("#")
        goal = (page.parent / name).resolve() if name else page
        if not goal.exists() or (section and section not in anchors(goal)):
            wrong.append(target)
    return wrong


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    assert not broken(page, page.read_text())


def test_a_broken_link_is_seen():
    page = ROOT / "README.md"
    text = (
        "[a](docs/concepts.md#flags) [b](docs/concepts.md#no-such) [c](nowhere.md) ![d](docs/none.png) [e](https://x.y)"
    )
    assert broken(page, text) == ["docs/concepts.md#no-such", "nowhere.md", "docs/none.png"]
    assert broken(page, "`[a](nowhere.md)`") == []


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r"[\w./-]+\.md", (ROOT / "mkdocs.yml").read_text()))
    assert listed == {p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")}
