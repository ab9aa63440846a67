"""Problems of many kinds for the choice of a method, each written twice: as a problem of dvax, and with
its law solved by hand, for references and peers that share no code."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import dvax
from dvax import generators, sets

from .races import contact, heat, moving_box, shrinking_ball

PLAIN = dvax.operators.Scaling(1.0)


class Case(NamedTuple):
    """x(0) = x0 up to `end`; `field(t, x, lib)` is the right-hand side with the law solved by hand, by
    NumPy or JAX. x(end) is `exact` where that is known."""

    name: str
    problem: dvax.Problem
    x0: np.ndarray
    end: float
    field: Callable[[Any, Any, Any], Any]
    exact: np.ndarray | None = None

    def reference(self) -> np.ndarray:
        """Return x(end), from the closed form or from SciPy's Radau at 1e-12."""
        if self.exact is not None:
            return np.asarray(self.exact)
        found = solve_ivp(
            lambda t, x: np.asarray(self.field(t, x, np)), (0.0, self.end), self.x0,
            method="Radau", rtol=1e-12, atol=1e-14, max_step=self.end / 500,
        )  # fmt: skip
        assert found.success, found.message
        return found.y[:, -1]


def cases(full: bool) -> list[Case]:
    """Return the problems: small ones, stiff ones, oscillations, fields; the large field if `full`."""
    races = [contact(), moving_box(), shrinking_ball(), heat(16), heat(64), heat(256)]
    found = [Case(r.name, r.problem, r.x0, r.end, r.field, r.exact) for r in races]
    found += [_oscillator(k) for k in (3.0, 30.0, 1e3, 1e5)]
    found += [_diode(r) for r in (10.0, 1.0, 0.1, 1e-2, 1e-3)]
    found += [_spring(k) for k in (1e2, 1e3, 1e4, 1e6)]
    found += [_saturated_gain(k) for k in (1.0, 10.0, 1e2, 1e3, 1e4)]
    found += [_van_der_pol(m) for m in (1.0, 10.0, 50.0)]
    found += [_turning(w) for w in (3.0, 30.0, 100.0)]
    found += [_clipped_drive(), _pendulum(), _stiff_diagonal()]
    found += [_chain(n) for n in (5, 40)]
    found += [_shares(n) for n in (4, 12, 100)] + [_budget(200)]
    found += [_creep(eta) for eta in (1.0, 1e-2, 1e-4)]
    found += [_manufactured(A, K) for A in _MATRICES for K in _SETS]
    return found + [_strip(n) for n in ((100, 1000, 100_000) if full else (100,))]


def _planar(**parts: Any) -> dvax.Problem:
    return dvax.Problem(P=PLAIN, control_space=dvax.spaces.Euclidean(()), **parts)


def _oscillator(k: float) -> Case:
    """x'' = −x, with a spring of stiffness k below 0."""
    problem = _planar(
        A=generators.Dense(jnp.array([[0.0, 1.0], [-1.0, 0.0]])), K=sets.Box(0.0, jnp.inf),
        f=lambda t, x, u, args: jnp.stack([0.0 * u, u]),
        h=lambda t, x, u, args: u - (u / k + x[0]),
    )  # fmt: skip
    return Case(
        f"oscillator with a spring of {k:g} on one side", problem, np.array([1.0, 0.0]), 20.0,
        lambda t, x, lib: lib.stack([x[1], -x[0] + lib.maximum(0.0, -k * x[0])]),
    )  # fmt: skip


def _diode(r: float) -> Case:
    """A driven LC circuit whose voltage a diode of resistance r keeps above 0."""
    problem = _planar(
        A=generators.Dense(jnp.array([[0.0, -1.0], [1.0, -0.1]])), K=sets.Box(0.0, jnp.inf),
        f=lambda t, x, u, args: jnp.stack([jnp.sin(2 * t) + u, 0.0 * u]),
        h=lambda t, x, u, args: u - (r * u + x[0]),
    )  # fmt: skip
    return Case(
        f"circuit with a diode of {r:g} Ω", problem, np.array([1.0, 0.0]), 10.0,
        lambda t, x, lib: lib.stack(
            [-x[1] + lib.sin(2 * t) + lib.maximum(0.0, -x[0] / r), x[0] - 0.1 * x[1]]
        ),
    )  # fmt: skip


