"""A small filmed world with exact answers: what tests, examples and ablations run on."""

from recon.simulate.capture import Capture, synthetic
from recon.simulate.effects import Blur, Exposure, MoreNoise, Rolling, Sheen
from recon.simulate.world import World

__all__ = ["Blur", "Capture", "Exposure", "MoreNoise", "Rolling", "Sheen", "World", "synthetic"]
