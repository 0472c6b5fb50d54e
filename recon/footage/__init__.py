"""What a fit reads of the videos: frames at working size, masks, backgrounds, depth."""

from recon.footage.footage import Footage, footage_of

__all__ = ["Footage", "footage_of"]
