"""User equilibria to roundoff, with the paths that carry flow, by column generation.

Path flows x are a user equilibrium if they minimise Beckmann's Φ(Δx) over K, the flows that add up to
the demand of every pair (Beckmann, McGuire and Winsten 1956). Each iteration computes the shortest path
of every pair on the whole network, adds it if it costs less than all paths of its pair (Leventhal,
Nemhauser and Trotter 1973), and reduces Φ over the current paths (`RestrictedProblem`). The relative
gap is the fraction of Σ xc that would be saved if all trips took the shortest paths of the whole
network at these costs. It bounds the error of Φ.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...errors import SolveError
from .costs import LinkCosts
from .paths import Paths
from .restricted import EXACT, ROUGH, RestrictedProblem
from .shortest import ShortestPaths

_COST_ROUNDOFF = 1e-13
"""Relative roundoff of path costs, which are sums of several dozen numbers."""

_KEEP_TOLERANCE = 1e-6
"""Paths within this relative difference of the shortest path are kept at the equilibrium."""

_MAX_ITERATIONS, _MAX_STAGNATION = 500, 60
"""The largest number of iterations, and of consecutive iterations without progress in gap or Φ."""

_PATIENCE = 15
"""The number of iterations without progress after which steps are exact, of all pairs together."""

_MAX_SWEEPS = 4
"""Largest number of sweeps between two shortest-path searches."""
_RESTRICTED_GAP_RATIO = 0.05
"""Sweeps end once the gap over the current paths is below this fraction of the gap of the network."""

_LARGE_STEP, _SMALL_STEP, _MAX_BLOCKS = 0.5, 0.1, 1024
"""Step lengths of the line search above which blocks are enlarged, and below which they are split."""

_REPORT_INTERVAL = 2.0
"""Seconds between two reports."""

Report = Callable[[str], None]
"""A function that receives a message about the progress."""


class Equilibrium(NamedTuple):
    """Path flows, and their relative gap over all paths of the network."""

    paths: Paths
    flows: np.ndarray
    gap: float


def equilibrate(
    costs: LinkCosts,
    capacity: np.ndarray,
    search: ShortestPaths,
    demand: np.ndarray,
    paths: Paths | None,
    gap: float,
    report: Report | None = None,
) -> Equilibrium:
    """Return a user equilibrium to this relative gap.

    Its paths are the given `paths` (by default the shortest ones of the empty network) and the added
    ones that are shortest at the equilibrium.

    **Raises:** `dvax.SolveError` if roundoff, or the number of iterations, does not allow the gap.
    """
    free = costs.costs(np.zeros(len(capacity)), capacity)
    if paths is None:
        _, tree = search.find(free)
        every = np.arange(len(demand))
        paths = Paths(*search.trace(tree, every), np.ones(len(demand), int), len(capacity))
    x = all_or_nothing(paths, free, demand)
    given = np.ones(len(x), bool)
    blocks = None
    best, lowest, stagnation, last_report = np.inf, np.inf, 0, time.monotonic()
    for number in range(_MAX_ITERATIONS):
        incidence = paths.incidence()
        v = incidence.T @ x
        c = costs.costs(v, capacity)
        least, tree = search.find(c)
        path_costs = incidence @ c
        total_cost = float(x @ path_costs)
        # Subtract before summing, to avoid cancellation.
        saving = float(x @ (path_costs - np.repeat(least, paths.sizes)))
        current_gap = max(saving / total_cost, 0.0) if total_cost > 0 else 0.0
        if report is not None and time.monotonic() - last_report > _REPORT_INTERVAL:
            last_report = time.monotonic()
            report(f"iteration {number}: {len(x)} paths, relative gap {current_gap:.1e}")
        if current_gap <= gap:
            # Remove added paths that carry no flow and are not shortest.
            shortest = path_costs <= np.repeat(least, paths.sizes) * (1 + _KEEP_TOLERANCE)
            kept = given | (x > 0) | shortest
            return Equilibrium(paths.select(kept), x[kept], current_gap)
        value = float(costs.integrals(v, capacity).sum())
        progress = current_gap < 0.9 * best or value < 0.999 * lowest
        best, lowest = min(current_gap, best), min(value, lowest)
        stagnation = 0 if progress else stagnation + 1
        if stagnation > _MAX_STAGNATION:
            break
        current_least = np.minimum.reduceat(path_costs, paths.starts)
        improvable = np.flatnonzero(current_least > least * (1 + _COST_ROUNDOFF))
        if improvable.size:
            # A path that costs less than all paths of its pair is not among them.
            paths, positions = paths.insert(*search.trace(tree, improvable), improvable)
            x, given = (_scatter(v, positions, len(paths.lengths)) for v in (x, given))
        effort = EXACT if stagnation >= _PATIENCE else ROUGH
        if effort is EXACT:
            blocks = 1
        restricted = RestrictedProblem(costs, capacity, paths, demand, x, blocks, effort)
        for _ in range(_MAX_SWEEPS):
            restricted.sweep()
            if restricted.excess() <= _RESTRICTED_GAP_RATIO * saving:
                break
        x = restricted.flows()
        # After full steps larger blocks converge faster; one block is Newton's method. After short
        # steps the pairs of a block interfere, and smaller blocks converge faster.
        if restricted.shortest_step >= _LARGE_STEP:
            blocks = len(restricted.blocks) // 2
        elif restricted.shortest_step < _SMALL_STEP:
            blocks = min(2 * len(restricted.blocks), _MAX_BLOCKS)
    raise SolveError(
        f"The user equilibrium was not reached: after {number + 1} iterations its relative gap is "
        f"{best:.2e}, above the required {gap:.2e}. Pass a larger gap, or check the units of trips "
        "and capacities: at flows far above the capacities the method may not converge further."
    )


def all_or_nothing(paths: Paths, c: np.ndarray, demand: np.ndarray) -> np.ndarray:
    """Return the flows with all trips of a pair on its path of least cost."""
    path_costs = paths.incidence() @ c
    order = np.lexsort((path_costs, paths.pairs))
    x = np.zeros(len(path_costs))
    x[order[paths.starts]] = demand
    return x


def _scatter(values: np.ndarray, positions: np.ndarray, size: int) -> np.ndarray:
    """Return an array of this size with the values at `positions`, and zeros elsewhere."""
    result = np.zeros(size, values.dtype)
    result[positions] = values
    return result
