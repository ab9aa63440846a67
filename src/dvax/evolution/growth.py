"""Error bounds of the state for a disturbance of the equation, by Gronwall's lemma."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def disturbance(constants: Any, defect: Any, law_defect: Any) -> Any:
    """Return a bound on ∫ ‖x_h' − Ax_h − f̃‖ from the integrated defects of the state and of the law.

    A law solved up to ‖w‖ disturbs f̃ by at most β_f‖P⁻¹‖‖w‖/γ.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> c = dvax.verify(problem, -1.0, 0.0, 2.0).constants
    >>> float(dvax.evolution.disturbance(c, jnp.array(1e-6), jnp.array(0.0)))
    1e-06

    ```
    """
    gain = constants.beta_f * constants.norm_P_inv / constants.gamma
    return defect + gain * law_defect


def gronwall(
    t0: Any, ts: Any, integrated: Any, completed: Any, rate: Any, M: Any, initial: Any
) -> jax.Array:
    """Return M e^{ct} e₀ + M ∫ e^{c(t−s)} dI(s) at the times `ts`, for c = `rate` and e₀ = `initial`.

    The integrated disturbance I is given at the saved times only: `completed` over the completed
    steps, and `integrated` including the whole step that contains the saved time. A completed step may
    have acted at any time since the last saved time before its start, so its contribution is
    multiplied by e^{c₊Δ}, where Δ is the time from there to now. The current step is treated alike, at
    this saved time only, because I over a part of a step is unknown.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> ts, integrated = jnp.array([1.0, 2.0]), jnp.array([1e-6, 2e-6])      # I grows evenly
    >>> bounds = dvax.evolution.gronwall(0.0, ts, integrated, integrated, -1.0, 1.0, 1e-3)
    >>> bool(bounds[1] < bounds[0] < 1e-3)                                   # the initial error decays
    True

    ```
    """

    def advance(carry: tuple, row: tuple) -> tuple:
        # `bound` holds at time `base` and includes the disturbance `included`; the rest of the
        # disturbance acts after time `earliest`.
        earliest, base, included, bound, last = carry
        time, total, done = row
        propagated = jnp.exp(rate * (time - base)) * bound
        factor = M * jnp.exp(jnp.maximum(rate, 0.0) * (time - earliest))
        current = propagated + factor * (total - included)
        # Once the bound is infinite or NaN, it remains infinite.
        is_lost = ~jnp.isfinite(total) | jnp.isnan(current)
        is_updated = (done > included) | is_lost
        new = jnp.where(is_lost, jnp.inf, propagated + factor * (done - included))
        carry = (
            # The current step, if there is one, began after the last saved time.
            jnp.where(is_updated, jnp.where(total > done, last, time), earliest),
            jnp.where(is_updated, time, base),
            jnp.where(is_updated, done, included),
            jnp.where(is_updated, new, bound),
            time,
        )
        return carry, jnp.where(is_lost, jnp.inf, current)

    rate, M = jnp.asarray(rate, ts.dtype), jnp.asarray(M, ts.dtype)
    integrated, completed = (jnp.asarray(v, ts.dtype) for v in (integrated, completed))
    first_time = jnp.asarray(t0, ts.dtype)
    zero = jnp.zeros((), ts.dtype)
    start = (first_time, first_time, zero, jnp.asarray(M * initial, ts.dtype), first_time)
    return lax.scan(advance, start, (ts, integrated, completed))[1]


def between(
    t0: Any, ts: Any, integrated: Any, completed: Any, rate: Any, M: Any, initial: Any, bounds: Any
) -> jax.Array:
    """Return bounds that hold on each interval from the last saved time to this one.

    `bounds` are those of `gronwall` at the saved times. On an interval of length Δ the error is at most
    e^{c₊Δ} (the bound at its start + M ∫ dI over the interval).

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> ts, integrated = jnp.array([1.0, 2.0]), jnp.array([1e-6, 2e-6])
    >>> ends = dvax.evolution.gronwall(0.0, ts, integrated, integrated, -1.0, 1.0, 0.0)
    >>> inside = dvax.evolution.between(0.0, ts, integrated, integrated, -1.0, 1.0, 0.0, ends)
    >>> bool((inside >= ends).all())
    True

    ```
    """

    def shift(value: Any, rows: Any) -> jax.Array:
        """Return the rows moved by one, with `value` in front."""
        return jnp.concatenate([jnp.asarray(value, ts.dtype)[None], rows[:-1]])

    factor = jnp.exp(jnp.maximum(rate, 0.0) * (ts - shift(t0, ts)))
    inside = factor * (shift(M * initial, bounds) + M * (integrated - shift(0.0, completed)))
    # The interval includes its end.
    return jnp.where(jnp.isnan(inside), jnp.inf, jnp.maximum(inside, bounds))