def _spring(k: float) -> Case:
    """A spring of stiffness k holds x above 1.5 against a slow force."""
    problem = dvax.Problem(
        A=generators.Zero(), P=PLAIN, K=sets.Box(0.0, jnp.inf),
        f=lambda t, x, u, args: 1.0 + jnp.sin(t) - x + u, h=lambda t, x, u, args: -k * (x - 1.5),
    )  # fmt: skip
    return Case(
        f"spring of {k:g}", problem, np.array([4.0]), 8.0,
        lambda t, x, lib: 1.0 + lib.sin(t) - x + lib.maximum(0.0, k * (1.5 - x)),
    )  # fmt: skip


def _saturated_gain(k: float) -> Case:
    """A feedback of gain k, saturated at ±2, makes x follow sin t."""
    problem = dvax.Problem(
        A=generators.Scalar(-1.0), P=PLAIN, K=sets.Box(-2.0, 2.0),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: k * (jnp.sin(t) - x),
    )  # fmt: skip
    return Case(
        f"saturated feedback of gain {k:g}", problem, np.array([2.0]), 10.0,
        lambda t, x, lib: -x + lib.clip(k * (lib.sin(t) - x), -2.0, 2.0),
    )  # fmt: skip


def _van_der_pol(m: float) -> Case:
    problem = _planar(
        A=generators.Zero(), K=sets.Box(-0.5, 0.5), h=lambda t, x, u, args: -x[0],
        f=lambda t, x, u, args: jnp.stack([x[1], m * (1 - x[0] ** 2) * x[1] - x[0] + u]),
    )  # fmt: skip
    return Case(
        f"van der Pol, {m:g}, with a bounded force", problem, np.array([2.0, 0.0]),
        15.0 if m < 10 else 60.0,
        lambda t, x, lib: lib.stack(
            [x[1], m * (1 - x[0] ** 2) * x[1] - x[0] + lib.clip(-x[0], -0.5, 0.5)]
        ),
    )  # fmt: skip


def _turning(w: float) -> Case:
    problem = _planar(
        A=generators.Dense(jnp.array([[-0.1, w], [-w, -0.1]])), K=sets.Box(-0.5, 0.5),
        f=lambda t, x, u, args: jnp.stack([u, jnp.sin(t)]), h=lambda t, x, u, args: -3 * x[0],
    )  # fmt: skip
    return Case(
        f"rotation at the rate {w:g}", problem, np.array([1.0, 0.0]), 5.0,
        lambda t, x, lib: lib.stack(
            [
                -0.1 * x[0] + w * x[1] + lib.clip(-3 * x[0], -0.5, 0.5),
                -w * x[0] - 0.1 * x[1] + lib.sin(t),
            ]
        ),
    )  # fmt: skip


def _clipped_drive() -> Case:
    problem = dvax.Problem(
        A=generators.Scalar(-1.0), P=PLAIN, K=sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: jnp.sin(5 * t) - u,
        h=lambda t, x, u, args: 0.5 * (x + jnp.cos(7 * t)),
    )  # fmt: skip
    return Case(
        "clipped periodic drive", problem, np.array([0.0]), 20.0,
        lambda t, x, lib: -x + lib.sin(5 * t) - lib.clip(0.5 * (x + lib.cos(7 * t)), 0.0, 0.5),
    )  # fmt: skip


def _pendulum() -> Case:
    problem = _planar(
        A=generators.Zero(), K=sets.Box(-0.3, 0.3), h=lambda t, x, u, args: -2.0 * x[1],
        f=lambda t, x, u, args: jnp.stack([x[1], -jnp.sin(x[0]) - 0.1 * x[1] + u]),
    )  # fmt: skip
    return Case(
        "pendulum with a bounded torque", problem, np.array([2.0, 0.0]), 15.0,
        lambda t, x, lib: lib.stack(
            [x[1], -lib.sin(x[0]) - 0.1 * x[1] + lib.clip(-2.0 * x[1], -0.3, 0.3)]
        ),
    )  # fmt: skip


