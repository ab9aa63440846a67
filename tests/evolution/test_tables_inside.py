"""Tables that f creates: steps end at their kinks, as for tables created outside."""

import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax import generators, operators, sets, signals

TIMES, VALUES = np.array([0.0, 0.3, 0.31, 0.7, 1.0]), np.array([0.0, 1.0, -2.0, 3.0, 0.5])


@pytest.mark.parametrize(
    ("kind", "method", "shift"),
    mostly_thorough(
        [
            (kind, method, shift)
            for kind in ("linear", "constant")
            for method in (dvax.ETD2RK(), dvax.DormandPrince(), dvax.ETD4RK())
            for shift in (0.0, 0.0123, -0.11)
        ],
        [("linear", dvax.ETD2RK(), 0.0)],
    ),
)
def test_table_created_inside_f_is_integrated_exactly(kind, method, shift):
    times = TIMES.copy()
    times[1:-1] += shift * TIMES[1:-1] * (1.0 - TIMES[1:-1])

    def inside(t, x, u, args):
        return signals.Table(jnp.array(times), jnp.array(VALUES), kind=kind)(t) + 0.0 * u

    problem = dvax.Problem(
        A=generators.Zero(),
        P=operators.Scaling(1.0),
        K=sets.Box(-1.0, 1.0),
        f=inside,
        h=lambda t, x, u, args: x,
    )
    ts = np.array([0.2, 0.305, 0.5, 1.0])
    sol = dvax.solve(problem, 0.0, 0.0, 1.0, ts=ts, rtol=1e-8, atol=1e-10, method=method)
    fine = np.union1d(np.union1d(ts, times), np.linspace(0.0, 1.0, 11))
    if kind == "linear":
        pieces = np.interp(fine, times, VALUES)
        grown = np.cumsum(0.5 * (pieces[1:] + pieces[:-1]) * np.diff(fine))
    else:
        level = VALUES[np.searchsorted(times, 0.5 * (fine[1:] + fine[:-1])) - 1]
        grown = np.cumsum(level * np.diff(fine))
    exact = np.interp(ts, fine, np.append(0.0, grown))
    np.testing.assert_allclose(sol.xs, exact, atol=1e-9)
    assert int(sol.stats["rejected"]) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("q", "method"),
    mostly_thorough(
        [
            (q, m)
            for q in (1, 2, 5, 8)
            for m in (dvax.ETD2RK(), dvax.ETD4RK(), dvax.DormandPrince(), dvax.ExpRosenbrock())
        ],
        [(5, dvax.ETD2RK()), (2, dvax.ExpRosenbrock())],
    ),
)
def test_a_kink_that_no_code_declares_is_crossed(q, method):
    """A hat around t = q, from a table that is read by floor(t): its kinks are not found, and no
    enclosure holds across them. Until then x is exactly 0, and any step is accurate."""
    values = jnp.zeros(12).at[q].set(1.0)

    def hat(t):
        i = jnp.floor(t).astype(int)
        return values[i] + (t - jnp.floor(t)) * (values[i + 1] - values[i])

    problem = dvax.Problem(
        A=generators.Scalar(-1.0), P=operators.Scaling(1.0), K=sets.Box(-5.0, 5.0),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: hat(t),
    )  # fmt: skip
    assert len(problem.knots(0.0, 10.0, jnp.zeros(()))) == 0
    end = dvax.solve(problem, 0.0, 0.0, 10.0, method=method).xs[-1]
    assert float(end) == pytest.approx(np.exp(q - 10.0) * (2.0 * np.cosh(1.0) - 2.0), abs=2e-6)
