"""User equilibria to rounding, with the paths that carry them, by the proximal point method.

Flows x on paths are a user equilibrium where they minimise Beckmann's Φ(Δx) over K, the flows that
add up to the demand of every pair (Beckmann, McGuire and Winsten 1956). The proximal point method

    x ← argmin over y ∈ K of ½‖y − x‖² + ρ Φ(Δy)

converges from anywhere, and joins the least cost path of every pair to the set before each of its
steps. How far x is from the end is its gap: the share of Σ xc that would be saved if everybody took
the least cost path of the whole network at these costs. It bounds the error of Φ.
"""

from typing import NamedTuple

import numpy as np

from ...errors import SolveError
from .costs import LinkCosts
from .paths import Paths
from .proximal import ProximalStep
from .shortest import ShortestPaths

_SAME = 1e-13
"""Costs that differ by so little, relatively, are the same: they are sums of a few dozen numbers."""

_ROUNDS = 300


class Equilibrium(NamedTuple):
    """Path flows, and their gap over all paths of the network."""

    paths: Paths
    flows: np.ndarray
    gap: float


class _Look(NamedTuple):
    """What is seen at path flows: the gap, Φ, the cost along each path, the least one of each pair on
    any path, and the tree to read that path from."""

    gap: float
    value: float
    along: np.ndarray
    least: np.ndarray
    tree: np.ndarray


def equilibrate(
    costs: LinkCosts,
    capacity: np.ndarray,
    search: ShortestPaths,
    demand: np.ndarray,
    paths: Paths | None,
    gap: float,
) -> Equilibrium:
    """A user equilibrium to this gap, on the `paths` given and those that had to be added.

    **Raises:** `dvax.SolveError` where rounding, or the number of rounds, does not allow the gap.
    """

    def look(x: np.ndarray, step: ProximalStep) -> _Look:
        v = step.flows(x)
        c = costs.costs(v, capacity)
        least, tree = search.find(c)
        along = step.incidence @ c
        spent = float(x @ along)
        # Differences first: they are small where their sums are not.
        saved = float(x @ (along - np.repeat(least, step.sizes)))
        value = float(costs.integrals(v, capacity).sum())
        return _Look(saved / spent if spent > 0 else 0.0, value, along, least, tree)

    free = costs.costs(np.zeros(len(capacity)), capacity)
    least, tree = search.find(free)
    if paths is None:
        every = np.arange(len(demand))
        paths = Paths(*search.trace(tree, every), np.ones(len(demand), int), len(capacity))
    step = ProximalStep(costs, capacity, paths, demand)
    x = all_or_nothing(paths, free, demand)
    seen = look(x, step)
    # A difference of costs as large as a typical cost moves a typical flow.
    rho = float(demand @ demand) / float(demand @ least) if np.any(least > 0) else 1.0
    for _ in range(_ROUNDS):
        if seen.gap <= gap:
            return Equilibrium(paths, x, float(max(seen.gap, 0.0)))
        own = np.minimum.reduceat(seen.along, paths.starts)
        worse = np.flatnonzero(own > seen.least * (1 + _SAME))
        if worse.size:
            # A path that costs less than all those of its pair is none of them.
            paths, x = _joined(paths, x, *search.trace(seen.tree, worse), worse)
            step = ProximalStep(costs, capacity, paths, demand)
        # As exact as the gap is small, and not before: the paths are still to come.
        y, tries = step.solve(x, rho, min(1e-6, max(1e-3 * seen.gap, 1e-13)))
        new = look(y, step)
        # Φ falls while paths come in, and the gap need not; in the end Φ rests, to rounding.
        if new.gap < seen.gap or new.value < seen.value * (1 - _SAME):
            x, seen = y, new
            rho *= 4.0 if tries < 10 else 0.25 if tries > 20 else 1.0
        else:
            seen = look(x, step)
            rho *= 0.25
    raise SolveError(
        f"The user equilibrium was not reached: after {_ROUNDS} rounds its relative gap is "
        f"{seen.gap:.2e}, and {gap:.2e} was asked for. Ask for a larger gap: with numbers of very "
        "different sizes rounding allows no more."
    )


def all_or_nothing(paths: Paths, c: np.ndarray, demand: np.ndarray) -> np.ndarray:
    """All trips of a pair on its path with the least cost."""
    along = paths.incidence() @ c
    order = np.lexsort((along, paths.pairs))
    x = np.zeros(len(along))
    x[order[paths.starts]] = demand
    return x


def _joined(
    paths: Paths, x: np.ndarray, links: np.ndarray, lengths: np.ndarray, pairs: np.ndarray
) -> tuple[Paths, np.ndarray]:
    """The set with one more path for each of the `pairs`, and x on it."""
    more, moved = paths.joined(links, lengths, pairs)
    flows = np.zeros(len(more.lengths))
    flows[moved] = x
    return more, flows
