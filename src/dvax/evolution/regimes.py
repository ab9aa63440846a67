"""The intervals of a trajectory on which the active constraints of K do not change."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._dataset import dataset, described
from .after_run import at_rows, steps_at
from .flow import Flow
from .locate_event import locate_event
from .outcome import Record
from .plan import Plan
from .setup import Setup
from .stepper import dense_output, one_sided_time

_SAMPLES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Positions in a step at which the signs of the switch functions are sampled."""


class Regimes(NamedTuple):
    """The times of events, and the signs of the switch functions of K between them.

    `times` = (t₀, events…, t₁). `positive` has a row for each interval between two times, and a column
    for each of the set's `switches`. For a `dvax.sets.Box` of m entries, column i says that yᵢ is above
    its lower bound, and column m + i that it is below its upper bound. Of several changes in one step
    only the first one has a time.
    """

    times: np.ndarray
    positive: np.ndarray

    def to_xarray(self, *, time_unit: str = "") -> Any:
        """Return an `xarray.Dataset` with the dimensions `interval` and `switch`: `start`, `end`,
        `positive`.

        **Raises:** `ModuleNotFoundError` if xarray (the extra `dvax[app]`) is not installed.
        """
        unit = time_unit or None
        ends = {
            name: (("interval",), values, described(f"{name} of the interval", unit))
            for name, values in (("start", self.times[:-1]), ("end", self.times[1:]))
        }
        words = "whether a switch function of K is positive"
        positive = ("interval", "switch"), self.positive, described(words)
        return dataset("Regimes.to_xarray", {**ends, "positive": positive})


def switch_count(setup: Setup) -> int | None:
    """Return the number of the switch functions of the set K of a run, None if it has none at all."""
    problem, x0, args = setup.problem, setup.x0, _tree.as_arrays(setup.args)

    def switches(t: Any, x: Any) -> Any:
        return problem.set_at(t, args).switches(problem.zero_control(x), problem.spaces(x)[1])

    found = jax.eval_shape(switches, setup.number("t0"), x0)
    return None if found is None else sum(leaf.size for leaf in found)


def regimes(setup: Setup, plan: Plan, records: Record, count: int) -> Regimes:
    """Return the regimes of the first `count` ≥ 1 steps of a run whose set has switch functions."""
    steps = steps_at(records, slice(count))
    starts, lengths = np.asarray(steps.start), np.asarray(steps.length)
    end = starts[-1] + lengths[-1]
    run = np.full(count, starts[0]), np.full(count, end)
    events, before, after = at_rows(_changes_in_steps, setup, plan, (steps, run))
    times, rows = [starts[0]], [before[0]]
    for k in range(count):
        # Jumps of data lie between two steps, and events of the trajectory inside a step.
        for time, row in ((starts[k], before[k]), (events[k], after[k])):
            if np.any(row != rows[-1]):
                times.append(time)
                rows.append(row)
    return Regimes(np.array([*times, end]), np.array(rows))


def switches_along(flow: Flow, method: Any, step: Record, run: Any) -> Callable[..., jax.Array]:
    """Return the switch functions of K over a step as a function of θ, and of the time there if it is
    one-sided."""
    states = dense_output(method, flow, step, flow.guess(step.x0), run)

    def at(theta: Any, t: Any = None) -> jax.Array:
        t = step.start + theta * step.length if t is None else t
        x = states(theta)
        switches = flow.switches(t, x, flow.rate(t, x, flow.guess(x)).z)
        assert switches is not None
        return switches

    return at


def _changes_in_steps(setup: Setup, plan: Plan, rows: tuple[Record, Any]) -> Any:
    """Return the time of the first sign change in each step, and the one-sided signs at its ends."""
    return jax.vmap(partial(_changes, plan.flow(setup), setup.method))(*rows)


def _changes(flow: Flow, method: Any, step: Record, run: tuple[Any, Any]) -> Any:
    end, at = step.start + step.length, switches_along(flow, method, step, run)
    thetas = jnp.asarray(_SAMPLES, end.dtype)
    times = jnp.stack([one_sided_time(step.start, end, theta, run) for theta in _SAMPLES])
    # As a loop: each evaluation site of a law that iterates takes its time to compile.
    values = list(jax.lax.map(lambda sample: at(*sample), (thetas, times)))
    if values[0].size == 0:
        return jnp.full_like(end, jnp.inf), values[0] > 0, values[0] > 0
    event = step.start + locate_event(_SAMPLES, values, at) * step.length
    return event, values[0] > 0, values[-1] > 0
