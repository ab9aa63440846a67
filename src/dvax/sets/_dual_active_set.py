"""Projection onto a polyhedron by the dual active-set method.

min ½‖x − z‖² subject to Nx ≤ b. Start at x = z with no active row. Choose the most violated row. Move
along the component of its normal orthogonal to the active rows and increase its multiplier, until the
row is satisfied (it then becomes active) or the multiplier of an active row reaches 0 (that row is
dropped, and the move continues). Every move increases the dual objective, so the method terminates.
If a violated row depends on active rows none of which can be dropped, no point satisfies all rows
(Goldfarb and Idnani 1983).

An interior-point method finds the face only to the square root of its tolerance where an active row
has a zero multiplier. This method finds the face exactly, and so the derivative on it.

The pseudoinverse B of the active rows is kept by rank-one updates. The only operations are products
of a matrix with a vector, which are fast under `vmap` and on accelerators.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._small_matrices import combine, times

SLACK = 0.75
"""A row is satisfied if its violation is at most eps^0.75 of its terms: 2e-12 in double precision."""


class Projection(NamedTuple):
    """The projection x, its active rows, their multipliers, and whether x is a valid projection.

    An active row may have the multiplier 0.
    """

    x: jax.Array
    active: jax.Array
    multiplier: jax.Array
    valid: jax.Array


class _State(NamedTuple):
    x: jax.Array
    dual: jax.Array  # B: N_A Bᵀ = I on the active rows A, zero on the others
    multiplier: jax.Array
    active: jax.Array
    row: jax.Array  # the current violated row, if `pending`
    pending: jax.Array
    violation: jax.Array
    failed: jax.Array
    count: jax.Array


def nearest_point(rows: jax.Array, bounds: jax.Array, z: jax.Array, size: jax.Array) -> Projection:
    """Return the projection of z onto {x : rows x ≤ bounds}.

    The rows have length one (or zero), and bounds may be +∞. `size` has one number a row: the
    magnitude of the terms that were subtracted to form its bound, for the roundoff tolerance.
    """
    m, n = rows.shape
    dtype = jnp.result_type(z)
    eps = jnp.finfo(dtype).eps
    finite = jnp.isfinite(bounds)
    size = jnp.where(finite, jnp.abs(bounds), 0.0) + size

    def slack(x: jax.Array) -> jax.Array:
        return jnp.where(finite, times(rows, x) - jnp.where(finite, bounds, 0.0), -jnp.inf)

    # At the apex of a cone x should be 0; its roundoff is relative to the norm of z.
    residue = eps ** (1.0 + SLACK) * jnp.linalg.norm(z)

    def tolerance(x: jax.Array) -> jax.Array:
        return eps**SLACK * (size + jnp.linalg.norm(x)) + residue

    def violations(x: jax.Array, active: jax.Array) -> jax.Array:
        violation = slack(x)
        return jnp.where(~active & (violation > tolerance(x)), violation, 0.0)

    def unfinished(s: _State) -> jax.Array:
        violated = s.pending | jnp.any(s.violation > 0)
        return violated & ~s.failed & (s.count < 50 + 10 * m)

    def advance(s: _State) -> _State:
        row = jnp.where(s.pending, s.row, jnp.argmax(s.violation))
        normal = rows[row]
        # The component of the normal orthogonal to the active rows. The second pass removes the
        # roundoff of the first.
        coefficients = times(s.dual, normal)
        direction = normal - combine(coefficients, _masked(s.active, rows))
        correction = times(s.dual, direction)
        coefficients = coefficients + correction
        direction = direction - combine(correction, _masked(s.active, rows))
        square = jnp.sum(direction * direction)
        independent = square > (1e3 * eps) ** 2

        full_step = jnp.where(independent, jnp.maximum(slack(s.x)[row], 0.0) / square, jnp.inf)
        decreasing = s.active & (coefficients > 10 * eps)
        divisor = jnp.where(decreasing, coefficients, 1.0)
        ratios = jnp.where(decreasing, s.multiplier / divisor, jnp.inf)
        dropped = jnp.argmin(ratios)
        smallest_ratio = ratios[dropped]
        step = jnp.minimum(full_step, smallest_ratio)
        failed = ~(step < jnp.inf)
        adds_row = full_step <= smallest_ratio

        # Masks instead of indexed updates, which compile to much longer code.
        is_row, is_dropped = index == row, (index == dropped) & ~adds_row
        multiplier = jnp.maximum(s.multiplier - step * coefficients, 0.0)
        multiplier = multiplier + jnp.where(is_row, step, 0.0)
        multiplier = jnp.where(is_dropped, 0.0, multiplier)
        x = s.x - jnp.where(independent, step, 0.0) * direction
        # Rank-one update of the pseudoinverse with the added row, or without the dropped one.
        dropped_dual = s.dual[dropped]
        length = jnp.where(adds_row, 1.0, jnp.sum(dropped_dual * dropped_dual))
        overlap = times(s.dual, dropped_dual) / length
        new_dual = jnp.where(adds_row, direction / square, dropped_dual)
        weights = jnp.where(adds_row, coefficients, overlap)
        dual = s.dual - weights[:, None] * new_dual[None, :]
        dual = jnp.where((is_row & adds_row)[:, None], new_dual[None, :], dual)
        dual = jnp.where(is_dropped[:, None], 0.0, dual)
        active = (s.active | (is_row & adds_row)) & ~is_dropped
        # Project back onto the active rows: this corrects the roundoff of a distant z.
        x = x - combine(jnp.where(active, slack(x), 0.0), dual)
        violation = violations(x, active)
        pending = ~adds_row
        return _State(x, dual, multiplier, active, row, pending, violation, failed, s.count + 1)

    none, index = jnp.zeros(m, bool), jnp.arange(m)
    start = _State(
        x=z,
        dual=jnp.zeros((m, n), dtype),
        multiplier=jnp.zeros(m, dtype),
        active=none,
        row=jnp.asarray(0),
        pending=jnp.asarray(False),
        violation=violations(z, none),
        failed=jnp.asarray(False),
        count=jnp.asarray(0),
    )
    end = lax.while_loop(unfinished, advance, start)
    # Check the optimality conditions: x in the set, z − x a nonnegative sum of active normals.
    multiplier = times(end.dual, z - end.x)
    magnitude = jnp.linalg.norm(z) + jnp.linalg.norm(end.x)
    kkt_tolerance = jnp.sqrt(eps) * 1e-2 * magnitude  # well above the accumulated roundoff
    residual = z - end.x - combine(multiplier, _masked(end.active, rows))
    stationary = jnp.linalg.norm(residual) <= kkt_tolerance
    feasible = jnp.all(~(slack(end.x) > 2.0 * tolerance(end.x)))
    nonnegative = jnp.all(multiplier >= -kkt_tolerance)
    valid = feasible & stationary & nonnegative & ~end.failed & jnp.isfinite(magnitude)
    active = end.active | (jnp.abs(slack(end.x)) <= tolerance(end.x))
    return Projection(end.x, active, jnp.where(end.active, end.multiplier, 0.0), valid)


def _masked(mask: jax.Array, rows: jax.Array) -> jax.Array:
    return jnp.where(mask[:, None], rows, 0.0)
