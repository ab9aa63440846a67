"""What a run over the stops returns, whatever steps it took."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .._tree import Tree
from .bounds import Bounds
from .flow import Flow
from .results import RESULTS
from .time_derivatives import left_derivatives, transport, zero_with_tangent


class Record(NamedTuple):
    """What is needed to evaluate a step anywhere inside: x₀ and the stage polynomial."""

    start: jax.Array
    length: jax.Array
    x0: Tree
    coefficients: tuple[Tree, ...]


class Saved(NamedTuple):
    """The state at a saved time, and the defects up to it.

    `integrated_defect` = (∫ ‖p − f̃(·, x_h)‖ ds, ∫ ‖w‖ ds) up to the end of the step that the time lies
    in: x_h is the exact solution of the system with a disturbance of that size. `completed_defect` is
    the same up to the start of that step. `bounds` holds the bounds of x_h and u_h from t0 to the end
    of that step, where they are tracked. None where nothing
    is measured. `guess` is where the solver of the law may begin. `step` is the number
    of steps up to this time where a step ends at it, −1 where it lies inside a step.
    """

    t: Any
    x: Tree
    integrated_defect: tuple[Any, Any] | None = None
    completed_defect: tuple[Any, Any] | None = None
    bounds: Bounds | None = None
    guess: Tree | None = None
    step: Any = None


class Outcome(NamedTuple):
    """The saved times with their states, the entries of `Solution.stats`, how the run ended, and the
    steps where they were kept."""

    rows: Saved
    stats: dict[str, Any]
    result: RESULTS
    records: Record | None


def ended(result: RESULTS, complete: Any) -> RESULTS:
    """Return the result of a run: one that stopped early without an error took too many steps."""
    return RESULTS.where((result == RESULTS.successful) & ~complete, RESULTS.max_steps, result)


def end_alone(end: Any, complete: Any, t1: Any, measured: bool) -> Saved:
    """Return the last state of a run as its one saved time, ∞ where the run is not `complete`."""
    x = jtu.tree_map(lambda leaf: jnp.where(complete, leaf, jnp.nan), end.x)
    integrated_defect = end.integrated_defect if measured else None
    one = Saved(
        jnp.where(complete, t1, jnp.inf), x, integrated_defect, integrated_defect, end.bounds
    )
    return jtu.tree_map(lambda leaf: leaf[None], one)


def with_tangents(rows: Saved, ts: jax.Array, x0: Any, flow: Flow, ends: tuple[Any, Any]) -> Saved:
    """Return the rows with the tangents of the saved times `ts`, given rows whose times have the
    tangents of the ends of steps that they meet. Times that were not reached keep their states."""
    reached = rows.t < jnp.inf
    t = jnp.where(reached, rows.t, ends[0])
    apart = zero_with_tangent(jnp.where(reached, ts, ends[0])) - zero_with_tangent(t)
    given = reached, lax.stop_gradient(x0), flow, ends
    x = transport(rows.x, apart, _arrived, t, *given)
    return rows._replace(t=rows.t + apart, x=x)


def _arrived(ts: jax.Array, xs: Any, reached: Any, x0: Any, flow: Flow, ends: Any) -> Any:
    """Return the left derivative at the times that were reached, and 0 at the others."""
    there = lambda x, y: jnp.where(reached.reshape(-1, *(1,) * (x.ndim - 1)), x, y)  # noqa: E731
    found = left_derivatives(ts, jtu.tree_map(there, xs, x0), flow, ends)
    return jtu.tree_map(lambda leaf: there(leaf, 0.0), found)
