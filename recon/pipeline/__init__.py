"""From a recording and its offsets to a 4D scene and better offsets."""

from recon.pipeline.plan import Plan
from recon.pipeline.verb import reconstruct

__all__ = ["Plan", "reconstruct"]
