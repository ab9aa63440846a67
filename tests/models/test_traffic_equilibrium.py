"""User equilibria: Wardrop's conditions on generated networks, closed forms, and a linear programme."""

import itertools

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.csgraph
from tests.models import traffic_networks as networks

import dvax
from dvax.models.traffic import Network, Trips
from dvax.models.traffic import restricted as restricted_module
from dvax.models.traffic.costs import link_costs
from dvax.models.traffic.equilibrium import equilibrate
from dvax.models.traffic.paths import Paths
from dvax.models.traffic.restricted import RestrictedProblem
from dvax.models.traffic.shortest import ShortestPaths


def solved(network, trips, gap=1e-12):
    costs = link_costs(network, 0.3, 0.4).up_to(np.full(len(network), trips.flow.sum()))
    return equilibrate(
        costs, network.capacity, ShortestPaths(network, trips), trips.flow, None, gap
    )


def least_costs(network, trips, c):
    """The least cost of every pair by SciPy, one graph for each origin, without the links that leave
    other closed nodes."""
    least = np.empty(len(trips))
    for origin in np.unique(trips.origin):
        through = (network.init_node >= network.first_thru_node) | (network.init_node == origin)
        ends = network.init_node[through] - 1, network.term_node[through] - 1
        # Zeros would be no links to SciPy's coordinate format, so they are stored explicitly.
        graph = scipy.sparse.csr_array((c[through], ends), shape=(network.nodes,) * 2)
        far = scipy.sparse.csgraph.dijkstra(graph, indices=origin - 1)
        own = trips.origin == origin
        least[own] = far[trips.destination[own] - 1]
    return least


def check(network, trips, found, gap, paths_alike=1e-9):
    """Wardrop's conditions from the formula of BPR, conservation, and the gap from link flows alone."""
    pairs = found.paths.pairs
    np.testing.assert_allclose(np.bincount(pairs, found.flows), trips.flow, rtol=1e-12)
    assert np.all(found.flows >= 0)
    v = np.bincount(found.paths.links, np.repeat(found.flows, found.paths.lengths), len(network))
    c = networks.bpr(network, v, 0.3, 0.4)
    least = least_costs(network, trips, c)
    saved = 1 - trips.flow @ least / (c @ v)
    assert saved <= gap + 1e-13 and abs(saved - found.gap) <= 1e-13
    starts = np.cumsum(found.paths.lengths) - found.paths.lengths
    along = np.add.reduceat(c[found.paths.links], starts)
    used = found.flows > 1e-6 * trips.flow[pairs]
    assert np.all(along[used] <= least[pairs][used] * (1 + paths_alike))


SMALL = [(5, 6, 8, 30, load, seed) for load, seed in ((3e2, 1), (1e4, 2), (3e4, 3), (1e5, 4))]
MANY = [
    (rows, rows + 2, zones, pairs, load, seed)
    for seed, (rows, zones, pairs, load) in enumerate(
        itertools.product((4, 8, 14), (6, 20), (12, 200), (1e2, 1e4, 6e4, 3e5))
    )
    if pairs <= zones * (zones - 1)
]


@pytest.mark.parametrize(
    "case", [*SMALL, *(pytest.param(c, marks=pytest.mark.thorough) for c in MANY)], ids=str
)
@pytest.mark.parametrize("one_way", [False, True])
def test_equilibrium_has_no_path_with_less_cost(case, one_way):
    *shape, load, seed = case
    if one_way:
        shape[:2] = [n + n % 2 for n in shape[:2]]
    network, trips = networks.grid(*shape, load, seed, one_way=one_way)
    # Costs grow with the fourth power of the load: at some fifty times the capacity of every link many
    # paths carry flow, and the last digits take long.
    gap = 1e-12 if load < 3e5 else 1e-4
    found = solved(network, trips, gap)
    check(network, trips, found, gap, 1e-9 if load < 3e5 else 0.1)
    networks.walks(network, trips, found.paths)


