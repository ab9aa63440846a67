"""Projection onto a polyhedron by the dual active-set method.

min ½‖x − z‖² subject to Nx ≤ b. Start at x = z with no active row. Choose the most violated row. Move
along the component of its normal orthogonal to the active rows and increase its multiplier, until the
row is satisfied (it then becomes active) or the multiplier of an active row reaches 0 (that row is
dropped, and the move continues). Every move increases the dual objective, so the method terminates.
If a violated row depends on active rows none of which can be dropped, no point satisfies all rows
(Goldfarb and Idnani 1983).

An interior-point method finds the face only to the square root of its tolerance where an active row
has a zero multiplier. This method finds the face exactly, and so the derivative on it.

Rows that hold with equality at the end are active too, with the multiplier 0: the same loop adds them
last, without a move. So it returns the pseudoinverse B of all active rows, and I − BN is the derivative
of the projection. The pseudoinverse is kept by rank-one updates (Greville 1960 for rows that depend on
others). The only operations are products of a matrix with a vector, which are fast under `vmap` and on
accelerators.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._small_matrices import combine, times

SLACK = 0.75
"""A row holds with equality if its slack is at most eps^0.75 of its terms: 2e-12 in double precision.
A violation of this size counts only if the row is far enough from a combination of active rows."""

_INDEPENDENT = 1e-11
"""Length of the component of a normal orthogonal to the active normals, from which on violations above
roundoff count: the normals of rows at a smaller angle may differ by roundoff alone."""


class Projection(NamedTuple):
    """The projection x, its active rows, their multipliers, the transposed pseudoinverse of the active
    rows (zero for the others), and whether x is a valid projection.

    An active row may have the multiplier 0.
    """

    x: jax.Array
    active: jax.Array
    multiplier: jax.Array
    dual: jax.Array
    valid: jax.Array


class _State(NamedTuple):
    """`row` is the next row to add. Its `priority` is ∞ if the move towards it was interrupted, its
    violation, 0 if it holds with equality, and −∞ if no row is left."""

    x: jax.Array
    dual: jax.Array
    multiplier: jax.Array
    active: jax.Array
    row: jax.Array
    priority: jax.Array
    count: jax.Array


def nearest_point(rows: jax.Array, bounds: jax.Array, z: jax.Array, size: jax.Array) -> Projection:
    """Return the projection of z onto {x : rows x ≤ bounds}.

    The rows have length one (or zero). `size` has one number a row: the magnitude of the terms that
    were subtracted to form its bound, for the roundoff tolerance.
    """
    m, n = rows.shape
    dtype = jnp.result_type(z)
    eps, index = jnp.finfo(dtype).eps, jnp.arange(m, dtype=jnp.uint32)
    # At the apex of a cone x should be 0; its roundoff is relative to the norm of z.
    length_z = _norm(z)
    absolute = eps**SLACK * (jnp.abs(bounds) + size) + eps ** (1.0 + SLACK) * length_z

    def slack(x: jax.Array) -> jax.Array:
        return times(rows, x) - bounds

    def tolerance(x: jax.Array) -> jax.Array:
        return absolute + eps**SLACK * _norm(x)

    def roundoff(x: jax.Array) -> jax.Array:
        terms = jnp.abs(bounds) + size + _norm(x) + eps**SLACK * length_z
        return 4 * (8 + n) * eps * terms

    def next_row(x: jax.Array, active: jax.Array, multiplier: jax.Array) -> tuple:
        excess = slack(x)
        tied = jnp.where(excess >= -tolerance(x), 0.0, -jnp.inf)
        priority = jnp.where(excess > roundoff(x), excess, tied)
        priority = jnp.where(multiplier > 0, jnp.inf, priority)
        priority = jnp.where(active, -jnp.inf, priority)
        row = lax.argmax(priority, 0, jnp.uint32)
        return row, _entry(priority, row)

    def unfinished(s: _State) -> jax.Array:
        return (s.priority > -jnp.inf) & (s.count < 50 + 10 * m)

    def advance(s: _State) -> _State:
        normal, bound = _entry(rows, s.row), _entry(bounds, s.row)
        # The component of the normal orthogonal to the active rows. The second pass removes the
        # roundoff of the first. (Inactive rows have coefficients 0.)
        coefficients = times(s.dual, normal)
        direction = normal - combine(coefficients, rows)
        correction = times(s.dual, direction)
        coefficients = coefficients + correction
        direction = direction - combine(correction, rows)
        square = jnp.sum(direction * direction)
        is_independent = square > (1e3 * eps) ** 2

        excess = jnp.maximum(jnp.sum(normal * s.x) - bound, 0.0)
        counts = (square > _INDEPENDENT**2) | (excess > _entry(tolerance(s.x), s.row))
        violated = (s.priority > 0) & counts
        full_step = jnp.where(is_independent, excess / square, jnp.inf)
        full_step = jnp.where(violated, full_step, 0.0)
        ratios = jnp.where(coefficients > 10 * eps, s.multiplier / coefficients, jnp.inf)
        dropped = lax.argmin(ratios, 0, jnp.uint32)
        smallest_ratio = _entry(ratios, dropped)
        step = jnp.minimum(full_step, smallest_ratio)
        adds_row = full_step <= smallest_ratio
        failed = ~(step < jnp.inf)

        # Masks instead of indexed updates, which compile to much longer code.
        is_added, is_dropped = (index == s.row) & adds_row, (index == dropped) & ~adds_row
        multiplier = jnp.maximum(s.multiplier - step * coefficients, 0.0)
        multiplier = multiplier + jnp.where(index == s.row, step, 0.0)
        multiplier = jnp.where(is_dropped, 0.0, multiplier)
        # Rank-one update of the pseudoinverse with the added row, or without the dropped one.
        dropped_dual = _entry(s.dual, dropped)
        spread = combine(coefficients, s.dual) / (1.0 + jnp.sum(coefficients * coefficients))
        new_dual = jnp.where(is_independent, direction / square, spread)
        new_dual = jnp.where(adds_row, new_dual, dropped_dual)
        overlap = times(s.dual, dropped_dual) / jnp.sum(dropped_dual * dropped_dual)
        weights = jnp.where(adds_row, coefficients, overlap)
        dual = s.dual - weights[:, None] * new_dual[None, :]
        dual = jnp.where(is_added[:, None], new_dual[None, :], dual)
        dual = jnp.where(is_dropped[:, None], 0.0, dual)
        active = (s.active | is_added) & ~is_dropped
        x = s.x - jnp.where(is_independent, step, 0.0) * direction
        # Project back onto the active rows: this corrects the roundoff of a distant z.
        x = jnp.where(violated, x - combine(slack(x), dual), s.x)
        row, priority = next_row(x, active, multiplier)
        priority = jnp.where(failed, -jnp.inf, priority)
        return _State(x, dual, multiplier, active, row, priority, s.count + 1)

    none, zero = jnp.zeros(m, bool), jnp.zeros(m, dtype)
    row, priority = next_row(z, none, zero)
    start = _State(z, jnp.zeros((m, n), dtype), zero, none, row, priority, jnp.asarray(0))
    end = lax.while_loop(unfinished, advance, start)
    # Check the optimality conditions: x in the set, z − x a nonnegative sum of active normals.
    size = length_z + _norm(end.x)
    residual = _norm(z - end.x - combine(end.multiplier, rows))
    # The limit is well above the accumulated roundoff.
    stationary = (residual <= jnp.sqrt(eps) * 1e-2 * size) & (size < jnp.inf)
    feasible = jnp.all(slack(end.x) <= 2.0 * tolerance(end.x))
    return Projection(end.x, end.active, end.multiplier, end.dual, feasible & stationary)


def _entry(array: jax.Array, index: jax.Array) -> jax.Array:
    return lax.dynamic_index_in_dim(array, index, keepdims=False)


def _norm(x: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(x * x))
