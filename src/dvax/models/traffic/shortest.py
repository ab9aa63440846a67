"""Shortest paths that respect the first through node."""

import numpy as np

from ...formats.road_network import Network, Trips


class ShortestPaths:
    """Dijkstra's method from every origin, with the links of the shortest paths.

    A node below `first_thru_node` may be the first or last node of a path, but not an interior one.
    It is therefore split: links that leave it start at a copy that no link enters."""

    def __init__(self, network: Network, trips: Trips):
        first, tail = network.first_thru_node, network.init_node
        self.size = network.nodes + first  # copy of node k < first: nodes + k, all counted from 0
        tail = np.where(tail < first, network.nodes + tail, tail - 1)
        head = network.term_node - 1
        self.order = np.lexsort((head, tail))
        self.heads = head[self.order].astype(np.int32)
        self.starts = np.searchsorted(tail[self.order], np.arange(self.size + 1)).astype(np.int32)
        # The two end nodes identify a link: there is at most one in each direction.
        self.keys = (tail * self.size + head)[self.order]
        begin = np.where(trips.origin < first, network.nodes + trips.origin, trips.origin - 1)
        self.begin, self.end = begin, trips.destination - 1
        self.sources, self.row = np.unique(begin, return_inverse=True)

    def find(self, costs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (the least cost of every pair, ∞ without a path; the predecessor trees)."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra

        # SciPy treats explicitly stored zeros as links of cost 0.
        shape = (self.size, self.size)
        graph = csr_array((costs[self.order], self.heads, self.starts), shape=shape)
        least, before = dijkstra(graph, indices=self.sources, return_predecessors=True)
        return least[self.row, self.end], before

    def trace(self, before: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (the concatenated links of the shortest paths of these pairs, their numbers)."""
        node, row, origin = self.end[pairs], self.row[pairs], self.begin[pairs]
        steps: list[np.ndarray] = []
        unfinished = node != origin
        while unfinished.any():
            previous = before[row, node]
            key = np.where(unfinished, previous.astype(np.int64) * self.size + node, self.keys[0])
            link = self.order[np.searchsorted(self.keys, key)]
            steps.append(np.where(unfinished, link, -1))
            node = np.where(unfinished, previous, node)
            unfinished = node != origin
        links = np.stack(steps[::-1], axis=1)
        return links[links >= 0], (links >= 0).sum(axis=1)
