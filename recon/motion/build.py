"""A scaffold from lifted tracks and offsets: pick nodes, solve for their curves, turn them, connect them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from otsync.types import TrackSet
from recon.motion import nodes as picking
from recon.motion.binding import Binding
from recon.motion.nodes import Grid
from recon.motion.paths import SPLINES, Path
from recon.motion.scaffold import Scaffold
from recon.motion.solve import FRAME, Coupling, Observations, Smoothness, along, neighbourhood_rotations, solve_curves
from recon.motion.track_curves import WIDEST, knot_spacing
from recon.motion.warp import BLENDS, LINEAR
from recon.rotations import continuous, quaternions

logger = logging.getLogger("recon.motion")

FEWEST = 300
"""Nodes below which a scaffold is rather built with a smaller spacing."""


@dataclass(frozen=True)
class ScaffoldOptions:
    """How a scaffold is built. Lengths in footprints (the world size of a working pixel), times in seconds.

    Args:
        unit: spacing of the nodes; None: 7.5, or less (down to 2) where that gives fewer than `fewest` nodes, or more
            where it gives more than `most`. Give `unit` or `fewest`, not both.
        second_pick: spacing of the second pick, on full curves, as a share of `unit`.
        spline: "b-spline", or "hermite", the paper's. spacing: of its knots in time; None: 8/3 of a 30th of a second,
            or less where tracks move too fast for that. margin: seconds of knots beyond both ends: the largest
            believable offset.
        per_video: one scaffold per video, each on its own clock, as in the paper; else one in world time.
        neighbours: of a node. reach: D_track, in units, from which nodes are no neighbours.
        robust: distance at which a sample counts half, in footprints.
        shortest: seconds that a track must be seen to be picked, or a third of those of the longest.
        smooth: weights of the solve. blend: "linear" or "dual-quaternion".
    """

    unit: float | None = None
    second_pick: float = 0.8
    fewest: int = FEWEST
    most: int = 1800
    spline: str = "b-spline"
    spacing: float | None = None
    margin: float = 4 * FRAME
    per_video: bool = False
    neighbours: int = 10
    reach: float = picking.REACH
    robust: float = 2.3
    shortest: float = 10 * FRAME
    smooth: Smoothness = field(default_factory=Smoothness)
    blend: str = LINEAR

    def __post_init__(self) -> None:
        if self.unit is not None and not self.unit > 0:
            raise ValueError(f"unit: expected footprints > 0, or None to choose; found {self.unit}.")
        if not (0 < self.second_pick <= 1 and self.reach > 0 and self.robust > 0):
            raise ValueError("second_pick, reach, robust: expected numbers > 0, second_pick at most 1.")
        if self.spacing is not None and not self.spacing > 0:
            raise ValueError(f"spacing: expected seconds > 0, or None to choose; found {self.spacing}.")
        if self.unit is not None and self.fewest != FEWEST:
            raise ValueError("unit, fewest: expected one of them, since fewest chooses the unit; found both.")
        least = 1 if self.unit is not None else self.fewest
        if not (self.margin >= 0 and self.neighbours >= 1 and 1 <= least <= self.most):
            raise ValueError("margin, neighbours, fewest, most: expected margin >= 0, 1 neighbour, fewest <= most.")
        if self.blend not in BLENDS:
            raise ValueError(f"blend: expected one of {', '.join(BLENDS)}; found {self.blend!r}.")
        if self.spline not in SPLINES:
            raise ValueError(f"spline: expected one of {', '.join(SPLINES)}; found {self.spline!r}.")

    def path(self, first: float, last: float) -> Path:
        """The curve in time for a motion from one second to another, with no values yet."""
        return SPLINES[self.spline].of(first, last, WIDEST if self.spacing is None else self.spacing, self.margin)

    def spaced(self, tracks: Sequence[TrackSet], footprint: float, rates: np.ndarray | None = None) -> ScaffoldOptions:
        """These options with a spacing; where none is given, :func:`recon.motion.track_curves.knot_spacing` finds it.

        rates: world seconds per second of each video's clock.
        """
        if self.spacing is not None:
            return self
        rates = None if self.per_video else rates  # there, knots are on each video's own clock
        return replace(self, spacing=knot_spacing(tracks, spline=self.spline, footprint=footprint, rates=rates))


UNIT, LEAST_UNIT, MOST_UNIT, GROWTH = 7.5, 2.0, 750.0, 1.25  # footprints; the last: the factor between two tries
ROUNDS = 3  # of reweighting in each of the two solves


def build_scaffold(
    tracks: Sequence[TrackSet],
    offsets: np.ndarray,
    *,
    footprint: float,
    frame_step: float,
    options: ScaffoldOptions | None = None,
    rates: np.ndarray | None = None,
    seed: int = 0,
) -> Scaffold:
    """Nodes, curves and rotations from the lifted tracks of V videos: float32 tensors on the CPU, nothing bound yet.

    tracks: one set per video, in the order of the fit: a node's clock is the index of its set, and a scaffold per video
    expects V clocks. The set of a video without tracks is empty.
    offsets, rates [V]: world second = rate · own second + offset. footprint: world size of a working pixel at what
    moves. frame_step: seconds of one frame of the reference. seed: orders tracks that are seen equally long.
    """
    options = options or ScaffoldOptions()
    if not (np.isfinite(footprint) and footprint > 0):
        raise ValueError(f"footprint: expected world units per working pixel, > 0; found {footprint}.")
    offsets = np.asarray(offsets, float)
    if not options.per_video:
        grid = Grid.of(tracks, offsets, frame_step, rates)
        options = options.spaced(tracks, footprint, rates)
        path = options.path(grid.times[0], grid.times[-1])
        return _assemble(path, [_nodes(grid, path, footprint, options, seed)], options)
    clocks, options = picking.world_clocks(tracks, offsets, rates), options.spaced(tracks, footprint)
    rates = np.ones(len(tracks)) if rates is None else np.asarray(rates, float)
    usable = [v for v, one in enumerate(tracks) if one.seen.any()]
    if not usable:
        raise ValueError("tracks: expected at least one visible sample; found none in any of the videos.")
    first, last = min(clocks[v][0] for v in usable), max(clocks[v][-1] for v in usable)
    own = (np.array([first, last])[:, None] - offsets[usable]) / rates[usable]
    path = options.path(own.min(), own.max())
    parts = []
    for v in usable:
        grid = Grid.of([tracks[v]], np.zeros(1), frame_step / rates[v])
        parts.append(_nodes(grid, path, footprint, options, seed))
    scaffold = _assemble(path, parts, options)
    clock = np.repeat(usable, [part.curves.shape[1] for part in parts])
    return replace(
        scaffold,
        clock=torch.from_numpy(clock),
        offsets=torch.tensor(offsets, dtype=torch.float64),
        rates=torch.tensor(rates, dtype=torch.float64),
    )


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Nodes of one clock: knots [P,M,3], rotations [P,M,3,3] at their seconds, neighbours [M,K], weights, spacing."""

    curves: np.ndarray
    rotations: np.ndarray
    neighbours: np.ndarray
    weights: np.ndarray
    unit: float