@pytest.mark.slow
@pytest.mark.parametrize("one_way", [False, True])
@pytest.mark.parametrize(
    "load", [1e4, 6e4, *(pytest.param(v, marks=pytest.mark.thorough) for v in (3e5, 1e6))]
)
def test_equilibrium_far_above_the_capacities_is_reached(load, one_way):
    """Costs grow with up to the sixth power of flows that are up to a hundred times the capacities, so
    that slopes differ by ten orders of magnitude."""
    for seed in range(8):
        network, trips = networks.grid(4, 6, 6, 12, load, seed, one_way=one_way)
        found = solved(network, trips)
        check(network, trips, found, 1e-12)


def free(network):
    """The same network, where a third of all links has no cost and another third no travel time."""
    rng, scale = np.random.default_rng(9), network.free_flow_time.copy()
    chosen = rng.integers(0, 3, len(network))
    length = np.where(chosen > 0, network.length, 0.0)
    scale[chosen < 2] = 0.0
    columns = {name: getattr(network, name) for name in networks.COLUMNS}
    columns |= dict(length=length, free_flow_time=scale, toll=np.zeros(len(network)))
    return Network(network.zones, network.nodes, network.first_thru_node, **columns)


@pytest.mark.parametrize("load", [1e3, 1e5])
def test_equilibrium_accepts_links_without_cost(load):
    network, trips = networks.grid(6, 6, 10, 60, load, seed=5)
    network = free(network)
    assert np.sum(network.free_flow_time + network.length == 0) > 5
    found = solved(network, trips)
    v = np.bincount(found.paths.links, np.repeat(found.flows, found.paths.lengths), len(network))
    c = networks.bpr(network, v, 0.3, 0.4)
    cheapest = networks.cheapest(network, trips, c)
    assert abs(c @ v - cheapest) <= 1e-9 * (c @ v)


def test_equilibrium_ignores_pairs_without_trips():
    network, trips = networks.grid(5, 6, 8, 30, 3e4, seed=3)
    every = [(o, d) for o in range(1, 9) for d in range(1, 9)]
    flow = dict(zip(zip(trips.origin.tolist(), trips.destination.tolist()), trips.flow))
    origin, destination = np.array(every).T
    all_pairs = Trips(8, origin, destination, np.array([flow.get(pair, 0.0) for pair in every]))
    assert len(all_pairs) == len(trips) == 30
    np.testing.assert_array_equal(solved(network, all_pairs).flows, solved(network, trips).flows)


@pytest.mark.parametrize("power", [1.0, 1.5, 2.0, 4.0, 6.0])
@pytest.mark.parametrize("number", [2, 7])
def test_equilibrium_of_parallel_roads_is_the_closed_form(power, number):
    """`number` roads of t = 1 + 0.15 (v/k)^p, k = 1, 2, …, each through a node of its own: at a common
    cost 1 + λ each carries k (λ/0.15)^(1/p), so that flows are in proportion to capacities."""
    k = np.arange(1.0, number + 1)
    middle = 3 + np.arange(number)
    ones, zeros = np.ones(number), np.zeros(number)
    network = Network(
        zones=2, nodes=2 + number, first_thru_node=3,
        init_node=np.concatenate([ones, middle]).astype(int),
        term_node=np.concatenate([middle, 2 * ones]).astype(int),
        capacity=np.concatenate([k, ones]), length=np.zeros(2 * number),
        free_flow_time=np.concatenate([ones, zeros]), b=np.full(2 * number, 0.15),
        power=np.full(2 * number, power),
    )  # fmt: skip
    trips = Trips(2, [1], [2], [1.7 * k.sum()])
    costs = link_costs(network, 0.0, 0.0).up_to(np.full(2 * number, trips.flow.sum()))
    found = equilibrate(
        costs, network.capacity, ShortestPaths(network, trips), trips.flow, None, 1e-14
    )
    v = found.paths.incidence().T @ found.flows
    np.testing.assert_allclose(v[:number], 1.7 * k, rtol=1e-6)
    assert len(found.flows) == number


