"""An affine law on a box of a few unknowns, solved by a formula.

For two unknowns, by medians (`Medians`). Given y₁, the second condition is met by
y₂ = clip(−(q₂ + M₂₁y₁)/M₂₂), and what is left of the first is

    g(y₁) = M₁₁y₁ + M₁₂y₂(y₁) + q₁ = 0,   or the sign that a bound of y₁ asks for.

A clip is the median of its argument and of the two bounds; a multiple of a median, and what is added to
it, pass into it. So g is the median of three lines, one for y₂ on either bound and one for a free y₂,
of slopes M₁₁, M₁₁ and det M/M₂₂. Where these increase, the median of the lines is zero at the median of
their zeros, and y₁ is the clip of that. A slope of zero has its zero at infinity.

For three and four unknowns, face by face (`Faces`). On the face where the entries of a set B sit on
their bounds and the others are free, the conditions yᵢ = boundᵢ (i in B), (My + q)ᵢ = 0 (others) are
linear: y = Gr with r made of the bounds and of −q. The G of all 3ⁿ faces are computed once a run. An
evaluation is then a few products, and the face whose point satisfies the law is the one whose natural
residual is zero.
"""

import abc
import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

MOST_UNKNOWNS = 4


def is_small(like: Any) -> bool:
    """Return whether a law for elements like this one has few enough unknowns."""
    return isinstance(like, jax.Array) and 1 < like.size <= MOST_UNKNOWNS


def small_box(M: jax.Array) -> "AbstractSmallBox":
    """Return the formula for F(y) = My + q."""
    return Medians(M) if len(M) == 2 else faces(M)


class Point(NamedTuple):
    """The solution y, z = y − τF(y) with proj(z) = y, both up to rounding, and w in F(z̄) + N_K(z̄) at
    z̄ = proj(z), which is of the size of rounding."""

    y: jax.Array
    z: jax.Array
    w: jax.Array


class AbstractSmallBox(eqx.Module):
    """F(y) = My + q on boxes, where M does not change."""

    M: eqx.AbstractVar[jax.Array]

    @abc.abstractmethod
    def find(self, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        """y for vectors q and bounds, up to rounding. Its derivative is that of the face that
        z = y − F(y) lies over, an entry on its bound counting as held."""

    def solve(self, q: jax.Array, low: jax.Array, up: jax.Array) -> Point:
        """The solution for this q and these bounds, of any shape."""
        shape, M = q.shape, self.M
        q, low, up = q.ravel(), low.ravel(), up.ravel()
        # An entry that is held is its bound, to the last digit.
        y = jnp.clip(self.find(q, low, up), low, up)
        # A step of at most 1/‖M‖, or what rounding leaves of F would be taken for z.
        tau = 1.0 / jnp.maximum(1.0, jnp.max(jnp.sum(jnp.abs(M), axis=1)))
        z = y - tau * (M @ y + q)
        near = jnp.clip(z, low, up)
        # (z − near)/τ is in N_K(near), and F(near) + (z − near)/τ is:
        w = (y - near) / tau + M @ (near - y)
        return Point(y.reshape(shape), z.reshape(shape), w.reshape(shape))

    def held(self, y: jax.Array, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        """−1 and 1 for an entry that z = y − F(y) has on its lower or upper bound, 0 for a free one."""
        z, slack = y - (self.M @ y + q), 8 * self.rounding(y, q)
        return jnp.where(z <= low + slack, -1, jnp.where(z >= up - slack, 1, 0))

    def rounding(self, y: jax.Array, q: jax.Array) -> jax.Array:
        """What My + q, entry by entry, cannot be told from zero by."""
        y = jnp.abs(y.ravel())
        return jnp.finfo(q.dtype).eps * (jnp.abs(q.ravel()) + jnp.abs(self.M) @ y + y)


class Faces(AbstractSmallBox):
    """F(y) = My + q on boxes of n unknowns, where M does not change; `pieces` holds G face by face."""

    M: jax.Array
    pieces: jax.Array

    def find(self, q: jax.Array, low: jax.Array, up: jax.Array) -> jax.Array:
        M, side = self.M, jnp.asarray(sides(q.size))
        right = jnp.where(side < 0, low[None], jnp.where(side > 0, up[None], -q[None]))
        there = jnp.all(jnp.isfinite(right), axis=1)
        # A bound at infinity has no face.
        right = jnp.where(jnp.isfinite(right), right, 0.0)
        # Nor has one where its matrix is singular.
        sound = jnp.all(jnp.isfinite(self.pieces), axis=(1, 2))
        there, pieces = there & sound, jnp.where(sound[:, None, None], self.pieces, 0.0)
        # Sums of products, for what are so few numbers: a product of matrices is a call of a library.
        points = jnp.sum(pieces * right[:, None, :], axis=2)
        F = jnp.sum(M[None] * points[:, None, :], axis=2) + q[None]
        off = jnp.max(jnp.abs(points - jnp.clip(points - F, low[None], up[None])), axis=1)
        off = lax.stop_gradient(jnp.where(there & ~jnp.isnan(off), off, jnp.inf))
        first = jnp.argmin(off)
        best = points[first]
        held = self.held(best, q, low, up)
        index = jnp.sum((held + 1) * 3 ** jnp.arange(q.size)[::-1])
        # Over that face, where it has the solution as well.
        slack = 8 * self.rounding(best, q)
        return points[jnp.where(off[index] <= off[first] + jnp.min(slack), index, first)]


def sides(n: int) -> np.ndarray:
    """All faces of a box: −1 and 1 for an entry on its lower or upper bound, 0 for a free one."""
    return np.array(list(itertools.product((-1, 0, 1), repeat=n)))


def faces(M: jax.Array) -> Faces:
    """The pieces for this M."""
    n = len(M)
    side, eye = jnp.asarray(sides(n)), jnp.eye(n, dtype=M.dtype)
    rows = jnp.where((side == 0)[:, :, None], M[None], eye[None])
    return Faces(M, jnp.linalg.inv(rows))


class Medians(AbstractSmallBox):
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
