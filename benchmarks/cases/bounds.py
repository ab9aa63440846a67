"""Error bounds along trajectories of nonlinear problems: beside the true error, and what they cost."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..section import Section, Table

_SAVED, _TARGET = 80, 10.0
_TOLERANCES = (1e-4, 1e-6, 1e-8)
_ROUNDING = 1e-11
"""Errors below this are those of the reference."""

_HEADER = ("problem", "span", "rtol", "true error", "bound", "bound/error", "target", "status",
           "above at every time", "by constants of a region", "solve, s", "bound, s")  # fmt: skip


class _Case(NamedTuple):
    """A problem without Lipschitz constants, or with large ones, from x0 over a span."""

    name: str
    problem: dvax.Problem
    x0: Any
    span: float


def run(full: bool) -> Section:
    cases = [
        make()
        for make in (
            _van_der_pol, _stiff_van_der_pol, _spring, _pendulum, _fishery, _lorenz, _routes,
            _dispatch, _polygon, _disk,
        )
    ]  # fmt: skip
    tolerances = _TOLERANCES if full else _TOLERANCES[1:2]
    return Section(
        title="bounds: dvax.bound_error(problem, sol) without constants",
        fair=(
            f"dvax.solve with the given rtol = atol and {_SAVED} saved times, its method chosen; the "
            "true error is that to ExpRosenbrock with rtol = 1e-12. Errors and bounds are the largest "
            "of all saved times. 'By constants of a region': the bound of the same problem, solved by "
            "ETD2RK with rtol = 1e-6, with constants that dvax.verify proves for twice the box of the "
            "trajectory. Times are of second calls, without compilation."
        ),
        tables=[Table("bounds along trajectories", _HEADER,
                      [_row(case, tol) for case in cases for tol in tolerances])],
    )  # fmt: skip


def _row(case: _Case, tol: float) -> tuple[str, ...]:
    ts = np.linspace(0.0, case.span, _SAVED + 1)[1:]
    given: dict[str, Any] = dict(ts=ts, rtol=tol, atol=tol)
    solve = lambda: dvax.solve(case.problem, case.x0, 0.0, case.span, **given)  # noqa: E731
    exact = dvax.solve(
        case.problem, case.x0, 0.0, case.span, ts=ts, rtol=1e-12, atol=1e-12,
        method=dvax.ExpRosenbrock(),
    )  # fmt: skip
    sol, taken = _second(solve)
    bound, taken_bound = _second(lambda: dvax.bound_error(case.problem, sol))
    error = np.linalg.norm(np.asarray(sol.xs - exact.xs), axis=1)
    least = np.min((np.asarray(bound.x) + _ROUNDING) / np.maximum(error, _ROUNDING))
    largest, top = float(np.max(error)), float(np.max(np.asarray(bound.x)))
    return (
        case.name, f"{case.span:g}", f"{tol:.0e}", f"{largest:.1e}", f"{top:.1e}",
        f"{top / max(largest, tol):.2g}" + (" (of rtol)" if largest < tol else ""),
        f"≤ {_TARGET:g}", bound.status, "yes" if least >= 1.0 else "NO",
        _by_region(case, exact), f"{taken:.3g}", f"{taken_bound:.3g}",
    )  # fmt: skip


def _by_region(case: _Case, exact: dvax.Solution) -> str:
    xs = np.asarray(exact.xs)
    middle, half = 0.5 * (xs.max(axis=0) + xs.min(axis=0)), xs.max(axis=0) - xs.min(axis=0)
    region = jnp.asarray(middle - half), jnp.asarray(middle + half)
    constants = dvax.verify(case.problem, case.x0, 0.0, case.span, x=region).constants
    if constants is None:
        return "none"
    sol = dvax.solve(
        case.problem,
        case.x0,
        0.0,
        case.span,
        constants=constants,
        method=dvax.ETD2RK(),
        ts=exact.ts,
    )
    return f"{float(np.max(np.asarray(dvax.bound_error(case.problem, sol, constants).x))):.1e}"


def _second(call: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of the second call, and the seconds that it takes."""
    jax.block_until_ready(jax.tree_util.tree_leaves(call()))
    started = time.perf_counter()
    result = call()
    jax.block_until_ready(jax.tree_util.tree_leaves(result))
    return result, time.perf_counter() - started


def _problem(f: Any, h: Any, K: Any, A: Any = None, shape: Any = ()) -> dvax.Problem:
    return dvax.Problem(
        A=dvax.generators.Scalar(0.0) if A is None else A, P=dvax.operators.Scaling(1.0), K=K, f=f, h=h,
        control_space=dvax.spaces.Euclidean(shape),
    )  # fmt: skip


def _oscillator(mu: float) -> dvax.Problem:
    return _problem(
        lambda t, x, u, args: jnp.stack([x[1], mu * (1.0 - x[0] ** 2) * x[1] - x[0] + u]),
        lambda t, x, u, args: -x[1], dvax.sets.Box(-0.5, 0.5),
    )  # fmt: skip


def _van_der_pol() -> _Case:
    return _Case("van der Pol, μ = 1", _oscillator(1.0), jnp.array([1.0, 0.0]), 40.0)


def _stiff_van_der_pol() -> _Case:
    return _Case("van der Pol, μ = 4", _oscillator(4.0), jnp.array([1.0, 0.0]), 20.0)


