"""The pictures of README and docs, of pages that the project itself makes:

    python -m tests.docs.pictures demo docs                     # of a folder that otsync demo wrote
    python -m tests.docs.pictures recording/ docs --run folder  # of a rig: its cameras begin at different moments

demo.webp, scene.webp   the scene page, from the clocks as filmed to the synchronised ones, then through a camera
report.webp             the beginning of the demo's report
"""

from __future__ import annotations

import argparse
import io
import json
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


CAMERAS, FRAMES, LATEST, SEED = 8, 90, 30, 7
"""Of the rig: videos, frames of each, the largest number of frames that one begins late, and the draw."""


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("docs", type=Path)
    parser.add_argument("--run", type=Path, help="folder for the recording made unsynchronised, and its run")
    asked = parser.parse_args(argv)
    with chromium() as browser:
        if asked.run is not None:
            page = ran(asked.source, asked.run)
            save(animation(browser, page, camera=None), asked.docs / "scene.webp")
            return 0
        save(animation(browser, asked.source / "result" / "scene.html", camera="phone2"), asked.docs / "demo.webp")
        shown = Opened(browser, (900, 900)).look(asked.source / "result" / "report.html")
        pixels = shown.picture()
        shown.close()
        _image(pixels).save(asked.docs / "report.webp", quality=80, method=6)
    return 0


def save(pictures: tuple[list[Any], list[int]], out: Path) -> None:
    (first, *rest), lasts = pictures
    options: dict[str, Any] = {"save_all": True, "loop": 0, "quality": QUALITY, "method": 6}
    first.save(out, append_images=rest, duration=lasts, **options)
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


def ran(recording: Path, folder: Path) -> Path:
    """The scene page of ``otsync run`` on cameras of a rig, each of which is made to begin late by frames of its own.

    A run that was finished there before is not repeated.
    """
    from otsync.cli import main as otsync
    from otsync.io.scene import read_document

    document, root = read_document(recording)
    chosen = np.linspace(0, len(document["videos"]) - 1, CAMERAS).round().astype(int)
    late = np.random.default_rng(SEED).integers(0, LATEST + 1, CAMERAS)
    videos = [document["videos"][k] | {"range": [int(n), int(n) + FRAMES]} for k, n in zip(chosen, late, strict=True)]
    for video in videos:
        video |= {key: f"{root.resolve()}/{video[key]}" for key in ("frames", "masks") if key in video}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.json").write_text(json.dumps(document | {"videos": videos}, indent=1))
    page = folder / "result" / "scene.html"
    # 1 says that there are doubts, which the page tells
    if not page.exists() and otsync(["run", str(folder), "--out", str(page.parent), "--allow-outside"]) > 1:
        raise SystemExit(1)
    return page


def animation(browser: Any, page: Path, camera: str | None) -> tuple[list[Any], list[int]]:
    """Pictures of the scene page, and how long each is shown, ms. camera: looked through at last; None: the second."""
    shown = Opened(browser, SIZE)
    frames, lasts = [], []
    shown.open(page)
    low, high = (float(shown.page.get_attribute("#time", end) or 0) for end in ("min", "max"))
    times = np.linspace(low + 0.25 * (high - low), low + 0.75 * (high - low), STEPS)
    last = camera or shown.page.locator("#camera option").nth(2).inner_text()
    for clocks, through in (("filmed", ""), ("synchronised", ""), ("synchronised", last)):
        for n, t in enumerate(times):
            asked = {"time": f"{t:.3f}"} | ({"camera": through} if through else {})
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
    sys.exit(main(sys.argv[1:]))
