"""Generation of the paths of a traffic model, from its equilibria for all capacities and demands."""

import numpy as np

from ...errors import input_error
from ...formats.road_network import Network, Trips
from .costs import LinkCosts
from .equilibrium import Equilibrium, Report, equilibrate
from .shortest import ShortestPaths

_FLOWS_PER_COST = 1000.0
"""The default ρ in units of mean flow over mean cost. With it networks with little congestion also
reach the equilibrium within weeks. A hundredth of it halves the time of solving the law, and Sioux
Falls reaches its equilibrium equally fast."""


def generate_paths(
    costs: LinkCosts, network: Network, trips: Trips, capacities: np.ndarray, peak: np.ndarray,
    gap: float, report: Report | None = None,
) -> Equilibrium:  # fmt: skip
    """Return the equilibrium for the unmodified capacities and trips, on all generated paths.

    These are the paths of the equilibria for every row of `capacities`, with the given trips and with
    those of the `peak`."""
    search = ShortestPaths(network, trips)
    unmodified = [(network.capacity, trips.flow)]
    changed = [
        (capacity, demand)
        for demand in (peak, trips.flow)
        for capacity in capacities
        if not (np.array_equal(capacity, network.capacity) and np.array_equal(demand, trips.flow))
    ]
    if np.array_equal(peak, trips.flow):
        changed = changed[: len(changed) // 2]
    paths = None
    # The unmodified one is last, so that its flows refer to all paths.
    for capacity, demand in changed + unmodified:
        bounded = costs.up_to(np.full(len(network), demand.sum()))
        equilibrium = equilibrate(bounded, capacity, search, demand, paths, gap, report)
        paths = equilibrium.paths
    return equilibrium


def typical_rho(costs: LinkCosts, network: Network, trips: Trips) -> float:
    """Return 1000 mean flows over the mean cost of the empty network.

    **Raises:** `dvax.InputError` if this cost is 0.
    """
    free = costs.up_to(np.zeros(len(network))).costs(np.zeros(len(network)), network.capacity)
    least, _ = ShortestPaths(network, trips).find(free)
    if not np.any(least > 0):
        raise input_error(
            "dvax.models.Traffic(rho)", "None", "the default is relative to the mean cost on the "
            "empty network, which is 0", "Give rho, in trips per unit of cost",
        )  # fmt: skip
    return float(_FLOWS_PER_COST * trips.flow.mean() * trips.flow.sum() / (trips.flow @ least))