def _assemble(path: Path, parts: Sequence[_Nodes], options: ScaffoldOptions) -> Scaffold:
    before = np.cumsum([0] + [part.curves.shape[1] for part in parts])
    knots = torch.from_numpy(np.concatenate([part.curves for part in parts], 1)).float()
    quats = path.through(continuous(quaternions(np.concatenate([part.rotations for part in parts], 1))))
    edges = np.concatenate([part.neighbours + b for part, b in zip(parts, before, strict=False)])
    weights = np.concatenate([part.weights for part in parts])
    return Scaffold(
        path,
        knots,
        torch.from_numpy(quats).float(),
        torch.from_numpy(edges),
        torch.from_numpy(weights).float(),
        float(np.median([part.unit for part in parts])),
        Binding.empty(knots.shape[1], knots),
        blend=options.blend,
    )


def _nodes(grid: Grid, path: Path, footprint: float, options: ScaffoldOptions, seed: int) -> _Nodes:
    """Pick, solve, pick again on the full curves, solve again, turn."""
    picked, unit = _first_pick(grid, footprint, options, seed)
    nodes = _PickedTracks(grid, path, picked, unit, footprint, options)
    xyz, seen = grid.compared()
    curves = nodes.solve(*picking.neighbours(xyz[picked], seen[picked], options.neighbours), rounds=ROUNDS)
    full = nodes.on_grid(curves)
    every = np.ones(full.shape[:2], bool)
    longest = np.argsort(-grid.seen[picked].sum(1), kind="stable")
    again = picking.pick(full, every, longest, options.second_pick * unit, len(picked))
    nodes = _PickedTracks(grid, path, picked[again], unit, footprint, options)
    curves = nodes.solve(*picking.neighbours(full[again], every[again], options.neighbours), rounds=ROUNDS)
    full = nodes.on_grid(curves)
    neighbours, distances = picking.neighbours(full, every[again], options.neighbours)
    weights = picking.edge_weights(distances, unit, options.reach)
    turned = neighbourhood_rotations(path.at_knots(torch.from_numpy(curves)).numpy(), neighbours, weights, unit)
    logger.info("%d nodes of %d tracks, %.3g world units apart", len(again), len(grid), unit)
    return _Nodes(curves, turned, neighbours, weights, unit)


