"""Linear systems with the block of a matrix for the free unknowns."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from .._small_matrices import MAX_ROWS, solve_constant

_MAX_WHOLE_UNKNOWNS = 32
"""Up to this size the whole matrix is factorised instead of an extracted block."""

_BLOCK_SIZES = 8
"""Number of block sizes: a compiled program has arrays of fixed size, so it has one branch per size."""


@custom_vmap
def solve_block(matrix: jax.Array, free: jax.Array, right: jax.Array) -> jax.Array:
    """Return d with M_II d_I = right_I for the free unknowns I, and dᵢ = rightᵢ for the others.

    The method is LU with partial pivoting; the result is infinite or NaN if the block is singular. The
    cost is that of the smallest of eight block sizes that contains the free unknowns, and for a batch
    (by `jax.vmap`) those of each of its problems. It has no derivatives: it is used inside iterations.
    """
    n = matrix.shape[-1]
    if n <= _MAX_WHOLE_UNKNOWNS:
        return _solve_whole(matrix, free, right)
    sizes = sorted({-(-n * k // _BLOCK_SIZES) for k in range(1, _BLOCK_SIZES + 1)})
    free_count = jnp.max(jnp.sum(free, axis=-1, dtype=int))
    branch = jnp.searchsorted(jnp.asarray(sizes[:-1]), free_count)
    branches = [partial(_solve_extracted, size) for size in sizes[:-1]] + [_solve_whole]
    return lax.switch(branch, branches, matrix, free, right)


@solve_block.def_vmap
def _(size: int, batched: list[bool], *arrays: jax.Array) -> tuple[jax.Array, bool]:
    # One block size for the whole batch: a batched `lax.switch` would compute every branch.
    full = [
        x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
        for x, is_batched in zip(arrays, batched, strict=True)
    ]
    return solve_block(*full), True


def _solve_whole(matrix: jax.Array, free: jax.Array, right: jax.Array) -> jax.Array:
    return _solve(_with_identity(matrix, free), right)


def _solve_extracted(size: int, matrix: jax.Array, free: jax.Array, right: jax.Array) -> jax.Array:
    if matrix.ndim > 2:
        return jax.vmap(partial(_solve_extracted, size))(matrix, free, right)
    index = jnp.nonzero(free, size=size, fill_value=len(right))[0]
    is_used = index < len(right)
    block = matrix.at[index].get(mode="clip").at[:, index].get(mode="clip")
    part = _solve(_with_identity(block, is_used), right.at[index].get(mode="clip"))
    return right.at[index].set(part, mode="drop")


def _with_identity(matrix: jax.Array, free: jax.Array) -> jax.Array:
    """Replace the rows and columns of the unknowns that are not free by those of the identity."""
    both = free[..., :, None] & free[..., None, :]
    return jnp.where(
        both, matrix, jnp.broadcast_to(jnp.eye(matrix.shape[-1], dtype=matrix.dtype), matrix.shape)
    )


def _solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    if matrix.ndim > 2 and right.shape[-1] <= MAX_ROWS:
        return jax.vmap(_solve)(matrix, right)
    if matrix.ndim > 2:
        return jnp.linalg.solve(matrix, right[..., None])[..., 0]
    return solve_constant(matrix, right)
