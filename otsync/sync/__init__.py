"""Many videos: ``synchronize(tracks)``, the graph of pairs, and the verdict on each video."""

from .graph import Graph
from .method import METHODS, PAPER, Method
from .verb import synchronize

__all__ = ["METHODS", "PAPER", "Graph", "Method", "synchronize"]