def _stiff_diagonal() -> Case:
    rates = np.array([-1.0, -1e2, -1e4])
    problem = dvax.Problem(
        A=generators.Diagonal(jnp.asarray(rates)), P=PLAIN, K=sets.Box(0.0, 0.4),
        f=lambda t, x, u, args: jnp.sin(t) - u, h=lambda t, x, u, args: x,
    )  # fmt: skip
    return Case(
        "rates of 1, 100 and 10⁴", problem, np.array([1.0, 0.5, 0.2]), 5.0,
        lambda t, x, lib: rates * x + lib.sin(t) - lib.clip(x, 0.0, 0.4),
    )  # fmt: skip


def _chain(n: int) -> Case:
    """n masses on springs and dampers, the first one driven against a stop of stiffness 1000."""
    laplacian = np.eye(n, k=1) + np.eye(n, k=-1) - 2.0 * np.eye(n)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [laplacian, 0.1 * laplacian]])
    drive = np.zeros(2 * n)
    drive[2 * n - 1] = 1.0
    stop = np.zeros(2 * n)
    stop[n] = 1.0
    problem = dvax.Problem(
        A=generators.Dense(jnp.asarray(A)), P=PLAIN, K=sets.Box(0.0, jnp.inf),
        f=lambda t, x, u, args: jnp.asarray(drive) * jnp.sin(t) + jnp.asarray(stop) * u,
        h=lambda t, x, u, args: u - (1e-3 * u + x[0] + 0.1),
        control_space=dvax.spaces.Euclidean(()),
    )  # fmt: skip
    return Case(
        f"chain of {n} masses with a stop", problem, np.zeros(2 * n), 10.0,
        lambda t, x, lib: (
            A @ x + drive * lib.sin(t) + stop * lib.maximum(0.0, -1e3 * (x[0] + 0.1))
        ),
    )  # fmt: skip


def _shared(total: float, v: Any, lib: Any) -> Any:
    """The projection on the simplex of this sum, by sorting (Held, Wolfe and Crowder 1974)."""
    down = -lib.sort(-v)
    level = (lib.cumsum(down) - total) / lib.arange(1, v.shape[0] + 1)
    return lib.maximum(v - lib.max(level), 0.0)


def _shares(n: int) -> Case:
    """Shares on the simplex that follow payoffs, which the state lowers and a season moves."""
    phase = 2.0 * np.pi * np.arange(n) / n
    problem = dvax.Problem(
        A=generators.Scalar(-0.5), P=PLAIN, K=sets.Simplex(1.0), f=lambda t, x, u, args: u,
        h=lambda t, x, u, args: jnp.sin(t + jnp.asarray(phase)) - x,
    )  # fmt: skip
    return Case(
        f"shares on a simplex of {n}", problem, np.full(n, 1.0 / n), 10.0,
        lambda t, x, lib: -0.5 * x + _shared(1.0, lib.sin(t + phase) - x, lib),
    )  # fmt: skip


def _budget(n: int) -> Case:
    """n states that share a tenth of n by need, each pushed at its own frequency."""
    frequencies = np.linspace(1.0, 6.0, n)
    needs = 0.5 + 1.5 * np.modf(np.arange(n) * 0.6180339887)[0]

    problem = dvax.Problem(
        A=generators.Scalar(-1.0), P=PLAIN, K=sets.Simplex(n / 10),
        f=lambda t, x, u, args: jnp.sin(jnp.asarray(frequencies) * t) + u,
        h=lambda t, x, u, args: jnp.asarray(needs) - 2.0 * x,
    )  # fmt: skip
    return Case(
        f"a budget shared by {n}", problem, np.zeros(n), 3.0,
        lambda t, x, lib: -x + lib.sin(frequencies * t) + _shared(n / 10, needs - 2.0 * x, lib),
    )  # fmt: skip


