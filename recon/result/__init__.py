"""The folder of a reconstruction, and ways to show it: images, video, exports, the report page."""

from recon.result.export import Checkpoint, Exporter, Ply, PlySequence, Splat, Tracks
from recon.result.page import Page

EXPORTERS: tuple[Exporter, ...] = (Ply(), PlySequence(), Splat(), Checkpoint(), Tracks(), Page())
"""Our own formats."""

__all__ = ["EXPORTERS", "Checkpoint", "Exporter", "Page", "Ply", "PlySequence", "Splat", "Tracks"]
