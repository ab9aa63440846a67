"""A solve in single precision uses no double precision, and reports what it cannot reach."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params
from tests.vi.results import reasons, successful

import dvax
from dvax.sets import Box
from dvax.vi import (
    Auto,
    Bracketing,
    ClosedForm,
    Extragradient,
    ForwardBackwardForward,
    GoldenRatio,
    Projection,
    SemismoothNewton,
)

M = np.array([[2.0, -0.7, 0.1], [0.7, 1.5, 0.4], [0.0, -0.4, 1.0]], np.float32)


def mixing(y, q):
    return jnp.asarray(M) @ y + y**3 + q


def pointwise(y, q):
    return y + y**3 + q


def isotropic(y, q):
    return jnp.float32(2.0) * y + q


SOLVERS = {
    "newton": (SemismoothNewton(), mixing), "extragradient": (Extragradient(), mixing),
    "forward-backward-forward": (ForwardBackwardForward(), mixing),
    "golden ratio": (GoldenRatio(), mixing), "projection": (Projection(), mixing),
    "auto": (Auto(), mixing), "bracketing": (Bracketing(), pointwise),
    "closed": (ClosedForm(), isotropic),
}  # fmt: skip


def run(name, tol, gamma, y0, q, upper):
    solver, F = SOLVERS[name]
    L_F = 8.0 if name == "projection" else None
    return dvax.solve_vi(
        F, Box(jnp.float32(-1.0), upper), y0, q, solver, tol=tol, gamma=gamma, L_F=L_F
    )


def given(dtype):
    rng = np.random.default_rng(6)
    return [jnp.asarray(v, dtype) for v in (rng.normal(size=3), 3 * rng.normal(size=3), np.ones(3))]


def types(jaxpr):
    """The types of all values in a program, including inner programs."""
    for eqn in jaxpr.eqns:
        for out in eqn.outvars:
            yield eqn.primitive.name, getattr(out.aval, "dtype", None)
        for inner in jaxprs_in_params(eqn.params):
            yield from types(inner)


@pytest.mark.slow
@pytest.mark.parametrize("gamma", [None, 0.5])
@pytest.mark.parametrize("name", SOLVERS)
def test_solve_vi_keeps_single_precision(name, gamma):
    traced, shape = jax.make_jaxpr(
        lambda *v: run(name, 1e-4, gamma, *v), return_shape=True
    )(*given(jnp.float32))  # fmt: skip
    double = {kind for kind, dtype in types(traced.jaxpr) if dtype in (jnp.float64, jnp.complex128)}
    assert not double
    floats = [leaf for leaf in jax.tree.leaves(shape) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert len(floats) >= 2 and all(leaf.dtype == jnp.float32 for leaf in floats)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n == "auto" else pytest.mark.thorough) for n in SOLVERS],
)
def test_solve_vi_in_single_precision_reaches_rounding_or_reports_stalled(name):
    # One program for both tolerances, as `tol` is a number among the others.
    solve = jax.jit(lambda tol, *v: run(name, tol, jnp.float32(0.5), *v))
    # Its short steps are lost in rounding first.
    tol = 1e-3 if name == "projection" else 1e-4
    within = solve(jnp.float32(tol), *given(jnp.float32))
    assert successful(within)
    beyond = solve(jnp.float32(1e-12), *given(jnp.float32))
    if name not in ("bracketing", "closed"):  # they enclose the solution to rounding, and stop
        exactly = float(beyond.residual) == 0.0
        assert exactly or not successful(beyond)
        print(f"{name}: 1e-12 in single precision is {reasons(beyond, True) or 'met by chance'}")
    for vi in (within, beyond):
        assert float(vi.error_bound) < 1e-2
        _, q, _ = given(jnp.float64)
        F = np.asarray(
            SOLVERS[name][1](jnp.asarray(vi.y, jnp.float32), jnp.asarray(q, jnp.float32))
        )
        left = np.asarray(vi.y) - np.clip(np.asarray(vi.y) - F, -1, 1)
        assert np.abs(left).max() < 1e-3
