"""Footage: videos as a fit reads them, with frames at working size, masks, backgrounds and depth."""

from recon.footage.footage import Footage, footage_of

__all__ = ["Footage", "footage_of"]
