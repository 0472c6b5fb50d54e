"""Motion: a scaffold of splined nodes, and its ablations, in one slot.

motion.py        Motion: the slot, as a fit uses it
paths.py         BSpline, HermiteSpline, Sampled: curves in time as sums over four knots
scaffold.py      Scaffold: nodes, and binding Gaussians to them; binding.py: which nodes carry which Gaussian
warp.py          carrying Gaussians with nodes: the definition in torch
fused.py         the same, poses and motion losses in compiled kernels: *_kernels.py
per_gaussian.py  PerGaussian, Static; track_curves.py: splines through tracks, with which PerGaussian begins
build.py         build_scaffold: from lifted tracks and offsets
nodes.py         tracks on one grid of world time, D_track, picking nodes; solve.py: their curves and rotations
density.py       more nodes where they are needed, fewer where they are not
"""

from recon.motion.binding import Binding
from recon.motion.build import ScaffoldOptions, build_scaffold
from recon.motion.motion import Motion, motion_from_arrays
from recon.motion.paths import BSpline, HermiteSpline, Path, Sampled
from recon.motion.per_gaussian import PerGaussian, Static
from recon.motion.scaffold import Scaffold
from recon.motion.track_curves import TrackCurves

__all__ = [
    "BSpline",
    "Binding",
    "HermiteSpline",
    "Motion",
    "Path",
    "PerGaussian",
    "Sampled",
    "Scaffold",
    "ScaffoldOptions",
    "Static",
    "TrackCurves",
    "build_scaffold",
    "motion_from_arrays",
]
