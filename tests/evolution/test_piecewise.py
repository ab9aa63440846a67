"""`PiecewiseLinear` against closed forms and matrix exponentials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from tests.selection import mostly_thorough

import dvax
from dvax.evolution.piecewise import inputs, radau


def held(stiffness, **kwargs):
    """The problem x' = 1 − x + u, where a spring of this stiffness keeps x nearly above 2."""
    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, np.inf),
        f=lambda t, x, u, args: 1.0 - x + u, h=lambda t, x, u, args: -stiffness * (x - 2.0), **kwargs,
    )  # fmt: skip


@pytest.mark.parametrize("stiffness", [1.0, 1e3, 1e8, 1e15])
def test_piecewise_contact_with_a_spring_of_any_stiffness_is_exact(stiffness):
    ts = np.array([0.5, np.log(3.0), 1.2, 4.0])
    sol = dvax.solve(
        held(stiffness), 4.0, 0.0, 4.0, ts=ts, rtol=1e-8, method=dvax.PiecewiseLinear(), dense=True
    )
    # x = 1 + 3e^{−t} down to 2 at t = ln 3; then x' = 1 − x + s(2 − x).
    rate, level = 1.0 + stiffness, (1.0 + 2.0 * stiffness) / (1.0 + stiffness)
    after = level + (2.0 - level) * np.exp(-rate * (ts - np.log(3.0)).clip(0))
    exact = np.where(ts <= np.log(3.0), 1.0 + 3.0 * np.exp(-ts), after)
    # The polynomials may lack 10⁻⁴ rtol.
    np.testing.assert_allclose(np.asarray(sol.xs), exact, rtol=1e-12)
    times, positive = sol.regimes()
    assert len(times) == 3 and abs(times[1] - np.log(3.0)) < 1e-14
    assert positive[:, 0].tolist() == [False, True]
    assert int(sol.stats["steps"]) + int(sol.stats["rejected"]) < 40
    x, u = sol.evaluate(3.0)
    left = np.exp(-rate * (3.0 - np.log(3.0)))
    spring = stiffness / (1.0 + stiffness) * (1.0 - left)
    assert float(u) == pytest.approx(spring, rel=1e-11)
    assert float(x) == pytest.approx(level + (2.0 - level) * left, rel=1e-13)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", mostly_thorough(range(6), [0]))
def test_piecewise_random_systems_agree_with_matrix_exponentials(seed):
    rng = np.random.default_rng(seed)
    n, m = 3, 2
    R, S = rng.normal(size=(n, n)), rng.normal(size=(m, m))
    A, M = R - R.T - 0.3 * np.eye(n), S @ S.T + 0.5 * np.eye(m)
    C = rng.normal(size=(m, n))
    B, q, low = -C.T, rng.normal(size=m), -rng.uniform(0.1, 1.0, m)
    problem = dvax.Problem(
        A=dvax.generators.Dense(jnp.asarray(A)), P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(low, -low), f=lambda t, x, u, args: B @ u + jnp.sin(3.0 * t),
        h=lambda t, x, u, args: u - M @ u - C @ x - q, state_space=dvax.spaces.Euclidean(n),
        control_space=dvax.spaces.Euclidean(m),
    )  # fmt: skip
    x0 = rng.normal(size=n)
    ts = np.linspace(0.0, 8.0, 17)
    one = dvax.solve(problem, x0, 0.0, 8.0, ts=ts, method=dvax.PiecewiseLinear(), rtol=1e-8)
    other = dvax.solve(
        problem, x0, 0.0, 8.0, ts=ts, method=dvax.DormandPrince(), rtol=1e-11, atol=1e-12
    )
    np.testing.assert_allclose(np.asarray(one.xs), np.asarray(other.xs), atol=2e-9)
    np.testing.assert_allclose(np.asarray(one.us), np.asarray(other.us), atol=2e-9)
    assert int(one.stats["switchings"]) >= 3
    assert float(jnp.max(one.law_residual)) < 1e-12


