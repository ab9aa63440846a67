"""Shortest paths that keep the rule of the first through node."""

import numpy as np

from ...formats.road_network import Network, Trips


class ShortestPaths:
    """Dijkstra's method from every origin, and the links of the paths that it finds.

    A node below `first_thru_node` may begin and end a path but not lie inside one. So it is split:
    links that leave it begin at a copy that no link enters, and a path that enters it ends there.
    """

    def __init__(self, network: Network, trips: Trips):
        first, tail = network.first_thru_node, network.init_node
        self.size = network.nodes + first  # copy of node k < first: nodes + k, all counted from 0
        tail = np.where(tail < first, network.nodes + tail, tail - 1)
        head = network.term_node - 1
        self.order = np.lexsort((head, tail))
        self.heads = head[self.order].astype(np.int32)
        self.starts = np.searchsorted(tail[self.order], np.arange(self.size + 1)).astype(np.int32)
        # A link is found by its ends: two nodes have one a direction.
        self.keys = (tail * self.size + head)[self.order]
        begin = np.where(trips.origin < first, network.nodes + trips.origin, trips.origin - 1)
        self.begin, self.end = begin, trips.destination - 1
        self.sources, self.row = np.unique(begin, return_inverse=True)

    def find(self, costs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(the least cost of every pair, ∞ where there is no path; the tree that it was read from)."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra

        # Stored zeros are links that cost nothing; only what is not stored is no link.
        shape = (self.size, self.size)
        graph = csr_array((costs[self.order], self.heads, self.starts), shape=shape)
        least, before = dijkstra(graph, indices=self.sources, return_predecessors=True)
        return least[self.row, self.end], before

    def trace(self, before: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(links of the paths of these pairs one after the other, how many each has)."""
        at, row, goal = self.end[pairs], self.row[pairs], self.begin[pairs]
        steps: list[np.ndarray] = []
        going = at != goal
        while going.any():
            came = before[row, at]
            key = np.where(going, came.astype(np.int64) * self.size + at, self.keys[0])
            link = self.order[np.searchsorted(self.keys, key)]
            steps.append(np.where(going, link, -1))
            at = np.where(going, came, at)
            going = at != goal
        backward = np.stack(steps[::-1], axis=1)
        return backward[backward >= 0], (backward >= 0).sum(axis=1)
