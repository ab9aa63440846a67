"""Simplices: nonnegative shares of a total, one or very many at once."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from ._threshold import above, cut, levels, thresholds
from ._weights import even, inverse_weights
from .abstract import AbstractSet

_LOT = 16_000
"""Entries that a processor works on at a time."""
_WASTE = 1.5
"""Simplices are projected in blocks of similar size; the smallest is filled up by at most this."""


class Simplex(AbstractSet):
    """K = {y ≥ 0 : Σᵢ yᵢ = total}, with a plain sum whatever the space's weights.

    proj_K(z)ᵢ = (zᵢ − τ/wᵢ)₊ with the one τ that reaches the total. At total = 0 the set is {0}, and
    the derivative in the total is that to the right, on the largest wᵢzᵢ.

    **Arguments:** `total` ≥ 0: a number, or an array with one a simplex. `sizes`: without it the
    simplices lie along the last axis of y, and `total` broadcasts against the others; with it y is
    one vector cut into consecutive simplices of these sizes, a product of many unequal ones
    projected at once: one an origin-destination pair, say.

    **Raises:** `dvax.InputError` where a total is negative or not finite, or a size is not positive.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> dvax.sets.Simplex(1.0).project(jnp.array([2.0, 1.0]), dvax.spaces.Euclidean(2)).tolist()
    [1.0, 0.0]
    >>> K = dvax.sets.Simplex(jnp.array([1.0, 3.0]), sizes=(2, 3))
    >>> K.project(jnp.zeros(5), dvax.spaces.Euclidean(5)).tolist()
    [0.5, 0.5, 1.0, 1.0, 1.0]

    ```
    """

    total: jax.Array
    blocks: tuple["_Block", ...] | None
    place: jax.Array | None
    entries: int | None = eqx.field(static=True)

    def __init__(self, total: Any, sizes: Sequence[int] | np.ndarray | None = None):
        name = "dvax.sets.Simplex(total)"
        self.total = _tree.as_array(total, name)
        _tree.require(
            lambda: jnp.all((self.total >= 0) & jnp.isfinite(self.total)),
            name,
            self.total,
            "nonnegative numbers add up to a finite total ≥ 0, or the set is empty",
            "Mend the totals that are not",
        )
        if not _tree.is_concrete(self.total):
            # Not known yet: a negative one is made NaN, so that an empty set stops a solve.
            self.total = jnp.where(self.total >= 0, self.total, jnp.nan)
        self.blocks, self.place, self.entries = None, None, None
        if sizes is not None:
            self.blocks, self.place, self.entries = _blocks(sizes, jnp.shape(self.total))

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        inverse_w = None if even(space) else inverse_weights(space, z)
        return cut(z, *self._thresholds(z, inverse_w), inverse_w)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        inverse_w = None if even(space) else inverse_weights(space, z)
        return [above(z, *self._thresholds(z, inverse_w), inverse_w)]

    def _thresholds(self, z: jax.Array, inverse_w: jax.Array | None) -> tuple[jax.Array, jax.Array]:
        if self.blocks is None or self.place is None:
            return thresholds(z, jnp.broadcast_to(self.total, z.shape[:-1]), inverse_w)
        shifts, taus = [], []
        for block in self.blocks:
            one = jnp.ndim(self.total) == 0
            total = self.total if one else self.total[block.number]
            shift, tau = block.levels(z, inverse_w, jnp.broadcast_to(total, block.number.shape))
            shifts.append(shift.reshape(-1))
            taus.append(tau.reshape(-1))
        shift, tau = (
            jnp.concatenate(a).at[self.place].get(mode="promise_in_bounds") for a in (shifts, taus)
        )
        return shift, tau

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        shape = _tree.shapes(like)
        if self.entries is not None:
            fits, rule = shape == (self.entries,), f"a vector of {self.entries} entries (Σ sizes)"
        else:
            rule = "an array whose last axis is the simplex and whose others fit the totals"
            fits = not isinstance(like, tuple) and len(shape) > 0 and shape[-1] > 0
            fits = fits and _broadcasts(jnp.shape(self.total), shape[:-1])
        if not fits:
            raise InputError(
                InputProblem(
                    "dvax.sets.Simplex(total, sizes)",
                    f"y = P u of shape {shape}, and totals of shape {jnp.shape(self.total)}",
                    f"y must be {rule}",
                    "Give sizes= for simplices of unequal size, dvax.sets.Product for tuples",
                )
            )


class _Block(eqx.Module):
    """Simplices of similar size, in lots: arrays of shape (lots, simplices of a lot)."""

    start: jax.Array
    size: jax.Array
    number: jax.Array
    width: int = eqx.field(static=True)

    def levels(
        self, z: jax.Array, inverse_w: jax.Array | None, total: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Of each simplex where its entries are cut off, in two parts: see `cut`."""

        def one_lot(given: tuple) -> tuple[jax.Array, jax.Array]:
            start, size, total = given
            weights = None if inverse_w is None else self._columns(inverse_w, 1.0, start, size)
            return levels(self._columns(z, -jnp.inf, start, size), total, weights, axis=0)

        # A lot stays in the processor's cache until its own simplices have settled, which is three
        # times as fast as all at once; an accelerator is fastest with all at once.
        return lax.platform_dependent(
            (self.start, self.size, total),
            cpu=lambda lots: lax.map(one_lot, lots),
            default=jax.vmap(one_lot),
        )

    def _columns(
        self, flat: jax.Array, missing: float, start: jax.Array, size: jax.Array
    ) -> jax.Array:
        """The entries of each simplex down a column, `missing` below them."""
        row = jnp.arange(self.width, dtype=start.dtype)[:, None]
        inside = row < size[None, :]
        index = start[None, :] + jnp.where(inside, row, 0)
        columns = jnp.where(inside, flat.at[index].get(mode="promise_in_bounds"), missing)
        return lax.optimization_barrier(columns)  # gathered once, not in every pass over them


def _blocks(
    sizes: Sequence[int] | np.ndarray, totals: tuple[int, ...]
) -> tuple[tuple[_Block, ...], jax.Array, int]:
    """(blocks, the simplex of each entry of y in the blocks laid end to end, Σ sizes)."""
    given = np.asarray(sizes)
    if given.ndim != 1 or given.size == 0 or given.dtype.kind not in "iu" or np.any(given < 1):
        raise InputError(
            InputProblem(
                "dvax.sets.Simplex(sizes)",
                _tree.short(given),
                "sizes are integers ≥ 1, one a simplex, or a simplex has no entries",
                "Leave out the simplices that have none",
            )
        )
    if totals not in ((), given.shape):
        raise InputError(
            InputProblem(
                "dvax.sets.Simplex(total, sizes)",
                f"{totals} totals and {given.size} sizes",
                "a total is one number for all simplices, or one a simplex",
                "Give as many totals as sizes",
            )
        )
    start = np.cumsum(given) - given
    entries, offset, smallest = int(given.sum()), 0, 1
    place = np.empty(entries, np.int32)
    blocks = []
    while smallest <= given.max():
        smallest = int(given[given >= smallest].min())
        largest = max(smallest, int(_WASTE * smallest))
        number = np.flatnonzero((given >= smallest) & (given <= largest))
        size, count = given[number], len(number)
        width = int(size.max())
        lots = -(-count * width // _LOT)
        filled = -(-count // lots) * lots  # the last lot repeats a simplex, which nothing reads
        entry = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
        place[np.repeat(start[number], size) + entry] = offset + np.repeat(np.arange(count), size)
        offset += filled
        number = np.pad(number, (0, filled - count), "edge").reshape(lots, -1)
        first, long, which = (
            jnp.asarray(a[number], np.int32) for a in (start, given, np.arange(len(given)))
        )
        blocks.append(_Block(first, long, which, width))
        smallest = largest + 1
    return tuple(blocks), jnp.asarray(place), entries


def _broadcasts(inner: tuple[int, ...], outer: tuple[int, ...]) -> bool:
    try:
        return np.broadcast_shapes(inner, outer) == outer
    except ValueError:
        return False