def test_piecewise_defect_bounds_the_error():
    problem = held(50.0)
    constants = dvax.verify(problem, 4.0, 0.0, 4.0).constants
    sol = dvax.solve(
        problem, 4.0, 0.0, 4.0, ts=[1.0, 4.0], method=dvax.PiecewiseLinear(), constants=constants
    )
    bound = dvax.bound_error(problem, sol, constants)
    level = 101.0 / 51.0
    error = abs(float(sol.xs[1]) - level - (2 - level) * np.exp(-51.0 * (4 - np.log(3.0))))
    assert error <= float(bound.x[-1]) + 1e-14 and float(bound.x[-1]) < 1e-10
    assert bound.status == "proved" and sol.enclosed
    # Without constants the steps do not need their defect.
    assert dvax.solve(problem, 4.0, 0.0, 4.0, method=dvax.PiecewiseLinear()).defect is None


def test_piecewise_oscillation_beside_a_constraint_needs_no_step_per_period():
    # x'' = −ω²x with ω = 10⁶ for a second, and a law that it does not reach: exact by one cosine.
    w = 1e6
    problem = dvax.Problem(
        A=dvax.generators.Dense(jnp.array([[0.0, w, 0.0], [-w, -2.0, 0.0], [0.0, 0.0, -1.0]])),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-5.0, 5.0),
        f=lambda t, x, u, args: jnp.stack([0.0, 0.0, 1.0]) * u[0],
        h=lambda t, x, u, args: x[:1] + x[2:], control_space=dvax.spaces.Euclidean(1),
    )  # fmt: skip
    x0 = np.array([1.0, 0.0, 0.5])
    sol = dvax.solve(problem, x0, 0.0, 1.0, ts=[1e-4, 1.0], method=dvax.PiecewiseLinear())
    M = np.asarray(problem.generator().matrix) + np.outer([0, 0, 1.0], [1.0, 0, 1.0])
    for t, x in zip(np.asarray(sol.ts), np.asarray(sol.xs), strict=True):
        rates, vectors = np.linalg.eig(M)
        exact = (vectors * np.exp(rates * t)) @ np.linalg.solve(vectors, x0)
        np.testing.assert_allclose(x, exact.real, atol=1e-9)
    assert int(sol.stats["steps"]) < 60


def test_piecewise_first_crossings_are_found_and_contacts_are_not_crossings():
    theta = radau.GRID
    assert radau.first_negative((theta - 0.3) ** 2, 1e-14) == (1.0, False)
    found, crosses = radau.first_negative((theta - 0.3) ** 2 - 1e-10, 1e-14)
    assert crosses and found == pytest.approx(0.3 - 1e-5, abs=1e-9)
    rng = np.random.default_rng(0)
    for _ in range(50):
        c = rng.normal(size=12) / np.arange(1, 13)
        values = np.polynomial.chebyshev.chebval(2 * theta - 1, c)
        fine = np.linspace(0, 1, 200_001)
        there = np.polynomial.chebyshev.chebval(2 * fine - 1, c)
        found, crosses = radau.first_negative(values, 1e-13)
        below = np.flatnonzero(there < -1e-13)
        if not len(below):
            assert not crosses and found == 1.0
        else:
            assert crosses and abs(found - fine[below[0]]) <= 5e-6


