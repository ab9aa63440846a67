"""`Problem`: the frozen operator, the response, the reduced map, and rejected input."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax import generators, operators, sets, spaces

MATRIX = np.array([[2.0, 0.5], [0.5, 1.0]])


def make(**changed):
    parts = dict(
        A=generators.Scalar(-1.0),
        P=operators.Dense(MATRIX),
        K=sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: t - x - u,
        h=lambda t, x, u, args: 1.0 + x - 0.3 * u,
    )
    return dvax.Problem(**{**parts, **changed})


def test_frozen_operator_agrees_with_the_paper():
    y, x = np.array([0.2, -0.7]), np.array([1.0, 3.0])
    u = np.linalg.solve(MATRIX, y)
    found = make().frozen(0.4, jnp.asarray(x))(jnp.asarray(y))
    np.testing.assert_allclose(np.asarray(found), u - (1.0 + x - 0.3 * u), rtol=1e-13)


def test_response_solves_the_law_and_enters_the_reduced_map():
    # y is in K, and P⁻¹y − h(P⁻¹y) has the sign that the bounds ask for, entry by entry.
    x = np.array([-1.2, 3.0])
    made = make()
    u = np.asarray(made.response(0.4, jnp.asarray(x)))
    y, F = MATRIX @ u, u - (1.0 + x - 0.3 * u)
    assert np.all((y >= -1e-9) & (y <= 0.5 + 1e-9))
    for yi, Fi in zip(y, F, strict=True):
        assert (abs(Fi) < 1e-8) or (yi < 1e-9 and Fi > 0) or (yi > 0.5 - 1e-9 and Fi < 0)
    reduced = np.asarray(made.reduced(0.4, jnp.asarray(x)))
    np.testing.assert_allclose(reduced, 0.4 - x - u, rtol=1e-12)


def test_problem_data_may_depend_on_args_and_K_on_time():
    made = dvax.Problem(
        A=lambda a: generators.Scalar(-a),
        P=lambda a: operators.Scaling(a),
        K=lambda t, a: sets.Box(0.0, a * t),
        f=lambda t, x, u, a: a + 0.0 * x,
        h=lambda t, x, u, a: 9.0 + 0.0 * u,
    )
    # h pushes y to its upper bound a t; u = y/a = t.
    assert float(made.response(0.7, 0.0, 3.0)) == pytest.approx(0.7)
    assert float(made.generator(3.0).a) == -3.0
    assert float(made.operator(3.0).b) == 3.0


@pytest.mark.parametrize(
    ("changed", "x0", "words"),
    [
        ({"f": lambda t, x, u, args: x[0]}, jnp.zeros(2), ["Problem(f)", "()", "(2,)"]),
        ({"h": lambda t, x, u, args: jnp.zeros(3)}, jnp.zeros(2), ["Problem(h)", "(3,)", "(2,)"]),
        ({"K": sets.Box(jnp.zeros(3), 1.0)}, jnp.zeros(2), ["Box(lower)", "(3,)", "(2,)"]),
        (
            {"P": operators.Diagonal(jnp.ones(3))},
            jnp.zeros(2),
            ["P, Diagonal and K, Box", "(3,)", "(2,)"],
        ),
        ({"A": generators.Diagonal(jnp.ones(3))}, jnp.zeros(2), ["generators.Diagonal", "(3,)"]),
        ({"state_space": spaces.Euclidean(2)}, jnp.zeros(3), ["x0", "(3,)", "(2,)"]),
    ],
)
def test_problem_rejects_wrong_shapes_by_name(changed, x0, words):
    with pytest.raises(dvax.InputError) as caught:
        dvax.solve(make(**changed), x0, 0.0, 1.0)
    for word in words:
        assert word in str(caught.value)


def test_problem_reports_all_wrong_shapes_at_once():
    made = make(
        A=generators.Diagonal(jnp.ones(3)),
        P=operators.Dense(jnp.array([[1.0, 2.0], [0.0, 1.0]])),
        K=sets.Ball(jnp.zeros(5), 1.0),
        f=lambda t, x, u, args: x[0],
    )
    with pytest.raises(dvax.InputError) as caught:
        made.check(0.0, jnp.zeros(2))
    places = [problem.place for problem in caught.value.problems]
    assert [place.split("(")[0] for place in places] == [
        "dvax.generators.Diagonal",
        "dvax.operators.Dense",
        "dvax.sets.Ball",
        "dvax.Problem",
    ]


WRONG_KINDS = """
import dvax, jax.numpy as jnp
def places(make):
    try:
        make()
    except dvax.InputError as error:
        return [problem.place for problem in error.problems]
    return []
good = dvax.Problem(A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
                    K=dvax.sets.WholeSpace(), f=lambda t, x, u, args: x, h=lambda t, x, u, args: x)