def _spring() -> _Case:
    """A mass on a spring, driven to a place by a force with limits."""
    problem = _problem(
        lambda t, x, u, args: jnp.stack([0.0, 1.0]) * u,
        lambda t, x, u, args: 100.0 * (0.1 - x[0]) - 10.0 * x[1] + 4.0, dvax.sets.Box(-5.0, 5.0),
        dvax.generators.Dense(jnp.array([[0.0, 1.0], [-40.0, -1.0]])),
    )  # fmt: skip
    return _Case("driven spring", problem, jnp.zeros(2), 50.0)


def _pendulum() -> _Case:
    """A pendulum that a small torque brings up to the unstable rest and keeps there."""
    problem = _problem(
        lambda t, x, u, args: jnp.stack([x[1], -4.0 * jnp.sin(x[0]) + u]),
        lambda t, x, u, args: 3.0 * (jnp.pi - x[0]) - x[1] - u, dvax.sets.Box(-1.0, 1.0),
    )  # fmt: skip
    return _Case("pendulum", problem, jnp.array([2.0, 0.0]), 20.0)


def _fishery() -> _Case:
    """Prey and predator; the catch of predators grows with their number, up to a quota that moves."""
    problem = _problem(
        lambda t, x, u, args: jnp.stack(
            [x[0] * (1.5 - x[0] - 0.6 * x[1]), x[1] * (0.8 * x[0] - 0.4 - u)]
        ),
        lambda t, x, u, args: 2.0 * (x[1] - 0.8),
        lambda t, args: dvax.sets.Box(0.0, 1.0 + 0.5 * jnp.sin(t)),
    )  # fmt: skip
    return _Case("fishery", problem, jnp.array([0.5, 0.5]), 40.0)


def _lorenz() -> _Case:
    """Chaotic: errors grow by e^{0.9 t} on average."""
    problem = _problem(
        lambda t, x, u, args: jnp.stack(
            [10.0 * (x[1] - x[0]), x[0] * (28.0 - x[2]) - x[1] + u, x[0] * x[1] - 8.0 / 3.0 * x[2]]
        ),
        lambda t, x, u, args: -x[1], dvax.sets.Box(-10.0, 10.0),
    )  # fmt: skip
    return _Case("Lorenz, limited force", problem, jnp.array([1.0, 1.0, 20.0]), 8.0)


def _routes() -> _Case:
    """Drivers learn the times of five routes; the demand rises and falls with the day."""
    free = jnp.array([1.0, 1.2, 1.5, 1.1, 2.0])
    problem = _problem(
        lambda t, x, u, args: 2.0 * (free + 0.3 * u + 0.1 * u**2 - x),
        lambda t, x, u, args: -x - 0.2 * jnp.tanh(u) + 0.1 * jnp.sin(jnp.roll(u, 1)),
        lambda t, args: dvax.sets.Simplex(3.0 + 2.0 * jnp.sin(0.5 * t)), shape=5,
    )  # fmt: skip
    return _Case("routes, moving simplex", problem, free, 24.0)


def _dispatch() -> _Case:
    """Four units meet a demand at the least cost; expected costs follow the output."""
    problem = _problem(
        lambda t, x, u, args: jnp.array([0.5, 1.0, 2.0, 4.0]) * u - x,
        lambda t, x, u, args: -x - jnp.array([1.0, 0.0, 2.0, 0.5]),
        lambda t, args: dvax.sets.ConstrainedBox(
            0.0, jnp.array([1.5, 1.0, 2.0, 1.0]), jnp.ones((1, 4)),
            jnp.stack([3.0 + 1.5 * jnp.sin(t)]), jnp.stack([3.0 + 1.5 * jnp.sin(t)]),
        ), shape=4,
    )  # fmt: skip
    return _Case("dispatch, moving sum", problem, jnp.zeros(4), 8.0)


def _polygon() -> _Case:
    """A body in the plane is pulled into a polygon whose sides follow tables."""
    angles = np.arange(5) * 2.0 * np.pi / 5.0
    sides = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    times = np.arange(21.0)
    widths = 1.0 + 0.3 * np.sin(times[:, None] + np.arange(5))
    table = dvax.signals.Table(jnp.asarray(times), jnp.asarray(widths))
    problem = _problem(
        lambda t, x, u, args: jnp.concatenate([x[2:], 4.0 * (u - x[:2]) - 0.5 * x[2:]]),
        lambda t, x, u, args: x[:2] + jnp.stack([jnp.sin(t), jnp.cos(0.7 * t)]),
        lambda t, args: dvax.sets.Polyhedron(sides, table(t)), shape=2,
    )  # fmt: skip
    return _Case("body, polygon by tables", problem, jnp.array([1.0, 0.0, 0.0, 0.0]), 20.0)


def _disk() -> _Case:
    """A body is pulled into a disk that goes round and breathes."""
    problem = _problem(
        lambda t, x, u, args: 3.0 * (u - x), lambda t, x, u, args: x,
        lambda t, args: dvax.sets.Ball(
            jnp.stack([2.0 * jnp.cos(t), jnp.sin(2.0 * t)]), 0.6 + 0.3 * jnp.sin(3.0 * t)
        ), shape=2,
    )  # fmt: skip
    return _Case("body, moving disk", problem, jnp.array([2.0, 0.0]), 20.0)
