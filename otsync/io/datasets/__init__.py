"""Readers of datasets as others publish them, one file each.

common.py       what they share: pairing, strict numbers, axes
sync_nerf.py    Sync-NeRF's Blender scenes
llff.py         Neural 3D Video, and Sync-NeRF's Plenoptic scenes
nerfstudio.py   transforms.json
d_nerf.py       D-NeRF
colmap.py       COLMAP's models
colmap_files.py the same from files, every size checked
anipose.py      calibration.toml
easymocap.py    intri.yml and extri.yml
dannce.py       .mat files of cameras
mosca.py        MoSca's working folder
"""

from .anipose import Anipose
from .colmap import Colmap
from .d_nerf import DNerf
from .dannce import Dannce
from .easymocap import EasyMocap
from .llff import NeuralVideo, SyncNerfPlenoptic
from .mosca import MoSca
from .nerfstudio import Nerfstudio
from .sync_nerf import SyncNerfBlender

DATASETS = (
    SyncNerfBlender(),
    NeuralVideo(),
    SyncNerfPlenoptic(),
    DNerf(),
    Nerfstudio(),
    Colmap(),
    Anipose(),
    EasyMocap(),
    Dannce(),
    MoSca(),
)
"""In the order in which they are asked."""

__all__ = ["DATASETS"]
