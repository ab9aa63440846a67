"""Networks for the tests of the traffic model, and an oracle for their equilibria."""

from pathlib import Path

import numpy as np
import scipy.optimize
import scipy.sparse

from dvax.models.traffic import Network, Trips

SIOUX_FALLS = Path(__file__).parents[3] / "shared" / "data" / "SiouxFalls"

COLUMNS = ("init_node", "term_node", "capacity", "length", "free_flow_time", "b", "power", "toll")

BRAESS_NET = """<NUMBER OF ZONES> 2
<NUMBER OF NODES> 4
<FIRST THRU NODE> 1
<NUMBER OF LINKS> 5
<END OF METADATA>

~\tinit_node\tterm_node\tcapacity\tlength\tfree_flow_time\tb\tpower\tspeed\ttoll\tlink_type\t;
\t1\t3\t1\t0\t1e-8\t1e9\t1\t0\t0\t1\t;
\t1\t4\t1\t0\t50\t0.02\t1\t0\t0\t1\t;
\t3\t2\t1\t0\t50\t0.02\t1\t0\t0\t1\t;
\t3\t4\t1\t0\t10\t0.1\t1\t0\t0\t1\t;
\t4\t2\t1\t0\t1e-8\t1e9\t1\t0\t0\t1\t;
"""
"""Braess 1968: t = 10v, 50 + v, 50 + v, 10 + v, 10v."""

BRAESS_TRIPS = """<NUMBER OF ZONES> 2
<TOTAL OD FLOW> 6.0
<END OF METADATA>

Origin 1
    1 :      0.0;     2 :      6.0;
"""


def braess(folder: Path) -> tuple[Path, Path]:
    """The two files of Braess' network."""
    net, trips = folder / "braess_net.tntp", folder / "braess_trips.tntp"
    net.write_text(BRAESS_NET)
    trips.write_text(BRAESS_TRIPS)
    return net, trips


def two_roads(**changed) -> tuple[Network, Trips]:
    """From 1 to 2 straight on, t = 10 + 0.1v, toll 4, length 8; or by 3, t = 5 + 0.2v and a road of
    constant time 6 and length 3."""
    columns = dict(
        init_node=[1, 1, 3], term_node=[2, 3, 2], capacity=[100.0, 50.0, 1.0],
        length=[8.0, 0.0, 3.0], free_flow_time=[10.0, 5.0, 6.0], b=[1.0, 2.0, 0.0],
        power=[1.0, 1.0, 4.0], toll=[4.0, 0.0, 0.0],
    )  # fmt: skip
    network = Network(zones=2, nodes=3, first_thru_node=3, **(columns | changed))
    return network, Trips(zones=2, origin=[1], destination=[2], flow=[90.0])


