"""The check that ``make docs`` makes of the built pages sees what a page would load."""

from __future__ import annotations

import pytest

from tests.docs.offline import main


@pytest.mark.parametrize(
    "text, fine",
    [
        ('<script src="assets/a.js"></script><a href="https://example.org">a link</a>', True),
        ('<link rel="canonical" href="https://example.org/">', True),
        ('<script src="https://example.org/a.js"></script>', False),
        ('<script src="//example.org/a.js"></script>', False),
        ('<link rel="stylesheet" href="https://example.org/a.css">', False),
        ('<img src="HTTP://example.org/a.png">', False),
        ("<style>@import 'https://example.org/a.css';</style>", False),
        ('<p style="background: url(https://example.org/a.png)">', False),
    ],
)
def test_what_a_page_loads_is_seen(text, fine, tmp_path, capsys):
    (tmp_path / "page.html").write_text(text)
    assert main(tmp_path) == (0 if fine else 1)


def test_a_style_sheet_is_read_too_and_an_empty_folder_is_no_success(tmp_path, capsys):
    assert main(tmp_path) == 1
    (tmp_path / "page.css").write_text("@font-face { src: url('https://example.org/a.woff2') }")
    assert main(tmp_path) == 1
    assert "example.org/a.woff2" in capsys.readouterr().out