print(places(lambda: dvax.Problem(A=-1.0, P=2.0, K=(0.0, 1.0), f=3.0, h=None)))
print(places(lambda: dvax.signals.Table([0.0, 1.0], [1.0, 2.0], "quintic")))
print(places(lambda: dvax.solve("problem", 0.0, 1.0, 0.0, method="Euler", adjoint="sideways")))
"""


def test_problem_reports_all_wrong_types_at_once():
    # In an interpreter without run-time annotations, which would answer first: a user has none.
    here = {**os.environ, "PYTHONPATH": str(Path(dvax.__file__).parents[1])}
    run = subprocess.run(
        [sys.executable, "-c", WRONG_KINDS], capture_output=True, text=True, check=True, env=here
    )
    assert [ast.literal_eval(line) for line in run.stdout.splitlines()] == [
        [f"dvax.Problem({name})" for name in "APKfh"],
        ["dvax.signals.Table(kind)"],
        [f"dvax.solve({name})" for name in ("problem", "method", "adjoint", "t0, t1")],
    ]


@pytest.mark.parametrize("x0", [np.array([1, 2]), "zero", None, True, 1j])
def test_problem_rejects_a_state_that_is_not_real(x0):
    with pytest.raises(dvax.InputError, match="x0"):
        dvax.solve(make(), x0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("args", "given"),
    [
        (np.array([1.0, "a"], dtype=object), "an array of object"),
        ({"names": np.array(["a", "b"])}, "an array of <U1"),
        ({0: 2.0, "n": 3.0}, "keys of several types"),
    ],
)
def test_problem_rejects_args_that_jax_cannot_trace(args, given):
    for name, call in {"solve": dvax.solve, "verify": dvax.verify}.items():
        with pytest.raises(dvax.InputError) as caught:
            call(make(), jnp.zeros(2), 0.0, 1.0, args)
        assert caught.value.problems[0].place == f"dvax.{name}(args)"
        assert given in caught.value.problems[0].given


@pytest.mark.slow
def test_problem_accepts_strings_in_args():
    sol = dvax.solve(make(), jnp.zeros(2), 0.0, 1.0, {"load": 2.0, "name": "of a run"})
    assert sol.result == dvax.RESULTS.successful


def test_the_place_of_a_set_that_is_refused_is_that_in_K():
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(args, 1.0),
        f=lambda t, x, u, args: u - x, h=lambda t, x, u, args: x - u,
    )  # fmt: skip
    assert problem.check(0.0, jnp.asarray(0.5), jnp.asarray(0.5)) is None
    with pytest.raises(dvax.InputError) as caught:
        problem.check(0.0, jnp.asarray(0.5), jnp.asarray(2.0))
    found = caught.value.problems[0]
    assert found.place.startswith("dvax.Problem(K)") and "test_problem.py, line" in found.place
    assert "dvax.sets.Box(lower, upper)" in found.place and "lower = 2" in found.given


PAIR = jnp.array([0.1, 0.2])


def of_parameters(**own):
    standard = dict(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 3.0),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: 16.0 - x,
    )  # fmt: skip
    return dvax.Problem(**{**standard, **own})


@pytest.mark.parametrize(
    ("own", "args"),
    [
        (dict(h=lambda t, x, u, args: args[2] * x), PAIR),
        (dict(h=lambda t, x, u, args: args[2] * x), np.asarray(PAIR)),
        (dict(f=lambda t, x, u, args: args["k"][5] * u), {"k": PAIR}),
        (dict(h=lambda t, x, u, args: args["k"][args["row"]] * x), {"k": PAIR, "row": 2}),
        (dict(K=lambda t, args: dvax.sets.Box(0.0, args[-3])), PAIR),
        (dict(A=lambda args: dvax.generators.Scalar(-args[2])), PAIR),
        (dict(P=lambda args: dvax.operators.Scaling(args[9])), PAIR),
    ],
    ids=["h", "array of NumPy", "f", "index in args", "K", "A", "P"],
)
def test_an_index_outside_of_an_array_in_args_is_refused(own, args):
    with pytest.raises(dvax.InputError, match="into an axis of 2 entries") as caught:
        of_parameters(**own).check(0.0, jnp.asarray(1.0), args)
    name = next(iter(own))
    assert caught.value.problems[0].place.startswith(f"dvax.Problem({name}), ")
    assert "test_problem.py, line" in caught.value.problems[0].place


@pytest.mark.parametrize("args", [[0.1, 0.2], (0.1, 0.2)])
def test_an_index_outside_of_a_list_in_args_names_args(args):
    with pytest.raises(dvax.InputError, match="index out of range; args has 2 entries"):
        of_parameters(h=lambda t, x, u, p: p[2] * x).check(0.0, jnp.asarray(1.0), args)
