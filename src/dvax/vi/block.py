"""Linear systems with the block of a matrix that belongs to the free unknowns."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

_SMALL = 32
"""Up to so many unknowns a block is not cut out: the whole matrix is factorised."""

_SIZES = 8
"""A compiled program has arrays of fixed size, so a block is cut out in one of so many sizes."""


@custom_vmap
def solve_block(matrix: jax.Array, free: jax.Array, right: jax.Array) -> jax.Array:
    """Return d with M_II d_I = right_I for the free unknowns I, and dᵢ = rightᵢ for the others.

    By LU with partial pivoting; infinite or NaN where the block is singular. The cost is that of a
    block of the smallest of eight sizes that holds the free unknowns; for a batch (by `jax.vmap`), of
    one that holds those of each of its problems. No derivatives: it serves inside iterations.
    """
    n = matrix.shape[-1]
    if n <= _SMALL:
        return _whole(matrix, free, right)
    sizes = sorted({-(-n * k // _SIZES) for k in range(1, _SIZES + 1)})
    most = jnp.max(jnp.sum(free, axis=-1, dtype=int))
    which = jnp.searchsorted(jnp.asarray(sizes[:-1]), most)
    branches = [partial(_cut, size) for size in sizes[:-1]] + [_whole]
    return lax.switch(which, branches, matrix, free, right)


@solve_block.def_vmap
def _(size: int, batched: list[bool], *given: jax.Array) -> tuple[jax.Array, bool]:
    # One block size for the whole batch: `lax.switch` on one for each would compute all of them.
    full = [
        x if own else jnp.broadcast_to(x, (size, *x.shape))
        for x, own in zip(given, batched, strict=True)
    ]
    return solve_block(*full), True


def _whole(matrix: jax.Array, free: jax.Array, right: jax.Array) -> jax.Array:
    return _solve(_kept(matrix, free), right)


def _cut(size: int, matrix: jax.Array, free: jax.Array, right: jax.Array) -> jax.Array:
    if matrix.ndim > 2:
        return jax.vmap(partial(_cut, size))(matrix, free, right)
    at = jnp.nonzero(free, size=size, fill_value=len(right))[0]
    inside = at < len(right)
    block = matrix.at[at].get(mode="clip").at[:, at].get(mode="clip")
    part = _solve(_kept(block, inside), right.at[at].get(mode="clip"))
    return right.at[at].set(part, mode="drop")


def _kept(matrix: jax.Array, inside: jax.Array) -> jax.Array:
    """The matrix with the rows and columns of the others replaced by those of the identity."""
    both = inside[..., :, None] & inside[..., None, :]
    return jnp.where(
        both, matrix, jnp.broadcast_to(jnp.eye(matrix.shape[-1], dtype=matrix.dtype), matrix.shape)
    )


def _solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    return jnp.linalg.solve(matrix, right[..., None])[..., 0]
