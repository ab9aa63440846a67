"""The law of firms that pool their units: merit order, in closed form."""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ...errors import input_error
from ...vi import RESULTS, AbstractSolver, Answer, FrozenVI

_MOST = 120
"""Rounds, of which sixty halve an interval of doubles to nothing."""


class MeritOrder(AbstractSolver):
    """The solution of VI(K, F) for F(y)ᵢ = aᵢyᵢ + b Q_f + qᵢ, i ∈ f, on a box, to rounding.

    Q_f = Σ_{i∈f} yᵢ is what the firm f of unit i makes. Given Q_f every unit is a clip,
    yᵢ = clip(−(qᵢ + bQ_f)/aᵢ, lowerᵢ, upperᵢ), so a firm is one scalar equation

        g_f(Q) = Σ_{i∈f} clip(−(qᵢ + bQ)/aᵢ, lowerᵢ, upperᵢ) − Q = 0,

    strictly falling and linear in pieces. Newton's method, all firms at once, starts from the guess and
    stops where a step ends in the piece that it was computed for, which is then solved exactly; a step
    that leaves the interval in which g_f is known to change its sign is replaced by its middle, so
    that nothing can cycle. From a guess nearby that is one to three rounds of n clips, and no matrix,
    where a factorisation of the free block takes n³/3 operations. The derivative is that of the last
    formula, with the held units held.

    **Arguments:** `slope`: a > 0, a vector; `coupling`: b > 0; `firms`: one row a unit and one column a
    firm, 1 where the unit belongs to the firm and else 0.

    **Raises:** `dvax.InputError` where K is not a box of as many unknowns. That F is of this form is
    the caller's word; what is found is put into F, and the result is `stalled` where it is no solution.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> from dvax.models.market import MeritOrder
    >>> firms = jnp.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    >>> a, b = jnp.array([1.0, 2.0, 1.0]), 1.0
    >>> F = lambda y, q: a * y + b * (firms @ (firms.T @ y)) + q
    >>> vi = dvax.solve_vi(F, dvax.sets.Box(0.0, 1.0), jnp.zeros(3), jnp.array([-5.0, -4.0, -1.0]),
    ...                    solver=MeritOrder(a, b, firms))
    >>> vi.y.tolist(), bool(vi.residual < 1e-12)
    ([1.0, 1.0, 0.5], True)

    ```
    """

    certifies: ClassVar[bool] = False

    slope: jax.Array
    coupling: Any
    firms: jax.Array

    def solve(self, vi: FrozenVI, y0: Any, tol: Any) -> Answer:
        ends = None if isinstance(y0, tuple) else vi.K.intervals(y0)
        if isinstance(y0, tuple) or ends is None or jnp.shape(y0) != jnp.shape(self.slope):
            raise input_error(
                "dvax.models.market.MeritOrder",
                f"a {type(vi.K).__name__} and a guess of another shape than {self.slope.shape}"
                if ends is not None
                else f"a {type(vi.K).__name__}, which is not a box",
                "every unit has a least and a greatest output, and a slope",
                "Use dvax.vi.Auto()",
            )
        q = vi.F(jnp.zeros_like(y0))
        z = self._unclipped(q, *ends, y0)
        y = vi.K.project(z, vi.space)
        w = lax.stop_gradient(_outward(vi.F(y), y, *ends))
        # What the largest terms of F may lose in rounding; F off its form leaves far more.
        size = (
            jnp.max(jnp.abs(q))
            + jnp.max(self.slope * jnp.abs(y))
            + self.coupling * jnp.sum(jnp.abs(y))
        )
        lost = jnp.max(jnp.abs(w)) <= 1e4 * jnp.finfo(q.dtype).eps * lax.stop_gradient(size)
        residual = vi.space.norm(w)
        result = RESULTS.where(lost, RESULTS.successful, RESULTS.stalled)
        result = RESULTS.where(jnp.isfinite(residual), result, RESULTS.nonfinite)
        one = jnp.asarray(1)
        return Answer(y, lax.stop_gradient(z), residual, one, result, 2 * one)

    def _unclipped(
        self, q: jax.Array, lower: jax.Array, upper: jax.Array, guess: jax.Array
    ) -> jax.Array:
        """−(q + bQ)/a with the Q of the solution."""
        held = lax.stop_gradient(self._held(*lax.stop_gradient((q, lower, upper, guess))))
        Q = self._made(q, lower, upper, held)
        return -(q + self.coupling * (self.firms @ Q)) / self.slope

    def _made(self, q: jax.Array, lower: jax.Array, upper: jax.Array, held: "_Held") -> jax.Array:
        """Q of every firm where these units are held: the zero of its piece of g."""
        firms, a = self.firms, self.slope
        free = jnp.where(held.free[:, None], firms, 0.0)
        bound = jnp.where(held.above, upper, lower)
        pushed = jnp.sum(free * (-q / a)[:, None] + (firms - free) * bound[:, None], axis=0)
        return pushed / (1.0 + self.coupling * jnp.sum(free / a[:, None], axis=0))

    def _held(self, q: jax.Array, lower: jax.Array, upper: jax.Array, guess: jax.Array) -> "_Held":
        """Which units are free, and which of the others are at their upper bound."""
        firms, a, b = self.firms, self.slope, self.coupling

        def at(Q: jax.Array) -> tuple[jax.Array, _Held]:
            z = -(q + b * (firms @ Q)) / a
            return z, _Held((z > lower) & (z < upper), z >= upper)

        def go_on(state: tuple) -> jax.Array:
            return state[-1] & (state[-2] < _MOST)

        def advance(state: tuple) -> tuple:
            Q, low, high, count, _ = state
            z, held = at(Q)
            excess = firms.T @ jnp.clip(z, lower, upper) - Q
            low, high = jnp.where(excess >= 0, Q, low), jnp.where(excess <= 0, Q, high)
            new = self._made(q, lower, upper, held)
            there = at(new)[1]
            # The zero of a piece that lies in it is the zero of g.
            moved = (there.free != held.free) | (there.above != held.above)
            solved = firms.T @ jnp.where(moved, 1.0, 0.0) == 0
            inside = (new > low) & (new < high)
            Q = jnp.where(solved | inside, new, 0.5 * (low + high))
            return Q, low, high, count + 1, ~jnp.all(solved)

        Q = firms.T @ jnp.clip(guess, lower, upper)
        start = (Q, firms.T @ lower, firms.T @ upper, jnp.asarray(0), jnp.asarray(True))
        return at(lax.while_loop(go_on, advance, start)[0])[1]


class _Held(NamedTuple):
    free: jax.Array
    above: jax.Array


def _outward(F: jax.Array, y: jax.Array, lower: jax.Array, upper: jax.Array) -> jax.Array:
    """The least w ∈ F + N_K(y) at a point y of the box."""
    w = jnp.where(y <= lower, jnp.minimum(F, 0.0), F)
    return jnp.where(y >= upper, jnp.where(y <= lower, 0.0, jnp.maximum(F, 0.0)), w)
