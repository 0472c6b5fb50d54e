"""The folder of a reconstruction, and ways to show it: images, video, exports, the report page."""

from recon.result.export import Checkpoint, Exporter, Ply, PlySequence, Splat, Tracks

EXPORTERS: tuple[Exporter, ...] = (Ply(), PlySequence(), Splat(), Checkpoint(), Tracks())
"""Our own formats."""

__all__ = ["EXPORTERS", "Checkpoint", "Exporter", "Ply", "PlySequence", "Splat", "Tracks"]
