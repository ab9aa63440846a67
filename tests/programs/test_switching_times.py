"""Jumps detected in the code of f, h and K are knots: steps end there, derivatives include them."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax

START, END = 0.5, 2.0


def drive(t, times, form):
    """1 before the first time, −1 up to the second, 1 up to the third, …"""
    value = 1.0
    for k in range(times.shape[0]):
        passed = {
            "t < a": lambda a: ~(t < a),
            "t - a > 0": lambda a: t - a > 0,
            "2 t >= 2 a": lambda a: 2.0 * t + 1.0 >= 2.0 * a + 1.0,
            "sign": lambda a: jnp.sign(a - t) < 0,
        }[form](times[k])
        value = jnp.where(passed, -1.0 if k % 2 == 0 else 1.0, value)
    return value


def problem(where, form):
    """x' = −x + s(t) with the jump in f, in h (u = s) or in K (u = min(3, s))."""
    s = lambda t, a: drive(t, a, form)  # noqa: E731
    K = dvax.sets.Box(-9.0, 9.0)
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=(lambda t, a: dvax.sets.Box(-9.0, s(t, a))) if where == "K" else K,
        f=(lambda t, x, u, a: s(t, a) + 0.0 * x) if where == "f" else (lambda t, x, u, a: u),
        h={
            "f": lambda t, x, u, a: 0.0 * x,
            "h": lambda t, x, u, a: s(t, a) + 0.0 * x,
            "K": lambda t, x, u, a: 3.0 + 0.0 * x,
        }[where],
    )


def closed_form(times):
    """x(END) and its derivative in each time: a jump from s₋ to s₊ at a adds (s₋ − s₊)e^{a−END}."""
    edges, signs = [0.0, *times, END], [(-1.0) ** k for k in range(len(times) + 1)]
    x = START * np.exp(-END)
    for s, a, b in zip(signs, edges, edges[1:], strict=False):
        x += s * (np.exp(b - END) - np.exp(a - END))
    return x, np.array([2 * signs[k] * np.exp(a - END) for k, a in enumerate(times)])


METHODS = {
    "ETD1": dvax.ETD1(),
    "ETD2RK": dvax.ETD2RK(),
    "ETD4RK": dvax.ETD4RK(),
    "DormandPrince": dvax.DormandPrince(),
    "ExpRosenbrock": dvax.ExpRosenbrock(),
    "Implicit": dvax.Implicit(),
}
CASES = [
    *(("f", "t < a", name, None, n) for name in METHODS for n in (1, 3)),
    *((where, form, "ETD2RK", dt, 2)
      for where in "fhK" for form in ("t < a", "t - a > 0", "2 t >= 2 a", "sign")
      for dt in (None, 0.11)),
    ("K", "t < a", "DormandPrince", None, 5), ("h", "t - a > 0", "ETD4RK", 0.07, 4),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "form", "method", "dt", "count"),
    mostly_thorough(CASES, [("K", "t - a > 0", "ETD2RK", 0.11, 2)]),
)
def test_switching_times_of_comparisons_have_exact_derivatives(where, form, method, dt, count):
    times = np.linspace(0.3, 1.7, count) + 0.01 * np.sqrt(2) * np.arange(count)
    case = problem(where, form)
    np.testing.assert_array_equal(
        np.unique(case.knots(0.0, END, jnp.array(START), times)).size, count
    )

    def end(a, adjoint):
        return dvax.solve(
            case, START, 0.0, END, a, dt=dt, max_steps=4096, method=METHODS[method], adjoint=adjoint,
            rtol=1e-8, atol=1e-10,
        ).xs[-1]  # fmt: skip

    exact, slopes = closed_form(times)
    near = 1e-5 if method == "Implicit" else 1e-9
    value, back = jax.jit(jax.value_and_grad(lambda a: end(a, "reverse")))(jnp.asarray(times))
    np.testing.assert_allclose(value, exact, atol=near)
    # Diffrax differentiates its step sizes along with the stop that clipped a step, divided by what
    # was left of that step: 1e-4 was seen.
    near = 1e-3 if method == "Implicit" else near
    np.testing.assert_allclose(back, slopes, atol=near)
    batch = jnp.asarray(times)[None] + jnp.array([[0.0], [0.05]])
    along = jax.vmap(jax.jacfwd(lambda a: end(a, "forward")))(batch)
    for a, found in zip(np.asarray(batch), along, strict=True):
        np.testing.assert_allclose(found, closed_form(a)[1], atol=near)


def test_switching_times_come_from_affine_functions_of_time_only():
    def knots(s, args=None):
        case = problem("f", "t < a")
        case = dvax.Problem(A=case.A, P=case.P, K=dvax.sets.Box(-9.0, 9.0), f=s, h=case.h)
        return case.knots(0.0, END, jnp.array(START), args)

    one = lambda t, x, u, a: jnp.where((t > 0.3) & ~(2 * t - 1 >= 1.5), 1.0, -1.0) + 0 * x  # noqa: E731
    np.testing.assert_allclose(knots(one), [0.3, 1.25])
    nested = jax.jit(lambda t, x: jnp.where(3.0 - t < t, x, jnp.where(t < 0.1, -x, x)))
    np.testing.assert_allclose(knots(lambda t, x, u, a: nested(t, x)), [0.1, 1.5])
    # Kinks of max, min, abs and clip too; not events in x, nor what lies outside of the run.
    clipped = lambda t, x, u, a: jnp.clip(t, 0.2, 9.0) + jnp.abs(t - 0.4) * x  # noqa: E731
    np.testing.assert_allclose(knots(clipped), [0.2, 0.4])
    assert (
        knots(lambda t, x, u, a: jnp.where(x > t, 1.0, 2.0) * jnp.where(t < -1.0, x, u)).size == 0
    )
    # A vector of times, and a pulse between two of them.
    several = lambda t, x, u, a: x * jnp.sum(jnp.where(t > a["on"], 1.0, 0.0))  # noqa: E731
    np.testing.assert_allclose(knots(several, {"on": jnp.array([1.1, 0.4, 7.0])}), [0.4, 1.1])


