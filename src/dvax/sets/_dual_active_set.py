"""The point of a polyhedron nearest to a given one, by the dual active-set method.

min ½‖x − z‖² subject to Nx ≤ b. Start at x = z with no row held. Take the row violated most; move
along its part normal to the rows held, raising its multiplier, until it is satisfied (it is then
held as well) or the multiplier of a held row has fallen to 0 (it is let go, and the move goes on).
Every move raises the dual objective, so the method ends; where a violated row depends on held rows
none of which can be let go, no point satisfies them all (Goldfarb and Idnani 1983).

Against interior-point methods: the face is found exactly, so that a row held without force costs no
accuracy (an interior point is then only within √tolerance), and so is its derivative.

The held rows' pseudoinverse B is carried along by updates of rank one: all there is to do are
products of a matrix with a vector, which run well under `vmap` and on accelerators.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

SLACK = 0.75
"""A row holds where it does to eps^0.75 of what enters it: 2e-12 in double precision."""


class Found(NamedTuple):
    """x; the rows that hold it, with force or without; their forces; whether x is right."""

    x: jax.Array
    held: jax.Array
    force: jax.Array
    good: jax.Array


class _State(NamedTuple):
    x: jax.Array
    dual: jax.Array  # B: N_A Bᵀ = I on the held rows A, zero on the others
    force: jax.Array  # multipliers
    held: jax.Array
    row: jax.Array  # the row being worked on, where `pending`
    pending: jax.Array
    violation: jax.Array
    failed: jax.Array
    count: jax.Array


def nearest(rows: jax.Array, bounds: jax.Array, z: jax.Array, size: jax.Array) -> Found:
    """The projection of z, for rows of length one (or zero) and bounds that may be +∞.

    `size` has one number a row: what its bound has lost digits against, besides itself.
    """
    m, n = rows.shape
    dtype = jnp.result_type(z)
    eps = jnp.finfo(dtype).eps
    finite = jnp.isfinite(bounds)
    size = jnp.where(finite, jnp.abs(bounds), 0.0) + size

    def slack(x: jax.Array) -> jax.Array:
        return jnp.where(finite, rows @ x - jnp.where(finite, bounds, 0.0), -jnp.inf)

    # At the apex of a cone x is 0, and what is left of z in it is rounding of rounding.
    residue = eps ** (1.0 + SLACK) * jnp.linalg.norm(z)

    def tolerance(x: jax.Array) -> jax.Array:
        return eps**SLACK * (size + jnp.linalg.norm(x)) + residue

    def violations(x: jax.Array, held: jax.Array) -> jax.Array:
        above = slack(x)
        return jnp.where(~held & (above > tolerance(x)), above, 0.0)

    def unfinished(s: _State) -> jax.Array:
        todo = s.pending | jnp.any(s.violation > 0)
        return todo & ~s.failed & (s.count < 50 + 10 * m)

    def advance(s: _State) -> _State:
        row = jnp.where(s.pending, s.row, jnp.argmax(s.violation))
        normal = rows[row]
        # The part of the normal across the held rows; taken twice, it is so to rounding.
        share = s.dual @ normal
        across = normal - share @ _only(s.held, rows)
        again = s.dual @ across
        share, across = share + again, across - again @ _only(s.held, rows)
        square = across @ across
        independent = square > (1e3 * eps) ** 2

        full = jnp.where(independent, jnp.maximum(slack(s.x)[row], 0.0) / square, jnp.inf)
        falls = s.held & (share > 10 * eps)
        ratios = jnp.where(falls, s.force / jnp.where(falls, share, 1.0), jnp.inf)
        leaving = jnp.argmin(ratios)
        step = jnp.minimum(full, ratios[leaving])
        failed = ~(step < jnp.inf)
        adding = full <= ratios[leaving]

        force = jnp.maximum(s.force - step * share, 0.0).at[row].add(step)
        x = s.x - jnp.where(independent, step, 0.0) * across
        new = across / square
        grown = (s.dual - jnp.outer(share, new)).at[row].set(new)
        out = s.dual[leaving]
        along = s.dual @ out / jnp.where(adding, 1.0, out @ out)
        shrunk = (s.dual - jnp.outer(along, out)).at[leaving].set(0.0)
        held = jnp.where(adding, s.held.at[row].set(True), s.held.at[leaving].set(False))
        dual = jnp.where(adding, grown, shrunk)
        force = jnp.where(adding, force, force.at[leaving].set(0.0))
        # Back onto the held rows: what rounding lost of a far-away z is seen from nearby.
        x = x - jnp.where(held, slack(x), 0.0) @ dual
        violation = violations(x, held)
        return _State(x, dual, force, held, row, ~adding, violation, failed, s.count + 1)

    none = jnp.zeros(m, bool)
    start = _State(
        x=z,
        dual=jnp.zeros((m, n), dtype),
        force=jnp.zeros(m, dtype),
        held=none,
        row=jnp.asarray(0),
        pending=jnp.asarray(False),
        violation=violations(z, none),
        failed=jnp.asarray(False),
        count=jnp.asarray(0),
    )
    end = lax.while_loop(unfinished, advance, start)
    # Checked from the conditions alone: in the set, and z − x a nonnegative sum of held normals.
    force = end.dual @ (z - end.x)
    reach = jnp.linalg.norm(z) + jnp.linalg.norm(end.x)
    loose = jnp.sqrt(eps) * 1e-2 * reach  # a sum of rounding errors, far below any mistake
    balanced = jnp.linalg.norm(z - end.x - force @ _only(end.held, rows)) <= loose
    inside = jnp.all(~(slack(end.x) > 2.0 * tolerance(end.x)))
    pushing = jnp.all(force >= -loose)
    good = inside & balanced & pushing & ~end.failed & jnp.isfinite(reach)
    held = end.held | (jnp.abs(slack(end.x)) <= tolerance(end.x))
    return Found(end.x, held, jnp.where(end.held, end.force, 0.0), good)


def _only(mask: jax.Array, rows: jax.Array) -> jax.Array:
    return jnp.where(mask[:, None], rows, 0.0)
