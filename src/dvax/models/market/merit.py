"""A finite solver for the law of firms with several units, by merit order."""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ...errors import input_error
from ...vi import RESULTS, AbstractSolver, Answer, FrozenVI

_MAX_ITERATIONS = 120
"""Twice the number of bisections that reduce an interval to adjacent floating-point numbers."""


class MeritOrder(AbstractSolver):
    """Solve VI(K, F) for F(y)ᵢ = aᵢyᵢ + b Q_f + qᵢ, i ∈ f, on a box, to roundoff.

    Q_f = Σ_{i∈f} yᵢ is the output of the firm f of unit i. Given Q_f, every unit is a clip,
    yᵢ = clip(−(qᵢ + bQ_f)/aᵢ, lowerᵢ, upperᵢ), so each firm has one scalar equation

        g_f(Q) = Σ_{i∈f} clip(−(qᵢ + bQ)/aᵢ, lowerᵢ, upperᵢ) − Q = 0,

    which is strictly decreasing and piecewise linear. Newton's method, for all firms at once, starts
    from the guess. It terminates when a step ends in the linear piece for which it was computed, and is
    then exact. A step that leaves the bracketing interval is replaced by bisection, which excludes
    cycles. From a close guess this takes one to three iterations of n clips, without a matrix, whereas
    a factorisation of the inactive block takes n³/3 operations. The derivative is that of the final
    formula with fixed active units.

    **Arguments:** `slope`: a > 0, a vector; `coupling`: b > 0; `firms`: a matrix with one row a
    unit and one column a firm, 1 if the unit belongs to the firm and else 0.

    **Raises:** `dvax.InputError` if K is not a box with this number of unknowns. The caller must ensure
    that F has this form. The solution is verified with F, and the result is `stalled` if it fails.

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
                "K must be a box, with one unknown for each entry of slope",
                "Use dvax.vi.Auto()",
            )
        q = vi.F(jnp.zeros_like(y0))
        z = self._unclipped(q, *ends, y0)
        y = vi.K.project(z, vi.space)
        w = lax.stop_gradient(_smallest_residual(vi.F(y), y, *ends))
        # The roundoff of the largest terms of F; an F of another form has a much larger residual.
        size = (
            jnp.max(jnp.abs(q))
            + jnp.max(self.slope * jnp.abs(y))
            + self.coupling * jnp.sum(jnp.abs(y))
        )
        solved = jnp.max(jnp.abs(w)) <= 1e4 * jnp.finfo(q.dtype).eps * lax.stop_gradient(size)
        residual = vi.space.norm(w)
        result = RESULTS.where(solved, RESULTS.successful, RESULTS.stalled)
        result = RESULTS.where(jnp.isfinite(residual), result, RESULTS.nonfinite)
        one = jnp.asarray(1)
        return Answer(y, lax.stop_gradient(z), residual, one, result, 2 * one)

    def _unclipped(
        self, q: jax.Array, lower: jax.Array, upper: jax.Array, guess: jax.Array
    ) -> jax.Array:
        """Return −(q + bQ)/a with the Q of the solution."""
        active = lax.stop_gradient(self._active_set(*lax.stop_gradient((q, lower, upper, guess))))
        Q = self._output(q, lower, upper, active)
        return -(q + self.coupling * (self.firms @ Q)) / self.slope

    def _output(
        self, q: jax.Array, lower: jax.Array, upper: jax.Array, active: "_ActiveSet"
    ) -> jax.Array:
        """Return Q of every firm for a fixed active set: the zero of the linear piece of g."""
        firms, a = self.firms, self.slope
        inactive = jnp.where(active.inactive[:, None], firms, 0.0)
        bound = jnp.where(active.upper, upper, lower)
        total = jnp.sum(inactive * (-q / a)[:, None] + (firms - inactive) * bound[:, None], axis=0)
        return total / (1.0 + self.coupling * jnp.sum(inactive / a[:, None], axis=0))

    def _active_set(
        self, q: jax.Array, lower: jax.Array, upper: jax.Array, guess: jax.Array
    ) -> "_ActiveSet":
        """Return the active set of the solution."""
        firms, a, b = self.firms, self.slope, self.coupling

        def at(Q: jax.Array) -> tuple[jax.Array, _ActiveSet]:
            z = -(q + b * (firms @ Q)) / a
            return z, _ActiveSet((z > lower) & (z < upper), z >= upper)

        def unfinished(state: tuple) -> jax.Array:
            return state[-1] & (state[-2] < _MAX_ITERATIONS)

        def advance(state: tuple) -> tuple:
            Q, low, high, count, _ = state
            z, active = at(Q)
            excess = firms.T @ jnp.clip(z, lower, upper) - Q
            low, high = jnp.where(excess >= 0, Q, low), jnp.where(excess <= 0, Q, high)
            new = self._output(q, lower, upper, active)
            new_active = at(new)[1]
            # If the zero of a linear piece lies in that piece, it is the zero of g.
            changed = (new_active.inactive != active.inactive) | (new_active.upper != active.upper)
            solved = firms.T @ jnp.where(changed, 1.0, 0.0) == 0
            inside = (new > low) & (new < high)
            Q = jnp.where(solved | inside, new, 0.5 * (low + high))
            return Q, low, high, count + 1, ~jnp.all(solved)

        Q = firms.T @ jnp.clip(guess, lower, upper)
        start = (Q, firms.T @ lower, firms.T @ upper, jnp.asarray(0), jnp.asarray(True))
        return at(lax.while_loop(unfinished, advance, start)[0])[1]


class _ActiveSet(NamedTuple):
    """Which units are at no bound, and which are at their upper bound."""

    inactive: jax.Array
    upper: jax.Array


def _smallest_residual(F: jax.Array, y: jax.Array, lower: jax.Array, upper: jax.Array) -> jax.Array:
    """Return the element w ∈ F + N_K(y) of smallest norm at a point y of the box."""
    w = jnp.where(y <= lower, jnp.minimum(F, 0.0), F)
    return jnp.where(y >= upper, jnp.where(y <= lower, 0.0, jnp.maximum(F, 0.0)), w)
