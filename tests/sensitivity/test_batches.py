"""Gradients of batches, and of a long run."""

import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import c1, c1_solution

import dvax


@pytest.mark.thorough
def test_gradients_of_an_adaptive_batch_equal_those_of_single_runs():
    """Each lane has its own steps and kinks, and waits when it has ended."""
    case = c1()

    def end(x0, load):
        return dvax.solve(
            case.problem, x0, 0.0, 2.0, (load,), rtol=1e-5, atol=1e-7, max_steps=2**12
        ).xs[-1]

    x0s, loads = jnp.array([-1.0, 0.2, 3.0, -2.5]), jnp.array([3.0, 1.0, 2.0, 5.0])
    both = jax.grad(end, argnums=(0, 1))
    together = jax.jit(jax.vmap(both))(x0s, loads)
    alone = [jax.jit(both)(x0, load) for x0, load in zip(x0s, loads, strict=True)]
    for k in range(2):
        one = np.array([pair[k] for pair in alone])
        np.testing.assert_allclose(np.asarray(together[k]), one, rtol=1e-10, atol=1e-12)


@pytest.mark.thorough
def test_gradient_of_ten_thousand_steps_fits_in_four_gigabytes():
    program = """
        import jax, jax.numpy as jnp, dvax
        jax.config.update("jax_enable_x64", True)
        n = 10**5
        g = 1.0 + jnp.sin(6.28 * jnp.arange(n) / n)
        problem = dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
            f=lambda t, x, u, p: p - 0.5 * x - u, h=lambda t, x, u, p: g - 2.0 * x - u,
        )
        total = lambda p: jnp.sum(
            dvax.solve(problem, jnp.full(n, -1.0), 0.0, 10.0, p, dt=1e-3).xs[-1]
        )
        slope = jax.grad(total)(jnp.full(n, 3.0))
        # Not ru_maxrss, which begins with the peak of the process that started this one.
        (peak,) = (line for line in open("/proc/self/status") if line.startswith("VmHWM"))
        print(float(slope[0]), int(peak.split()[1]) / 2**20)
    """
    run = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, check=True
    )
    slope, gigabytes = map(float, run.stdout.split())
    print(f"peak {gigabytes:.2f} GiB")
    assert 0.0 < slope < 1.0
    assert gigabytes < 4.0


ROWS = np.array([0.0, 0.25, 0.5, 1.0, 1.93, 2.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "steps",
    [
        pytest.param(dict(dt=0.05), id="dt"),
        pytest.param(dict(rtol=1e-4, max_steps=2**11), id="rtol", marks=pytest.mark.thorough),
    ],
)
@pytest.mark.parametrize(
    "ts", [pytest.param(None, marks=pytest.mark.thorough), ROWS], ids=["the last", "rows"]
)
def test_derivatives_of_a_batch_equal_those_of_its_runs(ts, steps):
    """In either order of transformations and either mode, of x and u, in mapped and shared data."""
    case = c1()

    def total(x0, load, adjoint):
        found = dvax.solve(case.problem, x0, 0.0, 2.0, (load,), ts=ts, adjoint=adjoint, **steps)
        return jnp.sum(jnp.sin(found.xs)) + jnp.sum(found.us)

    def of_all(x0s, load, adjoint):
        return jnp.sum(jax.vmap(lambda x0: total(x0, load, adjoint))(x0s))

    x0s = jnp.array([-1.0, 0.2, 3.0])
    alone = [jax.jit(jax.grad(total, (0, 1)), static_argnums=2)(x0, 3.0, "reverse") for x0 in x0s]
    exact = [pair[0] for pair in alone], sum(pair[1] for pair in alone)
    for found in (
        jax.jit(jax.grad(of_all, (0, 1)), static_argnums=2)(x0s, 3.0, "reverse"),
        jax.jit(jax.jacfwd(of_all, (0, 1)), static_argnums=2)(x0s, 3.0, "forward"),
    ):
        np.testing.assert_allclose(found[0], exact[0], rtol=1e-8)
        np.testing.assert_allclose(found[1], exact[1], rtol=1e-8)


@pytest.mark.thorough
def test_derivatives_of_a_batch_may_all_be_zero():
    """XLA then eliminates the whole loop, and aborts on unused arguments of an outlined call."""
    case = c1()

    def total(unused, x0, ts):
        return jnp.sum(
            dvax.solve(case.problem, x0, 0.0, 2.0, (jnp.asarray(3.0), unused), ts=ts, dt=0.1).xs
        )

    x0s, ts = jnp.array([-1.0, 0.0]), jnp.array([0.5, 1.0])
    slopes = jax.vmap(jax.grad(total), (0, 0, None))(jnp.ones(2), x0s, ts)
    np.testing.assert_array_equal(slopes, 0.0)
    by_time = jax.vmap(jax.grad(total, 2), (None, 0, None))(1.0, x0s, ts)
    velocity = lambda x, u: 3.0 - 1.5 * x - u  # noqa: E731
    for x0, row in zip(x0s, by_time, strict=True):
        pairs = (c1_solution(t, float(x0)) for t in ts)
        np.testing.assert_allclose(row, [velocity(x, u) for x, u in pairs], atol=0.02)
