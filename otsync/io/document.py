"""The head and tail of ``scene.json``: format, version, and writing one."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from ..files.arrays import write_json

FORMAT, VERSION = "otsync.scene", 1


def write_document(path: str | os.PathLike[str], videos: Sequence[dict[str, Any]], frame: str = "world") -> None:
    """Write a scene document, atomically."""
    write_json(path, {"format": FORMAT, "version": VERSION, "frame": frame, "videos": list(videos)})
