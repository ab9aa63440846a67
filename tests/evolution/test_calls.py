"""What a call hands to its compiled loop, and what it gives back of it."""

import equinox as eqx
import numpy as np
import pytest
from tests.closed_forms import c1

import dvax


def problem(f):
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 0.5),
        f=f,
        h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )


def test_what_was_asked_is_not_copied():
    case = c1()
    sol = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, dt=0.1)
    assert sol.setup.problem is case.problem
    assert sol.setup.args is case.args


def test_whole_numbers_for_times_and_steps_are_the_same_run():
    case = c1()
    whole = dvax.solve(case.problem, -1.0, 0, 2, args=case.args, dt=1)
    point = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, dt=1.0)
    assert float(whole.xs[0]) == float(point.xs[0])
    assert int(whole.stats["steps"]) == 2


def test_integers_and_flags_in_args_stay_python_and_numbers_become_arrays_everywhere():
    seen = []

    def f(t, x, u, args):
        seen.append(type(args["few"]))
        ell = args["ell"].astype(x.dtype)
        for _ in range(args["few"]):
            ell = ell + 0.5
        return (ell if args["on"] else 0.0 * ell) - 0.5 * x - u

    given = {"ell": 2.0, "few": 2, "on": True}
    it = problem(f)
    sol = dvax.solve(it, -1.0, 0.0, 2.0, args=given, ts=[1.0, 2.0], dense=True, max_steps=10_000)
    x, _ = sol.evaluate(1.0)
    np.testing.assert_allclose(float(x), float(sol.xs[0]), atol=1e-9)
    off = dvax.solve(it, -1.0, 0.0, 2.0, args={**given, "on": False}, dt=0.01)
    assert set(seen) == {int}
    assert abs(float(off.xs[0] - sol.xs[-1])) > 0.1


def test_a_check_within_f_is_quoted():
    def f(t, x, u, args):
        return eqx.error_if(3.0 - 0.5 * x - u, x > 1.0, "x left the range of the table")

    with pytest.raises(eqx.EquinoxRuntimeError, match="x left the range of the table"):
        dvax.solve(problem(f), -1.0, 0.0, 2.0, dt=0.01)


def test_the_law_at_the_saved_states_is_certified_in_a_large_state_as_at_a_point():
    case = c1()
    x0 = np.linspace(-1.0, 3.0, 5000)
    field = dvax.solve(case.problem, x0, 0.0, 2.0, args=case.args, ts=[1.0, 2.0], dt=0.01)
    for k in (0, 2500, 4999):
        point = dvax.solve(case.problem, x0[k], 0.0, 2.0, args=case.args, ts=[1.0, 2.0], dt=0.01)
        np.testing.assert_allclose(np.asarray(field.us[:, k]), np.asarray(point.us), atol=1e-14)
    assert np.all(np.asarray(field.law_residual) <= 1e-12)
