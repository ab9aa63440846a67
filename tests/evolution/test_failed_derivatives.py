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
    # An implicit step is solved to its tolerance, with other roundings in a batch.
    rtol, atol = (1e-6, 1e-6) if method == "Implicit" else (1e-9, 1e-12)
    for name in WELL:
        np.testing.assert_allclose(found[name][0], alone[name], rtol=rtol, atol=atol)
    # Nor has one that is not part of a batch or a larger program.
    failed, _ = derive(cost)({name: value[1] for name, value in batch.items()})
    assert all(np.isnan(value) for value in failed.values())


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