def _creep(eta: float) -> Case:
    """A viscoplastic bar under a cycle of strain: stress above 1 relaxes at the rate 1/η."""
    problem = dvax.Problem(
        A=generators.Zero(), P=PLAIN, K=sets.Box(-1.0, 1.0),
        f=lambda t, x, u, args: 2.0 * jnp.cos(t) - (x - u) / eta, h=lambda t, x, u, args: x,
    )  # fmt: skip
    return Case(
        f"viscoplastic bar of viscosity {eta:g}", problem, np.array([0.0]), 10.0,
        lambda t, x, lib: 2.0 * lib.cos(t) - (x - lib.clip(x, -1.0, 1.0)) / eta,
    )  # fmt: skip


def _strip(n: int) -> Case:
    """Independent points, each with x' = c − 1.5 x − clip(g − 2x, 0, ½) of its own: by hand, from the
    closed form of each regime in turn."""
    s = np.linspace(0.0, 1.0, n)
    load, gap, x0 = 3.0 + s, 0.5 + 0.2 * np.sin(6 * s), -np.ones(n)
    problem = dvax.Problem(
        A=generators.Scalar(-1.0), P=PLAIN, K=sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: jnp.asarray(load) - 0.5 * x - u,
        h=lambda t, x, u, args: jnp.asarray(gap) - x,
    )  # fmt: skip
    # u = ½ while x < g − ½, then g − x up to x = g, then 0: x rises throughout.
    levels = (gap - 0.5, gap, np.full(n, np.inf))
    forces = ((load - 0.5, 1.5), (load - gap, 0.5), (load, 1.5))
    x, left = x0.copy(), np.full(n, 2.0)
    for level, (force, rate) in zip(levels, forces, strict=True):
        rest = force / rate
        with np.errstate(divide="ignore", invalid="ignore"):
            needed = np.log((rest - x) / (rest - level)) / rate
        spent = np.where(np.isfinite(needed), np.clip(needed, 0.0, left), left)
        x, left = rest + (x - rest) * np.exp(-rate * spent), left - spent
    return Case(
        f"strip of {n} points", problem, x0, 2.0,
        lambda t, x, lib: load - 1.5 * x - lib.clip(gap - x, 0.0, 0.5), x,
    )  # fmt: skip


