"""A small filmed world with exact answers, for tests, examples and ablations.

world.py      two walking bodies in a room
effects.py    what cameras do to the light
camera.py     a camera that films the world
estimates.py  tracks and depth maps with errors
capture.py    synthetic(): all of it at once
recording.py  a capture as a recording on disk, and the scene that a fit of it begins with
sync_nerf.py  a capture in Sync-NeRF's Blender layout
"""

from recon.simulate.capture import Capture, synthetic
from recon.simulate.effects import Blur, Exposure, MoreNoise, Rolling, Sheen
from recon.simulate.world import World

__all__ = ["Blur", "Capture", "Exposure", "MoreNoise", "Rolling", "Sheen", "World", "synthetic"]
