"""Conditions a fit runs under: one thread per frame, and short sections that Ctrl-C may not tear."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from otsync.compute.threads import get_threads
from recon.raster import set_threads


@contextmanager
def one_thread_each(batch: int) -> Iterator[None]:
    """Frames run side by side, so a single frame gets one thread, in torch and in the rasterizer; put back afterwards.

    With one frame a step the rasterizer keeps its threads. Small tensors do not gain from torch's own threads.
    """
    torch_threads, raster_threads = torch.get_num_threads(), get_threads()
    torch.set_num_threads(1)
    if batch > 1:
        set_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(torch_threads)
        set_threads(raster_threads)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C inside waits for the end of the block; only the main thread receives it, elsewhere nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[tuple[int, Any]] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: waiting.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if waiting and callable(before):
        before(*waiting[0])
