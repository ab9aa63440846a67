"""x0, the end time and everything in args: A, P, K, f and h, by both modes against central differences
of the same steps, over methods × sets with the generators in turn."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax import generators, sets

N = 3
RNG = np.random.default_rng(11)
ROWS = RNG.normal(size=(4, N))
METHODS = {
    "ETD2RK": dvax.ETD2RK(),
    "ETD4RK": dvax.ETD4RK(),
    "DormandPrince": dvax.DormandPrince(),
    "ExpRosenbrock": dvax.ExpRosenbrock(),
    "ETD1": dvax.ETD1(),
    "Implicit": dvax.Implicit(),
    "Picard": dvax.Picard(),
}
SETS = {
    "Box": lambda t, p: sets.Box(-p["r"] * jnp.exp(-t), p["r"] + 0.1 * jnp.sin(t + p["c"])),
    "Ball": lambda t, p: sets.Ball(p["c"] * t, p["r"]),
    "HalfSpace": lambda t, p: sets.HalfSpace(1.0 + p["c"], p["r"] * jnp.cos(t)),
    "Simplex": lambda t, p: sets.Simplex(p["r"] + 0.3 * jnp.cos(t)),
    "SecondOrderCone": lambda t, p: sets.SecondOrderCone(p["r"] + 0.1 * t),
    "L1Ball": lambda t, p: sets.L1Ball(p["c"] * t, p["r"]),
    "Ellipsoid": lambda t, p: sets.Ellipsoid(p["c"], radii=p["r"] * jnp.arange(1.0, N + 1.0)),
    "Polyhedron": lambda t, p: sets.Polyhedron(
        jnp.asarray(ROWS), p["r"] + 0.1 * jnp.sin(t + jnp.arange(4.0))
    ),
}
GENERATORS = {
    "Scalar": lambda p: generators.Scalar(-p["a"]),
    "Diagonal": lambda p: generators.Diagonal(-p["a"] * jnp.array([0.5, 1.0, 4.0])),
    "Dense": lambda p: generators.Dense(p["a"] * jnp.asarray(ROWS[:3]) - 2.0 * jnp.eye(N)),
    "Elliptic": lambda p: generators.Elliptic(N, 1.0, diffusion=0.1 * p["a"], boundary="neumann"),
}
ARGS = {
    "a": jnp.array(0.7), "P": jnp.array([0.8, 1.1, 1.4]), "r": jnp.array(0.4),
    "c": jnp.array([0.1, -0.2, 0.15]), "load": jnp.array([1.0, -0.6, 0.4]), "gain": jnp.array(1.3),
}  # fmt: skip
X0, T1, TS = jnp.array([0.5, -0.4, 0.9]), jnp.array(0.99), np.array([0.33, 0.9])
"""Not a multiple of the step: there one more, however short, would begin."""
CASES = list(itertools.product(METHODS, SETS))
OFTEN = {("ETD2RK", "Ball"), ("Picard", "Ball")}


@pytest.mark.thorough
@pytest.mark.parametrize(("method", "kind"), mostly_thorough(CASES, OFTEN))
def test_derivatives_in_all_data_agree_with_central_differences(method, kind, uncached):
    names = list(GENERATORS)
    made = GENERATORS[names[CASES.index((method, kind)) % len(names)]]
    twist = jnp.asarray(0.3 * (ROWS[:3] - ROWS[:3].T))
    problem = dvax.Problem(
        A=made, P=lambda p: dvax.operators.Diagonal(p["P"]), K=SETS[kind],
        f=lambda t, x, u, p: p["load"] * jnp.sin(2 * t) - 0.5 * u + 0.1 * x**2,
        h=lambda t, x, u, p: p["gain"] * x - 0.6 * u + twist @ u + p["load"],
    )  # fmt: skip
    # Steps of Diffrax adapt, and step over kinks, where their derivatives are as good as steps are
    # short: these runs end before the first.
    adapts = method == "Implicit"
    steps = dict(rtol=1e-11, atol=1e-11) if adapts else dict(dt=1 / 16, max_steps=64)
    share = 0.1 if adapts else 1.0
    settings = dict(steps, method=METHODS[method])

    def asked(given, adjoint):
        x0, t1, args = given
        ts = jnp.append(share * TS, t1) if adapts or (method, kind) in OFTEN else TS
        sol = dvax.solve(problem, x0, 0.0, t1, args, ts, adjoint=adjoint, **settings)
        # Without times to save a run keeps its end alone; of Diffrax's one program is enough, and in
        # the short tests `test_times.py` has the end alone.
        one_solve = adapts or (method, kind) in OFTEN
        last = (
            sol
            if one_solve
            else dvax.solve(problem, x0, 0.0, t1, args, adjoint=adjoint, **settings)
        )
        weights = jnp.array([[1.0, -2.0, 0.5], [0.3, 1.0, 2.0]])
        saved = jnp.sum(weights * sol.xs[:2]) + jnp.sum(weights * sol.us[:2])
        return saved + jnp.sum(last.xs[-1] ** 2)

    # (That of the second part of u is at 0.005 otherwise, on the ball of ℓ₁.)
    given = X0 - jnp.array([0.0, 0.2, 0.0]) if adapts else X0, share * T1, ARGS
    rng = np.random.default_rng(3)
    along = jax.tree_util.tree_map(lambda a: jnp.asarray(rng.normal(size=a.shape)), given)
    moved = lambda e: jax.tree_util.tree_map(lambda a, d: a + e * d, given, along)  # noqa: E731
    value = jax.jit(lambda g: asked(g, "forward"))
    eps = 1e-4
    central = lambda e: (float(value(moved(e))) - float(value(moved(-e)))) / (2 * e)  # noqa: E731
    exact = (4 * central(eps / 2) - central(eps)) / 3
    forward = float(
        jax.jit(lambda g: jax.jvp(lambda q: asked(q, "forward"), (g,), (along,))[1])(given)
    )
    assert forward == pytest.approx(exact, rel=1e-6, abs=1e-6)
    if method == "Picard":  # forward derivatives only: `test_picard.py` has what it says to others
        return
    grad = jax.jit(jax.grad(lambda g: asked(g, "reverse")))(given)
    pairs = zip(*map(jax.tree_util.tree_leaves, (grad, along)), strict=True)
    assert float(sum(jnp.sum(a * b) for a, b in pairs)) == pytest.approx(forward, rel=1e-8)


@pytest.mark.slow
def test_an_adaptive_run_on_an_intersection_has_derivatives_in_both_modes():
    problem = dvax.Problem(
        A=generators.Scalar(-0.4), P=dvax.operators.Scaling(1.0),
        K=lambda t, r: sets.Intersection(sets.Box(-0.6, 0.6), sets.Ball(0.0, r)),
        f=lambda t, x, u, r: jnp.cos(2 * t) - 0.3 * x + u, h=lambda t, x, u, r: 2 * x - 0.5 * u,
    )  # fmt: skip

    def end(r, adjoint="reverse"):
        sol = dvax.solve(
            problem, jnp.array([1.0, 0.2]), 0.0, 0.5, r, rtol=1e-10, atol=1e-10, adjoint=adjoint
        )
        return jnp.sum(sol.xs[-1])

    forward = float(jax.jvp(lambda r: end(r, "forward"), (0.8,), (1.0,))[1])
    assert float(jax.grad(end)(0.8)) == pytest.approx(forward, rel=1e-8)
    # Steps go over the kinks of this set, which are not located: derivatives are as good as steps are
    # short.
    assert (float(end(0.8001)) - float(end(0.7999))) / 2e-4 == pytest.approx(forward, rel=1e-5)
