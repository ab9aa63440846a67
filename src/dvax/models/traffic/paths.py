"""Sets of paths, as lists of links for every pair."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


@dataclass(frozen=True, eq=False)
class Paths:
    """The paths of all pairs, ordered by pair.

    `links` holds the concatenated links of all paths, `lengths` the number of links of each path,
    `sizes` the number of paths of each pair, and `count` the number of links of the network.
    """

    links: np.ndarray
    lengths: np.ndarray
    sizes: np.ndarray
    count: int

    @property
    def starts(self) -> np.ndarray:
        """The index of the first path of every pair."""
        return np.cumsum(self.sizes) - self.sizes

    @property
    def pairs(self) -> np.ndarray:
        """The pair of every path."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)

    def incidence(self) -> Any:
        """Return Δᵀ as a sparse matrix: one row a path, with ones at its links."""
        from scipy.sparse import csr_array

        ends = np.concatenate([[0], np.cumsum(self.lengths)])
        shape = len(self.lengths), self.count
        return csr_array((np.ones(len(self.links)), self.links, ends), shape=shape)

    def select(self, mask: np.ndarray) -> "Paths":
        """Return the paths where `mask` is true, at least one for every pair."""
        sizes = np.add.reduceat(mask.astype(int), self.starts)
        links = self.links[np.repeat(mask, self.lengths)]
        return Paths(links, self.lengths[mask], sizes, self.count)

    def differences(self, demand: np.ndarray) -> "Differences":
        """Return the reduced paths of pairs with several paths, for flows that add up to `demand`."""
        several = self.sizes > 1
        rows = np.flatnonzero(np.repeat(several, self.sizes))
        sizes = self.sizes[several]
        lengths = self.lengths[rows]
        begin = np.cumsum(self.lengths) - self.lengths
        offset = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        links = self.links[np.repeat(begin[rows], lengths) + offset]
        pair = np.repeat(np.arange(len(sizes)), sizes)
        row = np.repeat(np.arange(len(rows)), lengths)
        # A link is on all paths of its pair if (pair, link) occurs once for each of them.
        key = pair[row] * self.count + links
        order = np.argsort(key, kind="stable")
        is_new = np.append(True, key[order][1:] != key[order][:-1])
        group = np.cumsum(is_new) - 1
        shared = np.empty(len(key), bool)
        shared[order] = np.bincount(group)[group] == sizes[pair[row[order]]]
        first = np.cumsum(sizes) - sizes
        once = shared & (row == first[pair[row]])
        pairs = np.flatnonzero(several)
        fixed = np.bincount(links[once], demand[pairs][pair[row[once]]], self.count).astype(float)
        single = np.repeat(~several, self.sizes)
        single_flows = np.repeat(np.repeat(demand, self.sizes), self.lengths)[
            np.repeat(single, self.lengths)
        ]
        fixed += np.bincount(self.links[np.repeat(single, self.lengths)], single_flows, self.count)
        ends = np.append(0, np.cumsum(np.bincount(row[~shared], minlength=len(rows))))
        return Differences(rows, pairs, sizes, links[~shared], ends, fixed, self.count)

    def insert(
        self, links: np.ndarray, lengths: np.ndarray, pairs: np.ndarray
    ) -> tuple["Paths", np.ndarray]:
        """Return (these paths and one more for each of `pairs`, the new indices of the old paths)."""
        pair = np.concatenate([self.pairs, pairs])
        order = np.argsort(pair, kind="stable")
        all_lengths = np.concatenate([self.lengths, lengths])
        begin = np.cumsum(all_lengths) - all_lengths
        new = all_lengths[order]
        offset = np.arange(new.sum()) - np.repeat(np.cumsum(new) - new, new)
        flat = np.concatenate([self.links, links])[np.repeat(begin[order], new) + offset]
        sizes = np.bincount(pair, minlength=len(self.sizes))
        positions = np.argsort(order, kind="stable")[: len(self.lengths)]
        return Paths(flat, new, sizes, self.count), positions


@dataclass(frozen=True, eq=False)
class Differences:
    """The paths of pairs with several paths, without the links that all paths of a pair share.

    `rows` are the indices of these paths among all paths, `pairs` the indices of their pairs,
    `sizes` the numbers of paths of these pairs. `links[ends[k]:ends[k + 1]]` are the links of row
    k. `fixed` are the link flows that do not depend on the choice of paths: v = fixed + Δ′x."""

    rows: np.ndarray
    pairs: np.ndarray
    sizes: np.ndarray
    links: np.ndarray
    ends: np.ndarray
    fixed: np.ndarray
    count: int

    def matrix(self, first: int, last: int) -> Any:
        """Return the rows `first`, …, `last` − 1 as a sparse matrix with ones at their links."""
        from scipy.sparse import csr_array

        ends = self.ends[first : last + 1]
        links = self.links[ends[0] : ends[-1]]
        shape = last - first, self.count
        return csr_array((np.ones(len(links)), links, ends - ends[0]), shape=shape)


class Incidence(eqx.Module):
    """The link-path incidence Δ for JAX: v = Δx are link flows, Δᵀc are path costs.

    Both process the concatenated links of all paths. Tables padded to the longest path take much longer
    if few paths are long.
    """

    path: jax.Array
    link: jax.Array
    number: int = eqx.field(static=True)
    count: int = eqx.field(static=True)

    def __init__(self, lengths: np.ndarray, links: np.ndarray, count: int):
        self.path = jnp.asarray(np.repeat(np.arange(len(lengths)), lengths), jnp.int32)
        self.link = jnp.asarray(links, jnp.int32)
        self.number, self.count = len(lengths), count

    def flows(self, x: jax.Array) -> jax.Array:
        """Return v = Δx."""
        path_flows = _materialise(x).at[self.path].get(mode="promise_in_bounds")
        zero = jnp.zeros(self.count, x.dtype)
        return zero.at[self.link].add(path_flows, mode="promise_in_bounds")

    def along(self, c: jax.Array) -> jax.Array:
        """Return Δᵀc."""
        link_costs = _materialise(c).at[self.link].get(mode="promise_in_bounds")
        return jax.ops.segment_sum(link_costs, self.path, self.number, indices_are_sorted=True)


def _materialise(a: jax.Array) -> jax.Array:
    """Return the same array, written to memory by a scatter.

    XLA fuses the computation of a gather's operand into the gather, even across an optimisation
    barrier. It would then compute the power in a link's cost once for every path over the link.
    """
    return jnp.zeros_like(a).at[jnp.arange(len(a))].set(a, mode="promise_in_bounds")