def grid(
    rows: int, columns: int, zones: int, pairs: int, load: float, seed: int, one_way: bool = False
) -> tuple[Network, Trips]:
    """A street grid whose zones hang on it by links of constant cost, in both ways that the format
    writes them; with tolls, powers from 1 to 6, and roads that would be shorter through a zone.
    One-way streets alternate, of even numbers of rows and columns, so that one can drive around."""
    rng = np.random.default_rng(seed)
    node = zones + 1 + np.arange(rows * columns).reshape(rows, columns)
    streets = [*zip(node[:, :-1].flat, node[:, 1:].flat), *zip(node[:-1].flat, node[1:].flat)]
    if one_way:
        back = [k % 2 == 1 for k in range(rows) for _ in range(columns - 1)]
        back += [k % 2 == 0 for _ in range(rows - 1) for k in range(columns)]
        streets = [(b, a) if turn else (a, b) for (a, b), turn in zip(streets, back)]
    else:
        streets += [(b, a) for a, b in streets]
    gates = [(z, n) for z in range(1, zones + 1) for n in rng.choice(node.flat, 3, replace=False)]
    gates += [(n, z) for z, n in gates]
    S, G = len(streets), len(gates)
    ends = np.array(streets + gates)
    network = Network(
        zones=zones,
        nodes=zones + rows * columns,
        first_thru_node=zones + 1,
        init_node=ends[:, 0],
        term_node=ends[:, 1],
        capacity=np.concatenate([rng.uniform(500, 1500, S), np.full(G, 1e4)]),
        length=np.concatenate([rng.uniform(1, 3, S), np.full(G, 0.2)]),
        free_flow_time=np.concatenate([rng.uniform(1, 3, S), np.full(G, 0.1)]),
        b=np.concatenate([np.full(S, 0.15), rng.choice([0.0, 0.15], G)]),
        power=np.concatenate([rng.choice([1.0, 2.5, 4.0, 6.0], S), np.zeros(G)]),
        toll=np.concatenate([rng.choice([0.0, 0.0, 10.0], S), np.zeros(G)]),
        name="grid",
    )
    every = [(o, d) for o in range(1, zones + 1) for d in range(1, zones + 1) if o != d]
    chosen = np.array(every)[rng.permutation(len(every))[:pairs]]
    flow = rng.uniform(0.1, 2.0, len(chosen)) * load / pairs
    return network, Trips(zones, chosen[:, 0], chosen[:, 1], flow, name="grid trips")


def bpr(network: Network, v: np.ndarray, toll_weight: float, distance_weight: float) -> np.ndarray:
    """The cost of each link, from the formula."""
    cost = []
    for k in range(len(network)):
        ratio = v[k] / network.capacity[k]
        time = network.free_flow_time[k] * (1 + network.b[k] * ratio ** network.power[k])
        cost.append(time + toll_weight * network.toll[k] + distance_weight * network.length[k])
    return np.array(cost)


def cheapest(network: Network, trips: Trips, c: np.ndarray) -> float:
    """The least Σ cv over all link flows that serve the trips, by a linear programme in the flows of
    every origin: they balance at every node, and links that leave another node below the first
    through node are closed."""
    rows, cols, ones, right, upper = [], [], [], [], []
    origins = np.unique(trips.origin)
    for k, origin in enumerate(origins):
        own = trips.origin == origin
        balance = np.zeros(network.nodes)
        np.subtract.at(balance, trips.destination[own] - 1, trips.flow[own])
        balance[origin - 1] += trips.flow[own].sum()
        link = np.arange(len(network)) + k * len(network)
        for nodes, sign in ((network.init_node, 1.0), (network.term_node, -1.0)):
            rows.append(nodes - 1 + k * network.nodes)
            cols.append(link)
            ones.append(np.full(len(link), sign))
        right.append(balance)
        through = (network.init_node >= network.first_thru_node) | (network.init_node == origin)
        upper.append(np.where(through, trips.flow.sum(), 0.0))
    shape = len(origins) * network.nodes, len(origins) * len(network)
    matrix = scipy.sparse.csr_array(
        (np.concatenate(ones), (np.concatenate(rows), np.concatenate(cols))), shape=shape
    )
    found = scipy.optimize.linprog(
        np.tile(c, len(origins)), A_eq=matrix, b_eq=np.concatenate(right),
        bounds=np.stack([np.zeros(shape[1]), np.concatenate(upper)], axis=1), method="highs",
    )  # fmt: skip
    assert found.status == 0, found.message
    return float(found.fun)


def walks(network: Network, trips: Trips, paths) -> None:
    """Assert that every path leads from its origin to its destination, and through no closed node."""
    ends = np.cumsum(paths.lengths)
    for pair, begin, end in zip(paths.pairs, ends - paths.lengths, ends):
        links = paths.links[begin:end]
        first, last = network.init_node[links], network.term_node[links]
        assert first[0] == trips.origin[pair] and last[-1] == trips.destination[pair]
        assert np.array_equal(first[1:], last[:-1]) and len(set(first)) == len(first)
        assert np.all(first[1:] >= network.first_thru_node)
