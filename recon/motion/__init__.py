"""How things move: a scaffold of splined nodes, and its ablations, in one slot.

motion.py        Motion: what a fit asks of any of them
paths.py         HermiteSpline, Sampled: curves in time as sums over four knots
scaffold.py      Scaffold: nodes, and binding Gaussians to them; binding.py: who is bound to what
warp.py          carrying Gaussians with nodes: the definition in torch
fused.py         the same, poses and motion losses in compiled kernels: *_kernels.py
per_gaussian.py  PerGaussian, Static
build.py         build_scaffold: from lifted tracks and offsets
nodes.py         tracks on one grid of world time, D_track, the pick; solve.py: curves and rotations
density.py       more nodes where they are wanted, fewer where they are not
"""

from recon.motion.binding import Binding
from recon.motion.build import ScaffoldOptions, build_scaffold
from recon.motion.motion import Motion, motion_from_arrays
from recon.motion.paths import HermiteSpline, Path, Sampled
from recon.motion.per_gaussian import PerGaussian, Static
from recon.motion.scaffold import Scaffold

__all__ = [
    "Binding",
    "HermiteSpline",
    "Motion",
    "Path",
    "PerGaussian",
    "Sampled",
    "Scaffold",
    "ScaffoldOptions",
    "Static",
    "build_scaffold",
    "motion_from_arrays",
]
