"""`ExpRosenbrock`: order 4 for any stiffness of f̃, and exact for piecewise linear f̃."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tests.closed_forms import c1, c1_derivatives, c1_solution, c3

import dvax
from dvax import generators

METHOD = dvax.ExpRosenbrock()
PLAIN = dvax.operators.Scaling(1.0)


def slope(counts, errors):
    return -np.polyfit(np.log(counts), np.log(errors), 1)[0]


def test_exp_rosenbrock_has_order_four_on_the_shrinking_ball():
    case = c3()
    counts = 8 * np.array([1, 2, 4, 8])
    errors = []
    for n in counts:
        sol = dvax.solve(case.problem, jnp.asarray(case.x0), 0.0, 2.0, dt=2.0 / n, method=METHOD)
        errors.append(np.max(np.abs(np.asarray(sol.xs[-1]) - case.exact(2.0)[0])))
    found = slope(counts, errors)
    print(f"C3: observed order {found:.3f}, errors {errors}")
    assert found == pytest.approx(4.0, abs=0.15)


def tracking(gain):
    """Two coupled states, each pulled towards a moving target by a saturated feedback of that gain."""
    target = lambda t: jnp.stack([jnp.cos(t), jnp.sin(2.0 * t)])  # noqa: E731
    return dvax.Problem(
        A=generators.Dense(jnp.array([[-0.3, 2.0], [-2.0, -0.1]])), P=PLAIN,
        K=dvax.sets.Box(-50.0, 50.0),
        f=lambda t, x, u, args: u - 0.3 * x**3,
        h=lambda t, x, u, args: gain * (target(t) - x) + 0.1 * gain * (target(t) - x)[::-1] - u,
    )  # fmt: skip


def tracked(gain, t1):
    A = np.array([[-0.3, 2.0], [-2.0, -0.1]])

    def rate(t, x):
        off = np.array([np.cos(t), np.sin(2.0 * t)]) - x
        u = np.clip(0.5 * gain * (off + 0.1 * off[::-1]), -50.0, 50.0)
        return A @ x + u - 0.3 * x**3

    x0 = np.array([1.0, 0.0])
    return x0, solve_ivp(rate, (0.0, t1), x0, method="Radau", rtol=1e-12, atol=1e-12).y[:, -1]


@pytest.mark.slow
def test_exp_rosenbrock_keeps_its_order_with_stiff_feedback():
    # Steps of 80 to 320 times the time that the feedback takes: the defect is of order 4 (shorter steps
    # show the rounding of f̃, which the gain amplifies), and the error what the feedback makes of it.
    x0, exact = tracked(1e4, 1.6)
    counts = np.array([25, 50, 100])
    errors, defects = [], []
    for n in counts:
        sol = dvax.solve(tracking(1e4), x0, 0.0, 1.6, dt=1.6 / n, method=METHOD, measure=True)
        errors.append(np.max(np.abs(np.asarray(sol.xs[-1]) - exact)))
        defects.append(float(sol.defect[-1]))
    found = slope(counts, errors)
    print(f"a gain of 10⁴: observed order {found:.3f}, errors {errors}")
    assert found > 1.95 and errors[0] < 1e-6
    assert slope(counts, defects) == pytest.approx(4.0, abs=0.25)


@pytest.mark.slow
def test_exp_rosenbrock_number_of_steps_does_not_grow_with_the_gain():
    gain = 1e4
    x0, exact = tracked(gain, 1.6)
    sol = dvax.solve(tracking(gain), x0, 0.0, 1.6, rtol=1e-5, atol=1e-5, method=METHOD)
    assert np.max(np.abs(np.asarray(sol.xs[-1]) - exact)) < 2e-5
    assert int(sol.stats["steps"]) < 1000  # 67 000 by ETD2RK for the larger gain


def test_exp_rosenbrock_solves_piecewise_linear_systems_to_rounding():
    case, ts = c1(), np.linspace(0.0, 2.0, 9)
    sol = dvax.solve(
        case.problem, case.x0, 0.0, 2.0, args=case.args, ts=ts, method=METHOD, dense=True,
        max_steps=256,
    )  # fmt: skip
    for t, x, u in zip(ts, sol.xs, sol.us, strict=True):
        np.testing.assert_allclose((float(x), float(u)), c1_solution(t), atol=1e-13)
    assert int(sol.stats["steps"]) < 40
    for t in (0.2, 0.4, 1.3):
        x, u = sol.evaluate(t)
        np.testing.assert_allclose((float(x), float(u)), c1_solution(t), atol=1e-13)
    times, _ = sol.regimes()
    np.testing.assert_allclose(times[1:-1], [0.31333575, 0.52405678], atol=1e-7)


@pytest.mark.thorough
def test_exp_rosenbrock_has_derivatives_in_both_modes():
    case = c1()

    def end(x0, ell, adjoint):
        sol = dvax.solve(
            case.problem, x0, 0.0, 2.0, args=(ell,), method=METHOD, adjoint=adjoint, max_steps=256
        )
        return sol.xs[-1]

    given = jnp.asarray(-1.0), jnp.asarray(3.0)
    back = jax.grad(lambda v: end(*v, "reverse"))(given)
    there = jax.jacfwd(lambda v: end(*v, "forward"))(given)
    np.testing.assert_allclose([float(v) for v in back], c1_derivatives(), rtol=1e-6)
    np.testing.assert_allclose([float(v) for v in there], c1_derivatives(), rtol=1e-6)


@pytest.mark.thorough
def test_exp_rosenbrock_derivatives_of_an_iterated_coupled_law(uncached):
    def end(args, adjoint):
        problem = dvax.Problem(
            A=lambda args: generators.Dense(args["A"]), P=PLAIN,
            K=lambda t, args: dvax.sets.Ball(0.0, args["r"] * jnp.exp(-t)),
            f=lambda t, x, u, args: jnp.sin(t) - u - 0.2 * x**2,
            h=lambda t, x, u, args: 2 * x - u - 0.1 * u**3,
        )  # fmt: skip
        x0 = jnp.array([2.0, 0.3])
        sol = dvax.solve(
            problem, x0, 0.0, 1.0, args=args, dt=0.1, method=METHOD, ts=[0.35, 1.0], adjoint=adjoint
        )
        return jnp.sum(sol.xs * jnp.arange(1.0, 5.0).reshape(2, 2))

    args = {"A": jnp.array([[-0.5, -3.0], [3.0, -0.5]]), "r": jnp.array(0.7)}
    back = jax.grad(end)(args, "reverse")
    there = jax.jacfwd(end)(args, "forward")
    for key in args:
        np.testing.assert_allclose(np.asarray(back[key]), np.asarray(there[key]), rtol=1e-9)
    step = 1e-5
    up, down = (float(end({**args, "r": args["r"] + s}, "reverse")) for s in (step, -step))
    assert float(back["r"]) == pytest.approx((up - down) / (2 * step), rel=1e-6)


@pytest.mark.thorough
def test_exp_rosenbrock_batch_equals_its_lanes():
    # Adaptive step sizes follow an estimate of the error, and so its roundings: those of a batch may
    # differ by a share of the tolerance. Given steps differ by rounding alone.
    gains = jnp.array([1.0, 1e3])
    for steps, rtol in (({"rtol": 1e-4, "atol": 1e-4}, 1e-5), ({"dt": 0.01}, 1e-12)):

        def run(gain, steps=steps):
            x0 = jnp.array([0.9, 0.1])
            return dvax.solve(tracking(gain), x0, 0.0, 0.4, method=METHOD, **steps).xs[-1]

        together = jax.vmap(run)(gains)
        for gain, found in zip(gains, together, strict=True):
            np.testing.assert_allclose(np.asarray(found), np.asarray(run(gain)), rtol=rtol)


def field(n, coupled):
    return dvax.Problem(
        A=generators.Diagonal(-jnp.linspace(1.0, 3.0, n)), P=PLAIN, K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: 1e3 * u - x**3 + (jnp.mean(x) if coupled else 0.0),
        h=lambda t, x, u, args: jnp.cos(t) - x - u,
    )  # fmt: skip


def test_exp_rosenbrock_needs_no_matrix_for_pointwise_laws():
    """A pointwise law of any size is solved; a large coupled state raises an error."""
    x0 = jnp.linspace(0.0, 1.0, 5000)
    sol = dvax.solve(field(5000, False), x0, 0.0, 1.0, dt=0.02, method=METHOD)
    alone = dvax.solve(field(1, False), x0[:1], 0.0, 1.0, dt=0.02, method=METHOD)
    np.testing.assert_allclose(np.asarray(sol.xs[-1][0]), np.asarray(alone.xs[-1][0]), rtol=1e-10)
    with pytest.raises(dvax.InputError, match="5000 unknowns that A or f couples"):
        dvax.solve(field(5000, True), x0, 0.0, 1.0, dt=0.02, method=METHOD)
