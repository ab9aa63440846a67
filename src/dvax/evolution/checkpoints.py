"""Some of the states that steps began with, for a reverse pass that cannot keep them all."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree

_BYTES = 2**30
"""What checkpoints may take, of all kinds together."""

_FEWEST, _MOST = 16, 4096

_CHEAP, _ENOUGH = 2**22, 32
"""Bytes that cost nothing to keep; checkpoints that do for a run of large states: to touch new memory
takes longer than to compute a step several times more."""

_TURNS = 12
"""Up to this many times more is a step computed where that saves places."""


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

    def put(self, index: Any, x: Tree, counts: Any = True) -> "Checkpoints":
        """Step number `index` begins with x, where that `counts`. Steps come in order; one may come
        again."""
        full = counts & ((index >> self.j) >= 2**self.bits)
        j = jnp.where(full, self.j + 1, self.j)
        kept = counts & (index == ((index >> j) << j))
        # What is not kept goes to a place of its own, since not to write would be to copy.
        place = jnp.where(kept, self._place(index >> j, j), 2**self.bits)
        places = _tree.put(self.places, place, x)
        return eqx.tree_at(lambda c: (c.places, c.j), self, (places, j))

    def before(self, index: Any) -> tuple[Any, Tree]:
        """The last step up to `index` whose beginning is kept, and that."""
        k = index >> self.j
        place = self._place(k, self.j)
        return k << self.j, jtu.tree_map(lambda leaf: leaf[place], self.places)

    def stack(self, steps: Any) -> "Stack":
        """What is kept of a run of so many steps."""
        numbers = jnp.arange(2**self.bits)
        # The place of what was not kept is free as well.
        order = jnp.append(self._place(numbers, self.j), 2**self.bits)
        height = ((steps - 1) >> self.j) + 1
        return Stack(self.places, order, jnp.append(numbers << self.j, 0), height)

    def _place(self, k: Any, j: Any) -> Any:
        if self.bits == 0:
            return jnp.zeros_like(k)
        r = j % self.bits
        return ((k << r) | (k >> (self.bits - r))) & (2**self.bits - 1)


class Stack(NamedTuple):
    """Some of the states that steps began with, the last of them on top: the one at height k, that of
    the step at[k], is in the place order[k]; places further up are free."""

    places: Tree
    order: jax.Array
    at: jax.Array
    height: jax.Array

    @property
    def step(self) -> Any:
        """The step that begins with the state on top."""
        return self.at[self.height - 1]

    @property
    def x(self) -> Tree:
        place = self.order[self.height - 1]
        return jtu.tree_map(lambda leaf: leaf[place], self.places)

    def push(self, step: Any, x: Tree) -> "Stack":
        places = _tree.put(self.places, self.order[self.height], x)
        return Stack(places, self.order, _tree.put(self.at, self.height, step), self.height + 1)

    def pop(self) -> "Stack":
        return self._replace(height=self.height - 1)

    def next(self, target: Any) -> Any:
        """The next state to keep on the way from the top to that of step `target`.

        With s free places and every step computed at most r times more, C(s + r − 1, r) states are
        within reach (Griewank 1992); of d of them the best to keep first is number d r/(s + r),
        nearly, with the least r that will do.
        """
        apart, free = target - self.step, len(self.order) - self.height
        r, reach = 1, jnp.ones((), jnp.float32)
        for turn in range(1, _TURNS + 1):
            reach = reach * (free + (turn - 1)).astype(jnp.float32) / turn
            r = r + jnp.where(reach < apart.astype(jnp.float32), 1, 0)
        ahead = -(-(apart * r) // (free + r))
        return self.step + jnp.where(free > 1, jnp.clip(ahead, 1, apart), apart)


def how_many(x0: Tree, max_steps: int) -> int:
    """Of checkpoints of a run from x0."""
    size = max(1, sum(leaf.size * leaf.dtype.itemsize for leaf in jtu.tree_leaves(x0)))
    affordable = max(_FEWEST, _BYTES // size)
    enough = max(_CHEAP // size, _ENOUGH)
    return _power(min(affordable, _MOST, enough, _power(2 * max_steps - 1)))


def _power(count: int) -> int:
    """The largest power of two up to it."""
    return 2 ** (count.bit_length() - 1)
