"""When the constraints of K are active, from a solution: spans of time, or shares of the entries."""

from functools import partial
from typing import Any

import jax
import jax.tree_util as jtu
import numpy as np

from dvax import _tree
from dvax._tree import Tree
from dvax.app.plots.downsample import edges
from dvax.app.plots.panels import AbstractPanel, Curve, Panel
from dvax.app.plots.span_panel import SpanPanel, Spans
from dvax.evolution import Solution
from dvax.evolution.after_run import at_rows
from dvax.evolution.plan import Plan
from dvax.evolution.regimes import switch_count
from dvax.evolution.setup import Setup
from dvax.sets import ConstrainedBox, Polyhedron

_MOST_ROWS = 12
"""Up to this many constraints that are ever active have a row each."""
_MOST_LOCATED = 1000
"""Up to this many entries of y the changes of every step are listed: each has a row of signs."""
_LOWER, _UPPER, _ACTIVE = "at the lower bound", "at the upper bound", "active"
_KINDS = (_LOWER, _UPPER, _ACTIVE)


def box_rows(sol: Solution, times: np.ndarray) -> tuple[Tree, Tree] | None:
    """Return the bounds of K at these times, trees of rows shaped like y, or None if K is no box."""
    setup = sol.setup
    if jax.eval_shape(partial(_bounds, setup), setup.number("t0")) is None:
        return None
    return at_rows(_bounds_at, setup, _plan(sol), times.astype(sol.ts.dtype))


def _bounds(setup: Setup, t: Any) -> tuple[Tree, Tree] | None:
    """Return the bounds of K at one time, None if it is no box."""
    problem = setup.problem
    return problem.set_at(t, _tree.as_arrays(setup.args)).intervals(problem.zero_control(setup.x0))


def _bounds_at(setup: Setup, _: Plan, times: jax.Array) -> Any:
    return jax.vmap(partial(_bounds, setup))(times)


def _plan(sol: Solution) -> Plan:
    return Plan.of(sol.setup) if sol.plan is None else sol.plan


def constraint_panel(
    sol: Solution, times: np.ndarray, rows: tuple[Tree, Tree], box: Any, entries: list[str]
) -> AbstractPanel | None:
    """Return a panel with the spans in which constraints are active. They are those of
    `Solution.regimes` if the steps were recorded, else those of the saved times. None if no constraint
    is active, or K has no switch functions. `entries` are the names of the entries of y."""
    found = _signs(sol, times, rows, box, entries)
    if found is None:
        return None
    ends, active, labels = found
    used = np.flatnonzero(active.any(axis=0))
    if not used.size:
        return None
    if used.size > _MOST_ROWS:
        return _shares(ends, active, labels)
    spans = tuple(
        _spans(ends, active[:, k], _name(labels[k], labels), _KINDS.index(labels[k][1]))
        for k in used
    )
    return SpanPanel(spans, "constraints", share=0.25 + 0.11 * len(spans))


Label = tuple[str, str]
"""The entry of y, and the kind of its constraint."""


def _signs(
    sol: Solution, times: np.ndarray, rows: tuple[Tree, Tree], box: Any, entries: list[str]
) -> tuple[np.ndarray, np.ndarray, list[Label]] | None:
    """Return the ends of intervals, and whether each constraint is active in each of them."""
    problem, args = sol.setup.problem, _tree.as_arrays(sol.setup.args)
    K, like = problem.set_at(sol.setup.number("t0"), args), problem.zero_control(sol.setup.x0)
    has_switches = switch_count(sol.setup) is not None
    saved = len(sol.ts) >= 2
    if has_switches and sol.records is not None and not (saved and len(entries) > _MOST_LOCATED):
        found = sol.regimes()
        labels = _labels(K, like, entries, found.positive.shape[1])
        return found.times, ~found.positive, labels
    ends = edges(times)
    ends[[0, -1]] = times[[0, -1]]
    if box is not None:
        active = [_on_box(y, *pair) for y, *pair in zip(*map(jtu.tree_leaves, (rows[1], *box)))]
        columns = np.concatenate(active, axis=1)
        return ends, columns, _labels(K, like, entries, columns.shape[1])
    if not has_switches:
        return None
    given = times.astype(sol.ts.dtype), rows[0]
    columns = ~at_rows(_positive, sol.setup, _plan(sol), given)
    return ends, columns, _labels(K, like, entries, columns.shape[1])


def _positive(setup: Setup, plan: Plan, rows: tuple[jax.Array, Tree]) -> jax.Array:
    """Return whether each switch function of K is positive, at each of several times."""
    flow = plan.flow(setup)

    def at(row: Any) -> Any:
        t, x = row
        values = flow.switches(t, x, flow.rate(t, x, flow.guess(x)).z)
        assert values is not None
        return values > 0

    return jax.lax.map(at, rows)


def _on_box(y: Any, lower: Any, upper: Any) -> np.ndarray:
    """Return whether each entry is at its lower bound, then whether it is at its upper one."""
    flat, low, high = (np.reshape(np.asarray(v), (len(y), -1)) for v in (y, lower, upper))
    # y = P u is the projection up to the rounding of P.
    rounding = 64 * np.finfo(flat.dtype).eps * np.maximum(np.abs(flat), 1e-300)
    return np.concatenate([flat <= low + rounding, flat >= high - rounding], axis=1)


def _labels(K: Any, like: Tree, entries: list[str], count: int) -> list[Label]:
    """Return the labels of the constraints in the order of `AbstractSet.switches`: for each part of a
    box the lower bounds of its entries, then the upper ones, then the rows of conditions."""
    has_bounds = K.intervals(like) is not None or isinstance(K, ConstrainedBox)
    of_bounds = 2 * len(entries) if has_bounds else 0
    if not isinstance(K, ConstrainedBox | Polyhedron) and count != of_bounds:
        return [(f"constraint {k}" if count > 1 else "constraint", _ACTIVE) for k in range(count)]
    rows = [(f"row {k}", _ACTIVE) for k in range(count - of_bounds)]
    if not has_bounds:
        return rows
    labels: list[Label] = []
    rest = iter(entries)
    for leaf in jtu.tree_leaves(like):
        own = [next(rest) for _ in range(leaf.size)]
        labels += [(entry, kind) for kind in (_LOWER, _UPPER) for entry in own]
    return labels + rows


def _name(label: Label, labels: list[Label]) -> str:
    entry, kind = label
    if kind == _ACTIVE:
        return entry
    # The only entry needs no name.
    return kind if len(labels) == 2 else f"{entry} {kind}"


def _spans(ends: np.ndarray, active: np.ndarray, name: str, colour: int) -> Spans:
    """Return the runs of intervals in which a constraint is active."""
    change = np.diff(np.concatenate([[0], active.astype(np.int8), [0]]))
    return Spans(name, ends[np.flatnonzero(change > 0)], ends[np.flatnonzero(change < 0)], colour)


def _shares(ends: np.ndarray, active: np.ndarray, labels: list[Label]) -> Panel:
    """Return the shares of the entries that are at a bound, as steps over time."""
    x = np.repeat(ends, 2)[1:-1]
    curves = []
    for k, kind in enumerate(_KINDS):
        columns = active[:, [own == kind for _, own in labels]]
        if columns.any():
            curves.append(Curve(x, np.repeat(100.0 * columns.mean(axis=1), 2), kind, k))
    return Panel(curves, "constraints that<br>are active", "%", share=0.6)
