"""Many videos: ``synchronize(tracks)``, the graph of pairs, and the verdict on each video."""

from .graph import Graph
from .verb import synchronize

__all__ = ["Graph", "synchronize"]
