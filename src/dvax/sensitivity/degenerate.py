"""The kinks of the response along a trajectory, and their types.

The kinks of a projection are the zeros of continuous functions s(z), the `switches` of the set. If s
*crosses* zero transversally, or *touches* zero without a change of sign, the state is differentiable,
and u is not differentiable at that time only. If s *stays* at zero, there are only one-sided
derivatives from then on: `jax.grad` returns that of the constrained side.
"""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from ..errors import input_error
from ..evolution import Solution
from ..evolution.after_run import at_rows, steps_at
from ..evolution.outcome import Record
from ..evolution.plan import Plan
from ..evolution.regimes import switch_count, switches_along
from ..evolution.setup import Setup

_SAMPLES_PER_STEP = 8
"""Number of evaluations of the switches in a step."""

_MAX_INSTANT = 1e-3
"""An interval shorter than this fraction of the run counts as an instant."""


class Kink(NamedTuple):
    """A zero of a switch from `start` to `end`; these are equal unless the switch stays at zero.

    `switch` is the index of the switch of the set. For a `dvax.sets.Box` of m entries, switch i < m is
    the lower bound of entry i, and switch m + i the upper bound.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> sol = dvax.solve(problem, -1.0, 0.0, 2.0, rtol=1e-8, dense=True)
    >>> for kink in dvax.sensitivity.kinks(sol):                     # u leaves 1/2, then arrives at 0
    ...     print(kink.kind, kink.switch, f"{kink.start:.4f}")
    crosses 1 0.3133
    crosses 0 0.5241

    ```
    """

    start: float
    end: float
    switch: int
    kind: Literal["crosses", "touches", "stays"]


def kinks(sol: Solution, *, tol: float = 1e-6) -> list[Kink]:
    """Return the kinks of the response along a solution with `dense=True`, in order of time.

    A switch counts as zero if its absolute value is below `tol`, which must exceed the error of the
    solution. A zero over less than a thousandth of the run counts as an instant.

    **Raises:** `dvax.InputError` if the solution has no dense output, or is of `dvax.Implicit` or
    `dvax.PiecewiseLinear`, or if K is a `dvax.sets.Intersection`, which does not show its kinks.

    ```python
    >>> import dvax
    >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
    ...                             kappa0=0.5, g=1.0, ell=3.0)
    >>> sol = dvax.solve(
    ...     model.problem, -1.0, 0.0, 2.0, rtol=1e-8, method=dvax.ETD4RK(), dense=True, max_steps=2**12
    ... )
    >>> [(round(kink.start, 4), kink.kind) for kink in dvax.sensitivity.kinks(sol)]
    [(0.3133, 'crosses'), (0.5241, 'crosses')]

    ```
    """
    if not isinstance(sol.records, Record):
        dense = "without dense output" if sol.records is None else "with dense output"
        raise input_error(
            "dvax.sensitivity.kinks",
            f"a solution of {type(sol.setup.method).__name__} {dense}",
            "the kinks between saved times are located on the steps of an exponential method",
            "Solve with dense=True and an exponential method",
        )
    require_switches("dvax.sensitivity.kinks(sol)", sol.setup)
    count = int(sol.stats["steps"])
    if count == 0 or not switch_count(sol.setup):
        return []
    times, values = _sample_switches(sol, count)
    result: list[Kink] = []
    for k in range(values.shape[1]):
        result += _kinks_of_switch(times, values[:, k], k, tol)
    return sorted(result)


def require_switches(place: str, setup: Setup) -> None:
    """Raise an `InputError` where no functions of the set change sign at the kinks."""
    if switch_count(setup) is None:
        K = setup.problem.set_at(setup.number("t0"), _tree.as_arrays(setup.args))
        raise input_error(
            place, f"a law on {type(K).__name__}",
            "Dykstra's method does not determine which sets of an Intersection are active, so that "
            "kinks of the response are not known",
            "Write the set as dvax.sets.ConstrainedBox (limits of entries and of a few sums) or "
            "dvax.sets.Polyhedron",
        )  # fmt: skip


