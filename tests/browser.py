"""A real browser for the tests of pages: Chromium that is installed, driven by Playwright, drawing in software."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

FLAGS = (
    *("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--ignore-gpu-blocklist", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PATIENCE = 60_000
"""Milliseconds. Generous: no verdict depends on how fast the machine is."""


@contextmanager
def chromium() -> Iterator[Any]:
    """A running browser. Skips the test, with the reason, where there is none."""
    driver = pytest.importorskip("playwright.sync_api", reason="no Playwright: pip install 'otsync[test]'")
    path = os.environ.get("OTSYNC_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip("no browser: install Chromium, or name one in OTSYNC_CHROMIUM")
    with driver.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        yield browser
        browser.close()


class Opened:
    """A page that a browser shows, and all that it asked for and complained about."""

    def __init__(self, browser: Any, size: tuple[int, int] = (760, 480), **context: Any):
        options = {"viewport": {"width": size[0], "height": size[1]}, "reduced_motion": "reduce", **context}
        self.context = browser.new_context(**options)
        self.page = self.context.new_page()
        self.requests: list[str] = []
        self.complaints: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("console", self._heard)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.set_default_timeout(PATIENCE)

    def _heard(self, message: Any) -> None:
        # what software drivers say of their speed is no fault of the page
        if message.type in ("error", "warning") and "GPU stall" not in message.text:
            self.complaints.append(message.text)

    def open(self, path: Path, **asked: Any) -> Opened:
        """Open the page as a double click does; ``asked``: what its address asks for. Waits until it rests."""
        self.page.goto("about:blank")
        hash_ = "&".join(name if value is True else f"{name}={value}" for name, value in asked.items())
        self.page.goto(f"{path.resolve().as_uri()}#{hash_}")
        self.page.wait_for_selector("html[data-ready=yes]", state="attached")
        return self.rested()

    def look(self, path: Path) -> Opened:
        """Open a page without a script."""
        self.page.goto(path.resolve().as_uri())
        return self

    def too_wide(self) -> list[str]:
        """What sticks out of the window to the right."""
        code = """() => [...document.querySelectorAll('body *:not(svg *):not(.bar *):not(.mosaic *)')].filter((e) => {
            const box = e.getBoundingClientRect();
            return box.width && box.right > document.documentElement.clientWidth + 0.5;
        }).map((e) => e.outerHTML.slice(0, 80))"""
        return self.page.evaluate(code)

    def rested(self) -> Opened:
        """Once everything that was asked for is drawn, with every pixel."""
        self.page.wait_for_selector("html[data-state=still]", state="attached")
        return self

    def press(self, key: str, on: str | None = None) -> Opened:
        """A key, where the focus is or on an element; waits until the page rests."""
        if on is None:
            self.page.keyboard.press(key)
        else:
            self.page.press(on, key)
        return self.rested()

    def picture(self, of: str | None = None) -> np.ndarray:
        """Pixels [h,w,3] of an element, or of the whole window."""
        from PIL import Image

        png = self.page.locator(of).screenshot() if of else self.page.screenshot()
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(float)

    def seconds(self) -> float:
        """The world second that the page shows."""
        return float(self.page.input_value("#time"))

    def close(self) -> None:
        self.context.close()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Decibels between two images of 0..255."""
    return float(10 * np.log10(255**2 / max(float(((a - b) ** 2).mean()), 1e-9)))
