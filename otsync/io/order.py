"""The order of files: 9 before 10."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any


def natural(path: Path) -> list[Any]:
    """Sort key by which frame_9 comes before frame_10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name[:255])]
