"""What is called again with other numbers compiles nothing."""

import contextlib
import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.once import once

import dvax
from dvax._jax.compile_clock import listen

STAGES: list[str] = []
listen(lambda stage, seconds: STAGES.append(stage))


@contextlib.contextmanager
def nothing_is(*stages):
    STAGES.clear()
    yield
    assert not set(stages) & set(STAGES), STAGES


@once
def problem():
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, load: load - 0.5 * x - u,
        h=lambda t, x, u, load: 1.0 - 2.0 * x - u,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("method", [None, dvax.ETD2RK()], ids=["default", "ETD2RK"])
def test_second_solve_and_its_bound_compile_nothing(method):
    check = dvax.verify(problem(), -1.0, 0.0, 2.0, 3.0)

    def run(load):
        sol = dvax.solve(problem(), -1.0, 0.0, 2.0, load, [1.0, 2.0], method=method)
        return sol.us, dvax.bound_error(problem(), sol, check.constants).x

    run(3.0)
    with nothing_is("compile", "trace"):
        run(2.5)


@pytest.mark.slow
def test_second_piecewise_linear_run_traces_nothing_and_starts_where_it_should():
    switched = dvax.Problem(
        A=dvax.generators.Dense(jnp.array([[0.0, 1.0], [-1.0, -0.2]])),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(jnp.zeros(1), jnp.full(1, 0.5)),
        f=lambda t, x, u, load: jnp.concatenate([0.0 * u, jnp.sin(t) - load * u]),
        h=lambda t, x, u, load: x[:1] - 0.5 * u, control_space=dvax.spaces.Euclidean((1,)),
    )  # fmt: skip

    def run(x0, t0, t1, load=2.0):
        ts = np.linspace(t0, t1, 5)[1:]
        return dvax.solve(
            switched, x0, t0, t1, load, ts, method=dvax.PiecewiseLinear(), rtol=1e-10, atol=1e-12
        )

    x0 = jnp.array([0.1, 0.0])
    first = run(x0, 0.0, 4.0)
    middle = first.xs[-1]
    with nothing_is("compile", "trace"):
        second = run(middle, 4.0, 8.0)
    whole = run(x0, 0.0, 8.0)
    np.testing.assert_allclose(second.xs[-1], whole.xs[-1], atol=1e-9)
    # Nor are arguments kept that NumPy changes in place.
    load = np.array(2.0)
    run(x0, 0.0, 4.0, load)
    load[...] = 1.0
    changed = run(x0, 0.0, 4.0, load)
    # Other arguments are not those that were kept.
    other = run(x0, 0.0, 4.0, 1.0)
    expected = dvax.solve(switched, x0, 0.0, 4.0, 1.0, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(other.xs[-1], expected.xs[-1], atol=1e-8)
    np.testing.assert_array_equal(changed.xs[-1], other.xs[-1])
    assert not np.allclose(other.xs[-1], first.xs[-1], atol=1e-3)


@once
def coupled():
    """A law that a solver iterates for, on a set with switch functions."""
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Polyhedron(jnp.array([[1.0, 1.0], [-1.0, 0.0]]), jnp.array([0.6, 0.0])),
        f=lambda t, x, u, load: load * jnp.cos(t) - 0.5 * x + u,
        h=lambda t, x, u, load: x - jnp.array([[0.5, 0.3], [-0.3, 0.5]]) @ u,
    )  # fmt: skip


def read(load):
    sol = dvax.solve(
        coupled(), jnp.array([0.2, -0.1]), 0.0, 2.0, load, [1.0, 2.0], dense=True,
        method=dvax.DormandPrince(),
    )  # fmt: skip
    x, u = sol.evaluate(2.0)
    np.testing.assert_allclose(x, sol.xs[-1], rtol=1e-9)
    np.testing.assert_allclose(u, sol.us[-1], rtol=1e-7)
    np.testing.assert_allclose(sol.evaluate(np.array([[2.0, 1.0]]))[0][0], sol.xs[::-1], rtol=1e-9)
    return sol.regimes(), dvax.sensitivity.kinks(sol)


@pytest.mark.slow
def test_what_is_read_from_a_second_run_compiles_nothing():
    read(3.0)
    # The switch functions of K are counted by tracing K.
    with nothing_is("compile"):
        regimes, kinks = read(2.5)
    assert len(regimes.times) == len(regimes.positive) + 1 and len(kinks) > 0


@pytest.mark.slow
def test_a_number_of_numpy_compiles_nothing_after_one_of_python():
    read(3.0)
    with nothing_is("compile"):
        read(np.float64(2.75))


@pytest.mark.slow
def test_first_responses_of_a_law_that_iterates_are_one_program():
    problem = dataclasses.replace(coupled(), K=dvax.sets.Ball(jnp.zeros(2), 0.25))
    sol = dvax.solve(problem, jnp.array([0.2, -0.1]), 0.0, 0.1, 3.0, method=dvax.DormandPrince())
    STAGES.clear()
    assert np.isfinite(sol.us).all()
    assert STAGES.count("compile") == 1, STAGES


FIRST_USE = """
import jax

def first(load):
    from dvax._jax.traces import _OUTSIDE, current_trace  # modules of dvax are imported when first used
    assert current_trace() != _OUTSIDE
    return load

jax.jit(first)(2.0)
from dvax._jax.traces import _OUTSIDE, current_trace
assert current_trace() == _OUTSIDE
"""


@pytest.mark.slow
def test_dvax_may_be_used_first_inside_of_a_transformation():
    done = subprocess.run([sys.executable, "-c", FIRST_USE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_concrete_responses_are_read_inside_of_a_transformation():
    known = dvax.solve(problem(), -1.0, 0.0, 2.0, 3.0, dense=True, method=dvax.ETD2RK())

    def read(load):
        return load * float(np.asarray(known.us)[0]) * known.evaluate(0.5)[1]

    inside = jax.jit(read)(2.0)
    np.testing.assert_allclose(inside, read(2.0), rtol=1e-15)


def test_second_verification_of_a_law_without_a_proof_compiles_nothing():
    """The search for counterexamples is one program for all parameters."""

    def verify(load):
        law = dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
            K=dvax.sets.Box(0.0, jnp.ones(2)), f=lambda t, x, u, load: load - u,
            h=lambda t, x, u, load: x * load - jnp.sin(9.0 * u),
        )  # fmt: skip
        return dvax.verify(law, jnp.ones(2), 0.0, 2.0, jnp.asarray(load))["ass:strong_pseudomono"]

    assert verify(3.0).status != "proved"
    with nothing_is("compile"):
        verify(2.5)
