"""An affine law of two unknowns on a box, by medians.

Given y₁, the second condition is met by y₂ = clip(−(q₂ + M₂₁y₁)/M₂₂), and what is left of the first is

    g(y₁) = M₁₁y₁ + M₁₂y₂(y₁) + q₁ = 0,   or the sign that a bound of y₁ asks for.

A clip is the median of its argument and of the two bounds; a multiple of a median, and what is added to
it, pass into it. So g is the median of three lines, one for y₂ on either bound and one for a free y₂,
of slopes M₁₁, M₁₁ and det M/M₂₂. Where these increase, the median of the lines is zero at the median of
their zeros, and y₁ is the clip of that. A slope of zero has its zero at infinity.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .written import AbstractWritten


class Medians(AbstractWritten):
    """F(y) = My + q for two unknowns, where M₁₁, M₂₂, det M > 0, or M is monotone."""

    M: jax.Array

    def find(self, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        M = self.M
        y = self._by_medians(*lax.stop_gradient((M, q, low, up)))
        held = lax.stop_gradient(self.held(y, q, low, up))
        # Once more on its face, for the derivative.
        (a, b), (c, d) = M
        ends = jnp.where(held < 0, low, jnp.where(held > 0, up, 0.0))
        free = (held[0] == 0) & (held[1] == 0)
        det = a * d - b * c
        unique = det > 8 * jnp.finfo(M.dtype).eps * (jnp.abs(a * d) + jnp.abs(b * c))
        det = jnp.where(free & unique, det, 1.0)
        first = jnp.where(free, (b * q[1] - d * q[0]) / det, _over(-(q[0] + b * ends[1]), a))
        second = jnp.where(free, (c * q[0] - a * q[1]) / det, _over(-(q[1] + c * ends[0]), d))
        again = jnp.where(held == 0, jnp.stack([first, second]), ends)
        # Where solutions fill a face, it has no equation for them.
        return jnp.where(jnp.isfinite(again) & (unique | ~free), again, y)

    def _by_medians(self, M: jax.Array, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        (a, b), (c, d) = M
        det = a * d - b * c
        first = jnp.clip(
            _median(
                _zero(a, q[0] + _times(b, low[1])),
                _zero(a, q[0] + _times(b, up[1])),
                _zero(det, d * q[0] - b * q[1]),
            ),
            low[0],
            up[0],
        )
        other = _median(
            _zero(d, q[1] + _times(c, low[0])),
            _zero(d, q[1] + _times(c, up[0])),
            _zero(det, a * q[1] - c * q[0]),
        )
        # From the first, but for d = 0, where y₂ jumps: then from an elimination of its own.
        second = jnp.where(d > 0.0, _zero(d, q[1] + c * first), other)
        return jnp.stack([first, jnp.clip(second, low[1], up[1])])


def _zero(slope: Any, offset: Any) -> Any:
    """Where slope · y + offset, which does not fall, is zero; infinite where it never is."""
    beyond = jnp.where(offset == 0.0, 0.0, -jnp.sign(offset) * jnp.inf)
    return jnp.where(slope > 0.0, -_over(offset, slope), beyond)


def _over(value: Any, slope: Any) -> Any:
    """value / slope, infinite for a slope of zero."""
    some = slope != 0.0
    return jnp.where(some, value / jnp.where(some, slope, 1.0), jnp.inf)


def _median(a: Any, b: Any, c: Any) -> Any:
    return jnp.clip(c, jnp.minimum(a, b), jnp.maximum(a, b))


def _times(coefficient: Any, end: Any) -> Any:
    """A bound at infinity has no weight where nothing couples."""
    return jnp.where(coefficient == 0.0, 0.0, coefficient * end)
