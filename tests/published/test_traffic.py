"""Published optima of road networks lie within the proved bounds of those of dvax."""

import os
from pathlib import Path

import numpy as np
import pytest
from benchmarks.cases.published_traffic import FOLDER, PUBLISHED
from tests.models.traffic_networks import SIOUX_FALLS, bpr
from tests.selection import mostly_thorough

from dvax.formats import read_network, read_trips
from dvax.models.traffic.costs import link_costs
from dvax.models.traffic.equilibrium import equilibrate
from dvax.models.traffic.shortest import ShortestPaths


def beckmann(network, v, toll, distance):
    """Σ ∫ c by Gauss–Legendre quadrature, to rounding for all powers of the networks."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    at = 0.5 * v * (nodes[:, None] + 1)
    return float(
        np.sum(0.5 * v * (weights[:, None] * [bpr(network, a, toll, distance) for a in at]))
    )


@pytest.mark.parametrize("name", mostly_thorough(PUBLISHED, ["SiouxFalls"]))
def test_published_optimum_is_reached_to_its_digits(name):
    folder = SIOUX_FALLS if name == "SiouxFalls" else Path(os.environ.get(FOLDER, "absent"))
    files = [folder / f"{name}_{kind}.tntp" for kind in ("net", "trips")]
    if not all(file.is_file() and file.stat().st_size for file in files):
        pytest.skip(f"no files of {name}; {FOLDER} may name a folder that has them")
    toll, distance, published = PUBLISHED[name]
    network, trips = read_network(files[0]), read_trips(files[1])
    costs = link_costs(network, toll, distance)
    costs = costs.up_to(np.full(len(network), trips.flow.sum()))
    search = ShortestPaths(network, trips)
    found = equilibrate(costs, network.capacity, search, trips.flow, None, 1e-12)
    v = found.paths.incidence().T @ found.flows
    objective = beckmann(network, v, toll, distance)
    assert objective == pytest.approx(published, rel=1e-12)
    # Φ(v) − Φ* is at most the excess cost, and 0 at the least.
    c = bpr(network, v, toll, distance)
    excess = float(v @ c - trips.flow @ search.find(c)[0])
    rounding = 1e-13 * objective
    assert -rounding <= objective - published <= excess + rounding
