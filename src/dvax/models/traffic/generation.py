"""The paths that a traffic model needs: those of its equilibria, as they are and as they become."""

import numpy as np

from ...errors import input_error
from ...formats.road_network import Network, Trips
from .costs import LinkCosts
from .equilibrium import Equilibrium, Report, equilibrate
from .shortest import ShortestPaths

_MANY = 1000.0
"""The default ρ lets a difference of a typical cost move so many typical flows. Then an equilibrium
is reached within weeks where hardly anything is congested too; with ρ a hundred times less, the law
is solved in half the time, and Sioux Falls is as fast at its equilibrium."""


def generated(
    costs: LinkCosts, network: Network, trips: Trips, capacities: np.ndarray, peak: np.ndarray,
    gap: float, report: Report | None = None,
) -> Equilibrium:  # fmt: skip
    """The equilibrium of the network and the trips as they are, on all paths that are needed for it,
    and for those of every row of `capacities`, with these trips and with those of the `peak`."""
    search = ShortestPaths(network, trips)
    plain = [(network.capacity, trips.flow)]
    changed = [
        (capacity, demand)
        for demand in (peak, trips.flow)
        for capacity in capacities
        if not (np.array_equal(capacity, network.capacity) and np.array_equal(demand, trips.flow))
    ]
    if np.array_equal(peak, trips.flow):
        changed = changed[: len(changed) // 2]
    paths = None
    # The plain one comes last, so that its flows are on all of the paths.
    for capacity, demand in changed + plain:
        bounded = costs.up_to(np.full(len(network), demand.sum()))
        reached = equilibrate(bounded, capacity, search, demand, paths, gap, report)
        paths = reached.paths
    return reached


def typical_rho(costs: LinkCosts, network: Network, trips: Trips) -> float:
    """1000 mean flows over the mean cost of the empty network.

    **Raises:** `dvax.InputError` where that costs nothing.
    """
    free = costs.up_to(np.zeros(len(network))).costs(np.zeros(len(network)), network.capacity)
    least, _ = ShortestPaths(network, trips).find(free)
    if not np.any(least > 0):
        raise input_error(
            "dvax.models.Traffic(rho)", "None", "on the empty network no trip costs anything, so "
            "there is no typical cost to choose it by", "Give rho, in trips per unit of cost",
        )  # fmt: skip
    return float(_MANY * trips.flow.mean() * trips.flow.sum() / (trips.flow @ least))
