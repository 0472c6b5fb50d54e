"""Growing nodes where a scaffold needs more, and pruning those that carry nothing.

A change of the nodes tells where each came from, so that an optimiser can keep its averages.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from recon.motion import warp as warping
from recon.motion.binding import NODES
from recon.motion.nodes import REACH, edge_weights, neighbours
from recon.motion.paths import WINDOW
from recon.motion.scaffold import Scaffold
from recon.rotations import continuous, unit


@dataclass(frozen=True, eq=False)
class Change:
    """A scaffold with other nodes. source int64 [M']: the index that each node had before, -1 for a new one."""

    scaffold: Scaffold
    source: Tensor


def node_gradients(scaffold: Scaffold, gradients: Tensor) -> Tensor:
    """How hard each node is pulled [M]: the mean of its Gaussians' `gradients` [N] >= 0, weighted as they are bound."""
    nodes, w = scaffold.binding.nodes.reshape(-1), scaffold.binding.weights
    pull = torch.zeros(len(scaffold), dtype=w.dtype, device=w.device)
    total = pull.index_add(0, nodes, w.reshape(-1))
    pull = pull.index_add(0, nodes, (w * gradients.to(w)[:, None]).reshape(-1))
    return pull / total.clamp_min(1e-12)


def grow(
    scaffold: Scaffold,
    means: Tensor,
    gradients: Tensor,
    *,
    factor: float = 2.0,
    apart: float = 0.5,
    most: int = 100,
) -> Change:
    """New nodes where one is pulled `factor` times as hard as the median node: at most `most`.

    gradients [N]: norms of the gradients of the Gaussians' means [N,3], summed over steps. Of such a node's Gaussians
    the one pulled hardest becomes a node, if it is further than `apart` units from its nearest node. The new node moves
    and turns as its Gaussian has been carried so far, at the rests too: the other Gaussians are carried nearly as
    before (exactly so where all move rigidly). Neighbours and bindings are searched for again.
    """
    if gradients.shape != means.shape[:1] or len(means) != len(scaffold.binding):
        raise ValueError(
            f"gradients, means: expected a norm and a mean for each of the {len(scaffold.binding)} bound Gaussians; "
            f"found shapes {tuple(gradients.shape)}, {tuple(means.shape)}."
        )
    with torch.no_grad():
        chosen = _pulled(scaffold, means, gradients, factor, apart, most)
        if not len(chosen):
            return Change(scaffold, torch.arange(len(scaffold), device=means.device))
        bound, places = scaffold.binding.take(chosen), means[chosen]
        upright = means.new_tensor([1.0, 0, 0, 0]).expand(len(chosen), 4)

        def carried(positions: Tensor, quats: Tensor) -> tuple[Tensor, Tensor]:
            return warping.blend(bound, positions, quats, places, upright, scaffold.blend)

        # the nodes of a Gaussian share a clock: at the seconds of the knots all have poses of one time
        path = scaffold.path
        places_then, turned_then = path.at_knots(scaffold.knots), unit(path.at_knots(scaffold.knot_quats))
        moved, turns = zip(*map(carried, places_then, turned_then), strict=True)
        rests = [carried(p, q) for p, q in zip(scaffold.rest_positions, scaffold.rest_quats, strict=True)]
        signed = torch.from_numpy(path.through(continuous(torch.stack(turns).cpu().numpy()))).to(scaffold.knot_quats)
        knots = torch.from_numpy(path.through(torch.stack(moved).cpu().numpy())).to(scaffold.knots)
        binding = replace(
            scaffold.binding,
            positions=torch.cat([scaffold.rest_positions, torch.stack([x for x, _ in rests])], 1),
            quats=torch.cat([scaffold.rest_quats, torch.stack([q for _, q in rests])], 1),
        )
        owner = bound.nodes[:, 0]
        grown = replace(
            scaffold,
            knots=torch.cat([scaffold.knots, knots], 1),
            knot_quats=torch.cat([scaffold.knot_quats, signed], 1),
            edges=torch.cat([scaffold.edges, scaffold.edges[owner]]),
            edge_weights=torch.cat([scaffold.edge_weights, scaffold.edge_weights[owner]]),
            binding=binding,
            clock=None if scaffold.clock is None else torch.cat([scaffold.clock, scaffold.clock[owner]]),
        )
        source = torch.cat([torch.arange(len(scaffold), device=owner.device), torch.full_like(owner, -1)])
        return Change(rebind(retie(grown), means), source)


def _pulled(scaffold: Scaffold, means: Tensor, gradients: Tensor, factor: float, apart: float, most: int) -> Tensor:
    """Indices of the Gaussians that are to become nodes."""
    pull = node_gradients(scaffold, gradients)
    used = pull[pull > 0]
    if not len(used):
        return torch.zeros(0, dtype=torch.int64, device=means.device)
    crowded = pull > factor * used.median()
    nearest, rest = scaffold.binding.nodes[:, 0], scaffold.binding.rest
    distance = (means - scaffold.rest_positions[rest, nearest]).norm(dim=-1)
    candidates = torch.nonzero(crowded[nearest] & (distance > apart * scaffold.unit))[:, 0]
    # those pulled hardest first; of each node's Gaussians only the first is kept
    order = candidates[torch.argsort(gradients[candidates], descending=True, stable=True)].cpu().numpy()
    _, first = np.unique(nearest.cpu().numpy()[order], return_index=True)
    return torch.from_numpy(order[np.sort(first)][:most]).to(means.device)


def prune(scaffold: Scaffold, *, least: float = 0.02) -> Change:
    """Without the nodes that carry no Gaussian by at least `least` of its weight.

    Where nothing is bound, nothing is pruned.
    """
    if not 0 <= least < 1 / NODES:
        raise ValueError(
            f"least: expected a weight of 0 up to 1/{NODES}, which some node of a Gaussian reaches; found {least}."
        )
    bound, every = scaffold.binding, torch.arange(len(scaffold), device=scaffold.knots.device)
    largest = torch.zeros(len(scaffold), device=every.device, dtype=bound.weights.dtype)
    largest = largest.scatter_reduce(0, bound.nodes.reshape(-1), bound.weights.reshape(-1), "amax")
    kept = every[largest >= max(least, 1e-12)]
    if len(kept) == len(scaffold) or not len(bound):
        return Change(scaffold, every)
    position = torch.full_like(every, -1).index_put((kept,), torch.arange(len(kept), device=every.device))
    nodes = position[bound.nodes]
    weights = torch.where(nodes >= 0, bound.weights, 0)
    binding = replace(
        bound,
        nodes=torch.where(nodes >= 0, nodes, nodes[:, :1]),  # the first slot is the heaviest: it stays
        weights=weights / weights.sum(1, keepdim=True),
        positions=bound.positions[:, kept],
        quats=bound.quats[:, kept],
    )
    pruned = replace(
        scaffold,
        knots=scaffold.knots.detach()[:, kept],
        knot_quats=scaffold.knot_quats.detach()[:, kept],
        edges=torch.zeros_like(scaffold.edges[kept]),
        edge_weights=torch.zeros_like(scaffold.edge_weights[kept]),
        binding=binding,
        clock=None if scaffold.clock is None else scaffold.clock[kept],
    )
    return Change(retie(pruned), kept)


def retie(scaffold: Scaffold, reach: float = REACH) -> Scaffold:
    """The same nodes, with neighbours by the curves as they are now."""
    path = scaffold.path
    times = np.linspace(path.times[0], path.times[-1], WINDOW * (path.count - 1) + 1)
    with torch.no_grad():
        curves = path.at(scaffold.knots, torch.as_tensor(times, device=scaffold.knots.device)).cpu().numpy()
    curves = (curves - curves.reshape(-1, 3).mean(0)).transpose(1, 0, 2)
    clock = np.zeros(len(scaffold), int) if scaffold.clock is None else scaffold.clock.cpu().numpy()
    edges = np.zeros(tuple(scaffold.edges.shape), np.int64)
    distances = np.zeros(edges.shape)
    for v in np.unique(clock):
        mine = np.flatnonzero(clock == v)
        among, distances[mine] = neighbours(curves[mine], np.ones((len(mine), len(times)), bool), edges.shape[1])
        edges[mine] = mine[among]
    return replace(
        scaffold,
        edges=torch.as_tensor(edges).to(scaffold.edges),
        edge_weights=torch.as_tensor(edge_weights(distances, scaffold.unit, reach)).to(scaffold.edge_weights),
    )


def rebind(scaffold: Scaffold, means: Tensor) -> Scaffold:
    """The same Gaussians, at their rests bound again: to the present nodes and neighbours, from the present `means`
    [N,3]."""
    bound = scaffold.binding
    nodes, weights = bound.nodes.clone(), bound.weights.clone()
    clock = torch.zeros_like(bound.rest) if scaffold.clock is None else scaffold.clock[bound.nodes[:, 0]]
    for r, v in torch.unique(torch.stack([bound.rest, clock], 1), dim=0).tolist():
        rows = torch.nonzero((bound.rest == r) & (clock == v))[:, 0]
        video = None if scaffold.clock is None else v
        nodes[rows], weights[rows] = scaffold.skin(means.detach()[rows], bound.positions[r], video=video)
    return replace(scaffold, binding=replace(bound, nodes=nodes, weights=weights))
