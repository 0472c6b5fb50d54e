"""Bindings: which nodes carry which Gaussian, and where these nodes stood when it was bound."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from recon.motion.arrays import Arrays, indices, numbers

NODES = 8  # per Gaussian: the nearest one and its topological neighbours


@dataclass(frozen=True, eq=False)
class Layout:
    """The (rest, node) pairs that a binding uses, in the orders in which a warp goes through them.

    Q pairs in ascending order of the node, then of the rest. `of_slot` [N,8]: the pair of each slot of a Gaussian;
    `starts` [Q+1] and `slots` [N*8]: the slots (Gaussian * 8 + k) of every pair, ascending; `node_starts` [M+1]: the
    pairs of every node. Sums over slots and pairs run in these orders, and so are the same to the last bit.
    """

    node: np.ndarray
    rest: np.ndarray
    of_slot: np.ndarray
    starts: np.ndarray
    slots: np.ndarray
    node_starts: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class Binding:
    """N Gaussians bound to M nodes; constant during a fit.

    rest int64 [N]: at which of the R rests each Gaussian was bound. nodes int64 [N,8] and weights [N,8] >= 0, of sum 1:
    the nearest node first, which is the heaviest. times float64 [R]: world seconds of the rests. positions [R,M,3] and
    quats [R,M,4] (unit): the nodes' poses then, frozen, so that no step evaluates them again and a Gaussian's mean
    keeps its meaning.
    """

    rest: Tensor
    nodes: Tensor
    weights: Tensor
    times: Tensor
    positions: Tensor
    quats: Tensor

    @classmethod
    def empty(cls, n_nodes: int, like: Tensor) -> Binding:
        """No Gaussians yet; dtype and device of `like`."""
        whole = torch.zeros(0, dtype=torch.int64, device=like.device)
        times = torch.zeros(0, dtype=torch.float64, device=like.device)
        return cls(
            whole,
            whole.new_zeros(0, NODES),
            like.new_zeros(0, NODES),
            times,
            like.new_zeros(0, n_nodes, 3),
            like.new_zeros(0, n_nodes, 4),
        )

    @classmethod
    def from_arrays(cls, arrays: Arrays, n_nodes: int, kind: tuple[type, ...]) -> Binding:
        """From a scaffold's arrays ``binding_*``, in the precision `kind` of its knots.

        KeyError or ValueError for what is missing or unsound. Only arrays are checked: a binding made here is sound.
        """
        times = numbers(arrays, "binding_times", (None,), (np.float64,))
        rest = indices(arrays, "binding_rest", (None,), len(times), like="binding_times")
        weights = numbers(arrays, "binding_weights", (len(rest), NODES), kind, like="binding_rest and knots")
        if not (weights >= 0).all():
            raise ValueError(f"binding_weights: expected weights >= 0; found {float(weights.min())}.")
        return cls(
            rest,
            indices(arrays, "binding_nodes", (len(rest), NODES), n_nodes, like="binding_rest and knots"),
            weights,
            times,
            numbers(arrays, "binding_positions", (len(times), n_nodes, 3), kind, like="binding_times and knots"),
            numbers(arrays, "binding_quats", (len(times), n_nodes, 4), kind, like="binding_times and knots"),
        )

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.rest)

    def __repr__(self) -> str:
        rests, nodes = self.positions.shape[:2]
        return f"Binding({len(self)} Gaussians to {nodes} nodes, {rests} rests, {self.weights.device})"

    def take(self, index: Tensor | np.ndarray) -> Binding:
        """The Gaussians at `index` (integers, with repeats, or a mask)."""
        index = torch.as_tensor(index, device=self.rest.device)
        return replace(self, rest=self.rest[index], nodes=self.nodes[index], weights=self.weights[index])

    def append(self, nodes: Tensor, weights: Tensor, time: float, positions: Tensor, quats: Tensor) -> Binding:
        """With n more Gaussians, bound at world second `time` to nodes with poses [M,3], [M,4]: one more rest, unless
        an earlier one is the same."""
        same = [
            r
            for r in range(len(self.times))
            if torch.equal(self.positions[r], positions) and torch.equal(self.quats[r], quats)
        ]
        here = same[0] if same else len(self.times)
        rest = torch.full((len(nodes),), here, dtype=torch.int64, device=self.rest.device)
        bound = replace(
            self,
            rest=torch.cat([self.rest, rest]),
            nodes=torch.cat([self.nodes, nodes]),
            weights=torch.cat([self.weights, weights.to(self.weights)]),
        )
        if same:
            return bound
        return replace(
            bound,
            times=torch.cat([self.times, self.times.new_tensor([time])]),
            positions=torch.cat([self.positions, positions[None]]),
            quats=torch.cat([self.quats, quats[None]]),
        )

    @cached_property
    def layout(self) -> Layout:
        """Computed once per binding: parameters change in every step, bindings do not."""
        rest, nodes = self.rest.cpu().numpy(), self.nodes.cpu().numpy()
        n_nodes, n_rests = self.positions.shape[1], max(1, len(self.positions))
        keys, of_slot = np.unique(nodes * n_rests + rest[:, None], return_inverse=True)
        of_slot = of_slot.reshape(nodes.shape)
        counts = np.bincount(of_slot.reshape(-1), minlength=len(keys))
        node = keys // n_rests
        return Layout(
            node=node.astype(np.int32),
            rest=(keys % n_rests).astype(np.int32),
            of_slot=of_slot.astype(np.int32),
            starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
            slots=np.argsort(of_slot.reshape(-1), kind="stable").astype(np.int32),
            node_starts=np.searchsorted(node, np.arange(n_nodes + 1)).astype(np.int32),
        )

    @cached_property
    def pair_rests(self) -> tuple[np.ndarray, np.ndarray]:
        """Rest positions [Q,3] and quats [Q,4] of the layout's pairs: float32."""
        rests, nodes = self.layout.rest, self.layout.node

        def of_pairs(poses: Tensor) -> np.ndarray:
            return np.ascontiguousarray(poses.cpu().numpy()[rests, nodes], np.float32)

        return of_pairs(self.positions), of_pairs(self.quats)
