"""Generated road networks with the size and the congestion of real ones, equal at every call."""

import numpy as np
import scipy.sparse.csgraph

from dvax.models.traffic import Network, Trips


def region(
    rows: int, columns: int, zones: int, pairs: int, load: float, seed: int = 0
) -> tuple[Network, Trips]:
    """A grid of streets and freeways with `zones` centroids on connectors, and a gravity demand.

    Every fifth row and column is a freeway: twice as fast, four times the capacity. Streets are
    0.5 to 1.5 units long, costs follow BPR with b = 0.15 and power 4; connectors cost nothing but
    their length. Of all pairs the `pairs` with the largest a_i a_j exp(−distance/6) have trips, in
    proportion, scaled so that a twentieth of all streets has more than `load` times its capacity
    if all trips take the shortest path of the empty network.
    """
    rng = np.random.default_rng(seed)
    node = np.arange(rows * columns).reshape(rows, columns)
    ends = np.array(
        [*zip(node[:, :-1].flat, node[:, 1:].flat), *zip(node[:-1].flat, node[1:].flat)]
    )
    row, column = np.divmod(ends, columns)
    fast = np.where(row[:, 0] == row[:, 1], row[:, 0] % 5 == 2, column[:, 0] % 5 == 2)
    length = rng.uniform(0.5, 1.5, len(ends))
    time = length * np.where(fast, 1.0, 2.0) * rng.uniform(0.9, 1.1, len(ends))
    capacity = np.where(fast, 4000.0, 1000.0) * rng.uniform(0.8, 1.2, len(ends))
    ends, two = np.concatenate([ends, ends[:, ::-1]]) + zones + 1, np.ones(2)
    home = rng.choice(rows * columns, zones, replace=zones > rows * columns)
    zone = np.arange(1, zones + 1)
    init = np.concatenate([ends[:, 0], zone, home + zones + 1])
    term = np.concatenate([ends[:, 1], home + zones + 1, zone])
    gate = np.zeros(2 * zones)
    network = Network(
        zones=zones, nodes=zones + rows * columns, first_thru_node=zones + 1, init_node=init,
        term_node=term, capacity=np.concatenate([np.kron(two, capacity), gate + 5e4]),
        length=np.concatenate([np.kron(two, length), gate + rng.uniform(0.1, 0.5)]),
        free_flow_time=np.concatenate([np.kron(two, time), gate]),
        b=np.full(len(init), 0.15), power=np.full(len(init), 4.0), name="region",
    )  # fmt: skip

    links = scipy.sparse.csr_array(
        (np.kron(two, time), (ends[:, 0] - zones - 1, ends[:, 1] - zones - 1)),
        shape=(rows * columns,) * 2,
    )
    far, before = scipy.sparse.csgraph.dijkstra(links, indices=home, return_predecessors=True)
    size = rng.lognormal(0.0, 0.7, zones)
    wish = size[:, None] * size * np.exp(-far[:, home] / 6.0)
    np.fill_diagonal(wish, 0.0)
    kept = np.sort(np.argsort(wish, axis=None)[-pairs:])
    origin, destination = np.divmod(kept, zones)
    flow = wish.flat[kept]
    # The trips over each street, by following every pair's path back to its origin.
    over = np.zeros((rows * columns,) * 2)
    at = home[destination]
    while np.any(moving := at != home[origin]):
        came = before[origin, at]
        np.add.at(over, (came[moving], at[moving]), flow[moving])
        at = np.where(moving, came, at)
    streets = over[ends[:, 0] - zones - 1, ends[:, 1] - zones - 1]
    scale = load / np.quantile(streets / np.kron(two, capacity), 0.95)
    return network, Trips(zones, origin + 1, destination + 1, flow * scale, name="region trips")
