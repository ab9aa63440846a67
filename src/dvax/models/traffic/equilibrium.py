"""User equilibria to rounding, with the paths that carry them, by column generation.

Flows x on paths are a user equilibrium where they minimise Beckmann's Φ(Δx) over K, the flows that
add up to the demand of every pair (Beckmann, McGuire and Winsten 1956). Each round finds the least
cost path of every pair on the whole network, adds those that cost less than all that their pair has
(Leventhal, Nemhauser and Trotter 1973), and reduces Φ over the paths there are (`RestrictedProblem`).
How far x is from the end is its gap: the share of Σ xc that would be saved if everybody took the
least cost path of the whole network at these costs. It bounds the error of Φ.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...errors import SolveError
from .costs import LinkCosts
from .paths import Paths
from .restricted import RestrictedProblem
from .shortest import ShortestPaths

_SAME = 1e-13
"""Costs that differ by so little, relatively, are the same: they are sums of a few dozen numbers."""

_EQUAL = 1e-6
"""Paths whose costs differ by so little at an equilibrium are all kept: trips may take any of them."""

_ROUNDS, _PATIENCE = 500, 60
"""The most rounds, and the most in a row that need reduce neither the gap nor Φ noticeably."""

_SWEEPS = 4
"""Sweeps between two searches for shortest paths, unless the gap over the given paths has fallen to
`_WITHIN` of the whole one before."""
_WITHIN = 0.05

_FULL, _CUT, _MOST_BLOCKS = 0.5, 0.1, 1024
"""Shares of a step that the line search leaves: above and below, blocks become larger and smaller."""

_SILENCE = 2.0
"""Seconds between two reports."""

Report = Callable[[str], None]
"""Receives a sentence about the progress."""


class Equilibrium(NamedTuple):
    """Path flows, and their gap over all paths of the network."""

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
    """A user equilibrium to this gap, on the `paths` given (without them, those that are least on the
    empty network) and those that had to be added and cost no more.

    **Raises:** `dvax.SolveError` where rounding, or the number of rounds, does not allow the gap.
    """
    free = costs.costs(np.zeros(len(capacity)), capacity)
    if paths is None:
        _, tree = search.find(free)
        every = np.arange(len(demand))
        paths = Paths(*search.trace(tree, every), np.ones(len(demand), int), len(capacity))
    x = all_or_nothing(paths, free, demand)
    kept = np.ones(len(x), bool)
    blocks = None
    best, lowest, since, spoke = np.inf, np.inf, 0, time.monotonic()
    for number in range(_ROUNDS):
        incidence = paths.incidence()
        v = incidence.T @ x
        c = costs.costs(v, capacity)
        least, tree = search.find(c)
        along = incidence @ c
        spent = float(x @ along)
        # Differences first: they are small where their sums are not.
        saved = float(x @ (along - np.repeat(least, paths.sizes)))
        now = max(saved / spent, 0.0) if spent > 0 else 0.0
        if report is not None and time.monotonic() - spoke > _SILENCE:
            spoke = time.monotonic()
            report(f"round {number}: {len(x)} paths, relative gap {now:.1e}")
        if now <= gap:
            # Paths that were added, cost more in the end and carry nothing: the equilibrium needs none.
            kept |= (x > 0) | (along <= np.repeat(least, paths.sizes) * (1 + _EQUAL))
            return Equilibrium(paths.chosen(kept), x[kept], now)
        value = float(costs.integrals(v, capacity).sum())
        progress = now < 0.9 * best or value < 0.999 * lowest
        best, lowest = min(now, best), min(value, lowest)
        since = 0 if progress else since + 1
        if since > _PATIENCE:
            break
        own = np.minimum.reduceat(along, paths.starts)
        worse = np.flatnonzero(own > least * (1 + _SAME))
        if worse.size:
            # A path that costs less than all those of its pair is none of them.
            paths, moved = paths.joined(*search.trace(tree, worse), worse)
            x, kept = (_moved(values, moved, len(paths.lengths)) for values in (x, kept))
        restricted = RestrictedProblem(costs, capacity, paths, demand, x, blocks)
        for _ in range(_SWEEPS):
            restricted.sweep()
            if restricted.excess() <= _WITHIN * saved:
                break
        x = restricted.flows()
        # Where full steps do, larger blocks converge faster: with one it is Newton's method. Where
        # the pairs of a block hinder each other, smaller ones do, down to one pair at a time.
        if restricted.shortest >= _FULL:
            blocks = len(restricted.blocks) // 2
        elif restricted.shortest < _CUT:
            blocks = min(2 * len(restricted.blocks), _MOST_BLOCKS)
    raise SolveError(
        f"The user equilibrium was not reached: after {number + 1} rounds its relative gap is "
        f"{best:.2e}, and {gap:.2e} was asked for. Ask for a larger gap, or check the units of trips "
        "and capacities: at flows far above the capacities the method may converge no further."
    )


def all_or_nothing(paths: Paths, c: np.ndarray, demand: np.ndarray) -> np.ndarray:
    """All trips of a pair on its path with the least cost."""
    along = paths.incidence() @ c
    order = np.lexsort((along, paths.pairs))
    x = np.zeros(len(along))
    x[order[paths.starts]] = demand
    return x


def _moved(values: np.ndarray, places: np.ndarray, size: int) -> np.ndarray:
    """The values at their new places, and zeros at the others."""
    spread = np.zeros(size, values.dtype)
    spread[places] = values
    return spread
