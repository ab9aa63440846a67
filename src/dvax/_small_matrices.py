"""Linear systems and pseudoinverses of small matrices, without calls of a library.

A library call interrupts a compiled program: XLA compiles what surrounds it as separate kernels, which
takes seconds for a law that is solved by iteration, and a call costs more than the arithmetic of a few
unknowns. The loops here can be part of one compiled function.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

MAX_ROWS = 16
"""Largest number of unknowns for which systems are solved here; beyond, by LAPACK."""


def solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Return x with matrix · x = right, for a vector; infinite or NaN if the matrix is singular.

    Both derivatives are those of the linear system, not of the elimination.
    """
    if len(right) > MAX_ROWS:
        return jnp.linalg.solve(matrix, right)
    return lax.custom_linear_solve(
        lambda x: times(matrix, x),
        right,
        lambda _, vector: solve_constant(matrix, vector),
        lambda _, vector: solve_constant(matrix.T, vector),
    )


def solve_constant(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Return x with matrix · x = right, for a vector and without derivatives."""
    matrix, right = lax.stop_gradient((matrix, right))
    if len(right) > MAX_ROWS:
        return jnp.linalg.solve(matrix, right)
    return lax.stop_gradient(eliminate(matrix, right)[0])


def pivots(matrix: jax.Array) -> jax.Array:
    """Return the pivots of the elimination with partial pivoting, without derivatives."""
    matrix = lax.stop_gradient(matrix)
    if len(matrix) > MAX_ROWS:
        return jnp.diagonal(lax.linalg.lu(matrix)[0])
    return lax.stop_gradient(eliminate(matrix, matrix[:, :0])[1])


def eliminate(matrix: jax.Array, right: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return x and the pivots of Gauss–Jordan elimination with partial pivoting, for a vector or the
    columns of a matrix `right`.

    Rows are not exchanged: each pivot row is marked as used, and x is read in the order of the pivots.
    """
    n = len(matrix)
    index = jnp.arange(n)

    def column(k: jax.Array, state: tuple) -> tuple:
        rows, unused, order, pivots = state
        entries = lax.dynamic_index_in_dim(rows, k, axis=1, keepdims=False)
        row = jnp.argmax(jnp.where(unused, jnp.abs(entries), -1.0))
        chosen = index == row
        scaled = lax.dynamic_index_in_dim(rows, row)
        pivot = lax.dynamic_index_in_dim(entries, row, keepdims=False)
        scaled = scaled / pivot
        rows = jnp.where(chosen[:, None], scaled, rows - entries[:, None] * scaled)
        at_k = index == k
        return rows, unused & ~chosen, jnp.where(at_k, row, order), jnp.where(at_k, pivot, pivots)

    rows = jnp.concatenate([matrix, right.reshape(n, -1)], axis=1)
    start = rows, jnp.ones(n, bool), index, jnp.zeros(n, rows.dtype)
    rows, _, order, pivots = lax.fori_loop(0, n, column, start)
    return rows[order, n:].reshape(right.shape), pivots


def times(A: Any, x: Any) -> jax.Array:
    """Return A x."""
    return A @ x if A.size > MAX_ROWS**2 else jnp.sum(A * x[None, :], axis=1)


def combine(weights: Any, rows: Any) -> jax.Array:
    """Return Σₖ weightsₖ rowsₖ."""
    if rows.size > MAX_ROWS**2:
        return weights @ rows
    return jnp.sum(weights[:, None] * rows, axis=0)


def product(A: jax.Array, B: jax.Array) -> jax.Array:
    """Return A B, for small matrices as a sum of products."""
    if A.size * B.shape[1] > MAX_ROWS**3:
        return A @ B
    return jnp.sum(A[:, :, None] * B[None, :, :], axis=1)


def pseudoinverse(rows: jax.Array) -> jax.Array:
    """Return the pseudoinverse of a matrix whose rows have length one or zero."""
    return as_pseudoinverse(lax.stop_gradient(_pseudoinverse(lax.stop_gradient(rows))), rows)


def _pseudoinverse(rows: jax.Array) -> jax.Array:
    """Return the pseudoinverse by adding the rows one by one (Greville 1960).

    A row adds its component orthogonal to the earlier ones; a row that depends on them is distributed
    over them. Matrices of many rows take an SVD.
    """
    m, n = rows.shape
    if m > 2 * MAX_ROWS or m == 0:
        return jnp.linalg.pinv(rows)
    eps, index = jnp.finfo(rows.dtype).eps, jnp.arange(m)

    def add_row(k: jax.Array, dual: jax.Array) -> jax.Array:
        # `dual` is the transpose of the pseudoinverse of the earlier rows, and zero on the others.
        row = rows[k]
        coefficients = times(dual, row)
        earlier = jnp.where((index < k)[:, None], rows, 0.0)
        rest = row - combine(coefficients, earlier)
        # The second pass removes the roundoff of the first.
        correction = times(dual, rest)
        coefficients, rest = coefficients + correction, rest - combine(correction, earlier)
        square = jnp.sum(rest * rest)
        is_independent = square > (1e3 * eps) ** 2
        spread = combine(coefficients, dual) / (1.0 + jnp.sum(coefficients * coefficients))
        new = jnp.where(is_independent, rest / jnp.where(is_independent, square, 1.0), spread)
        dual = dual - coefficients[:, None] * new[None, :]
        return jnp.where((index == k)[:, None], new[None, :], dual)

    return lax.fori_loop(0, m, add_row, jnp.zeros((m, n), rows.dtype)).T


@jax.custom_jvp
def as_pseudoinverse(inverse: jax.Array, rows: jax.Array) -> jax.Array:
    """Return `inverse`, which is the pseudoinverse of `rows`, with its derivative in `rows`."""
    return inverse


@as_pseudoinverse.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """Return B = A⁺ and dB = −B dA B + B Bᵀ dAᵀ (I − A B) + (I − B A) dAᵀ Bᵀ B, for a constant rank
    (Golub and Pereyra 1973)."""
    A, dA = primals[1], tangents[1]
    B = as_pseudoinverse(*primals)
    of_rows = product(product(B, B.T), dA.T - product(product(dA.T, A), B))
    of_columns = product(dA.T - product(B, product(A, dA.T)), product(B.T, B))
    return B, of_rows + of_columns - product(product(B, dA), B)
