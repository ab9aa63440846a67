"""Bounds on the slopes of path costs, for the Lipschitz constant L_F."""

import numpy as np

from .costs import LinkCosts
from .paths import Paths

_POWER_ITERATIONS = 60
_ROUNDOFF_FACTOR = 1 + 1e-10
"""Exceeds the relative roundoff of sums of several thousand positive numbers."""


def largest_flows(paths: Paths, demand: np.ndarray) -> np.ndarray:
    """Return the largest possible flow of each link: all trips of every pair with a path over it."""
    once = np.unique(np.repeat(paths.pairs, paths.lengths) * paths.count + paths.links)
    return np.bincount(once % paths.count, demand[once // paths.count], paths.count)


def largest_slope(costs: LinkCosts, paths: Paths, capacity: np.ndarray) -> float:
    """Return an upper bound of ‖ΔᵀDΔ‖ for the largest slopes D of the links at these capacities.

    M = ΔᵀDΔ is symmetric with nonnegative entries, so for every z > 0 its norm is at most
    max (Mz)ᵢ/zᵢ (Collatz 1942, Wielandt 1950). The power method yields a z for which the bound is
    sharp; the bound is valid for every z.
    """
    D = costs.slopes(costs.most, capacity)
    incidence = paths.incidence()
    transposed = incidence.T.tocsr()
    z, bound = np.ones(len(paths.lengths)), np.inf
    for _ in range(_POWER_ITERATIONS):
        Mz = incidence @ (D * (transposed @ z))
        bound = min(bound, float(np.max(Mz / z)))
        if bound == 0.0:
            break
        # The shift and the lower limit keep all entries positive, for reducible M as well.
        z = Mz + 0.01 * bound * z
        z = np.maximum(z / z.max(), 1e-8)
    return bound * _ROUNDOFF_FACTOR