def _first_pick(grid: Grid, footprint: float, options: ScaffoldOptions, seed: int) -> tuple[np.ndarray, float]:
    """Tracks that become nodes, and the spacing in world units at which they were picked."""
    count = grid.seen.sum(1)
    step = grid.times[1] - grid.times[0] if len(grid.times) > 1 else FRAME
    enough = min(options.shortest / step, count.max() / 3)
    shuffled = np.random.default_rng(seed).permutation(len(grid))
    order = shuffled[np.argsort(-count[shuffled], kind="stable")]
    order = order[count[order] >= max(1, enough)]
    xyz, seen = grid.compared()
    order = order[seen[order].any(1)]

    def at(unit: float) -> np.ndarray:
        return picking.pick(xyz, seen, order, unit * footprint, options.most + 1)

    unit = options.unit or UNIT
    picked = at(unit)
    # rather a larger spacing than a part of the scene without nodes; no use where few are ever seen together
    while len(picked) > options.most and unit < MOST_UNIT:
        unit *= GROWTH
        picked = at(unit)
    while options.unit is None and len(picked) < min(options.fewest, len(order)) and unit / GROWTH >= LEAST_UNIT:
        closer = at(unit / GROWTH)
        if len(closer) > options.most:
            break
        unit, picked = unit / GROWTH, closer
    if len(picked) > options.most:
        logger.warning(
            "more than %d tracks are never seen together, or are further apart than %g footprints: those seen longest "
            "become nodes. Are the offsets right?",
            *(options.most, unit),
        )
    return picked[: options.most], unit * footprint


class _PickedTracks:
    """The tracks that become nodes: their samples, ready for the solve."""

    def __init__(
        self,
        grid: Grid,
        path: Path,
        picked: np.ndarray,
        unit: float,
        footprint: float,
        options: ScaffoldOptions,
    ) -> None:
        self.grid, self.path, self.unit, self.options = grid, path, unit, options
        self.robust, self.n = options.robust * footprint, len(picked)
        self.seen = grid.seen[picked]
        self.observed = []
        begin = 0
        for times, xyz in grid.samples:
            mine = np.flatnonzero((picked >= begin) & (picked < begin + len(xyz)))
            if len(mine):
                self.observed.append(Observations(times, xyz[picked[mine] - begin], mine))
            begin += len(xyz)
        stride = -(-len(grid.times) // picking.COMPARED_FRAMES)
        self.design = path.design(grid.times[::stride])

    def solve(self, neighbours: np.ndarray, distances: np.ndarray, rounds: int) -> np.ndarray:
        ties = picking.edge_weights(distances, self.unit, self.options.reach)
        edges = np.stack([np.nonzero(ties)[0], neighbours[ties > 0]], 1)
        coupling = Coupling(edges, ties[ties > 0], self.grid.times, self.seen, self.unit)
        return solve_curves(self.path, self.observed, coupling, self.options.smooth, robust=self.robust, rounds=rounds)

    def on_grid(self, curves: np.ndarray) -> np.ndarray:
        """Curves [P,M,3] at the frames at which tracks are compared: float32 [M,G,3] relative to the centre."""
        return along(self.design, (curves - self.grid.centre).transpose(1, 0, 2)).astype(np.float32)
