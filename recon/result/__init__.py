"""The folder of a reconstruction, and ways to show it: images, video, exports, the report page."""

from recon.result.export import Checkpoint, Exporter, Ply, PlySequence, Splat, Tracks
from recon.result.four_dgs import FourDgs
from recon.result.others import Dynamic3DGaussians, SuperSplat, TapVid3D
from recon.result.page import Page

EXPORTERS: tuple[Exporter, ...] = (
    Ply(),
    SuperSplat(),
    PlySequence(),
    Splat(),
    Checkpoint(),
    Tracks(),
    TapVid3D(),
    Dynamic3DGaussians(),
    FourDgs(),
    Page(),
)
"""Our own formats."""

__all__ = [
    "EXPORTERS",
    "Checkpoint",
    "Dynamic3DGaussians",
    "Exporter",
    "FourDgs",
    "Page",
    "Ply",
    "PlySequence",
    "Splat",
    "SuperSplat",
    "TapVid3D",
    "Tracks",
]
