"""The motion scaffold: nodes with splined poses that carry Gaussians bound to them (the paper's Sec. 3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.motion import fused
from recon.motion import warp as warping
from recon.motion.arrays import indices, numbers, scalar
from recon.motion.binding import NODES, Binding
from recon.motion.paths import WINDOW, Path, path_arrays, path_from_arrays, resampled
from recon.rotations import unit

LEAST_WEIGHT = 1e-6  # before normalisation: a point far from all of its nodes still follows them


@dataclass(frozen=True, eq=False, repr=False)
class Scaffold:
    """M nodes, each a pose that moves along a path, and the Gaussians bound to them.

    Args:
        path: the curve in time that the knots make.
        knots [P,M,3] world units, knot_quats [P,M,4] wxyz of any length: learnable.
        edges int64 [M,K]: topological neighbours, the nearest (by D_track) first.
        edge_weights [M,K]: 0 where the neighbour is too far to be one.
        unit: spacing of the nodes, world units; also the sigma of the radial weights by which points are bound.
        binding: of the Gaussians to the nodes.
        clock int64 [M] or None: the video on whose own clock each node lives (the paper's scaffold per video); None:
            all nodes live in world time.
        offsets, rates float64 [V] or None: of those videos when it was built; used where a caller gives no `clocks`.
        blend: "linear" or "dual-quaternion".

    A node of video u stands, at world time t, where its curve is at its own time (t - offset_u) / rate_u.
    """

    path: Path
    knots: Tensor
    knot_quats: Tensor
    edges: Tensor
    edge_weights: Tensor
    unit: float
    binding: Binding
    clock: Tensor | None = None
    offsets: Tensor | None = None
    rates: Tensor | None = None
    blend: str = warping.LINEAR

    def __post_init__(self) -> None:
        m = self.knots.shape[1]
        expected = {
            "knots": (self.path.count, m, 3),
            "knot_quats": (self.path.count, m, 4),
            "edges": (m, self.edges.shape[-1]),
            "edge_weights": (m, self.edges.shape[-1]),
        }
        for name, shape in expected.items():
            actual = tuple(getattr(self, name).shape)
            if actual != shape:
                raise ValueError(f"{name}: expected shape {shape} for {m} nodes on {self.path}; found {actual}.")
        if self.blend not in warping.BLENDS:
            raise ValueError(f"blend: expected one of {warping.BLENDS}; found {self.blend!r}.")
        if self.clock is not None and (self.offsets is None or self.rates is None):
            raise ValueError("offsets, rates: expected those of the videos on whose clocks the nodes live; found none.")

    def __len__(self) -> int:
        """Number of nodes."""
        return self.knots.shape[1]

    def __repr__(self) -> str:
        clocks = "world time" if self.clock is None else "the videos' own times"
        return (
            f"Scaffold({len(self)} nodes, {len(self.binding)} Gaussians, {clocks}, {self.path}, {self.blend}, "
            f"{self.knots.device})"
        )

    @property
    def rest_positions(self) -> Tensor:
        """Frozen positions of the nodes at the R rests [R,M,3]."""
        return self.binding.positions

    @property
    def rest_quats(self) -> Tensor:
        """Frozen orientations of the nodes at the R rests [R,M,4]."""
        return self.binding.quats

    @property
    def peak(self) -> float:
        return self.path.peak

    def parameters(self) -> dict[str, Tensor]:
        return {"knots": self.knots, "knot_quats": self.knot_quats}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Scaffold:
        return replace(self, knots=parameters["knots"], knot_quats=parameters["knot_quats"])

    def own_times(self, t: Tensor | float, clocks: Tensor | None = None) -> Tensor:
        """World second `t`, or T of them, on the videos' clocks: float64 [V] or [T,V]; V is 1 in world time."""
        t = torch.as_tensor(t, dtype=torch.float64, device=self.knots.device)
        if self.clock is None:
            return t[..., None]
        assert self.offsets is not None and self.rates is not None
        if clocks is None:
            clocks = self.offsets
        elif clocks.shape != self.offsets.shape:
            raise ValueError(
                f"clocks: expected one offset in seconds per video, {tuple(self.offsets.shape)}; "
                f"found {tuple(clocks.shape)}."
            )
        return (t[..., None] - clocks.to(torch.float64)) / self.rates

    def nodes(self, t: Tensor | float, clocks: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Positions [M,3] and unit quaternions [M,4] of the nodes at world second `t` ([T,M,3], [T,M,4] at T of them);
        differentiable in everything."""
        times = self.own_times(t, clocks)
        if times.ndim == 1 and fused.applies(self.knots, self.knot_quats):
            return fused.poses(times, self.knots, self.knot_quats, self.path, self.rig.clock)
        first, w = self.path.weights(times)
        clock = torch.zeros(len(self), dtype=torch.int64, device=w.device) if self.clock is None else self.clock
        window = torch.as_tensor(first)[..., None, clock] + torch.arange(WINDOW, device=w.device)[:, None]  # [...,4,M]
        every = torch.arange(len(self), device=w.device)
        positions, quats = (
            torch.einsum("...ma,...amx->...mx", w.to(knots.dtype)[..., clock, :], knots[window, every])
            for knots in (self.knots, self.knot_quats)
        )
        return positions, unit(quats)

    def warp(
        self, means: Tensor, quats: Tensor, t: Tensor | float, clocks: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Means [N,3] and quats [N,4] of the bound Gaussians at world second `t`, [T,N,3] and [T,N,4] at T of them; see
        :func:`recon.motion.warp.blend`.

        clocks float64 [V]: offsets of the videos, for a scaffold per video; one in world time does not need them.
        """
        if len(means) != len(self.binding):
            raise ValueError(f"means: expected the {len(self.binding)} Gaussians bound here; found {len(means)}.")
        if fused.applies(means, quats, self.knots, self.knot_quats):
            times = self.own_times(t, clocks)
            if times.ndim == 1:
                return fused.warp(means, quats, times, self.knots, self.knot_quats, self.rig)
            each = [fused.warp(means, quats, own, self.knots, self.knot_quats, self.rig) for own in times]
            return torch.stack([moved for moved, _ in each]), torch.stack([turned for _, turned in each])
        positions, node_quats = self.nodes(t, clocks)
        return warping.blend(self.binding, positions, node_quats, means, quats, self.blend)

    def moments(self, times: Sequence[float], clocks: Tensor | None = None) -> tuple[np.ndarray, np.ndarray]:
        """First knots [S,V] and weights [S,V,4] of S world seconds, for the kernels."""
        own = torch.stack([self.own_times(t, clocks) for t in times]).detach().cpu().numpy()
        first, weights, _ = self.path.basis(own)
        return first, weights

    @cached_property
    def rig(self) -> fused.Rig:
        """The constants, as the kernels take them."""
        clock = np.zeros(len(self), np.int32) if self.clock is None else self.clock.numpy().astype(np.int32)
        return fused.Rig(self.path, self.binding, clock, self.blend == warping.DUAL_QUATERNION)

    def bind(
        self, points: Tensor | np.ndarray, t_rest: float, clocks: Tensor | None = None, *, video: int | None = None
    ) -> Scaffold:
        """This scaffold with n more Gaussians, at `points` [n,3] at world second `t_rest`.

        Each is carried by the node nearest to it then, and by the seven nearest neighbours of that node, with weights
        exp(-d²/2 unit²) of the distances then. `video`: only by nodes on that video's clock, as in the paper, where
        every video seeds its own scaffold.
        """
        with torch.no_grad():
            positions, quats = self.nodes(t_rest, clocks)
            nodes, weights = self.skin(points, positions, video=video)
        return replace(self, binding=self.binding.append(nodes, weights, float(t_rest), positions, quats))

    def skin(
        self, points: Tensor | np.ndarray, positions: Tensor, *, video: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """Nodes [n,8] and weights [n,8] that carry `points` [n,3] among nodes at `positions` [M,3]."""
        from scipy.spatial import cKDTree

        place = positions.detach().cpu().numpy().astype(float)
        where = torch.as_tensor(points).detach().cpu().numpy().astype(float).reshape(-1, 3)
        if not np.isfinite(where).all():
            raise ValueError("points: expected finite positions; found NaN or infinity. Leave those points out.")
        among = np.arange(len(self))
        if video is not None and self.clock is not None:
            among = np.flatnonzero(self.clock.cpu().numpy() == video)
            if not len(among):
                raise ValueError(f"video: expected one that has nodes here; found {video}. It had no usable tracks.")
        nearest = among[cKDTree(place[among]).query(where)[1]]
        edges, ties = self.edges.cpu().numpy(), self.edge_weights.cpu().numpy()
        k = min(NODES - 1, edges.shape[1])
        nodes = np.tile(nearest[:, None], (1, NODES))  # unused slots: the nearest node, with weight zero
        nodes[:, 1 : 1 + k] = edges[nearest, :k]
        open_slot = np.zeros((len(nodes), NODES), bool)
        open_slot[:, 0] = True
        open_slot[:, 1 : 1 + k] = ties[nearest, :k] > 0
        distance2 = ((place[nodes] - where[:, None]) ** 2).sum(-1)
        # relative to the nearest: far from all nodes every exponential would vanish
        excess = distance2 - np.where(open_slot, distance2, np.inf).min(1, keepdims=True)
        weights = (np.exp(-np.maximum(excess, 0) / (2 * self.unit**2)) + LEAST_WEIGHT) * open_slot
        weights /= weights.sum(1, keepdims=True)
        return torch.as_tensor(nodes, device=self.knots.device), torch.as_tensor(weights).to(self.knots)

    def shifted(self, by: float, clocks: Tensor | None = None) -> Scaffold:
        """The same motion, `by` seconds later; `clocks`: the videos' new offsets, for nodes on their clocks."""
        binding = replace(self.binding, times=self.binding.times + by)
        if self.clock is None:
            return replace(self, path=replace(self.path, start=self.path.start + by), binding=binding)
        assert self.offsets is not None
        offsets = self.offsets + by if clocks is None else clocks.detach().to(self.offsets)
        return replace(self, offsets=offsets, binding=binding)

    def take(self, index: Tensor | np.ndarray) -> Scaffold:
        """The same nodes with the Gaussians at `index`, to prune or duplicate them."""
        return replace(self, binding=self.binding.take(index))

    def on(self, path: Path) -> Scaffold:
        """The same motion on another path, sampled at its knots; on :class:`Sampled`, the "w/o spline" ablation."""
        knots, quats = (resampled(x, self.path, path) for x in (self.knots, self.knot_quats))
        return replace(self, path=path, knots=knots, knot_quats=quats)

    def to(self, device: torch.device | str) -> Scaffold:
        """The same scaffold on another device."""
        return _mapped(self, lambda x: x.to(device), binding=_mapped(self.binding, lambda x: x.to(device)))

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything as plain arrays, for a checkpoint."""
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        parts |= {f"binding_{f.name}": getattr(self.binding, f.name) for f in fields(self.binding)}
        arrays = {k: v.detach().cpu().numpy() for k, v in parts.items() if isinstance(v, Tensor)}
        named = {"kind": np.array("scaffold"), "blend": np.array(self.blend), "unit": np.array(self.unit)}
        return named | path_arrays(self.path) | arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Scaffold:
        """The scaffold whose :meth:`arrays` these are. ValueError where one is missing, unsound or does not fit."""
        try:
            path = path_from_arrays(arrays)
            knots = numbers(arrays, "knots", (path.count, None, 3), like="path_knots")
            m, kind = knots.shape[1], (np.asarray(arrays["knots"]).dtype.type,)  # kernels take one precision
            edges = indices(arrays, "edges", (m, None), m, like="knots")
            clock = offsets = rates = None
            if "offsets" in arrays:
                offsets = numbers(arrays, "offsets", (None,), (np.float64,))
                rates = numbers(arrays, "rates", offsets.shape, (np.float64,), like="offsets")
                if not (rates > 0).all():
                    raise ValueError(f"rates: expected numbers > 0; found {rates.tolist()}.")
            if "clock" in arrays:
                clock = indices(arrays, "clock", (m,), 0 if offsets is None else len(offsets), like="knots and offsets")
            return cls(
                path,
                knots=knots,
                knot_quats=numbers(arrays, "knot_quats", (path.count, m, 4), kind, like="path_knots and knots"),
                edges=edges,
                edge_weights=numbers(arrays, "edge_weights", edges.shape, kind, like="edges and knots"),
                unit=scalar(arrays, "unit"),
                binding=Binding.from_arrays(arrays, m, kind),
                clock=clock,
                offsets=offsets,
                rates=rates,
                blend=str(arrays["blend"]),
            )
        except (KeyError, TypeError) as error:
            raise ValueError(f"arrays: expected those of a scaffold; found no sound {error}.") from None


def _mapped(value: Any, change: Callable[[Tensor], Tensor], **others: Any) -> Any:
    """A dataclass with `change` applied to each of its tensors."""
    tensors = {f.name: getattr(value, f.name) for f in fields(value)}
    return replace(value, **{k: change(v) for k, v in tensors.items() if isinstance(v, Tensor)}, **others)
