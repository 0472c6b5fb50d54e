"""A window of the viewer: a server that only this machine reaches, a slider for time and one for every clock."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Mapping
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Any

import numpy as np

from otsync.progress import tell
from otsync.types import Camera
from recon.view.drawing import Drawing
from recon.view.shown import OfScene, Shown

if TYPE_CHECKING:
    from recon.scene.gaussians4d import Gaussians4D

HOST = "127.0.0.1"

REACH = 60.0
"""Frames to either side by which a clock can be moved."""


def check_port(port: int) -> None:
    """ValueError for a port that there is not."""
    if not 1 <= port <= 65535:
        raise ValueError(f"--port: expected 1 to 65535; found {port}.")


def require_viewer() -> None:
    """ModuleNotFoundError, before any work, where viser is not installed."""
    import viser

    assert viser


def local_server(port: int) -> Any:
    """A viser server on loopback, which nobody can make share itself.

    Where the port is taken another one is chosen: ask ``get_port()``.
    """
    import viser

    class Local(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """Nothing: any page in the browser could ask for a tunnel to the outside."""
            return None

    with redirect_stdout(io.StringIO()):  # standard output is ours
        server = Local(host=HOST, port=port, label="otsync", verbose=False)
    server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True)
    return server


class Window:
    """Shows something, until it is closed by its button, Ctrl-C, or :meth:`close`.

    Args:
        shown: what there is to look at. port: of the server; another one where it is taken.

    ``time``, ``clocks``: the sliders. ``address``: what to open in a browser of this machine.
    """

    def __init__(self, shown: Shown, port: int = 8080):
        self._server = local_server(port)
        self._lock, self._ended = threading.RLock(), threading.Event()
        self.shown = shown
        gui = self._server.gui
        low, high = shown.span
        self.time = gui.add_slider("seconds", low, high, shown.frame_step / 10, 0.5 * (low + high))
        self.playing = gui.add_checkbox("play, a quarter of real time", False)
        with gui.add_folder("Clocks, moved by frames"):
            self.clocks = [gui.add_slider(name, -REACH, REACH, 0.05, 0.0) for name in shown.names]
            back = gui.add_button("as they were found")
        close = gui.add_button("Close the viewer")
        self.told = gui.add_text("state", "", disabled=True)
        for slider in (self.time, *self.clocks):
            slider.on_update(lambda _: self.draw())
        back.on_click(lambda _: self._back())
        close.on_click(lambda _: self.close())
        self._drawing = Drawing(self._server, shown)
        self.draw()

    @property
    def address(self) -> str:
        return f"http://{HOST}:{self._server.get_port()}"

    def moved(self) -> np.ndarray:
        """(V,) seconds by which the sliders have moved the clocks."""
        return np.array([slider.value for slider in self.clocks]) * self.shown.frame_step

    def draw(self) -> None:
        """Draw the moment that the sliders stand at."""
        with self._lock:
            if not self._ended.is_set():
                self._drawing.draw(self.shown.at(float(self.time.value), self.moved()))

    def show(self, shown: Shown, words: str = "") -> None:
        """Show something else of the same videos, as a fit goes on."""
        with self._lock:
            self.shown = shown
            self.told.value = words
            self.draw()

    def _back(self) -> None:
        for slider in self.clocks:
            slider.value = 0.0
        self.draw()

    def wait(self) -> None:
        """Until it is closed; plays meanwhile, where that is ticked. Ctrl-C closes it."""
        last = time.perf_counter()
        try:
            while not self._ended.wait(0.05):
                now = time.perf_counter()
                if self.playing.value:
                    low, high = self.shown.span
                    self.time.value = low + (float(self.time.value) - low + 0.25 * (now - last)) % max(high - low, 1e-9)
                    self.draw()
                last = now
        finally:
            self.stop()

    def close(self) -> None:
        """End :meth:`wait`."""
        self._ended.set()

    def stop(self) -> None:
        """Close, where nobody waits."""
        self.close()
        with redirect_stdout(io.StringIO()):
            self._server.stop()


class Watcher:
    """Shows a fit as it goes on: its window opens with the first scene.

    cameras: of the videos, by name.
    """

    def __init__(self, cameras: Mapping[str, Camera], port: int = 8080):
        require_viewer()
        self.cameras, self.port = cameras, port
        self.window: Window | None = None

    def __call__(self, scene: Gaussians4D, words: str) -> None:
        shown = OfScene(scene, self.cameras)
        if self.window is None:
            self.window = Window(shown, self.port)
            tell(f"open {self.window.address} on this machine to see the fit")
        self.window.show(shown, words)

    def stop(self) -> None:
        """Close the window."""
        if self.window is not None:
            self.window.stop()
