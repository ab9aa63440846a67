"""How a disturbance of the equation grows into an error of the state (Gronwall's lemma)."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def disturbance(constants: Any, defect: Any, law_defect: Any) -> Any:
    """∫ ‖x_h' − Ax_h − f̃‖ from the defect and ∫ ‖w‖ of the frozen solves: a law solved to ‖w‖ disturbs
    f̃ by at most β_f‖P⁻¹‖‖w‖/γ."""
    gain = constants.beta_f * constants.norm_P_inv / constants.gamma
    return defect + gain * law_defect


def gronwall(
    t0: Any, ts: Any, integrated: Any, completed: Any, rate: Any, M: Any, initial: Any
) -> jax.Array:
    """M e^{ct} e₀ + M ∫ e^{c(t−s)} dI(s), from the impulse I known at the saved times only.

    `completed` is I over the steps that had ended by then; `integrated` includes the step under way.
    An ended step acted at any moment since the saved time before it began, so it is charged e^{c₊Δ}
    over the time from there to its end; the step under way is charged in the same way, and for that
    one saved time alone: nothing says how much of it had acted.
    """

    def advance(carry: tuple, now: tuple) -> tuple:
        # `bound` holds at `base` for the steps ended by then; the others act after `early`.
        early, base, ended, bound, last = carry
        time, total, done = now
        decayed = jnp.exp(rate * (time - base)) * bound
        grown = M * jnp.exp(jnp.maximum(rate, 0.0) * (time - early))
        after = decayed + grown * (total - ended)
        # What has no bound keeps none: ∞ − ∞, and an impulse that is not a number, say nothing.
        lost = ~jnp.isfinite(total) | jnp.isnan(after)
        moved = (done > ended) | lost
        new = jnp.where(lost, jnp.inf, decayed + grown * (done - ended))
        carry = (
            # A step under way began after the saved time before this one, whose own has ended.
            jnp.where(moved, jnp.where(total > done, last, time), early),
            jnp.where(moved, time, base),
            jnp.where(moved, done, ended),
            jnp.where(moved, new, bound),
            time,
        )
        return carry, jnp.where(lost, jnp.inf, after)

    rate, M = jnp.asarray(rate, ts.dtype), jnp.asarray(M, ts.dtype)
    integrated, completed = (jnp.asarray(v, ts.dtype) for v in (integrated, completed))
    begin = jnp.asarray(t0, ts.dtype)
    zero = jnp.zeros((), ts.dtype)
    start = (begin, begin, zero, jnp.asarray(M * initial, ts.dtype), begin)
    return lax.scan(advance, start, (ts, integrated, completed))[1]


def between(
    t0: Any, ts: Any, integrated: Any, completed: Any, rate: Any, M: Any, initial: Any, bounds: Any
) -> jax.Array:
    """The most that `bounds`, which `gronwall` gave at the saved times, may be at any time between
    the saved time before and this one: e^{c₊Δ} (the bound there + M ∫ dI over the time between)."""
    first = lambda value, rest: jnp.concatenate([jnp.asarray(value, ts.dtype)[None], rest[:-1]])  # noqa: E731
    grown = jnp.exp(jnp.maximum(rate, 0.0) * (ts - first(t0, ts)))
    most = grown * (first(M * initial, bounds) + M * (integrated - first(0.0, completed)))
    # The saved time itself belongs to it.
    return jnp.where(jnp.isnan(most), jnp.inf, jnp.maximum(most, bounds))
