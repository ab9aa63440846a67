"""How steep the costs of paths can be: what L_F rests on."""

import numpy as np

from .costs import LinkCosts
from .paths import Paths

_TURNS = 60
_ROUNDING = 1 + 1e-10
"""More than the sums of some thousand positive numbers can lose."""


def largest_flows(paths: Paths, demand: np.ndarray) -> np.ndarray:
    """What can come onto each link: all trips of every pair that has a path over it."""
    once = np.unique(np.repeat(paths.pairs, paths.lengths) * paths.count + paths.links)
    return np.bincount(once % paths.count, demand[once // paths.count], paths.count)


def largest_slope(costs: LinkCosts, paths: Paths, capacity: np.ndarray) -> float:
    """At least ‖ΔᵀDΔ‖ for the largest slopes D of the links at these capacities.

    The matrix M = ΔᵀDΔ is symmetric without negative entries, so for every z > 0 its norm is at
    most max (Mz)ᵢ/zᵢ (Collatz 1942, Wielandt 1950). The power method brings z, and with it the
    bound near the norm; that it is a bound does not rest on how near z came.
    """
    D = costs.slopes(costs.most, capacity)
    incidence = paths.incidence()
    transposed = incidence.T.tocsr()
    z, least = np.ones(len(paths.lengths)), np.inf
    for _ in range(_TURNS):
        Mz = incidence @ (D * (transposed @ z))
        least = min(least, float(np.max(Mz / z)))
        if least == 0.0:
            break
        # Shifted, so that no entry dies out; entries of parts that do not meet stay above 0.
        z = Mz + 0.01 * least * z
        z = np.maximum(z / z.max(), 1e-8)
    return least * _ROUNDING
