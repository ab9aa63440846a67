"""Checkpoints: states at the starts of some steps, for a reverse pass that cannot store them all."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree

_MAX_BYTES = 2**30
"""Largest memory of all checkpoints together."""

_MIN_COUNT, _MAX_COUNT = 16, 4096

_FREE_BYTES, _LARGE_STATE_COUNT = 2**22, 32
"""Memory whose use costs no time, and the number of checkpoints for states that exceed it: accessing
new memory takes longer than computing a step several times again."""

_MAX_RECOMPUTATIONS = 12
"""Largest number of times that a step is computed again to save memory."""


class Checkpoints(eqx.Module):
    """The states at the starts of steps 0, s, 2s, … in C = 2ᵇ slots, with s = 2ʲ.

    When the slots are full, s doubles and every other state is dropped, without copying. The k-th state
    is in the slot whose number is k with its b bits rotated left by j: when s doubles, (k, j) ↦
    (k/2, j+1) is the same slot for even k, and the slots of the odd states are reused in order.
    """

    slots: Tree
    j: jax.Array
    bits: int = eqx.field(static=True)

    def __init__(self, like: Tree, count: int):
        self.bits = count.bit_length() - 1
        assert count == 2**self.bits
        self.slots = jtu.tree_map(lambda v: jnp.zeros((count + 1, *v.shape), v.dtype), like)
        self.j = jnp.asarray(0)

    def put(self, index: Any, x: Tree, counts: Any = True) -> "Checkpoints":
        """Return the checkpoints after storing x, the state at the start of step `index`, if `counts`.

        Steps must come in order; a step may be repeated.
        """
        full = counts & ((index >> self.j) >= 2**self.bits)
        j = jnp.where(full, self.j + 1, self.j)
        is_kept = counts & (index == ((index >> j) << j))
        # Write a state that is not kept to an extra slot: a conditional write would copy the array.
        slot = jnp.where(is_kept, self._slot(index >> j, j), 2**self.bits)
        slots = _tree.put(self.slots, slot, x)
        return eqx.tree_at(lambda c: (c.slots, c.j), self, (slots, j))

    def before(self, index: Any) -> tuple[Any, Tree]:
        """Return the last step up to `index` that has a checkpoint, and the state at its start."""
        k = index >> self.j
        slot = self._slot(k, self.j)
        return k << self.j, jtu.tree_map(lambda leaf: leaf[slot], self.slots)

    def stack(self, steps: Any) -> "Stack":
        """Return the checkpoints of a run of this number of steps as a stack."""
        numbers = jnp.arange(2**self.bits)
        # The extra slot is free too.
        order = jnp.append(self._slot(numbers, self.j), 2**self.bits)
        height = ((steps - 1) >> self.j) + 1
        return Stack(self.slots, order, jnp.append(numbers << self.j, 0), height)

    def _slot(self, k: Any, j: Any) -> Any:
        if self.bits == 0:
            return jnp.zeros_like(k)
        r = j % self.bits
        return ((k << r) | (k >> (self.bits - r))) & (2**self.bits - 1)


class Stack(NamedTuple):
    """A stack of checkpoints with the latest step on top.

    The entry at height k belongs to step `at[k]` and is in the slot `order[k]`. The slots
    of higher entries are free.
    """

    slots: Tree
    order: jax.Array
    at: jax.Array
    height: jax.Array

    @property
    def step(self) -> Any:
        """The step of the entry on top."""
        return self.at[self.height - 1]

    @property
    def x(self) -> Tree:
        slot = self.order[self.height - 1]
        return jtu.tree_map(lambda leaf: leaf[slot], self.slots)

    def push(self, step: Any, x: Tree) -> "Stack":
        slots = _tree.put(self.slots, self.order[self.height], x)
        return Stack(slots, self.order, _tree.put(self.at, self.height, step), self.height + 1)

    def pop(self) -> "Stack":
        return self._replace(height=self.height - 1)

    def next(self, target: Any) -> Any:
        """Return the next step to store on the way from the step on top to step `target`.

        With s free slots, and every step computed at most r times again, C(s + r − 1, r) states are
        reachable (Griewank 1992). For a distance d, the best step to store first is about d r/(s + r),
        with the smallest r for which d is reachable.
        """
        distance, free = target - self.step, len(self.order) - self.height
        r, reach = 1, jnp.ones((), jnp.float32)
        for k in range(1, _MAX_RECOMPUTATIONS + 1):
            reach = reach * (free + (k - 1)).astype(jnp.float32) / k
            r = r + jnp.where(reach < distance.astype(jnp.float32), 1, 0)
        offset = -(-(distance * r) // (free + r))
        return self.step + jnp.where(free > 1, jnp.clip(offset, 1, distance), distance)


def checkpoint_count(x0: Tree, max_steps: int) -> int:
    """Return the number of checkpoints of a run from x0, a power of two."""
    size = max(1, sum(leaf.size * leaf.dtype.itemsize for leaf in jtu.tree_leaves(x0)))
    memory_limit = max(_MIN_COUNT, _MAX_BYTES // size)
    speed_limit = max(_FREE_BYTES // size, _LARGE_STATE_COUNT)
    step_limit = _power_of_two(2 * max_steps - 1)
    return _power_of_two(min(memory_limit, _MAX_COUNT, speed_limit, step_limit))


def _power_of_two(count: int) -> int:
    """Return the largest power of two that is at most `count`."""
    return 2 ** (count.bit_length() - 1)
