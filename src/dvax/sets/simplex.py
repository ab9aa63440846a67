"""Simplices {y ≥ 0 : Σᵢ yᵢ = total}, one or many at once."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from ._threshold import entry_thresholds, shift_and_level, subtract, subtract_and_clip
from ._weights import has_uniform_weight, inverse_weights
from .abstract import AbstractSet

_CHUNK_ENTRIES = 16_000
"""Number of entries projected at a time on a CPU, so that they stay in its cache."""
_MAX_SIZE_RATIO = 1.5
"""Ratio of the largest to the smallest size in a block of simplices, which bounds the padding."""


class Simplex(AbstractSet):
    """K = {y ≥ 0 : Σᵢ yᵢ = total}, with a plain sum whatever the space's weights.

    proj_K(z)ᵢ = (zᵢ − τ/wᵢ)₊, where τ is determined by the total. At total = 0 the set is {0}, and
    the derivative in the total is the right derivative, at the entry with the largest wᵢzᵢ.

    **Arguments:** `total` ≥ 0: a number, or an array with one total a simplex. `sizes`: without it
    the simplices lie along the last axis of y, and `total` broadcasts against the other axes. With it
    y is a vector of consecutive simplices of these sizes, for example one an origin-destination
    pair; all are projected at once.

    **Raises:** `dvax.InputError` if a total is negative or not finite, or a size is not positive.

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
    position: jax.Array | None
    entries: int | None = eqx.field(static=True)
    count: int | None = eqx.field(static=True)

    def __init__(self, total: Any, sizes: Sequence[int] | np.ndarray | None = None):
        name = "dvax.sets.Simplex(total)"
        self.total = _tree.as_array(total, name)
        _tree.require(
            lambda: np.all((np.asarray(self.total) >= 0) & np.isfinite(self.total)),
            name,
            self.total,
            "every total must be finite and ≥ 0, or the set is empty",
            "Correct the totals that are not",
        )
        if not _tree.is_concrete(self.total):
            # A traced total: replace a negative one by NaN, so that an empty set stops a solve.
            self.total = jnp.where(self.total >= 0, self.total, jnp.nan)
        self.blocks, self.position, self.entries, self.count = None, None, None, None
        if sizes is not None:
            self.blocks, self.position, self.entries = _blocks(sizes, jnp.shape(self.total))
            self.count = len(sizes)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        inverse_w = None if has_uniform_weight(space) else inverse_weights(space, z)
        return subtract_and_clip(z, *self._thresholds(z, inverse_w), inverse_w)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        inverse_w = None if has_uniform_weight(space) else inverse_weights(space, z)
        return [subtract(z, *self._thresholds(z, inverse_w), inverse_w)]

    def _thresholds(self, z: jax.Array, inverse_w: jax.Array | None) -> tuple[jax.Array, jax.Array]:
        """Return (shift, level) of `subtract`, for every entry of z."""
        if self.blocks is None or self.position is None:
            return entry_thresholds(z, jnp.broadcast_to(self.total, z.shape[:-1]), inverse_w)
        shifts, levels = [], []
        for block in self.blocks:
            is_scalar = jnp.ndim(self.total) == 0
            total = self.total if is_scalar else self.total[block.number]
            total = jnp.broadcast_to(total, block.number.shape)
            shift, level = block.shift_and_level(z, inverse_w, total)
            shifts.append(shift.reshape(-1))
            levels.append(level.reshape(-1))
        shift, level = (
            jnp.concatenate(a).at[self.position].get(mode="promise_in_bounds")
            for a in (shifts, levels)
        )
        return shift, level

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        shape = _tree.shapes(like)
        if self.entries is not None:
            fits, rule = shape == (self.entries,), f"a vector of {self.entries} entries (Σ sizes)"
        else:
            rule = (
                "an array with the simplex along its last axis; totals broadcast against the others"
            )
            fits = not isinstance(like, tuple) and len(shape) > 0 and shape[-1] > 0
            fits = fits and _broadcasts(jnp.shape(self.total), shape[:-1])
        if not fits:
            raise input_error(
                "dvax.sets.Simplex(total, sizes)",
                f"y = P u of shape {shape}, and totals of shape {jnp.shape(self.total)}",
                f"y must be {rule}",
                "Pass sizes= for simplices of unequal size; use dvax.sets.Product for tuples",
            )


