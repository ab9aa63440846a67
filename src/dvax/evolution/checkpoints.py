"""Some of the states that steps began with, for a reverse pass that cannot keep them all."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree

_BYTES = 2**30
"""What checkpoints may take, of all kinds together."""

_FEWEST, _MOST = 16, 4096

_CHEAP, _ENOUGH = 2**22, 128
"""Bytes that cost nothing to keep; checkpoints that do for a run of large states, one turn of 16 384
steps."""


class Checkpoints(eqx.Module):
    """The states before the steps 0, s, 2s, … in C = 2ᵇ places, with s = 2ʲ doubled whenever the
    places run out: then every other state is given up, and nothing is moved.

    The k-th of them is kept in the place whose number is k with its b bits rotated left j times:
    when s doubles, the even ones stay where they are, (k, j) ↦ (k/2, j+1) is the same place, and the
    places of the odd ones are filled in order.
    """

    places: Tree
    j: jax.Array
    bits: int = eqx.field(static=True)

    def __init__(self, like: Tree, count: int):
        self.bits = count.bit_length() - 1
        assert count == 2**self.bits
        self.places = jtu.tree_map(lambda v: jnp.zeros((count + 1, *v.shape), v.dtype), like)
        self.j = jnp.asarray(0)

    def put(self, index: Any, x: Tree) -> "Checkpoints":
        """Step number `index` begins with x. Steps come in order; one may come again."""
        full = (index >> self.j) >= 2**self.bits
        j = jnp.where(full, self.j + 1, self.j)
        kept = index == ((index >> j) << j)
        # What is not kept goes to a place of its own, since not to write would be to copy.
        place = jnp.where(kept, self._place(index >> j, j), 2**self.bits)
        places = _tree.put(self.places, place, x)
        return eqx.tree_at(lambda c: (c.places, c.j), self, (places, j))

    def before(self, index: Any) -> tuple[Any, Tree]:
        """The last step up to `index` whose beginning is kept, and that."""
        k = index >> self.j
        place = self._place(k, self.j)
        return k << self.j, jtu.tree_map(lambda leaf: leaf[place], self.places)

    def _place(self, k: Any, j: Any) -> Any:
        if self.bits == 0:
            return jnp.zeros_like(k)
        r = j % self.bits
        return ((k << r) | (k >> (self.bits - r))) & (2**self.bits - 1)


def how_many(x0: Tree, max_steps: int) -> tuple[int, int]:
    """Of checkpoints of the whole run, and of states between two of them, for steps from x0."""
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jtu.tree_leaves(x0))
    affordable = max(_FEWEST, _BYTES // (2 * max(size, 1)))
    # Large states are not kept because there is room: to touch new memory takes longer than to compute
    # a step of many once more, and one turn does for as many states as there are checkpoints.
    enough = max(_CHEAP // max(size, 1), min(_ENOUGH, math.isqrt(max_steps) + 1))
    most = _power(min(affordable, _MOST, _power(2 * enough - 1)))
    power = min(most, _power(2 * max_steps - 1))
    if power >= max_steps:
        return power, 1
    return power, min(_power(4 * max_steps // power), most)


def _power(count: int) -> int:
    """The largest power of two up to it."""
    return 2 ** (count.bit_length() - 1)