_MATRICES: dict[str, tuple[Any, np.ndarray]] = {
    "A = 0": (generators.Zero(), np.zeros((3, 3))),
    "rates up to 2000": (
        generators.Diagonal(jnp.array([-0.5, -40.0, -2e3])), np.diag([-0.5, -40.0, -2e3]),
    ),
    "A far from normal": (
        generators.Dense(jnp.array([[-1.0, 30.0, 0.0], [0.0, -1.3, 5.0], [0.0, 0.0, -2.0]])),
        np.array([[-1.0, 30.0, 0.0], [0.0, -1.3, 5.0], [0.0, 0.0, -2.0]]),
    ),
    "a rotation at the rate 10": (
        generators.Dense(jnp.array([[0.0, 10.0, 0.0], [-10.0, 0.0, 0.0], [0.0, 0.0, -1.0]])),
        np.array([[0.0, 10.0, 0.0], [-10.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    ),
}  # fmt: skip
"""Generators of the manufactured problems, with their matrices."""


def _on_ball(t: Any, v: Any, lib: Any) -> Any:
    """The projection on the ball around 0.1 t of radius 1 − 0.2 t."""
    away = v - 0.1 * t
    length = lib.sqrt(lib.sum(away**2) + 1e-300)
    return 0.1 * t + away * lib.minimum(1.0, (1.0 - 0.2 * t) / length)


def _on_simplex(t: Any, v: Any, lib: Any) -> Any:
    """The projection on the simplex of total 1 + 0.3 cos t, by sorting (Held, Wolfe and Crowder
    1974)."""
    down = -lib.sort(-v)
    level = (lib.cumsum(down) - 1.0 - 0.3 * lib.cos(t)) / lib.arange(1.0, 4.0)
    return lib.maximum(v - lib.max(level), 0.0)


def _on_half_space(t: Any, v: Any, lib: Any) -> Any:
    """The projection on y₁ + 2y₂ + 3y₃ ≤ 0.3 t."""
    normal = lib.arange(1.0, 4.0)
    return v - lib.maximum(lib.sum(normal * v) - 0.3 * t, 0.0) * normal / 14.0


_SETS: dict[str, tuple[Any, Callable[..., Any]]] = {
    "box": (
        lambda t: sets.Box(-0.5 * jnp.exp(-t), 0.6 + 0.1 * jnp.sin(t)),
        lambda t, v, lib: lib.clip(v, -0.5 * lib.exp(-t), 0.6 + 0.1 * lib.sin(t)),
    ),
    "ball": (lambda t: sets.Ball(jnp.full(3, 0.1) * t, 1.0 - 0.2 * t), _on_ball),
    "simplex": (lambda t: sets.Simplex(1.0 + 0.3 * jnp.cos(t)), _on_simplex),
    "half-space": (lambda t: sets.HalfSpace(jnp.arange(1.0, 4.0), 0.3 * t), _on_half_space),
}
"""Sets that move, with their projections by hand."""


def _manufactured(generator: str, kind: str) -> Case:
    """x* is a smooth curve and y* the projection of another one on K(t), so that the constraints change
    again and again; P = 0.7, u* = y*/0.7, ξ* = z* − y* ∈ N_K(y*), and

        f = x*′ − Ax* + F_x (x − x*) + F_u (u − u*),   h = H_x (x − x*) − ½(u − u*) + u* + ξ*,

    so that y = proj_K(0.7 (H_x (x − x*) + 1.5 u* + ξ*)/1.5) by hand."""
    A, matrix = _MATRICES[generator]
    K, project = _SETS[kind]
    rng, pace, end = np.random.default_rng(7), np.arange(1.0, 4.0) / 3.0, 3.0
    F_x, F_u, H_x = (size * rng.normal(size=(3, 3)) / np.sqrt(3.0) for size in (0.4, 0.8, 0.8))
    # What A multiplies by much is small in x*, as in a smooth field.
    size = 1.0 / np.maximum(1.0, 0.1 * np.max(np.abs(matrix), axis=1) ** 0.9)

    def curves(t: Any, lib: Any) -> tuple[Any, Any, Any, Any]:
        """x*, x*′, u* and ξ*."""
        z = 1.2 * lib.sin(2.5 * t + 1.3 * lib.arange(3.0)) + 0.2
        y = project(t, z, lib)
        angle = pace * t + pace
        return size * lib.sin(angle), size * pace * lib.cos(angle), y / 0.7, z - y

    def f(t: Any, x: Any, u: Any, args: Any) -> Any:
        at, rate, u_star, _ = curves(t, jnp)
        return rate - matrix @ at + F_x @ (x - at) + F_u @ (u - u_star)

    def h(t: Any, x: Any, u: Any, args: Any) -> Any:
        at, _, u_star, outward = curves(t, jnp)
        return H_x @ (x - at) - 0.5 * (u - u_star) + u_star + outward

    def field(t: Any, x: Any, lib: Any) -> Any:
        at, rate, u_star, outward = curves(t, lib)
        u = project(t, 0.7 * (H_x @ (x - at) + 1.5 * u_star + outward) / 1.5, lib) / 0.7
        return matrix @ (x - at) + rate + F_x @ (x - at) + F_u @ (u - u_star)

    problem = dvax.Problem(
        A=A, P=dvax.operators.Scaling(0.7), K=lambda t, args: K(t), f=f, h=h,
        control_space=dvax.spaces.Euclidean(3),
    )  # fmt: skip
    x0, exact = (np.asarray(curves(t, np)[0]) for t in (0.0, end))
    return Case(f"manufactured, {generator}, {kind}", problem, x0, end, field, exact)
