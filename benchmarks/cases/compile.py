"""The time to a first result: solves, gradients, responses and constants of laws with and without
iteration."""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..clock import timed
from ..contact_law import single
from ..layout import duration
from ..section import Comparison, Section, Table, Target

_END = 5.0
_EVALUATIONS = 1000
_LEAST_RESULT, _LEAST_GRADIENT, _LEAST_C1 = 2.5, 4.0, 0.8


def run(full: bool) -> Section:
    section = Section(
        title="compile: the time to a first result",
        fair=(
            "Seconds of the first call in a process whose caches are empty (jax.clear_caches), tracing "
            "and compilation included, and of the same call once more. Processor time is that of all "
            "cores. The games have six unknowns and a polyhedron of nine rows; one of them is cubic. "
            "Laws y = proj(h) have three unknowns, and no iteration but that of the projection."
        ),
    )
    law = single()
    cases: dict[str, tuple[dvax.Problem, Any, float, float]] = {
        "C1": (law.model.problem, jnp.asarray(law.start), 2.0, _LEAST_C1),
        "four unknowns on a simplex": (*_simplex(), _END, _LEAST_RESULT),
        "affine game": (*_game(0.0), _END, _LEAST_RESULT),
        "cubic game": (*_game(0.1), _END, _LEAST_RESULT),
        "three batteries, tables": (*_dispatch(), _END, _LEAST_RESULT),
    }
    sets = {
        "polyhedron": dvax.sets.Polyhedron(G=jnp.asarray(_ROWS), d=jnp.ones(3)),
        "box with a condition": dvax.sets.ConstrainedBox(
            jnp.zeros(3), jnp.ones(3), jnp.asarray(_ROWS[:1]), -jnp.ones(1), 1.5 * jnp.ones(1)
        ),
        "ellipsoid": dvax.sets.Ellipsoid(jnp.zeros(3), jnp.array([1.0, 2.0, 3.0])),
        "simplex": dvax.sets.Simplex(1.0),
    }
    cases |= {
        f"y = proj(h), {name}": (*_direct(K), _END, _LEAST_RESULT) for name, K in sets.items()
    }
    rows = []
    for name, (problem, x0, end, least) in cases.items():
        for what, call, target in _calls(problem, x0, end, least):
            first, worked, again = _first_and_again(call)
            section.comparisons.append(
                Comparison(
                    f"{name}, {what}: first call", "-", first, None,
                    target=Target("≤", target, first, " s"),
                )
            )  # fmt: skip
            rows.append((name, what, duration(first), duration(worked), duration(again)))
        if name != "C1":
            section.notes.append(f"{name}: {duration(_evaluation(problem, x0))} an evaluation.")
    header = ("problem", "call", "first", "processor time", "again")
    section.tables.append(Table("First and repeated calls", header, rows))
    section.notes.append(f"JAX {jax.__version__} on {jax.devices()[0].device_kind}.")
    return section


def _calls(
    problem: dvax.Problem, x0: Any, end: float, least: float
) -> list[tuple[str, Callable[[], Any], float]]:
    def last(x0: Any) -> Any:
        return jnp.sum(dvax.solve(problem, x0, 0.0, end).xs)

    return [
        ("solve", lambda: last(x0), least),
        ("gradient", lambda: jax.grad(last)(x0), _LEAST_GRADIENT),
        ("response", lambda: problem.response(0.3, x0), least),
        ("verify", lambda: dvax.verify(problem, x0, 0.0, end).constants, least),
    ]


def _first_and_again(call: Callable[[], Any]) -> tuple[float, float, float]:
    jax.clear_caches()
    start, worked = time.perf_counter(), time.process_time()
    jax.block_until_ready(call())
    first, worked = time.perf_counter() - start, time.process_time() - worked
    return first, worked, timed(lambda: jax.block_until_ready(call()))()


def _evaluation(problem: dvax.Problem, x0: Any) -> float:
    """Seconds of one response in a compiled loop over states that move a little."""

    @jax.jit
    def loop(x: Any) -> Any:
        def one(k: Any, y: Any) -> Any:
            state = x + 0.1 * jnp.sin(0.01 * k)
            return problem.law(0.0, state, y0=y).y

        return jax.lax.fori_loop(0, _EVALUATIONS, one, problem.zero_control(x))

    return timed(lambda: jax.block_until_ready(loop(x0)))() / _EVALUATIONS


_ROWS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 0.0], [0.0, 1.0, -2.0]])


def _direct(K: Any) -> tuple[dvax.Problem, Any]:
    """A law without iteration beyond that of the projection."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=K,
        f=lambda t, x, u, args: jnp.sin(t + jnp.arange(3.0)) + u,
        h=lambda t, x, u, args: 1.0 - 2.0 * x,
    )  # fmt: skip
    return problem, jnp.zeros(3)


def _dispatch() -> tuple[dvax.Problem, Any]:
    """Three batteries that meet a load from a table at prices from another: limits of power, and a
    condition that their powers add up to the load."""
    times = np.arange(0.0, 7.0)
    load = dvax.signals.Table(times, 1.0 + 0.5 * np.sin(times))
    price = dvax.signals.Table(times, 2.0 + np.cos(times))
    K = dvax.sets.Polyhedron(
        G=jnp.vstack([jnp.eye(3), -jnp.eye(3)]), d=2.0 * jnp.ones(6), E=jnp.ones((1, 3)),
        e=jnp.ones(1),
    )  # fmt: skip
    couple = jnp.asarray(0.3 * (np.ones((3, 3)) - np.eye(3)))
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-0.1), P=dvax.operators.Scaling(1.0), K=K,
        f=lambda t, x, u, args: -u * load(t),
        h=lambda t, x, u, args: x + price(t) - 0.5 * u - couple @ u,
    )  # fmt: skip
    return problem, jnp.array([1.0, 0.5, 0.2])


def _simplex() -> tuple[dvax.Problem, Any]:
    rng = np.random.default_rng(0)
    half, C = rng.normal(size=(2, 4, 4))
    C = jnp.asarray(0.3 * C)
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Dense(jnp.asarray(half @ half.T / 4 + np.eye(4))),
        K=dvax.sets.Simplex(1.0),
        f=lambda t, x, u, args: jnp.stack([jnp.sin(2 * t), jnp.cos(t), 0.0 * t, 0.5 + 0.0 * t]) - u,
        h=lambda t, x, u, args: C @ x - 0.5 * u,
    )
    return problem, jnp.array([1.0, -1.0, 0.5, 0.0])


def _game(cubic: float) -> tuple[dvax.Problem, Any]:
    """F(y) = Jy + cubic y³ − 1 + Cx: y ≥ 0, a bound on the sum, and two weighted ones."""
    rng = np.random.default_rng(1)
    S, C = rng.normal(size=(2, 6, 6))
    J, C = jnp.asarray(2.0 * np.eye(6) + 0.5 * (S - S.T)), jnp.asarray(C)
    G = np.vstack([-np.eye(6), np.ones((1, 6)), rng.uniform(0.0, 1.0, (2, 6))])
    d = np.concatenate([np.zeros(6), [2.0, 1.5, 1.5]])

    def h(t: Any, x: Any, u: Any, args: Any) -> Any:
        costs = J @ u + cubic * u**3 if cubic else J @ u
        return u - costs + 1.0 - C @ x

    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Polyhedron(G=jnp.asarray(G), d=jnp.asarray(d)),
        f=lambda t, x, u, args: jnp.sin(t + jnp.arange(6.0)) + u,
        h=h,
    )
    return problem, jnp.zeros(6)
