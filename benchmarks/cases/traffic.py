"""User equilibria of road networks against the biconjugate Frank–Wolfe method."""

import os
import time
from pathlib import Path

import numpy as np

from dvax.formats import Network, Trips, read_network, read_trips
from dvax.models.traffic.costs import link_costs
from dvax.models.traffic.equilibrium import Equilibrium, equilibrate
from dvax.models.traffic.shortest import ShortestPaths

from ..peers.frank_wolfe import frank_wolfe
from ..road_network import region
from ..section import Section, compare

_GAPS = [1e-4, 1e-5, 1e-6]
_FOLDER = "DVAX_TNTP"
_REAL = {"Anaheim": (0.0, 0.0), "Winnipeg": (0.0, 0.0), "ChicagoSketch": (0.02, 0.04)}
"""Weights of tolls and lengths, as the networks' own pages give them."""
_TARGET_SECONDS_RATIO = 3.0


def run(full: bool) -> Section:
    section = Section(
        title="traffic: seconds until a relative gap of a user equilibrium",
        fair=(
            "Biconjugate Frank–Wolfe in NumPy with an exact line search, on link flows alone; "
            "shortest paths are SciPy's on both sides. dvax restarts for every gap, the other side "
            "runs once. Errors: of dvax the gap that was reached, of the other side how far the two "
            "link flows are from each other, relative to the largest. Generated regions; real networks "
            f"where {_FOLDER} names a folder with the TNTP files of {', '.join(_REAL)}."
        ),
    )
    longest = 300.0 if full else 60.0
    for name, (network, trips, weights) in networks(section).items():
        charge = weights[1] * network.length
        if network.toll is not None:
            charge = charge + weights[0] * network.toll
        costs = link_costs(network, *weights).up_to(np.full(len(network), trips.flow.sum()))
        search = ShortestPaths(network, trips)

        def ours(gap: float) -> tuple[float, Equilibrium]:
            started = time.perf_counter()
            found = equilibrate(costs, network.capacity, search, trips.flow, None, gap)  # noqa: B023
            return time.perf_counter() - started, found

        rounds = 3 if full else 1
        taken: dict[float, list[float]] = {gap: [] for gap in _GAPS}
        theirs: dict[float, list[float]] = {gap: [] for gap in _GAPS}
        reached: dict[float, float] = {}
        apart = np.nan
        for _ in range(rounds):
            seconds, v = frank_wolfe(network, trips, charge, _GAPS, longest)
            for gap in _GAPS:
                spent, found = ours(gap)
                taken[gap].append(spent)
                reached[gap] = found.gap
                theirs[gap] += [seconds[gap]] if gap in seconds else []
            flows = found.paths.incidence().T @ found.flows
            apart = float(np.max(np.abs(flows - v)) / np.max(v))
        for gap in _GAPS:
            if len(theirs[gap]) < rounds:
                section.notes.append(
                    f"{name}: Frank–Wolfe did not reach {gap:.0e} within {longest:g} s, dvax took "
                    f"{np.median(taken[gap]):.2g} s."
                )
                continue
            section.comparisons.append(
                compare(
                    f"{name}, gap {gap:.0e}", "biconjugate Frank–Wolfe", taken[gap], theirs[gap],
                    error=reached[gap], error_other=apart if gap == _GAPS[-1] else None,
                    target=("≤", _TARGET_SECONDS_RATIO) if "hicago" in name else None,
                )
            )  # fmt: skip
    return section


def networks(section: Section) -> dict[str, tuple[Network, Trips, tuple[float, float]]]:
    """The networks by their names, and the weights of tolls and lengths; notes say which are absent."""
    found = {
        "region of Anaheim's size": (*region(18, 21, 38, 1_406, 1.5), (0.0, 0.04)),
        "region of Winnipeg's size": (*region(25, 36, 147, 4_344, 2.0), (0.0, 0.04)),
        "region of Chicago-Sketch's size": (*region(21, 26, 387, 93_135, 2.0), (0.0, 0.04)),
    }
    folder = os.environ.get(_FOLDER)
    for name, weights in _REAL.items():
        if folder is None or not (Path(folder) / f"{name}_net.tntp").exists():
            section.notes.append(
                f"{name}: no files, since {_FOLDER} names no folder that has them."
            )
            continue
        files = (Path(folder) / f"{name}_{kind}.tntp" for kind in ("net", "trips"))
        found[name] = (read_network(next(files)), read_trips(next(files)), weights)
    return found
