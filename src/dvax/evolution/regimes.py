"""The stretches of a trajectory on which the response obeys one formula."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .flow import Flow
from .locate_event import locate_event
from .loop import Record
from .stepper import interpolate, local, one_sided_time

_LOOKS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Where inside a step the signs are looked at."""


class Regimes(NamedTuple):
    """`times` = (t₀, the kinks…, t₁), and for every stretch between two of them the signs of the set's
    `switches`: `positive` has a row a stretch and a column a switch. For a `dvax.sets.Box` of m entries
    column i says that yᵢ is off its lower bound, column m + i that it is off the upper one. Of changes
    within one step only the first has a time."""

    times: np.ndarray
    positive: np.ndarray


def regimes(flow: Flow, method: Any, records: Record, count: int) -> Regimes:
    """Those of the first `count` steps, at least one, of a flow whose set says where its kinks are."""
    steps = jtu.tree_map(lambda leaf: leaf[:count], records)
    starts, lengths = np.asarray(steps.start), np.asarray(steps.length)
    run = steps.start[0], steps.start[-1] + steps.length[-1]
    look = jax.jit(jax.vmap(lambda step: _changes(flow, method, step, run)))
    kinks, before, after = map(np.asarray, look(steps))
    times, rows = [starts[0]], [before[0]]
    for k in range(count):
        # What data does when it jumps shows between two steps, a kink of the trajectory inside.
        for time, row in ((starts[k], before[k]), (kinks[k], after[k])):
            if np.any(row != rows[-1]):
                times.append(time)
                rows.append(row)
    return Regimes(np.array([*times, starts[-1] + lengths[-1]]), np.array(rows))


def _changes(
    flow: Flow, method: Any, step: Record, run: tuple[Any, Any]
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The time of the first change of sign in a step, and the signs at its ends, seen from inside."""

    end, guess = step.start + step.length, flow.guess(step.x0)
    own, _ = local(method, flow, step.start, end, step.x0, guess, run)

    def at(theta: Any, t: Any = None) -> jax.Array:
        t = step.start + theta * step.length if t is None else t
        x = interpolate(own, step.length, theta, step.x0, step.coefficients)
        found = flow.switches(t, x, flow.rate(t, x, flow.guess(x)).z)
        assert found is not None
        return found

    values = [
        at(jnp.asarray(theta, end.dtype), one_sided_time(step.start, end, theta, run))
        for theta in _LOOKS
    ]
    if values[0].size == 0:
        return jnp.full_like(end, jnp.inf), values[0] > 0, values[0] > 0
    kink = step.start + locate_event(_LOOKS, values, at) * step.length
    return kink, values[0] > 0, values[-1] > 0
