"""What pixels tell before any synchronisation: masks, flow, point tracks, features, depth. One leaf per prior.

A prior is an object in a slot (a frozen dataclass, called with frames); its parameters and the content of its input
make the key under which :class:`Cache` keeps the result.
"""

from ..files.cache import Cache
from .features import Daisy, LabHistogram
from .flow import DISFlow
from .masks import FlowResidual, GivenMasks, MedianBackground
from .points import ChainedFlow
from .working import WorkingFrames

__all__ = [
    "Cache",
    "ChainedFlow",
    "DISFlow",
    "Daisy",
    "FlowResidual",
    "GivenMasks",
    "LabHistogram",
    "MedianBackground",
    "WorkingFrames",
]
