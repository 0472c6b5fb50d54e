"""The JSON Schemas of the documents that otsync reads: ``python -m otsync.io.schemas docs/schemas`` writes them."""

from __future__ import annotations

import sys
from pathlib import Path

from ..files.strict import Document, write_schema
from ..types.offsets_file import OffsetsFile
from .layout import SceneFile

SCHEMAS: dict[str, type[Document]] = {"scene": SceneFile, "offsets": OffsetsFile}


def main(folder: Path) -> None:
    """Write ``NAME.schema.json`` of every document into the folder."""
    for name, kind in SCHEMAS.items():
        write_schema(folder / f"{name}.schema.json", kind, f"{name}.json of otsync")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
