"""The pictures of docs/gallery.md, made by its own code: ``python -m tests.docs.gallery docs [demo/result]``.

The last one is of a finished reconstruction; it is left as it is where none is named.
"""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path
from typing import Any

from tests.docs.pages import blocks

PICTURE = re.compile(r"^!\[[^\]]*\]\((gallery/[\w.]+)\)$", re.MULTILINE)


def main(docs: Path, result: Path | None = None) -> int:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    page = (docs / "gallery.md").read_text()
    names, space = PICTURE.findall(page), {}
    code = [block for block in blocks(page) if block.language == "python"]
    assert len(names) == len(code)
    for name, block in zip(names, code, strict=True):
        if block.skipped:
            if result is None:
                continue
            from recon.result.folder import load_result

            load_result(result).show(camera="phone2")
        else:
            exec(compile(block.text, "gallery.md", "exec"), space)
        _save(pyplot.gcf(), docs / name)
        pyplot.close("all")
        print(f"{docs / name}: {(docs / name).stat().st_size / 1000:.0f} kB")
    return 0


def _save(figure: Any, path: Path) -> None:
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=160, facecolor="white")
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.open(buffer).convert("RGB").save(path, "WEBP", quality=82, method=6)


if __name__ == "__main__":
    sys.exit(main(*map(Path, sys.argv[1:])))
