"""x.at[i].apply(fn) is no overwriting: no rule may treat its values as given ones."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.programs.slope import SlopeEnclosure, interval
from dvax.programs.structure import analyse

FUNCTIONS = {
    "3 sin": (lambda v: 3.0 * jnp.sin(v), 3.0),
    "v²": (lambda v: v * v, 4.0),
    "exp": (jnp.exp, np.exp(2.0)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_slopes_contain_the_function(name):
    fn, steepest = FUNCTIONS[name]
    low, high = np.full(2, -2.0), np.full(2, 2.0)
    found = SlopeEnclosure(lambda x: x.at[0].apply(fn), [np.zeros(2)], [0])(interval(low, high))
    part = found.out.parts[0]
    assert np.abs(part.center[0]).max() + part.radius[0].max() >= steepest


@pytest.mark.parametrize("name", FUNCTIONS)
def test_it_is_affine_only_where_it_writes_values(name):
    fn = FUNCTIONS[name][0]
    assert not analyse(lambda x: x.at[0].apply(fn), jnp.ones(2)).affine
    assert analyse(lambda x: x.at[0].set(1.0), jnp.ones(2)).affine


def system(g):
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, args: g(x) + 0.1 * u, h=lambda t, x, u, args: 0.3 * x,
    )  # fmt: skip


@pytest.mark.slow
def test_the_modulus_of_a_function_in_place_is_not_proved_and_not_too_small():
    problem = system(lambda x: x.at[0].apply(lambda v: 3.0 * jnp.sin(v)))
    verification = dvax.verify(problem, jnp.zeros(2), 0.0, 1.0)
    assert verification.constants.alpha_f > 2.5
    assert dict(verification.constants.statuses)["alpha_f"] == "estimated"
    # JAX has no derivative of it, and the default method needs none.
    sol = dvax.solve(problem, jnp.array([1e-3, 0.5]), 0.0, 6.0)
    same = system(lambda x: jnp.stack([3.0 * jnp.sin(x[0]), x[1]]))
    np.testing.assert_allclose(
        sol.xs, dvax.solve(same, jnp.array([1e-3, 0.5]), 0.0, 6.0, rtol=1e-10).xs, rtol=1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.05, 0.01])
def test_values_outside_of_a_table_are_in_the_bound(dt):
    """The table is left within a step, which no knot announces."""
    table = jnp.array([1.0, 2.0, 3.0])

    def f(t, x, u, args):
        place = jnp.floor(3.0 * t + 0.1).astype(int)
        return table.at[place].get(mode="fill", fill_value=1000.0) + 0.1 * u

    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=f, h=lambda t, x, u, args: 0.3 * x,
    )  # fmt: skip
    ts = np.array([0.95, 1.0, 1.5, 2.0])
    constants = dvax.verify(problem, 0.0, 0.0, 2.0).constants
    sol = dvax.solve(
        problem, 0.0, 0.0, 2.0, ts=ts, dt=dt, method=dvax.ETD2RK(), constants=constants
    )
    # Exact from jump to jump: 0.3x is inside K while |x| ≤ 10/3, and 1 beyond.
    times, values = [0.0, 0.3, 1.9 / 3.0, 2.9 / 3.0, 2.0], [1.0, 2.0, 3.0, 1000.0]
    exact = []
    for t in ts:
        x = 0.0
        for a, b, v in zip(times, times[1:], values, strict=False):
            if a < t:
                x = _after(x, min(b, t) - a, v)
        exact.append(x)
    error = np.abs(np.asarray(sol.xs) - exact)
    for bound in (dvax.bound_error(problem, sol, constants), dvax.bound_error(problem, sol)):
        assert (error <= np.asarray(bound.x)).all()


def _after(x, span, v):
    """x after `span` with x' = −x + v + 0.1 min(0.3x, 1), for x ≥ 0."""
    limit, rate = 1.0 / 0.3, 0.97
    if x < limit:
        rest = v / rate
        if rest <= limit or rest + (x - rest) * np.exp(-rate * span) < limit:
            return rest + (x - rest) * np.exp(-rate * span)
        until = np.log((rest - x) / (rest - limit)) / rate
        x, span = limit, span - until
    return (v + 0.1) + (x - (v + 0.1)) * np.exp(-span)