def test_equilibrium_does_not_depend_on_the_blocks(monkeypatch):
    network, trips = networks.grid(8, 8, 14, 120, 5e4, seed=6)
    flows = []
    for size in (50_000, 20):
        monkeypatch.setattr(restricted_module, "_BLOCK_ENTRIES", size)
        found = solved(network, trips)
        check(network, trips, found, 1e-12)
        flows.append(found.paths.incidence().T @ found.flows)
    np.testing.assert_allclose(flows[0], flows[1], rtol=1e-5, atol=1e-3)


@pytest.mark.thorough
def test_equilibrium_sweep_conserves_sums_and_reduces_the_objective():
    network, trips = networks.grid(6, 7, 12, 60, 6e4, seed=1)
    costs = link_costs(network, 0.3, 0.4).up_to(np.full(len(network), trips.flow.sum()))
    found = solved(network, trips, gap=1e-3)
    paths, rng = found.paths, np.random.default_rng(7)
    shares = rng.exponential(size=len(paths.lengths))
    x = shares * np.repeat(trips.flow / np.bincount(paths.pairs, shares), paths.sizes)
    problem = RestrictedProblem(costs, network.capacity, paths, trips.flow, x, blocks=60)
    at_first = problem.excess()
    incidence = paths.incidence()
    before = costs.integrals(incidence.T @ x, network.capacity).sum()
    for _ in range(60):
        problem.sweep()
        flows = problem.flows()
        np.testing.assert_allclose(np.bincount(paths.pairs, flows), trips.flow, rtol=1e-13)
        np.testing.assert_allclose(incidence.T @ flows, problem.v, rtol=1e-10, atol=1e-8)
        value = costs.integrals(problem.v, network.capacity).sum()
        assert value <= before * (1 + 1e-14)
        before = value
    # The excess bounds how far the objective is above its least value on these paths.
    assert problem.excess() <= 1e-6 * at_first


def test_path_differences_omit_shared_links():
    # Pair 0 has two paths that share links 0 and 3, pair 1 one path, pair 2 three without a common one.
    links = [[0, 1, 3], [0, 2, 3], [4, 0], [5], [1, 6], [2, 6]]
    paths = Paths(
        np.concatenate(links), np.array([len(one) for one in links]), np.array([2, 1, 3]), 7
    )
    demand, x = np.array([5.0, 2.0, 3.0]), np.array([1.0, 4.0, 2.0, 0.5, 1.5, 1.0])
    found = paths.differences(demand)
    matrix = found.matrix(0, 5)
    assert [row.tolist() for row in np.split(matrix.indices, matrix.indptr[1:-1])] == [
        [1], [2], [5], [1, 6], [2, 6],
    ]  # fmt: skip
    assert found.rows.tolist() == [0, 1, 3, 4, 5] and found.pairs.tolist() == [0, 2]
    np.testing.assert_allclose(found.fixed + matrix.T @ x[found.rows], paths.incidence().T @ x)


def test_equilibrium_gap_below_rounding_is_rejected():
    network, trips = networks.grid(4, 4, 5, 10, 2e4, seed=7)
    with pytest.raises(dvax.SolveError, match="larger gap"):
        solved(network, trips, gap=1e-25)


@pytest.mark.thorough
@pytest.mark.parametrize(("load", "seed"), [(4e4, 1), (4e5, 2)])
def test_equilibrium_of_a_network_with_thousands_of_pairs(load, seed):
    network, trips = networks.grid(20, 20, 80, 6000, load, seed)
    found = solved(network, trips, gap=1e-11)
    check(network, trips, found, 1e-11, paths_alike=1e-7)
