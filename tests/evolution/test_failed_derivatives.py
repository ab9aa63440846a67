"""The derivative of a failed run is NaN in every mode; successful lanes of a batch keep theirs."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.once import once
from tests.selection import mostly_thorough

import dvax
from dvax import generators
from dvax.evolution import RESULTS

# x' = −x + ½u + sin(wt)/10 + s/(t − 0.7) + n(t), u = proj_{[−1,1]}((x + a)/(1 − g)), n NaN after b.
WELL = {"x0": 0.4, "t1": 2.0, "a": 0.3, "w": 1.0, "s": 0.0, "g": 0.0, "b": 9.0}
KINDS = {
    "law without solution": {"g": 3.0},
    "not a number": {"b": 0.7001},
    "out of steps": {"w": 1e4},
    "step too small": {"s": 0.1},
}


@once
def problem():
    def f(t, x, u, p):
        pole = p["s"] * jnp.where(p["s"] > 0, 1.0 / (t - 0.7), 0.0)
        return 0.5 * u + 0.1 * jnp.sin(p["w"] * t) + pole + jnp.where(t > p["b"], jnp.nan, 0.0)

    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-1.0, 1.0),
        f=f,
        h=lambda t, x, u, p: x + p["a"] + p["g"] * u,
    )


METHODS = {
    "ETD2RK": dvax.ETD2RK(),
    "ETD4RK": dvax.ETD4RK(),
    "DormandPrince": dvax.DormandPrince(),
    "ExpRosenbrock": dvax.ExpRosenbrock(),
    "Implicit": dvax.Implicit(),
    "Picard": dvax.Picard(),
}
# A window of Picard's method has 64 steps, of which the first few windows are short.
STEPS = {"Picard": 1000}


def solver(method, dt, adjoint):
    def solve(p):
        return dvax.solve(
            problem(), p["x0"], 0.0, p["t1"], p, ts=jnp.array([0.5, 1.5]), dt=dt, rtol=1e-4,
            atol=1e-6, max_steps=STEPS.get(method, 200), method=METHODS[method], adjoint=adjoint,
            throw=False,
        )  # fmt: skip

    return solve


def lanes(method, dt):
    kinds = [
        name for name in KINDS if dt is None or name in ("law without solution", "not a number")
    ]
    if method == "Implicit":
        # Its root finder raises where a tangent meets NaN.
        kinds = ["out of steps"]
    every = [WELL, *(WELL | KINDS[kind] for kind in kinds)]
    return {name: jnp.array([lane[name] for lane in every]) for name in WELL}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "dt", "adjoint"),
    mostly_thorough(
        [
            case
            for case in itertools.product(METHODS, (None, 0.05), ("reverse", "forward"))
            if case not in {("Implicit", 0.05, a) for a in ("reverse", "forward")}
            and case[::2] != ("Picard", "reverse")
        ],
        [("ETD2RK", None, "reverse")],
    ),
)
def test_derivatives_of_failed_lanes_are_nan_and_others_are_correct(method, dt, adjoint):
    solve = solver(method, dt, adjoint)

    def cost(p):
        sol = solve(p)
        return jnp.sum(sol.xs), sol.result == RESULTS.successful

    derive = partial(jax.grad if adjoint == "reverse" else jax.jacfwd, has_aux=True)
    batch = lanes(method, dt)
    found, successful = jax.jit(jax.vmap(derive(cost)))(batch)
    assert successful.tolist() == [True] + [False] * (len(successful) - 1)
    for name, values in found.items():
        assert np.isnan(values[1:]).all(), name
        assert np.isfinite(values[0]), name
    # Alone, the lane that succeeded has the same derivative.
    alone, _ = derive(cost)({name: value[0] for name, value in batch.items()})
    # Adaptive and implicit steps have other roundings in a batch, and sizes that follow them.
    # (The tolerance of these runs is 1e-6, for Implicit that of a step.)
    share = 1e-5 if method == "Implicit" else 1e-6
    rtol, atol = (1e-9, 1e-12) if dt is not None else (share, share)
    for name in WELL:
        np.testing.assert_allclose(found[name][0], alone[name], rtol=rtol, atol=atol)
    # Nor has one that is not part of a batch or a larger program.
    failed, _ = derive(cost)({name: value[1] for name, value in batch.items()})
    assert all(np.isnan(value) for value in failed.values())


@pytest.mark.thorough
@pytest.mark.parametrize(
    "mode", mostly_thorough(["hessian", "twice forward", "twice back", "linearize"], ["linearize"])
)
def test_second_derivatives_and_linearisations_of_failed_lanes_are_nan(mode):
    first = "forward" if mode in ("twice forward", "linearize") else "reverse"
    bad = {k: jnp.asarray(v) for k, v in (WELL | KINDS["not a number"]).items()}

    def end(a, x0):
        return solver("ETD2RK", 0.05, first)(bad | {"a": a, "x0": x0}).xs[-1]

    if mode == "linearize":
        _, push = jax.linearize(end, 0.3, 0.4)
        assert np.isnan(push(1.0, 0.0)) and np.isnan(push(0.0, 1.0))
        return
    twice = {
        "hessian": jax.hessian(end, (0, 1)),
        "twice forward": jax.jacfwd(jax.jacfwd(end, (0, 1)), (0, 1)),
        "twice back": jax.jacfwd(jax.jacrev(end, (0, 1)), (0, 1)),
    }[mode](0.3, 0.4)
    assert np.isnan(jax.tree_util.tree_leaves(twice)).all()


DERIVATIVES = {
    "grad": ("reverse", jax.grad),
    "vjp": ("reverse", lambda g: lambda v: jax.vjp(g, v)[1](1.0)[0]),
    "hessian": ("reverse", jax.hessian),
    "jacfwd": ("forward", jax.jacfwd),
    "jvp": ("forward", lambda g: lambda v: jax.jvp(g, (v,), (1.0,))[1]),
    "linearize": ("forward", lambda g: lambda v: jax.linearize(g, v)[1](1.0)),
}


FAILURES = [(kind, None) for kind in KINDS]
FAILURES += [(kind, 0.05) for kind in ("law without solution", "not a number")]


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "dt"), mostly_thorough(FAILURES, [("not a number", None)]))
@pytest.mark.parametrize("method", mostly_thorough([None, "ETD2RK", "ExpRosenbrock"], [None]))
@pytest.mark.parametrize("name", mostly_thorough([*DERIVATIVES], ["grad"]))
def test_a_failed_run_raises_inside_a_derivative_and_is_nan_inside_jit(kind, dt, method, name):
    adjoint, derive = DERIVATIVES[name]
    p = WELL | KINDS[kind]

    def end(a, closed_over=False):
        """The last state, with the parameter in args, or in what f and h close over."""
        q = p | {"a": a}
        given, data = problem(), q
        if closed_over:
            f, h = given.f, given.h
            given = dvax.Problem(
                A=given.A, P=given.P, K=given.K, f=lambda t, x, u, args: f(t, x, u, q),
                h=lambda t, x, u, args: h(t, x, u, q),
            )  # fmt: skip
            data = None
        return dvax.solve(
            given, 0.4, 0.0, 2.0, data, dt=dt, rtol=1e-4, atol=1e-6, adjoint=adjoint,
            max_steps=200, method=None if method is None else METHODS[method],
        ).xs[-1]  # fmt: skip

    with pytest.raises(dvax.SolveError) as plain:
        end(0.3)
    for closed_over in (False, True):
        with pytest.raises(dvax.SolveError) as caught:
            derive(partial(end, closed_over=closed_over))(0.3)
        # The fields of the message are numbers, found as without a derivative.
        assert caught.value.solution.result == plain.value.solution.result
        assert caught.value.cause.split(" ")[:3] == plain.value.cause.split(" ")[:3]
        assert np.isnan(jax.jit(partial(end, closed_over=closed_over))(0.3))
        assert np.isnan(jax.jit(derive(partial(end, closed_over=closed_over)))(0.3))
        assert np.isnan(
            jax.vmap(derive(partial(end, closed_over=closed_over)))(jnp.full(2, 0.3))
        ).all()


@pytest.mark.thorough
def test_stability_changes_the_method_inside_a_derivative():
    # Van der Pol's oscillator on its slow branch, where x' = −x/(μ(1 − x²)).
    problem = dvax.Problem(
        A=generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, mu: jnp.stack([x[1], mu * (1 - x[0] ** 2) * x[1] - x[0] + u[0]]),
        h=lambda t, x, u, mu: x[:1], control_space=dvax.spaces.Euclidean((1,)),
    )  # fmt: skip
    methods = []

    def end(mu):
        sol = dvax.solve(problem, jnp.array([2.0, 0.0]), 0.0, 20.0, mu)
        methods.append(sol.stats["method"])
        return sol.xs[-1, 0]

    derivative = jax.grad(end)(1000.0)
    assert methods[0].startswith("ExpRosenbrock")
    difference = (end(1001.0) - end(999.0)) / 2
    assert float(derivative) == pytest.approx(float(difference), rel=1e-4)
