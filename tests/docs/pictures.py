"""The pictures of README and docs, of the demo's own pages: ``python -m tests.docs.pictures demo docs``.

demo.webp     the scene page, from the clocks as filmed to the synchronised ones, then flying past the phones
report.webp    the beginning of the report
"""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tests.browser import Opened, chromium

SIZE = (960, 640)
"""Of the window, pixels."""

STEPS = 10
"""Pictures of either half of the animation."""

EACH, REST = 140, 900
"""Milliseconds of a picture, and of the first of either half."""

QUALITY = 55


def main(demo: Path, docs: Path) -> int:
    with chromium() as browser:
        frames, lasts = animation(browser, demo / "result" / "scene.html")
        first, *rest = frames
        options: dict[str, Any] = {"save_all": True, "loop": 0, "quality": QUALITY, "method": 6}
        first.save(docs / "demo.webp", append_images=rest, duration=lasts, **options)
        shown = Opened(browser, (900, 900)).look(demo / "result" / "report.html")
        pixels = shown.picture()
        shown.close()
        _image(pixels).save(docs / "report.webp", quality=80, method=6)
    for name in ("demo.webp", "report.webp"):
        print(f"{docs / name}: {(docs / name).stat().st_size / 1000:.0f} kB")
    return 0


def animation(browser: Any, page: Path) -> tuple[list[Any], list[int]]:
    """Pictures of the scene page, and how long each is shown, ms."""
    shown = Opened(browser, SIZE)
    frames, lasts = [], []
    shown.open(page)
    low, high = (float(shown.page.get_attribute("#time", end) or 0) for end in ("min", "max"))
    times = np.linspace(low + 0.25 * (high - low), low + 0.75 * (high - low), STEPS)
    for clocks, camera in (("filmed", ""), ("synchronised", ""), ("synchronised", "phone2")):
        for n, t in enumerate(times):
            asked = {"time": f"{t:.3f}"} | ({"camera": camera} if camera else {})
            shown.open(page, **asked, **({"clocks": clocks} if clocks == "filmed" else {}))
            frames.append(_image(shown.picture()))
            lasts.append(EACH if n else REST)
    shown.close()
    return frames, lasts


def _image(pixels: np.ndarray) -> Any:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(buffer, "PNG")
    return Image.open(buffer).convert("RGB")


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
