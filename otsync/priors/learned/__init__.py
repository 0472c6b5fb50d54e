"""Learned priors, each a leaf that loads its package when it is used (extra ``learned``).

loading.py    weights and packages: found, or refused with what to install and where to put the file
tiles.py      large images in tiles that overlap
backbones.py  features of transformers' backbones and of ONNX models
raft.py       torchvision's RAFT
cotracker.py  CoTracker: points followed in windows
depth.py      transformers' estimators of depth
multiview.py  Depth Anything 3: depth of several frames at once
"""

from .backbones import Dinov2, Dinov3, Onnx, Transformers
from .cotracker import CoTracker
from .depth import DepthAnything2, TransformersDepth
from .multiview import DepthAnything3
from .raft import Raft

__all__ = [
    "CoTracker",
    "DepthAnything2",
    "DepthAnything3",
    "Dinov2",
    "Dinov3",
    "Onnx",
    "Raft",
    "Transformers",
    "TransformersDepth",
]
