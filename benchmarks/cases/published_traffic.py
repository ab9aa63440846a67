"""Published optima of Beckmann's objective on road networks, with a proved bound of each."""

import os
import time
from pathlib import Path

import numpy as np

from dvax.formats import read_network, read_trips
from dvax.models.traffic.costs import link_costs
from dvax.models.traffic.equilibrium import equilibrate
from dvax.models.traffic.shortest import ShortestPaths

from ..layout import duration
from ..peers.frank_wolfe import frank_wolfe
from ..section import Comparison, Section, Table, Target, compare

FOLDER = "DVAX_TNTP"
PUBLISHED = {
    "SiouxFalls": (0.0, 0.0, 42.31335287107440e5),
    "Barcelona": (0.0, 0.0, 1265654.92203176),
    "Winnipeg": (0.0, 0.0, 827911.494629963),
    "ChicagoSketch": (0.02, 0.04, 17313018.7387477),
    "ChicagoRegional": (0.1, 0.25, 30792611.3864393),
}
"""Weights of tolls and lengths, and the optimum, as the page of each network has them."""
_GAP = 1e-12
_RACE_GAP = 1e-6


def run(full: bool) -> Section:
    table = Table(
        "Beckmann's objective Φ",
        ("network", "links", "pairs", "published", "dvax", "dvax − published", "Φ − Φ* at most",
         "relative gap", "paths with flow", "time"), [],
    )  # fmt: skip
    section = Section(
        title="published_traffic: optima of road networks",
        fair=(
            f"Networks and optima are those of TransportationNetworks. dvax goes on to the relative "
            f"gap {_GAP:g}. Its bound is proved, for exact arithmetic: Φ is convex, so that Φ(v) − Φ* "
            "is at most the excess cost Σ vc − Σ demand × least cost, by all shortest paths. "
            f"The race ends at the gap {_RACE_GAP:g}: biconjugate Frank–Wolfe, with the same shortest "
            "paths (SciPy's) and an exact line search."
        ),
        tables=[table],
    )
    folder = os.environ.get(FOLDER)
    for name, (toll, distance, published) in PUBLISHED.items():
        files = [Path(folder or "") / f"{name}_{kind}.tntp" for kind in ("net", "trips")]
        if folder is None or not all(f.is_file() and f.stat().st_size for f in files):
            section.notes.append(f"{name}: {FOLDER} names no folder that has its files.")
            continue
        network, trips = read_network(files[0]), read_trips(files[1])
        costs = link_costs(network, toll, distance)
        costs = costs.up_to(np.full(len(network), trips.flow.sum()))
        search = ShortestPaths(network, trips)
        started = time.perf_counter()
        found = equilibrate(costs, network.capacity, search, trips.flow, None, _GAP)
        seconds = time.perf_counter() - started
        v = found.paths.incidence().T @ found.flows
        c = costs.costs(v, network.capacity)
        objective = float(np.sum(costs.integrals(v, network.capacity)))
        excess = float(v @ c - trips.flow @ search.find(c)[0])
        difference = objective - published
        table.rows.append(
            (
                name, f"{len(network):,}", f"{len(trips.flow):,}",
                f"{published:.8f}", f"{objective:.8f}", f"{difference:+.1e}",
                f"{max(excess, 0.0):.1e}", f"{found.gap:.0e}",
                f"{np.count_nonzero(found.flows):,}", duration(seconds),
            )
        )  # fmt: skip
        relative = abs(difference) / objective
        section.comparisons.append(
            Comparison(
                f"{name}: |Φ − published| / Φ", "", None, None, target=Target("≤", 1e-12, relative)
            )
        )  # fmt: skip
        _race(section, name, (network, trips, costs, search), 600.0 if full else 60.0)
    return section


def _race(section: Section, name: str, data: tuple, longest: float) -> None:
    network, trips, costs, search = data
    started = time.perf_counter()
    found = equilibrate(costs, network.capacity, search, trips.flow, None, _RACE_GAP)
    ours = time.perf_counter() - started
    theirs, _ = frank_wolfe(network, trips, costs.charge, [_RACE_GAP], longest)
    if _RACE_GAP not in theirs:
        section.notes.append(
            f"{name}: Frank–Wolfe did not reach the gap {_RACE_GAP:g} within {longest:g} s; dvax took "
            f"{ours:.2g} s."
        )
        return
    section.comparisons.append(
        compare(
            f"{name}, gap {_RACE_GAP:g}", "biconjugate Frank–Wolfe", [ours], [theirs[_RACE_GAP]],
            direction="other/dvax", error=found.gap, target=("≥", 1.0),
        )
    )  # fmt: skip