class _Block(eqx.Module):
    """Simplices of similar size, in chunks: arrays of shape (chunks, simplices a chunk).

    `start` is the index of the first entry in y, `size` the number of entries, `number` the index of
    the simplex, `width` the largest size.
    """

    start: jax.Array
    size: jax.Array
    number: jax.Array
    width: int = eqx.field(static=True)

    def shift_and_level(
        self, z: jax.Array, inverse_w: jax.Array | None, total: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return (shift, level) of `subtract` for each simplex."""

        def one_chunk(chunk: tuple) -> tuple[jax.Array, jax.Array]:
            start, size, total = chunk
            weights = None if inverse_w is None else self._columns(inverse_w, 1.0, start, size)
            columns = self._columns(z, -jnp.inf, start, size)
            return shift_and_level(columns, total, weights, axis=0)

        # On a CPU each chunk iterates to convergence within the cache, three times as fast as all
        # simplices at once. An accelerator is fastest with all at once.
        return lax.platform_dependent(
            (self.start, self.size, total),
            cpu=lambda chunks: lax.map(one_chunk, chunks),
            default=jax.vmap(one_chunk),
        )

    def _columns(
        self, flat: jax.Array, padding: float, start: jax.Array, size: jax.Array
    ) -> jax.Array:
        """Return a matrix with the entries of one simplex a column, padded with `padding`."""
        row = jnp.arange(self.width, dtype=start.dtype)[:, None]
        inside = row < size[None, :]
        index = start[None, :] + jnp.where(inside, row, 0)
        columns = jnp.where(inside, flat.at[index].get(mode="promise_in_bounds"), padding)
        return lax.optimization_barrier(columns)  # gather once, not in every iteration


def _blocks(
    sizes: Sequence[int] | np.ndarray, totals: tuple[int, ...]
) -> tuple[tuple[_Block, ...], jax.Array, int]:
    """Return (blocks, position, Σ sizes).

    `position` maps each entry of y to its simplex in the concatenated blocks.
    """
    given = np.asarray(sizes)
    if given.ndim != 1 or given.size == 0 or given.dtype.kind not in "iu" or np.any(given < 1):
        raise input_error(
            "dvax.sets.Simplex(sizes)",
            _tree.short(given),
            "sizes must be integers ≥ 1, one a simplex",
            "Omit the simplices that have no entries",
        )
    if totals not in ((), given.shape):
        raise input_error(
            "dvax.sets.Simplex(total, sizes)",
            f"{totals} totals and {given.size} sizes",
            "totals must be one number for all simplices, or one number a simplex",
            "Give as many totals as sizes",
        )
    start = np.cumsum(given) - given
    entries, offset, smallest = int(given.sum()), 0, 1
    position = np.empty(entries, np.int32)
    blocks = []
    while smallest <= given.max():
        smallest = int(given[given >= smallest].min())
        largest = max(smallest, int(_MAX_SIZE_RATIO * smallest))
        number = np.flatnonzero((given >= smallest) & (given <= largest))
        size, count = given[number], len(number)
        width = int(size.max())
        chunks = -(-count * width // _CHUNK_ENTRIES)
        padded = -(-count // chunks) * chunks  # the last chunk repeats a simplex as padding
        entry = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
        index = offset + np.repeat(np.arange(count), size)
        position[np.repeat(start[number], size) + entry] = index
        offset += padded
        number = np.pad(number, (0, padded - count), "edge").reshape(chunks, -1)
        block_start, block_size, block_number = (
            jnp.asarray(a[number], np.int32) for a in (start, given, np.arange(len(given)))
        )
        blocks.append(_Block(block_start, block_size, block_number, width))
        smallest = largest + 1
    return tuple(blocks), jnp.asarray(position), entries


def _broadcasts(inner: tuple[int, ...], outer: tuple[int, ...]) -> bool:
    try:
        return np.broadcast_shapes(inner, outer) == outer
    except ValueError:
        return False
