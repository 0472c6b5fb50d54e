"""The layout of result folders, as it is told to others."""

from __future__ import annotations

from pathlib import Path

from otsync.files.strict import write_schema
from recon.result.layout import RunFile

ROOT = Path(__file__).resolve().parents[3]


def test_the_schema_of_the_docs_is_up_to_date(tmp_path):
    write_schema(tmp_path / "run.schema.json", RunFile, "run.json of a reconstruction")
    kept = (ROOT / "docs/schemas/run.schema.json").read_text()
    assert (tmp_path / "run.schema.json").read_text() == kept, "run: make schemas"
