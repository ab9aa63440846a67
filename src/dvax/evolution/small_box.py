"""Solution formulas for an affine law on a box of two to four unknowns.

`Medians` solves for two unknowns. For a given y₁ the second condition gives
y₂ = clip(−(q₂ + M₂₁y₁)/M₂₂). Substitute it into the first condition:

    g(y₁) = M₁₁y₁ + M₁₂y₂(y₁) + q₁ = 0,   or the sign condition at a bound of y₁.

A clip is the median of its argument and of the two bounds. Multiples of a median and sums with a median
are medians too, so g is the median of three lines: two for y₂ at a bound, of slope M₁₁, and one for a
free y₂, of slope det M/M₂₂. If the lines increase, their median is zero at the median of their zeros,
and y₁ is the clip of that. A line of slope zero has its zero at infinity.

`Faces` solves for three and four unknowns by enumeration of the faces. On the face where the entries in
a set B are at their bounds and the others are free, the conditions yᵢ = boundᵢ (i in B), (My + q)ᵢ = 0
(others) are linear: y = Gr with r made of the bounds and of −q. The G of all 3ⁿ faces are computed once
per run. An evaluation takes a few products and selects the face with the smallest natural residual.
"""

import abc
import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

MAX_UNKNOWNS = 4


def is_small(like: Any) -> bool:
    """Return whether a law for elements like this one has two to four unknowns."""
    return isinstance(like, jax.Array) and 1 < like.size <= MAX_UNKNOWNS


def small_box(M: jax.Array) -> "AbstractSmallBox":
    """Return the formula for F(y) = My + q."""
    return Medians(M) if len(M) == 2 else faces(M)


class Point(NamedTuple):
    """A solution of the law.

    - `y`: the solution, up to roundoff;
    - `z`: y − τF(y), so that proj(z) = y up to roundoff;
    - `w`: an element of F(z̄) + N_K(z̄) at z̄ = proj(z), of the size of roundoff.
    """

    y: jax.Array
    z: jax.Array
    w: jax.Array


