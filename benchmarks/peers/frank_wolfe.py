"""The biconjugate Frank–Wolfe method for user equilibria (Mitradjieva and Lindberg 2013).

It keeps link flows alone. Each iteration loads all trips onto the paths that are least now, makes the
direction conjugate to the two before it, and searches the line exactly. Shortest paths are SciPy's, in
C, as those of dvax; all trees are loaded at once, level by level from their leaves.
"""

import time

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from dvax.models.traffic import Network, Trips


class _Loader:
    """All-or-nothing assignment."""

    def __init__(self, network: Network, trips: Trips):
        first = network.first_thru_node
        self.size = network.nodes + first
        tail = np.where(network.init_node < first, network.nodes, -1) + network.init_node
        head = network.term_node - 1
        self.order = np.lexsort((head, tail))
        self.heads = head[self.order].astype(np.int32)
        self.starts = np.searchsorted(tail[self.order], np.arange(self.size + 1)).astype(np.int32)
        self.keys = (tail * self.size + head)[self.order]
        begin = np.where(trips.origin < first, network.nodes, -1) + trips.origin
        self.sources, self.row = np.unique(begin, return_inverse=True)
        self.end, self.demand = trips.destination - 1, trips.flow
        count = len(self.sources) * self.size
        self.trips = np.bincount(self.row * self.size + self.end, trips.flow, count)

    def __call__(self, c: np.ndarray) -> tuple[float, np.ndarray]:
        """(Σ demand × least cost, the link flows of all trips on least cost paths)."""
        graph = csr_array((c[self.order], self.heads, self.starts), shape=(self.size,) * 2)
        far, before = dijkstra(graph, indices=self.sources, return_predecessors=True)
        least = float(self.demand @ far[self.row, self.end])
        here = np.arange(before.size).reshape(before.shape)
        parent = np.where(before >= 0, here - np.arange(self.size) + before, here).ravel()
        # Hops from the origin, by doubling.
        depth, up = (before >= 0).ravel().astype(np.int32), parent
        while np.any(add := depth[up]):
            depth, up = depth + add, up[up]
        order = np.argsort(depth, kind="stable")
        ends = np.cumsum(np.bincount(depth))
        flow = self.trips.copy()
        for level in range(len(ends) - 1, 0, -1):
            nodes = order[ends[level - 1] : ends[level]]
            np.add.at(flow, parent[nodes], flow[nodes])
        nodes = order[ends[0] :]
        nodes = nodes[flow[nodes] > 0]
        key = parent[nodes] % self.size * self.size + nodes % self.size
        links = self.order[np.searchsorted(self.keys, key)]
        return least, np.bincount(links, flow[nodes], len(c))


def frank_wolfe(
    network: Network, trips: Trips, charge: np.ndarray, gaps: list[float], longest: float
) -> tuple[dict[float, float], np.ndarray]:
    """(seconds until each relative gap, those reached within `longest` seconds; the link flows)."""
    started = time.perf_counter()
    scale = network.free_flow_time * network.b / network.capacity**network.power
    p, free = network.power, network.free_flow_time + charge
    steep = np.where(p > 0, scale * p, 0.0)

    def cost(v: np.ndarray) -> np.ndarray:
        return free + scale * v**p

    def slope(v: np.ndarray) -> np.ndarray:
        return steep * v ** np.maximum(p - 1, 0)

    load, reached = _Loader(network, trips), {}
    v = load(cost(np.zeros(len(network))))[1]
    targets: list[np.ndarray] = []
    length = 0.0
    while time.perf_counter() - started < longest:
        c, D = cost(v), slope(v)
        least, y = load(c)
        gap = (float(v @ c) - least) / float(v @ c)
        for goal in gaps:
            if gap <= goal:
                reached.setdefault(goal, time.perf_counter() - started)
        if len(reached) == len(gaps):
            break
        towards = y - v
        target = y
        if len(targets) == 1:
            last = targets[0] - v
            down = float(last @ (D * (towards - last)))
            share = float(last @ (D * towards)) / down if down != 0 else 0.0
            share = min(max(share, 0.0), 0.99)
            target = share * targets[0] + (1 - share) * y
        elif len(targets) == 2:
            s1, s2 = targets
            last, both = s1 - v, length * s1 + (1 - length) * s2 - v
            mu = -float(both @ (D * towards)) / float(both @ (D * (s2 - s1)))
            nu = -float(last @ (D * towards)) / float(last @ (D * last)) + mu * length / (
                1 - length
            )
            mu, nu = (w if np.isfinite(w) and w > 0 else 0.0 for w in (mu, nu))
            target = (y + nu * s1 + mu * s2) / (1 + mu + nu)
        if not c @ (target - v) < 0:
            target, targets = y, []
        dv = target - v
        length = _exact(cost, slope, v, dv)
        v = np.maximum(v + length * dv, 0.0)
        targets = [] if length > 0.99999 else [target, *targets][:2]
    return reached, v


def _exact(cost, slope, v: np.ndarray, dv: np.ndarray) -> float:
    low, high, alpha = 0.0, 1.0, 1.0
    for _ in range(60):
        at = np.maximum(v + alpha * dv, 0.0)
        rise = float(cost(at) @ dv)
        if alpha == 1.0 and rise <= 0:
            return 1.0
        low, high = (low, alpha) if rise > 0 else (alpha, high)
        curvature = float(slope(at) @ (dv * dv))
        new = alpha - rise / curvature if curvature > 0 else low
        new = new if low < new < high else 0.5 * (low + high)
        if abs(new - alpha) <= 1e-10 * alpha:
            return new
        alpha = new
    return alpha
