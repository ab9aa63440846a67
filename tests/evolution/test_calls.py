"""The arguments and results of `dvax.solve` around its compiled loop."""

import inspect
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import c1
from tests.selection import mostly_thorough

import dvax
from dvax._captured import current
from dvax.evolution.arguments import Arguments


def problem(f):
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 0.5),
        f=f,
        h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )


@pytest.mark.parametrize("rtol", [1.0, 10.0, 1e6])
def test_rtol_that_accepts_any_answer_is_refused(rtol):
    with pytest.raises(
        dvax.InputError, match=r"rtol\): got .*must be below 1, or an error as large"
    ):
        dvax.solve(c1().problem, -1.0, 0.0, 1.0, rtol=rtol)


def test_arguments_have_the_names_the_order_and_the_defaults_of_solve():
    signature = inspect.signature(dvax.solve).parameters.values()
    assert tuple(p.name for p in signature) == Arguments._fields
    defaults = {p.name: p.default for p in signature if p.default is not p.empty}
    assert defaults == Arguments._field_defaults


def test_solution_holds_the_given_problem_and_args_without_copies():
    case = c1()
    sol = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, dt=0.1)
    assert sol.setup.problem is current(case.problem)
    assert sol.setup.args is case.args


def test_integer_times_and_steps_give_the_same_run_as_floats():
    case = c1()
    whole = dvax.solve(case.problem, -1.0, 0, 2, args=case.args, dt=1)
    point = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, dt=1.0)
    assert float(whole.xs[0]) == float(point.xs[0])
    assert int(whole.stats["steps"]) == 2


@pytest.mark.thorough
def test_args_keep_python_integers_and_flags_and_convert_floats_to_arrays():
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


def test_error_if_inside_f_is_raised_with_its_message():
    def f(t, x, u, args):
        return eqx.error_if(3.0 - 0.5 * x - u, x > 1.0, "x left the range of the table")

    with pytest.raises(eqx.EquinoxRuntimeError, match="x left the range of the table"):
        dvax.solve(problem(f), -1.0, 0.0, 2.0, dt=0.01)


@pytest.mark.parametrize(
    "steps",
    [
        pytest.param(dict(dt=0.1), id="fixed"),
        pytest.param(dict(rtol=1e-6), id="adaptive", marks=pytest.mark.thorough),
    ],
)
def test_h_may_contain_a_debug_callback(steps):
    """A callback inside h is called, and does not change the solution."""
    told = []

    def h(t, x, u, args):
        jax.debug.callback(lambda x, u: told.append((float(x), float(u))), x, u)
        return 1.0 - 2.0 * x - u

    quiet = problem(lambda t, x, u, args: 3.0 - 0.5 * x - u)
    telling = eqx.tree_at(lambda p: p.h, quiet, h)
    found, want = (dvax.solve(p, -1.0, 0.0, 2.0, **steps).xs[-1] for p in (telling, quiet))
    jax.effects_barrier()
    assert told and abs(float(found - want)) < 1e-5


@pytest.mark.thorough
def test_saved_responses_of_a_field_are_certified_like_those_of_points():
    case = c1()
    x0 = np.linspace(-1.0, 3.0, 5000)
    field = dvax.solve(case.problem, x0, 0.0, 2.0, args=case.args, ts=[1.0, 2.0], dt=0.01)
    for k in (0, 2500, 4999):
        point = dvax.solve(case.problem, x0[k], 0.0, 2.0, args=case.args, ts=[1.0, 2.0], dt=0.01)
        np.testing.assert_allclose(np.asarray(field.us[:, k]), np.asarray(point.us), atol=1e-14)
    assert np.all(np.asarray(field.law_residual) <= 1e-12)


def test_args_with_true_and_1_compile_to_different_programs():
    def f(t, x, u, args):
        return (100.0 if args["on"] is True else 3.0) - 0.5 * x - u

    system = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=f, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip
    run = lambda on: float(dvax.solve(system, -1.0, 0.0, 2.0, {"on": on}, dt=0.5).xs[-1])  # noqa: E731
    number, flag = run(1), run(True)
    assert flag > 10.0 * number and run(1) == number