def _sample_switches(sol: Solution, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (times, values of the switches at these times)."""
    assert isinstance(sol.records, Record) and sol.plan is not None
    steps = steps_at(sol.records, slice(count))
    end = steps.start[-1] + steps.length[-1]
    run = np.full(count, steps.start[0]), np.full(count, end)
    values, last = at_rows(_switches_in_steps, sol.setup, sol.plan, (steps, run))
    thetas = np.arange(_SAMPLES_PER_STEP) / _SAMPLES_PER_STEP
    times = np.asarray(steps.start)[:, None] + thetas * np.asarray(steps.length)[:, None]
    return (
        np.append(times.ravel(), end),
        np.concatenate([values.reshape(times.size, -1), last[-1:]]),
    )


def _switches_in_steps(setup: Setup, plan: Plan, rows: tuple[Record, Any]) -> Any:
    """Return the switches at some positions in each of several steps, and at its end."""
    flow = plan.flow(setup)

    def sample(step: Record, run: Any) -> tuple[jax.Array, jax.Array]:
        at = switches_along(flow, setup.method, step, run)
        thetas = jnp.arange(_SAMPLES_PER_STEP + 1, dtype=step.start.dtype) / _SAMPLES_PER_STEP
        values = jax.lax.map(at, thetas)
        return values[:-1], values[-1]

    return jax.vmap(sample)(*rows)


def _kinks_of_switch(times: np.ndarray, s: np.ndarray, switch: int, tol: float) -> list[Kink]:
    """Return the kinks of one switch, from its sampled values."""
    result: list[Kink] = []
    is_zero = np.abs(s) <= tol
    i = 0
    while i < len(s):
        if is_zero[i]:
            j = i
            while j + 1 < len(s) and is_zero[j + 1]:
                j += 1
            before, after = (s[i - 1] if i > 0 else 0.0), (s[j + 1] if j + 1 < len(s) else 0.0)
            start, end = float(times[i]), float(times[j])
            stays = end - start > _MAX_INSTANT * (times[-1] - times[0])
            kind = "stays" if stays else "crosses" if before * after < 0 else "touches"
            if kind != "stays":
                nearest = i + int(np.argmin(np.abs(s[i : j + 1])))
                touches = kind == "touches"
                start = end = _vertex_time(times, s, nearest) if touches else float(times[nearest])
            result.append(Kink(start, end, switch, kind))
            i = j + 1
            continue
        if i + 1 < len(s) and s[i] * s[i + 1] < 0 and not is_zero[i + 1]:
            # A bound that becomes infinite does so between the two times.
            finite = np.all(np.isfinite(s[i : i + 2]))
            share = s[i] / (s[i] - s[i + 1]) if finite else 0.5
            t = float(times[i] + (times[i + 1] - times[i]) * share)
            result.append(Kink(t, t, switch, "crosses"))
        elif 0 < i < len(s) - 1 and abs(s[i]) <= min(abs(s[i - 1]), abs(s[i + 1])) < np.inf:
            # The minimum of the parabola through three values may be smaller than all of them.
            minimum = abs(s[i]) - _distance_to_vertex(s[i - 1 : i + 2])
            if minimum <= tol:
                vertex = _vertex_time(times, s, i)
                result.append(Kink(vertex, vertex, switch, "touches"))
        i += 1
    return result


def _distance_to_vertex(s: np.ndarray) -> float:
    """Return the middle one of three values of |s|, minus the minimum of the parabola through them."""
    a, b, c = np.abs(s)
    curvature = a - 2 * b + c
    # A bound that becomes infinite is no vertex.
    return 0.0 if not 0 < curvature < np.inf else (a - c) ** 2 / (8 * curvature)


def _vertex_time(times: np.ndarray, s: np.ndarray, i: int) -> float:
    """Return the time of the vertex of the parabola through three neighbouring values, or that of the
    middle one where the parabola is a line or its vertex lies outside."""
    if not 0 < i < len(s) - 1:
        return float(times[i])
    before, middle, after = times[i - 1 : i + 2]
    first = (s[i] - s[i - 1]) / (middle - before)
    second = ((s[i + 1] - s[i]) / (after - middle) - first) / (after - before)
    if second == 0.0:
        return float(middle)
    vertex = 0.5 * (before + middle) - 0.5 * first / second
    return float(vertex if before <= vertex <= after else middle)
