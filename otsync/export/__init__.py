"""Synchronised videos for other programs: what ``otsync export`` writes of a recording and its offsets.

slot.py      Aligned: every frame's world second; Export: the slot
mosaic.py    Mosaic: all videos in one, as filmed beside synchronised
clips.py     Clips: every video, cut to what all show, on the common clock, with its sound
copies.py    Copies: the same without encoding anew, from a key frame on
frames.py    FrameList: which frames belong together, as CSV
timeline.py  Timeline: an OpenTimelineIO file for editors
fcpxml.py    FinalCut: the same as FCPXML
datasets.py  the layouts that other reconstructions read
encode.py, sound.py   writing mp4 with exact timestamps; sound on the common clock
"""

from .clips import Clips
from .copies import Copies
from .datasets import Colmap, Dynamic3DGaussians, Nerfstudio
from .fcpxml import FinalCut
from .frames import FrameList
from .mosaic import Mosaic
from .slot import Aligned, Clip, Export, aligned
from .timeline import Timeline

EXPORTS: tuple[Export, ...] = (
    Mosaic(),
    Clips(),
    Copies(),
    FrameList(),
    Timeline(),
    FinalCut(),
    Nerfstudio(),
    Dynamic3DGaussians(),
    Colmap(),
)

__all__ = [
    "EXPORTS",
    "Aligned",
    "Clip",
    "Clips",
    "Colmap",
    "Copies",
    "Dynamic3DGaussians",
    "Export",
    "FinalCut",
    "FrameList",
    "Mosaic",
    "Nerfstudio",
    "Timeline",
    "aligned",
]