class AbstractSmallBox(eqx.Module):
    """A formula for F(y) = My + q on boxes with a fixed matrix M."""

    M: eqx.AbstractVar[jax.Array]

    @abc.abstractmethod
    def find(self, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        """Return y for vectors q and bounds, up to roundoff.

        Its derivative is that of the face onto which z = y − F(y) is projected. An entry of z exactly
        at its bound counts as active.
        """

    def solve(self, q: jax.Array, low: jax.Array, up: jax.Array) -> Point:
        """Return the solution for q and bounds of any shape."""
        shape, M = q.shape, self.M
        q, low, up = q.ravel(), low.ravel(), up.ravel()
        # Make active entries exactly equal to their bounds.
        y = jnp.clip(self.find(q, low, up), low, up)
        # With τ ≤ 1/‖M‖ the roundoff of F does not dominate z.
        tau = 1.0 / jnp.maximum(1.0, jnp.max(jnp.sum(jnp.abs(M), axis=1)))
        z = y - tau * (M @ y + q)
        projection = jnp.clip(z, low, up)
        # (z − projection)/τ is in N_K(projection), and F(projection) + (z − projection)/τ equals:
        w = (y - projection) / tau + M @ (projection - y)
        return Point(y.reshape(shape), z.reshape(shape), w.reshape(shape))

    def active_bounds(self, y: jax.Array, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        """Return −1 or 1 for entries of z = y − F(y) at or beyond the lower or upper bound, else 0."""
        z, slack = y - (self.M @ y + q), 8 * self.rounding(y, q)
        return jnp.where(z <= low + slack, -1, jnp.where(z >= up - slack, 1, 0))

    def rounding(self, y: jax.Array, q: jax.Array) -> jax.Array:
        """Return the roundoff error of My + q, entry by entry."""
        y = jnp.abs(y.ravel())
        return jnp.finfo(q.dtype).eps * (jnp.abs(q.ravel()) + jnp.abs(self.M) @ y + y)


class Faces(AbstractSmallBox):
    """The formula for n unknowns by enumeration; `inverses` holds the matrix G of each face."""

    M: jax.Array
    inverses: jax.Array

    def find(self, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        M, side = self.M, jnp.asarray(sides(q.size))
        right = jnp.where(side < 0, low[None], jnp.where(side > 0, up[None], -q[None]))
        # Exclude faces at infinite bounds.
        exists = jnp.all(jnp.isfinite(right), axis=1)
        right = jnp.where(jnp.isfinite(right), right, 0.0)
        # Exclude faces with a singular matrix.
        is_regular = jnp.all(jnp.isfinite(self.inverses), axis=(1, 2))
        exists = exists & is_regular
        inverses = jnp.where(is_regular[:, None, None], self.inverses, 0.0)
        # Sums of products instead of matrix products, which would call a library for a few numbers.
        points = jnp.sum(inverses * right[:, None, :], axis=2)
        F = jnp.sum(M[None] * points[:, None, :], axis=2) + q[None]
        residual = jnp.max(jnp.abs(points - jnp.clip(points - F, low[None], up[None])), axis=1)
        is_valid = exists & ~jnp.isnan(residual)
        residual = lax.stop_gradient(jnp.where(is_valid, residual, jnp.inf))
        first = jnp.argmin(residual)
        best = points[first]
        active = self.active_bounds(best, q, low, up)
        index = jnp.sum((active + 1) * 3 ** jnp.arange(q.size)[::-1])
        # Prefer the face of the active bounds, for its derivative, if its point solves the law too.
        slack = 8 * self.rounding(best, q)
        return points[jnp.where(residual[index] <= residual[first] + jnp.min(slack), index, first)]


def sides(n: int) -> np.ndarray:
    """Return all faces of a box: −1 or 1 for an entry at its lower or upper bound, 0 for a free one."""
    return np.array(list(itertools.product((-1, 0, 1), repeat=n)))


def faces(M: jax.Array) -> Faces:
    """Return the formula by faces for this M."""
    n = len(M)
    side, eye = jnp.asarray(sides(n)), jnp.eye(n, dtype=M.dtype)
    rows = jnp.where((side == 0)[:, :, None], M[None], eye[None])
    return Faces(M, jnp.linalg.inv(rows))


class Medians(AbstractSmallBox):
    """The formula for two unknowns, for M₁₁, M₂₂, det M > 0 or for monotone M."""

    M: jax.Array

    def find(self, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        M = self.M
        y = self._by_medians(*lax.stop_gradient((M, q, low, up)))
        active = lax.stop_gradient(self.active_bounds(y, q, low, up))
        # Solve again on the face of the solution, for the derivative.
        (a, b), (c, d) = M
        ends = jnp.where(active < 0, low, jnp.where(active > 0, up, 0.0))
        free = (active[0] == 0) & (active[1] == 0)
        det = a * d - b * c
        unique = det > 8 * jnp.finfo(M.dtype).eps * (jnp.abs(a * d) + jnp.abs(b * c))
        det = jnp.where(free & unique, det, 1.0)
        first = jnp.where(free, (b * q[1] - d * q[0]) / det, _divide(-(q[0] + b * ends[1]), a))
        second = jnp.where(free, (c * q[0] - a * q[1]) / det, _divide(-(q[1] + c * ends[0]), d))
        new = jnp.where(active == 0, jnp.stack([first, second]), ends)
        # If the solution on the face is not unique, keep the first one.
        return jnp.where(jnp.isfinite(new) & (unique | ~free), new, y)

    def _by_medians(self, M: jax.Array, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        (a, b), (c, d) = M
        det = a * d - b * c
        first = jnp.clip(
            _median(
                _root(a, q[0] + _multiply(b, low[1])),
                _root(a, q[0] + _multiply(b, up[1])),
                _root(det, d * q[0] - b * q[1]),
            ),
            low[0],
            up[0],
        )
        other = _median(
            _root(d, q[1] + _multiply(c, low[0])),
            _root(d, q[1] + _multiply(c, up[0])),
            _root(det, a * q[1] - c * q[0]),
        )
        # Compute y₂ from y₁. If d = 0, y₂ is not a function of y₁: eliminate y₁ instead.
        second = jnp.where(d > 0.0, _root(d, q[1] + c * first), other)
        return jnp.stack([first, jnp.clip(second, low[1], up[1])])


def _root(slope: Any, offset: Any) -> Any:
    """Return the zero of slope · y + offset for slope ≥ 0, or ±∞ if it has none."""
    infinite = jnp.where(offset == 0.0, 0.0, -jnp.sign(offset) * jnp.inf)
    return jnp.where(slope > 0.0, -_divide(offset, slope), infinite)


def _divide(value: Any, slope: Any) -> Any:
    """Return value / slope, ∞ for a slope of zero."""
    is_divisible = slope != 0.0
    return jnp.where(is_divisible, value / jnp.where(is_divisible, slope, 1.0), jnp.inf)


def _median(a: Any, b: Any, c: Any) -> Any:
    return jnp.clip(c, jnp.minimum(a, b), jnp.maximum(a, b))


def _multiply(coefficient: Any, end: Any) -> Any:
    """Return the product, with 0 · ∞ = 0."""
    return jnp.where(coefficient == 0.0, 0.0, coefficient * end)