def test_unhashable_args_raise_an_error_that_names_them():
    system = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: -u, h=lambda t, x, u, args: x - u,
    )  # fmt: skip
    with pytest.raises(dvax.InputError, match=r"set \{1, 2\}.*hashable"):
        dvax.solve(system, -1.0, 0.0, 2.0, {1, 2}, dt=0.5)


@pytest.mark.thorough
@pytest.mark.parametrize("steps", [dict(rtol=1e-3, atol=1e-3), dict(dt=0.1, measure=True)])
def test_solve_keeps_single_precision(steps):
    one = jnp.float32
    system = dvax.Problem(
        A=dvax.generators.Scalar(one(-1.0)), P=dvax.operators.Scaling(one(1.0)),
        K=dvax.sets.Box(one(0.0), one(0.5)), f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
        h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip
    sol = dvax.solve(system, one(-1.0), 0.0, 2.0, **steps)
    assert sol.xs.dtype == jnp.float32
    assert float(sol.xs[-1]) == pytest.approx(1.8360919559905713, abs=5e-3)


@pytest.mark.parametrize(
    "steps",
    [
        pytest.param({"rtol": 1e-6}, id="adaptive", marks=pytest.mark.thorough),
        pytest.param({"dt": 0.01}, id="fixed"),
    ],
)
def test_progress_output_appears_on_request_and_does_not_change_the_solution(steps, capfd):
    case, steps = c1(), steps | {"method": dvax.ETD2RK()}
    silent = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, **steps)
    assert "%" not in "".join(capfd.readouterr())
    shown = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, progress=True, **steps)
    jax.block_until_ready(shown.xs)
    jax.effects_barrier()
    lines = capfd.readouterr().err.splitlines()
    said = [
        re.fullmatch(r"dvax.solve: (\d+)%, (\d+) steps of ETD2RK, [\d.e-]+ s( left)?", s)
        for s in lines
    ]
    shares, counts = ([int(m[k]) for m in said if m] for k in (1, 2))
    assert len(shares) == len(lines) > 3 and shares[-1] == 100
    assert sorted(shares) == shares and sorted(counts) == counts
    # Another program, which is compiled otherwise: equal to rounding.
    assert float(shown.xs[0]) == pytest.approx(float(silent.xs[0]), rel=1e-13)


@pytest.mark.parametrize(
    ("method", "a_step"),
    mostly_thorough(
        [(dvax.ETD1(), 1), (dvax.ETD2RK(), 2), (dvax.DormandPrince(), 7)], [(dvax.ETD2RK(), 2)]
    ),
)
def test_stats_count_the_evaluations_of_all_stages(method, a_step):
    case = c1()
    sol = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, dt=0.1, method=method)
    assert int(sol.stats["evaluations"]) == 20 * a_step
    # Measured, a step has its samples and its end as well, and the next one begins with that.
    sol = dvax.solve(
        case.problem, -1.0, 0.0, 2.0, args=case.args, dt=0.1, method=method, measure=True
    )
    samples = 0 if sol.enclosed else len(method.samples)
    assert int(sol.stats["evaluations"]) == 20 * (a_step + samples) + 1


def test_stats_count_the_evaluations_of_an_iterated_law():
    case = c1()
    run = dict(args=case.args, dt=0.1)
    iterated = dvax.solve(
        case.problem, -1.0, 0.0, 2.0, **run, vi_solver=dvax.vi.ForwardBackwardForward()
    )
    assert int(iterated.stats["evaluations"]) > 2 * 40


@pytest.mark.thorough
def test_stats_separate_compile_time_and_run_time():
    f = lambda t, x, u, args: 2.5 - 0.5 * x - u  # noqa: E731
    fresh = problem(f)
    first, again = (dvax.solve(fresh, -1.0, 0.0, 2.0, rtol=1e-5).stats for _ in range(2))
    assert first["compile_time"] > 0.0 and first["run_time"] > 0.0
    assert again["compile_time"] == 0.0 and again["run_time"] > 0.0
    inside = jax.jit(lambda x: dvax.solve(fresh, x, 0.0, 2.0, rtol=1e-5).stats)(-1.0)
    assert "run_time" not in inside
