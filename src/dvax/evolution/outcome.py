"""The output of a time loop, common to all methods: saved rows, statistics, records."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .._tree import Tree
from .bounds import Bounds
from .event import Events
from .flow import Flow
from .results import RESULTS
from .time_derivatives import left_derivatives, transport, zero_with_tangent


class Record(NamedTuple):
    """The dense output of a step: its start, length, x₀ and stage polynomial."""

    start: jax.Array
    length: jax.Array
    x0: Tree
    coefficients: tuple[Tree, ...]


class Saved(NamedTuple):
    """The state at a saved time, and the defects up to it.

    - `integrated_defect`: (∫ ‖p − f̃(·, x_h)‖ ds, ∫ ‖w‖ ds) up to the end of the step that contains t,
      None if it is not measured. (x_h is the exact solution of the system with this disturbance.)
    - `completed_defect`: the same up to the start of that step;
    - `bounds`: the bounds of x_h and u_h since the saved time before, or t0, to the end of that step,
      None if they are not tracked;
    - `guess`: the initial guess for the solver of the law;
    - `step`: the number of steps up to t if a step ends at t, −1 if t lies inside a step.
    """

    t: Any
    x: Tree
    integrated_defect: tuple[Any, Any] | None = None
    completed_defect: tuple[Any, Any] | None = None
    bounds: Bounds | None = None
    guess: Tree | None = None
    step: Any = None


class Outcome(NamedTuple):
    """The rows at the saved times, the entries of `Solution.stats`, the result, the records of the
    steps if `dense=True`, and the events of the user."""

    rows: Saved
    stats: dict[str, Any]
    result: RESULTS
    records: Record | None
    events: Events | None = None


def ended(result: RESULTS, complete: Any) -> RESULTS:
    """Return the result of a run: `max_steps` if it is incomplete without another error."""
    return RESULTS.where((result == RESULTS.successful) & ~complete, RESULTS.max_steps, result)


def end_alone(end: Any, complete: Any, t1: Any, measured: bool, guess: Tree | None) -> Saved:
    """Return a single row with the last state of a run, with t = ∞ if the run is not `complete`."""
    x = jtu.tree_map(lambda leaf: jnp.where(complete, leaf, jnp.nan), end.x)
    integrated_defect = end.integrated_defect if measured else None
    one = Saved(
        jnp.where(complete, t1, jnp.inf), x, integrated_defect, integrated_defect, end.bounds, guess
    )
    return jtu.tree_map(lambda leaf: leaf[None], one)


def with_tangents(rows: Saved, ts: jax.Array, x0: Any, flow: Flow, ends: tuple[Any, Any]) -> Saved:
    """Return the rows with the tangents of the saved times `ts`.

    The times of the given rows have the tangents of step ends instead. Rows that were not reached keep
    their states.
    """
    reached = rows.t < jnp.inf
    t = jnp.where(reached, rows.t, ends[0])
    difference = zero_with_tangent(jnp.where(reached, ts, ends[0])) - zero_with_tangent(t)
    given = reached, lax.stop_gradient(x0), flow, ends
    x = transport(rows.x, difference, _derivatives, t, *given)
    return rows._replace(t=rows.t + difference, x=x)


def _derivatives(ts: jax.Array, xs: Any, reached: Any, x0: Any, flow: Flow, ends: Any) -> Any:
    """Return the left derivatives of x at the reached times, and 0 at the others."""

    def where_reached(x: Any, y: Any) -> Any:
        return jnp.where(reached.reshape(-1, *(1,) * (x.ndim - 1)), x, y)

    derivatives = left_derivatives(ts, jtu.tree_map(where_reached, xs, x0), flow, ends)
    return jtu.tree_map(lambda leaf: where_reached(leaf, 0.0), derivatives)