def test_derivative_in_the_time_of_an_undetected_jump_raises_an_error():
    def end(a, level):
        case = dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-9.0, 9.0),
            f=lambda t, x, u, p: p["level"] * jnp.where(jnp.sin(t) < p["a"], 1.0, -1.0) + 0.0 * x,
            h=lambda t, x, u, p: 0.0 * x,
        )  # fmt: skip
        args = {"a": a, "level": level}
        return dvax.solve(case, START, 0.0, END, args, dt=0.1, max_steps=64).xs[-1]

    with pytest.raises(
        dvax.DifferentiationError, match=r"not affine in t.*test_switching_times.*t < a"
    ):
        jax.grad(end)(0.5, 1.0)
    # What has nothing to do with the time of the jump is differentiated as ever.
    assert np.isfinite(jax.grad(end, 1)(0.5, 1.0))


@pytest.mark.thorough
@pytest.mark.parametrize("kind", mostly_thorough(["interp", "steps"], ["steps"]))
@pytest.mark.parametrize(
    "method",
    [None, pytest.param(dvax.DormandPrince(), marks=pytest.mark.thorough)],
    ids=["default", "DormandPrince"],
)
def test_switching_times_of_interpolated_arrays_are_differentiated(kind, method):
    """x' = −x + q(t), q read from arrays by JAX's own functions; exact between two of its times."""
    times, n = np.linspace(0.0, 10.0, 1001), 1000
    values = np.where(np.arange(n + 1) == 377, 50.0, 0.1)

    def data(t, times):
        if kind == "interp":
            return jnp.interp(t, times, values)
        return jnp.asarray(values)[jnp.searchsorted(times, t, side="right") - 1]

    read = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-99.0, 99.0),
        f=lambda t, x, u, times: u, h=lambda t, x, u, times: data(t, times) + 0.0 * x,
    )  # fmt: skip

    def end(times):
        return dvax.solve(read, 0.0, 0.0, 10.0, times, rtol=1e-7, atol=1e-9, method=method).xs[-1]

    h, x = 10.0 / n, 0.0
    for a, b in itertools.pairwise(values):
        b = a if kind == "steps" else b
        x = x * np.exp(-h) - a * np.expm1(-h) + (b - a) / h * (h + np.expm1(-h))
    assert abs(float(end(times)) - x) <= 1e-7
    if kind == "steps" and method is not None:
        slope = jax.grad(end)(jnp.asarray(times))
        jump = (values[1] - 50.0) * np.exp(times[377] - 10.0)
        np.testing.assert_allclose(slope[377:379], [jump, -jump * np.exp(h)], rtol=1e-6)


def _where(flag):
    return jnp.where(flag, 1.0, 0.0)


HIDDEN = {
    "a loop": lambda t, x, a: jax.lax.fori_loop(
        0, 3, lambda i, s: s + _where(t < a + 0.5 * i), 0.0
    ),
    "a map": lambda t, x, a: jnp.sum(jax.lax.map(lambda b: _where(t < b), jnp.stack([a, a + 0.5]))),
    "a while loop": lambda t, x, a: jax.lax.while_loop(
        lambda s: (s + 1) * a < t, lambda s: s + 1.0, 0.0
    ),
    "a remainder": lambda t, x, a: t % a,
    "a floor": lambda t, x, a: jnp.floor(t / a),
    "the parity of a floor": lambda t, x, a: _where(jnp.floor(t / a) % 2 == 0),
    "a rounding": lambda t, x, a: jnp.round(t - a),
    "a whole part": lambda t, x, a: jnp.arange(9.0)[(t / a).astype(int)],
    "cases of t": lambda t, x, a: jnp.where(t**2 < a, jnp.sin(t) + 1, 0.0),
    "cases of x": lambda t, x, a: jnp.where(jnp.sin(2 * t) < a, x, 1.0),
}
READ = {
    "a fixed period": lambda t, x, a: a * _where(t % 0.8 < 0.3),
    "a loop without comparisons": lambda t, x, a: jax.lax.fori_loop(
        0, 3, lambda i, s: 0.1 * s * t + a, 0.0
    ),
    "a loop that compares x": lambda t, x, a: jax.lax.fori_loop(
        0, 3, lambda i, s: s + jnp.maximum(x - a * i, 0.0), 0.0
    ),
    "a table": lambda t, x, a: jnp.interp(t, jnp.array([0.0, 1.0, 3.0]), jnp.stack([a, 1.0, a])),
}


def _end_with(drive):
    case = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, a: u + drive(t, x, a), h=lambda t, x, u, a: 2.0 * jnp.cos(t) - x,
    )  # fmt: skip
    return lambda a: dvax.solve(case, 0.3, 0.0, 1.9, a, dt=0.05, max_steps=64).xs[-1]


@pytest.mark.slow
@pytest.mark.parametrize("name", HIDDEN)
def test_derivative_in_a_time_hidden_by_code_raises_an_error(name):
    with pytest.raises(dvax.DifferentiationError, match="may jump at a time"):
        jax.grad(_end_with(HIDDEN[name]))(0.7)


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(READ, ["a table", "a loop that compares x"]))
def test_derivative_that_moves_no_jump_is_computed(name):
    end, a = _end_with(READ[name]), 0.7
    difference = (end(a + 1e-5) - end(a - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(end)(a), difference, rtol=1e-4, atol=1e-5)
