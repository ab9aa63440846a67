"""A `SolveError` names the cause that the functions show, and a fix that works."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from benchmarks.netlists import multiplier
from tests.selection import mostly_thorough

import dvax
from dvax import generators, operators, sets
from dvax.models import Circuit


def make(f, h=lambda t, x, u, args: 0.5 - u, K=None, A=None, **spaces):
    return dvax.Problem(
        A=generators.Zero() if A is None else A,
        P=operators.Scaling(1.0),
        K=sets.Box(0.0, 1.0) if K is None else K,
        f=f,
        h=h,
        **spaces,
    )


def failure(problem, x0=0.0, t1=2.0, t0=0.0, **options):
    with pytest.raises(dvax.SolveError) as caught:
        dvax.solve(problem, x0, t0, t1, **options)
    error = caught.value
    assert max(map(len, str(error).splitlines())) < 1000 and len(str(error).splitlines()) == 1
    return error


def fixes(error):
    return {fix.option: fix.value for fix in error.fixes}


ESCAPES = [
    # x' = c(1 + x^p) from 0 escapes at π/(c p sin(π/p)).
    (p, c, method)
    for p in (2.0, 1.5, 3.0, 4.0)
    for c in (1.0, 20.0)
    for method in (dvax.DormandPrince(), dvax.ETD2RK(), dvax.ETD4RK(), dvax.ExpRosenbrock())
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("p", "c", "method"),
    mostly_thorough(ESCAPES, [(3.0, 20.0, dvax.ETD2RK())]),
)
def test_cause_finite_time_escape_names_the_time(p, c, method):
    problem = make(lambda t, x, u, args: c * (1.0 + jnp.abs(x) ** p))
    escape = math.pi / (c * p * math.sin(math.pi / p))
    error = failure(problem, t1=3.0 * escape, method=method)
    assert "finite-time escape" in error.cause
    told = float(error.cause.split("t ≈ ")[1].split()[0])
    assert told == pytest.approx(escape, rel=1e-2)
    # The fix works: up to there the solution exists.
    end = float(fixes(error)["t1"])
    assert 0.9 * escape < end < escape
    loose = dict(rtol=1e-3, atol=1e-3)
    assert dvax.solve(problem, 0.0, 0.0, end, method=dvax.DormandPrince(), **loose).xs.shape == (1,)


@pytest.mark.thorough
@pytest.mark.parametrize("steps", mostly_thorough([60, 90, 120], [90]))
def test_cause_growth_faster_than_exponential_is_not_reported_as_escape(steps):
    # A drive that grows faster than any exponential, and a state that only follows it.
    error = failure(
        make(lambda t, x, u, args: jnp.exp(t**2) - x), t1=6.0, max_steps=steps, rtol=1e-8,
        method=dvax.DormandPrince(),
    )  # fmt: skip
    assert "escape" not in str(error)


@pytest.mark.thorough
def test_cause_exponential_growth_is_not_reported_as_escape():
    error = failure(make(lambda t, x, u, args: x), x0=1.0, t1=1e4, rtol=1e-3)
    assert "escape" not in str(error) and "exponential growth" in error.cause


@pytest.mark.slow
@pytest.mark.parametrize(
    "A",
    [
        dvax.generators.Dense(np.diag([2000.0, -1.0, 3.0, 0.5])),
        dvax.generators.Sparse(
            scipy.sparse.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(4, 4)) * 1e3
        ),
    ],
    ids=["matrix", "diffusion of the wrong sign"],
)
def test_cause_fast_growth_ends_the_run_where_the_norm_overflows(A):
    # Beyond it no defect can be compared with the state: the steps became ever shorter.
    error = failure(make(lambda t, x, u, args: u, A=A), x0=jnp.ones(4), t1=10.0, rtol=1e-3)
    assert "exponential growth" in error.cause and "Check the signs in A" in str(error)
    assert float(error.solution.stats["t"]) < 0.5


@pytest.mark.thorough
@pytest.mark.parametrize("rate", [3.0, 10.0, 60.0])
@pytest.mark.parametrize(
    "K",
    [
        sets.Box(0.0, 0.2),
        sets.Simplex(0.5),
        sets.ConstrainedBox(0.0, 0.2, np.ones((1, 4)), np.zeros(1), np.full(1, 0.5)),
        sets.Polyhedron(
            np.vstack([np.eye(4), -np.eye(4)]), np.append(np.full(4, 0.2), np.zeros(4))
        ),
    ],
    ids=["box", "simplex", "constrained box", "polyhedron"],
)
def test_cause_growth_that_makes_a_run_stiff_is_named(K, rate):
    """An epidemic whose infected recover at a rate of the wrong sign: the susceptible decay at a rate
    that grows with the infected, to 10¹⁰⁰ times the scale of K and of the susceptible."""

    def f(t, x, u, args):
        infections = 0.4 * x[:4] * jnp.mean(x[4:])
        return jnp.concatenate([-infections - u * x[:4], infections + rate * x[4:]])

    problem = make(
        f, lambda t, x, u, args: 4.0 * x[4:] - 0.5 * u, K, control_space=dvax.spaces.Euclidean(4)
    )
    x0 = jnp.concatenate([jnp.ones(4), jnp.array([0.05, 0.01, 0.01, 0.01])])
    error = failure(problem, x0=x0, t1=400.0 / rate)
    assert "exponential growth" in error.cause and "Check the signs in A" in str(error)
    error = failure(
        make(lambda t, x, u, args: t - x), x0=1.0, t1=50.0, max_steps=9, method=dvax.ETD2RK()
    )
    assert "grow" not in error.cause.split("max_steps")[0]


@pytest.mark.slow
@pytest.mark.parametrize("most", [1, 20, 60, 100])
def test_cause_too_few_steps_of_a_circuit_is_the_only_one_reported(most):
    # A multiplier with 20 periods of its source: with 20 steps not even these have a piece each.
    circuit = Circuit(multiplier(4, 1e-6, 1e-7, 1e4, 325.0, 1e6, 1e-6, 10.0))
    with pytest.raises(dvax.SolveError) as caught:
        circuit.solve(2e-3, max_steps=most)
    error = caught.value
    assert f"max_steps = {most} attempts were used" in error.cause
    assert [fix.option for fix in error.fixes] == ["max_steps"]
    assert most < int(error.fixes[0].value) <= 100 * most


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "at", "k"),
    mostly_thorough(
        [(name, at, k) for name in "fhK" for at in (0.37, 1.0, 1.9) for k in (0, 2)],
        [("K", 1.0, 0)],
    ),
)
def test_cause_nonfinite_value_names_function_time_and_component(name, at, k):
    def spoil(which, t):
        bad = (jnp.arange(3) == k) & (t >= at) & (which == name)
        return jnp.where(bad, jnp.nan, 0.0)

    problem = make(
        lambda t, x, u, args: -u + spoil("f", t),
        h=lambda t, x, u, args: x - u + spoil("h", t),
        K=lambda t, args: sets.Box(spoil("K", t), 1.0),
        A=generators.Scalar(-1.0),
    )
    error = failure(problem, x0=jnp.ones(3), rtol=1e-4)
    assert f"{name} is " in error.cause and f"t = {at:g}" in error.cause
    assert name == "K" or f"({k},)" in error.cause  # the box is refused as a whole


@pytest.mark.thorough
def test_nonfinite_response_fails_even_if_f_does_not_depend_on_it():
    upper = jnp.array([1.0, jnp.nan])
    problem = make(
        lambda t, x, u, args: -x, K=lambda t, args: sets.Box(0.0, jnp.where(t < 1.5, 1.0, upper))
    )
    error = failure(problem, x0=jnp.ones(2), ts=[0.0, 1.0, 2.0], rtol=1e-3)
    assert "K is " in error.cause


@pytest.mark.thorough
def test_cause_state_outside_the_domain_of_f_names_the_place():
    # x' = −1 from ½ under √x, with a part that is NaN below 0.
    problem = make(lambda t, x, u, args: -1.0 + 0.0 * jnp.log(x))
    error = failure(problem, x0=0.5, t1=2.0)
    assert "f is nan" in error.cause
    assert float(error.cause.split("t = ")[1].split(",")[0]) == pytest.approx(0.5, abs=1e-6)


@pytest.mark.thorough
def test_cause_nonmonotone_law_names_the_eigenvalue():
    gain = jnp.array([1.0, 3.0, 0.5])
    problem = make(lambda t, x, u, args: -u, h=lambda t, x, u, args: 1.0 - x + gain * u)
    error = failure(problem, x0=jnp.zeros(3), t1=1.0)
    assert "not strongly monotone" in error.cause and "eigenvalue -2 " in error.cause


@pytest.mark.slow
def test_cause_law_that_does_not_depend_on_u_names_the_eigenvalue():
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Ball(0.0, 1.0),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: 1.0 + x + u,
    )  # fmt: skip
    error = failure(problem, x0=jnp.zeros(2), t1=1.0)
    assert "not strongly monotone" in error.cause and "eigenvalue 0 " in error.cause
    assert "Subtract ε u from h" in str(error)


@pytest.mark.thorough
@pytest.mark.parametrize("rate", mostly_thorough([1e4, 1e5, 1e7, 1e9], [1e7]))
def test_cause_stiffness_suggests_a_method_that_succeeds(rate):
    problem = make(lambda t, x, u, args: -rate * (x - jnp.cos(t)))
    error = failure(problem, t1=1.0, method=dvax.DormandPrince(), max_steps=4000)
    assert "stiff" in error.cause
    assert float(error.cause.split("of about ")[1].split(",")[0]) == pytest.approx(-rate, rel=1e-3)
    method = getattr(dvax, fixes(error)["method"])()
    found = dvax.solve(problem, 0.0, 0.0, 1.0, method=method, max_steps=100_000)
    assert float(found.xs[-1]) == pytest.approx(math.cos(1.0), abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("tolerances", [{"rtol": 1e-10}, {"rtol": 0.0, "atol": 1e-9}])
def test_many_times_the_steps_so_far_are_the_last_advice(tolerances):
    problem = make(lambda t, x, u, args: jnp.sin(20.0 * t) - x)
    error = failure(problem, t1=500.0, max_steps=200, **tolerances)
    (loosened,) = set(fixes(error)) & {"rtol", "atol"}
    assert float(fixes(error)[loosened]) == pytest.approx(100 * tolerances[loosened])
    assert [fix.option for fix in error.fixes][-1] == "max_steps"
    assert int(fixes(error)["max_steps"]) % 100 == 0


@pytest.mark.slow
def test_suggested_max_steps_suffices():
    problem = make(lambda t, x, u, args: jnp.cos(5.0 * t) - x)
    error = failure(problem, t1=20.0, max_steps=300, rtol=1e-6)
    enough = int(fixes(error)["max_steps"])
    assert enough > 300
    dvax.solve(problem, 0.0, 0.0, 20.0, max_steps=enough, rtol=1e-6)


@pytest.mark.thorough
def test_cause_tolerance_below_rounding_suggests_an_attainable_tolerance():
    problem = make(lambda t, x, u, args: jnp.sin(t) - x)
    with pytest.warns(UserWarning, match="cannot be reached"):
        error = failure(problem, x0=1.0, t1=1.0, rtol=1e-20, atol=0.0, max_steps=10_000)
    assert "rounding of f" in error.cause
    rtol = float(fixes(error)["rtol"])
    found = dvax.solve(
        problem, 1.0, 0.0, 1.0, rtol=rtol, atol=0.0, method=dvax.ETD4RK(), max_steps=10**6
    )
    exact = 1.5 * math.exp(-1.0) + 0.5 * (math.sin(1.0) - math.cos(1.0))
    assert float(found.xs[-1]) == pytest.approx(exact, abs=1e-8)


@pytest.mark.parametrize("t0", mostly_thorough([1e15, -1e15], [1e15]))
def test_cause_rounding_of_large_times_is_reported(t0):
    problem = make(lambda t, x, u, args: -x, h=lambda t, x, u, args: 1.0 - 2.0 * x - u)
    error = failure(problem, x0=1.0, t0=t0, t1=t0 + 100.0, method=dvax.ETD2RK())
    assert "rounding of t" in error.cause and "Count time from" in str(error)


RESTING = make(lambda t, x, u, args: -1e-20 * x)  # one program for all spans


@pytest.mark.parametrize("t0", [1.0, -1.0, 4036.4, 1e15])
@pytest.mark.parametrize("ulps", mostly_thorough([1, 2, 3, 8, 64, 300, 512], [1, 64]))
def test_solve_over_a_span_of_a_few_roundings_succeeds(t0, ulps):
    t1 = t0 + ulps * float(np.spacing(abs(t0)))
    assert float(dvax.solve(RESTING, 1.0, t0, t1).xs[-1]) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.thorough
def test_shape_of_u_follows_from_P_or_K():
    # x ∈ ℝ², u ∈ ℝ³, given by K alone, by P alone, by both, and by the parts of a product.
    options = [
        (operators.Scaling(1.0), sets.Box(jnp.zeros(3), jnp.ones(3))),
        (operators.Dense(jnp.eye(3)), sets.Box(0.0, 1.0)),
        (operators.Diagonal(jnp.ones(3)), sets.Ball(jnp.zeros(3), 1.0)),
        (operators.Scaling(1.0), sets.HalfSpace(jnp.ones(3), 1.0)),
    ]
    for P, K in options:
        problem = dvax.Problem(
            A=generators.Zero(), P=P, K=K,
            f=lambda t, x, u, args: -x + u[:2], h=lambda t, x, u, args: jnp.full(3, 0.25),
        )  # fmt: skip
        np.testing.assert_allclose(problem.response(0.0, jnp.zeros(2)), 0.25, atol=1e-9)
    pair = dvax.Problem(
        A=generators.Zero(),
        P=operators.Product(operators.Dense(jnp.eye(3)), operators.Diagonal(jnp.ones(1))),
        K=sets.Product(sets.Box(0.0, 1.0), sets.Box(0.0, 1.0)),
        f=lambda t, x, u, args: -x + u[0][:2] + u[1],
        h=lambda t, x, u, args: (jnp.full(3, 0.25), jnp.full(1, 2.0)),
    )  # fmt: skip
    first, second = pair.response(0.0, jnp.zeros(2))
    np.testing.assert_allclose(first, 0.25, atol=1e-9)
    np.testing.assert_allclose(second, 1.0, atol=1e-9)


def test_shape_of_u_is_that_of_the_state_if_both_fit():
    # A matrix of the size of x, and bounds that are numbers, leave u what x is.
    problem = make(lambda t, x, u, args: -u, h=lambda t, x, u, args: x)
    assert problem.zero_control(jnp.zeros(4)).shape == (4,)
    square = dvax.Problem(
        A=generators.Zero(), P=operators.Dense(2.0 * jnp.eye(4)), K=sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: -u, h=lambda t, x, u, args: x,
    )  # fmt: skip
    assert square.zero_control(jnp.zeros(4)).shape == (4,)


EMPTIED = [
    lambda t, a: sets.Box(0.0, 0.5 - t),
    lambda t, a: sets.Box(t - 0.5, 0.0),
    lambda t, a: sets.Box(0.0, jnp.abs(t - 0.5001) - 1e-4),
    lambda t, a: sets.Box(0.0, jnp.where((t > 0.5) & (t < 0.5001), -1.0, 1.0)),
    lambda t, a: sets.Ball(0.0, 0.5 - t),
]


@pytest.mark.parametrize(
    ("K", "method"),
    mostly_thorough(
        [
            (K, method)
            for K in EMPTIED
            for method in (dvax.ETD2RK(), dvax.DormandPrince(), dvax.ETD4RK())
        ],
        [(EMPTIED[0], dvax.ETD2RK())],
    ),
)
def test_cause_empty_set_names_the_time(K, method):
    error = failure(make(lambda t, x, u, args: u - x, K=K), x0=0.1, t1=1.0, method=method)
    # Of no value that is not finite: the set is refused, by its own words. The third and the fourth
    # set are empty for a short time only.
    when = "at" if K in EMPTIED[2:4] else "from"
    assert str(error).startswith(f"K is refused {when} t = 0.5")
    assert "empty" in error.cause and "Check K there." in str(error)


@pytest.mark.slow
def test_cause_conditions_that_contradict_each_other_are_reported_as_an_empty_set():
    cube = jnp.concatenate([jnp.eye(3), -jnp.ones((1, 3))])
    release = jnp.concatenate([jnp.ones((1, 3)), -jnp.eye(3)])
    for K, words in (
        (
            sets.Intersection(sets.Box(0.0, 2.0), sets.HalfSpace(-jnp.ones(3), -7.0)),
            ("K is empty from t = 0", "contradict"),
        ),
        (
            lambda t, a: sets.Polyhedron(cube, jnp.array([2.0, 2.0, 2.0, -12 * t])),
            ("K is refused from t = 0.5", "no y satisfies rows 0, 1, 2, 3 of G"),
        ),
        (
            lambda t, a: sets.Polyhedron(release, jnp.array([8.0 - 5.0 * t, -3.0, -2.0, -1.0])),
            ("K is refused from t = 0.4", "no y satisfies rows 0, 1, 2, 3 of G"),
        ),
    ):
        problem = make(lambda t, x, u, args: u - x, lambda t, x, u, args: x - 0.5 * u, K)
        error = failure(problem, x0=jnp.ones(3), t1=1.0)
        for word in words:
            assert word in str(error)


@pytest.mark.slow
def test_cause_nonfinite_value_at_the_start_is_reported():
    error = failure(make(lambda t, x, u, args: 1.0 / t), x0=0.1, t1=1.0)
    assert "next to t = 0 " in error.cause or "f is inf" in error.cause
    assert "t1" not in fixes(error)


RELAYS = {
    # x' as a function of s = sign(g(x)), g, x0, the time at which x first meets g = 0.
    "one": (lambda x, s: -s, lambda x: x, 1.0, 1.0),
    "friction": (lambda x, s: jnp.stack([x[1], -x[0] - 0.5 * s]), lambda x: x[1], [3.0, 0.0], None),
    "surface": (
        lambda x, s: jnp.stack([x[1], -2.0 * s]), lambda x: x[0] + x[1], [1.0, 0.3], None
    ),
}  # fmt: skip
METHODS = {
    "ETD2RK": None, "DormandPrince": dvax.DormandPrince(), "ExpRosenbrock": dvax.ExpRosenbrock(),
    "ETD4RK": dvax.ETD4RK(),
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "method"),
    mostly_thorough([(n, m) for n in RELAYS for m in METHODS], [("one", "ETD2RK")]),
)
def test_cause_relay_in_x_is_reported_and_can_be_written_as_a_law(name, method):
    rate, g, x0, when = RELAYS[name]
    problem = make(lambda t, x, u, args: rate(x, jnp.sign(g(x))))
    error = failure(problem, x0=jnp.asarray(x0), t1=20.0, method=METHODS[method])
    assert "x' jumps as a function of x" in error.cause and "slide along it" in error.cause
    told = float(error.solution.stats["t"])
    assert when is None or told == pytest.approx(when, abs=1e-6)
    # The fix, to the letter: a layer of width ε, in which the solution stays.
    width = 1e-3
    one = dvax.spaces.Euclidean(())
    smooth = make(
        lambda t, x, u, args: rate(x, u), lambda t, x, u, args: g(x) / width, sets.Box(-1.0, 1.0),
        control_space=one,
    )  # fmt: skip
    sol = dvax.solve(
        smooth, jnp.asarray(x0), 0.0, told + 1e-2, method=dvax.ExpRosenbrock(), rtol=1e-4, atol=1e-6
    )
    assert abs(float(g(sol.xs[-1]))) <= 1.01 * width


def test_cause_growth_from_zero_has_no_mean_rate():
    error = failure(make(lambda t, x, u, args: 3.0 * x + 1.0), x0=jnp.asarray(0.0), t1=1000.0)
    assert "exponential growth" in error.cause
    assert "rate" not in error.cause and "inf" not in error.cause


def test_cause_a_nan_of_f_is_not_blamed_on_the_law():
    """x' = −√x arrives at 0, where the law is iterated."""
    M = np.array([[1.0, 0.3], [0.1, 1.0]])
    problem = make(
        lambda t, x, u, args: -jnp.sqrt(x), A=generators.Zero(), K=sets.Box(0.0, 9.0),
        h=lambda t, x, u, args: u - M @ u - 0.02 * u * u + x,
    )  # fmt: skip
    cause = failure(problem, jnp.ones(2), 6.0).cause
    assert cause.startswith("f, h or K returned NaN or infinity. f is nan in component")
    assert ", x = [" in cause and "law was not solved" not in cause
