"""How accurate matchers are and how long they take, by number of tracks: what ``otsync bench match`` measured."""

from __future__ import annotations

import numpy as np

ANCHORED_FROM = 200
"""Tracks from which AnchoredFGW is the default: at every measured size it is more precise than the dense solvers."""

#: name -> {tracks: (CPU seconds of one thread, P50)}
FRONTIER: dict[str, dict[int, tuple[float, float]]] = {
    "NearestNeighbor": {
        200: (0.00214, 0.22),
        500: (0.00819, 0.228),
        1000: (0.0217, 0.207),
        2000: (0.0861, 0.171),
        5000: (0.775, 0.157),
    },
    "OptimalTransport": {
        200: (0.005, 0.315),
        500: (0.0336, 0.404),
        1000: (0.14, 0.46),
        2000: (0.668, 0.458),
        5000: (7.65, 0.476),
    },
    "FusedGromovWasserstein": {200: (0.0365, 0.58), 500: (0.345, 0.664), 1000: (1.92, 0.726), 2000: (13.6, 0.734)},
    "PartialFGW": {200: (0.0471, 0.76), 500: (0.537, 0.776), 1000: (4.3, 0.852), 2000: (28.0, 0.857)},
    "AnchoredFGW, small": {
        200: (0.0958, 0.86),
        500: (0.116, 0.972),
        1000: (0.166, 0.979),
        2000: (0.186, 0.992),
        5000: (0.307, 0.997),
        20000: (1.54, 0.999),
        50000: (10.1, 0.996),
    },
    "AnchoredFGW": {
        200: (0.277, 0.86),
        500: (0.2, 0.966),
        1000: (0.252, 0.986),
        2000: (0.364, 0.99),
        5000: (0.579, 0.997),
        20000: (1.65, 0.999),
        50000: (4.37, 0.998),
    },
}


def predicted(name: str, n: int) -> float:
    """Seconds at ``n`` tracks: a line through the measured points in logarithms, continued with its last slope."""
    sizes = sorted(FRONTIER[name])
    x, y = np.log(sizes), np.log([FRONTIER[name][s][0] for s in sizes])
    at = np.log(max(n, 1))
    if at <= x[-1]:
        return float(np.exp(np.interp(at, x, y)))
    slope = max(1.0, (y[-1] - y[-2]) / (x[-1] - x[-2]))
    return float(np.exp(y[-1] + slope * (at - x[-1])))


def accuracy(name: str, n: int) -> float:
    """P50 at ``n`` tracks, between and beyond the measured sizes that of the nearest (in logarithms)."""
    sizes = np.array(sorted(FRONTIER[name]))
    return FRONTIER[name][int(sizes[np.argmin(np.abs(np.log(sizes / max(n, 1))))])][1]


def fitting(n: int, budget: float) -> str:
    """The most accurate matcher predicted to take at most ``budget`` seconds; ValueError when there is none.

    Dense solvers are not considered beyond the largest size that they were measured at.
    """
    able = [name for name, points in FRONTIER.items() if n <= max(points) or name.startswith("Anchored")]
    able = [name for name in able if predicted(name, n) <= budget]
    if not able:
        fastest = min((predicted(name, n), name) for name in FRONTIER if name.startswith("Anchored"))
        raise ValueError(
            f"budget: expected at least {fastest[0]:.2g} s, predicted for {fastest[1]} at {n} tracks; found "
            f"{budget:g}. "
            "Raise it, or take fewer tracks."
        )
    return max(able, key=lambda name: (accuracy(name, n), -predicted(name, n)))