@pytest.mark.parametrize("seed", mostly_thorough(range(12), range(3)))
def test_piecewise_first_crossings_with_oscillations_agree_with_dense_samples(seed):
    rng = np.random.default_rng(seed)
    c = rng.normal(size=6) / np.arange(1, 7) ** 2
    values = np.polynomial.chebyshev.chebval(2 * radau.GRID - 1, c)
    waves = [
        radau.Wave(complex(-rng.uniform(0, 5), 10 ** rng.uniform(1, 3.5)), 0.3 * rng.normal() + 0j)
        for _ in range(int(rng.integers(1, 3)))
    ]
    fine = np.linspace(0, 1, 400_001)
    there = np.polynomial.chebyshev.chebval(2 * fine - 1, c)
    there = there + sum(2 * (w.amplitude * np.exp(w.rate * fine)).real for w in waves)
    # From a level that makes the first crossing one near a trough, or none.
    level = np.quantile(there, rng.choice([0.0, 0.001, 0.05])) - 1e-9 * rng.integers(2)
    found, crosses = radau.first_negative(values - level, 1e-13, 1.0, waves)
    below = np.flatnonzero(there < level - 1e-13)
    if len(below):
        assert crosses and fine[below[0]] - 2.6e-6 <= found <= fine[below[0]]
    else:
        at = there[0] if found == 0.0 else np.interp(found, fine, there)
        assert not crosses or at < level + 2e-5  # below between two samples


def test_piecewise_progress_output_does_not_change_the_solution(capfd):
    run = lambda **kwargs: dvax.solve(  # noqa: E731
        held(50.0), 4.0, 0.0, 4.0, ts=[1.0, 4.0], method=dvax.PiecewiseLinear(), **kwargs
    )
    quiet = run()
    assert capfd.readouterr() == ("", "")
    np.testing.assert_array_equal(run(progress=True).xs, quiet.xs)
    lines = capfd.readouterr().err.splitlines()
    shares = [int(line.split()[1].removesuffix("%,")) for line in lines]
    assert len(lines) >= 2 and shares[-1] == 100 and "steps of PiecewiseLinear" in lines[0]
    assert shares == sorted(set(shares))


@pytest.mark.slow
@pytest.mark.parametrize("level", [1e4, 1e2, 1.0, 1e-6])
@pytest.mark.parametrize("M", [1e-8, 1e-10, 1e-13])
def test_piecewise_switching_below_rounding_is_detected(level, M):
    # x follows s(t) up through a response u = (s − x)/M ≥ 0, and z counts it. Beside s = 10⁴ the
    # rounding of s − x is more than all of s', and the law alone does not show the sign of u.
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, np.inf),
        f=lambda t, x, u, args: jnp.stack([u[0], u[0]]),
        h=lambda t, x, u, args: u - (M * u + x[:1] - level - 1e-5 * jnp.sin(2.0 * t)),
        state_space=dvax.spaces.Euclidean(2), control_space=dvax.spaces.Euclidean(1),
    )  # fmt: skip
    sol = dvax.solve(problem, np.array([level, 0.0]), 0.0, 4.0, method=dvax.PiecewiseLinear())
    # Up with s to its maximum and no further. Each step rounds x, and processors differ: one gave 9
    # units in the last place.
    rounding = 16 * np.spacing(level) + 1e-12
    np.testing.assert_allclose(sol.xs[-1], [level + 1e-5, 1e-5], rtol=0.0, atol=rounding)
    assert int(sol.stats["switchings"]) == 2


def test_piecewise_rejects_unsupported_problems():
    method = dvax.PiecewiseLinear()
    curved = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: -(x**2) + u, h=lambda t, x, u, args: t * x - u,
    )  # fmt: skip
    with pytest.raises(dvax.InputError) as caught:
        dvax.solve(curved, 1.0, 0.0, 1.0, method=method)
    assert len(caught.value.problems) == 2  # f is not affine, and the slope of h moves
    ball = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=lambda t, args:
        dvax.sets.Box(0.0, t), f=lambda t, x, u, args: -x + u, h=lambda t, x, u, args: x - u,
    )  # fmt: skip
    with pytest.raises(dvax.InputError, match="a box that does not move"):
        dvax.solve(ball, 1.0, 0.5, 1.0, method=method)
    with pytest.raises(dvax.InputError, match="dt"):
        dvax.solve(held(1.0), 4.0, 0.0, 1.0, dt=0.1, method=method)
    run = lambda x0: dvax.solve(held(1.0), x0, 0.0, 1.0, method=method).xs[-1]  # noqa: E731
    for traced in (jax.jit(run), jax.grad(run)):
        with pytest.raises(dvax.DifferentiationError, match="ExpRosenbrock"):
            traced(4.0)


