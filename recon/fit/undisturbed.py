"""Conditions a fit runs under: one thread per frame."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

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
