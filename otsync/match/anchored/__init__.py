"""Matching of tens of thousands of tracks: anchored (multi-scale) fused Gromov-Wasserstein.

The files in the order of the method: ``clouds`` (canonical order and unit), ``cells`` (k-means), ``anchors`` (partial
FGW by POT), ``signatures`` (landmarks and the truncated cost), ``coarse`` (refinement, restarts, the challenger),
``solver`` (all of it, and the answer).
"""

from .solver import AnchoredFGW

__all__ = ["AnchoredFGW"]
