"""Videos without a common frame: clock and similarity of a pair from motion alone.

The files in the order of the method: ``clouds`` (tracks in the unit of their scene), ``scan`` (the similarity that most
matches agree on, at every shift), ``agreement`` (two videos laid over each other), ``noise`` (how matched tracks err
along the lines of sight), ``fit`` (offset, rotation, translation and scale at once), ``weighing`` (candidates against
each other), ``solver`` (all of it, and the flags).
"""

from .solver import OwnFrames, PoseTrust

__all__ = ["OwnFrames", "PoseTrust"]