def test_piecewise_locates_jumps_and_reports_nan_data():
    def driven(s):
        return dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
            f=lambda t, x, u, args: u, h=lambda t, x, u, args: s(t) - x,
        )  # fmt: skip

    ending = driven(lambda t: jnp.where(t < 0.3, 0.0, jnp.nan))
    with pytest.raises(dvax.SolveError, match="NaN") as caught:
        dvax.solve(ending, 0.5, 0.0, 1.0, ts=[0.1, 1.0], method=dvax.PiecewiseLinear())
    assert float(caught.value.solution.stats["t"]) <= 0.3
    switched = driven(lambda t: jnp.where(t < 0.3, 0.0, 1.0))
    sol = dvax.solve(switched, 0.0, 0.0, 1.0, method=dvax.PiecewiseLinear())
    assert float(sol.xs[0]) == pytest.approx(0.5 * (1 - np.exp(-1.4)), rel=1e-12)
    jump = dvax.signals.Table([0.0, 0.3, 1.0], [0.0, 1.0, 1.0], kind="constant")
    sol = dvax.solve(driven(jump), 0.0, 0.0, 1.0, ts=[0.3, 1.0], method=dvax.PiecewiseLinear())
    # Then x' = −x + (1 − x).
    assert float(sol.xs[1]) == pytest.approx(0.5 * (1 - np.exp(-1.4)), rel=1e-13)
    assert float(sol.us[0]) == pytest.approx(1.0)


@pytest.mark.thorough
def test_piecewise_forcing_with_a_thousand_periods_is_resolved():
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-9.0, 9.0),
        f=lambda t, x, u, args: jnp.sin(2000 * jnp.pi * t) ** 2, h=lambda t, x, u, args: x,
    )  # fmt: skip
    stops = np.array([0.0, 1.0])
    found = inputs.build_pieces(problem, stops, jnp.asarray(0.0), None, 100_000)
    w = 4000 * np.pi
    sol = dvax.solve(problem, 0.0, 0.0, 1.0, method=dvax.PiecewiseLinear())
    e = np.exp(-1.0)
    exact = 0.5 * (1 - e) - 0.5 * (np.cos(w) + w * np.sin(w) - e) / (1 + w * w)
    assert len(found) > 500 and float(sol.xs[-1]) == pytest.approx(exact, rel=1e-11)


def test_piecewise_matrix_exponentials_agree_with_scipy_between_knots():
    # A line that turns at knots, through one mode: exact by an augmented exponential.
    table = dvax.signals.Table([0.0, 0.4, 1.0], [0.0, 2.0, -1.0])
    A = np.array([[-3.0, 50.0], [-50.0, -1.0]])
    problem = dvax.Problem(
        A=dvax.generators.Dense(jnp.asarray(A)), P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-1e3, 1e3), f=lambda t, x, u, args: jnp.stack([table(t), -table(t)]),
        h=lambda t, x, u, args: x,
    )  # fmt: skip
    x, slopes = np.array([1.0, -1.0]), ((0.4, 0.0, 5.0), (0.6, 2.0, -5.0))
    for h, value, slope in slopes:
        G = np.zeros((4, 4))
        G[:2, :2], G[:2, 2], G[2, 3] = A, [1.0, -1.0], 1.0
        x = (scipy.linalg.expm(h * G) @ np.array([*x, value, slope]))[:2]
    sol = dvax.solve(problem, np.array([1.0, -1.0]), 0.0, 1.0, method=dvax.PiecewiseLinear())
    np.testing.assert_allclose(np.asarray(sol.xs[-1]), x, atol=1e-13)
