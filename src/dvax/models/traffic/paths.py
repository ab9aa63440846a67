"""Sets of paths: which links each one takes, pair by pair."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


@dataclass(frozen=True, eq=False)
class Paths:
    """The paths of all pairs, those of one pair side by side.

    `links` holds the links of all paths one after the other, `lengths` how many each has, `sizes` how
    many paths each pair has; there are `count` links in the network.
    """

    links: np.ndarray
    lengths: np.ndarray
    sizes: np.ndarray
    count: int

    @property
    def starts(self) -> np.ndarray:
        """The first path of every pair."""
        return np.cumsum(self.sizes) - self.sizes

    @property
    def pairs(self) -> np.ndarray:
        """The pair of every path."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)

    def incidence(self) -> Any:
        """Δᵀ as a sparse matrix: a row a path, with a one for each of its links."""
        from scipy.sparse import csr_array

        ends = np.concatenate([[0], np.cumsum(self.lengths)])
        shape = len(self.lengths), self.count
        return csr_array((np.ones(len(self.links)), self.links, ends), shape=shape)

    def chosen(self, which: np.ndarray) -> "Paths":
        """The paths where `which` is true; every pair must keep one."""
        sizes = np.add.reduceat(which.astype(int), self.starts)
        links = self.links[np.repeat(which, self.lengths)]
        return Paths(links, self.lengths[which], sizes, self.count)

    def differences(self, demand: np.ndarray) -> "Differences":
        """What the choice between paths changes, for flows that add up to `demand`."""
        several = self.sizes > 1
        rows = np.flatnonzero(np.repeat(several, self.sizes))
        sizes = self.sizes[several]
        lengths = self.lengths[rows]
        begin = np.cumsum(self.lengths) - self.lengths
        offset = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        links = self.links[np.repeat(begin[rows], lengths) + offset]
        pair = np.repeat(np.arange(len(sizes)), sizes)
        row = np.repeat(np.arange(len(rows)), lengths)
        # A link is shared by all paths of its pair where (pair, link) occurs once for each of them.
        key = pair[row] * self.count + links
        order = np.argsort(key, kind="stable")
        fresh = np.append(True, key[order][1:] != key[order][:-1])
        group = np.cumsum(fresh) - 1
        shared = np.empty(len(key), bool)
        shared[order] = np.bincount(group)[group] == sizes[pair[row[order]]]
        first = np.cumsum(sizes) - sizes
        once = shared & (row == first[pair[row]])
        pairs = np.flatnonzero(several)
        fixed = np.bincount(links[once], demand[pairs][pair[row[once]]], self.count).astype(float)
        alone = np.repeat(~several, self.sizes)
        only = np.repeat(np.repeat(demand, self.sizes), self.lengths)[
            np.repeat(alone, self.lengths)
        ]
        fixed += np.bincount(self.links[np.repeat(alone, self.lengths)], only, self.count)
        ends = np.append(0, np.cumsum(np.bincount(row[~shared], minlength=len(rows))))
        return Differences(rows, pairs, sizes, links[~shared], ends, fixed, self.count)

    def joined(
        self, links: np.ndarray, lengths: np.ndarray, pairs: np.ndarray
    ) -> tuple["Paths", np.ndarray]:
        """(these paths and one more for each of the `pairs`, where each of the old ones is now)."""
        owner = np.concatenate([self.pairs, pairs])
        order = np.argsort(owner, kind="stable")
        every = np.concatenate([self.lengths, lengths])
        begin = np.cumsum(every) - every
        new = every[order]
        offset = np.arange(new.sum()) - np.repeat(np.cumsum(new) - new, new)
        flat = np.concatenate([self.links, links])[np.repeat(begin[order], new) + offset]
        sizes = np.bincount(owner, minlength=len(self.sizes))
        moved = np.argsort(order, kind="stable")[: len(self.lengths)]
        return Paths(flat, new, sizes, self.count), moved


@dataclass(frozen=True, eq=False)
class Differences:
    """The paths of the pairs that have several, without the links that all paths of a pair share.

    `rows` are their numbers among all paths, `pairs` those of the pairs among all pairs, `sizes` how
    many paths each pair has; `links` up to `ends` are those of each row, and `fixed` the link flows
    that no choice changes: v = fixed + Δ′x.
    """

    rows: np.ndarray
    pairs: np.ndarray
    sizes: np.ndarray
    links: np.ndarray
    ends: np.ndarray
    fixed: np.ndarray
    count: int

    def matrix(self, first: int, last: int) -> Any:
        """The rows from `first` to before `last`, sparse, with a one for each link."""
        from scipy.sparse import csr_array

        ends = self.ends[first : last + 1]
        links = self.links[ends[0] : ends[-1]]
        shape = last - first, self.count
        return csr_array((np.ones(len(links)), links, ends - ends[0]), shape=shape)


class Incidence(eqx.Module):
    """Δ, the links of paths, as JAX applies it: v = Δx adds the flows of the paths over each link,
    and Δᵀc the costs of the links along each path.

    Both go through the links of all paths one after the other: tables with a row for each step of a
    path, filled up to the longest, take XLA much longer where few paths are long.
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
        """v = Δx."""
        taken = _computed(x).at[self.path].get(mode="promise_in_bounds")
        nothing = jnp.zeros(self.count, x.dtype)
        return nothing.at[self.link].add(taken, mode="promise_in_bounds")

    def along(self, c: jax.Array) -> jax.Array:
        """Δᵀc."""
        passed = _computed(c).at[self.link].get(mode="promise_in_bounds")
        return jax.ops.segment_sum(passed, self.path, self.number, indices_are_sorted=True)


def _computed(a: jax.Array) -> jax.Array:
    """The same array, written to memory by a scatter. XLA fuses what precedes a gather into it, barrier
    or not, and would compute the power of a link's cost once for every path over it."""
    return jnp.zeros_like(a).at[jnp.arange(len(a))].set(a, mode="promise_in_bounds")
