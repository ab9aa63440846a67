"""How errors propagate: enclosed derivatives of the coupled system, and ellipsoids of errors."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import dvax
from dvax.programs.slope import interval
from dvax.theory.error_ellipsoid import ErrorEllipsoid, propagate
from dvax.theory.linearisation import Linearisation, linearisation
from dvax.theory.region import Region
from dvax.theory.system import System

SEEDS = st.integers(0, 2**32 - 1)


def response_of(P, low, high, h):
    """u with h(u) − u ∈ N_K(Pu), by a damped projection iteration in NumPy."""
    Pinv = np.linalg.inv(P)
    y = np.clip(np.zeros(len(P)), low, high)
    for _ in range(4000):
        new = np.clip(y + 0.2 * (h(Pinv @ y) - Pinv @ y), low, high)
        if np.abs(new - y).max() < 1e-15:
            break
        y = new
    return Pinv @ y


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_differences_of_the_coupled_system_lie_in_the_enclosure(seed):
    """|e' − Ce| is within the rest for pairs of states of a box, with the law solved in NumPy."""
    random = np.random.default_rng(seed)
    n, m = int(random.integers(1, 5)), int(random.integers(1, 4))
    A, B, H = random.normal(size=(n, n)), random.normal(size=(n, m)), random.normal(size=(m, n))
    G, S = 0.2 * random.normal(size=(m, m)) / m, 0.3 * random.normal(size=(m, m))
    P = S @ S.T + np.diag(random.uniform(0.7, 1.5, size=m))
    end, weights = random.uniform(0.2, 1.0, size=m), random.uniform(0.5, 2.0, size=n)

    def f(x, u, lib):
        return lib.sin(x) * x[0] + B @ u

    def h(x, u, lib):
        return H @ x + 0.3 * lib.cos(x[0]) + G @ lib.tanh(u)

    problem = dvax.Problem(
        A=dvax.generators.Dense(jnp.asarray(A)), P=dvax.operators.Dense(jnp.asarray(P)),
        K=dvax.sets.Box(jnp.asarray(-end), jnp.asarray(end)),
        f=lambda t, x, u, args: f(x, u, jnp), h=lambda t, x, u, args: h(x, u, jnp),
        state_space=dvax.spaces.L2(jnp.asarray(weights)), control_space=dvax.spaces.Euclidean(m),
    )  # fmt: skip
    x = random.normal(size=n)
    width = 10.0 ** random.uniform(-3, -0.3)
    pairs = x + width * random.uniform(-1, 1, size=(60, 2, n))
    u = np.array(
        [[response_of(P, -end, end, lambda u, x=x: h(x, u, np)) for x in p] for p in pairs]
    )
    system = System(problem, jnp.asarray(x), None, max_cuts=0)
    region = Region(
        interval(0.0, 1.0), interval(x - width, x + width),
        interval(u.min(axis=(0, 1)) - 1e-9, u.max(axis=(0, 1)) + 1e-9),
    )  # fmt: skip
    roots = np.sqrt(weights)
    e = roots * (pairs[:, 0] - pairs[:, 1])
    v = u[:, 0] - u[:, 1]
    L = 1.5 * float(np.max(np.linalg.norm(v, axis=1) / np.linalg.norm(e, axis=1))) + 1e-6
    linear = linearisation(system, region, L)
    assert linear is not None
    rates = np.array([[A @ x + f(x, w, np) for x, w in zip(*pair)] for pair in zip(pairs, u)])
    rest = roots * (rates[:, 0] - rates[:, 1]) - e @ linear.C.T
    for scales in (np.ones(n), random.uniform(1.0, 5.0, size=n)):
        most = linear.rest(scales) * np.linalg.norm(scales * e, axis=1)
        assert (np.linalg.norm(scales * rest, axis=1) <= most + 1e-11).all()
    assert (np.linalg.norm(v, axis=1) <= linear.gain * np.linalg.norm(e, axis=1) + 1e-11).all()


@pytest.mark.parametrize(("place", "known"), [(0.0, True), (2.0, True), (1.0, False)])
def test_the_derivative_of_a_limit_is_known_away_from_its_kink(place, known):
    """x' = −x + clip(−3x, −3, 3): the rate is −4 inside the limits and −1 beyond them."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-3.0, 3.0),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: -3.0 * x,
    )  # fmt: skip
    system = System(problem, jnp.asarray(0.0), None, max_cuts=0)
    low, high = np.clip([-3.0 * (place + 0.01), -3.0 * (place - 0.01)], -3.0, 3.0)
    region = Region(interval(0.0, 1.0), interval(place - 0.01, place + 0.01), interval(low, high))
    linear = linearisation(system, region, 3.0)
    assert linear.knows_law == known
    if known:
        assert linear.C == pytest.approx(-4.0 if place == 0.0 else -1.0)
        assert linear.rest(np.ones(1)) == 0.0 and linear.gain == (3.0 if place == 0.0 else 0.0)
    else:
        assert linear.C == pytest.approx(-2.5) and 1.5 <= linear.rest(np.ones(1)) <= 8.0


@given(SEEDS)
def test_sums_of_errors_lie_in_the_ellipsoid(seed):
    random = np.random.default_rng(seed)
    n = int(random.integers(1, 6))
    B, M = (random.normal(size=(n, n)) * 10.0 ** random.uniform(-6, 3) for _ in range(2))
    z = random.normal(size=(2, 200, n))
    z /= np.linalg.norm(z, axis=-1, keepdims=True)
    total = ErrorEllipsoid(B).plus(M)
    sums = z[0] @ B.T + z[1] @ M.T
    inside = np.linalg.norm(np.linalg.solve(total.B, sums.T), axis=0)
    assert (inside <= 1.0 + 1e-6).all()
    assert np.linalg.norm(sums, axis=1).max() <= total.norm * (1.0 + 1e-12)
    parts = sum(float(np.linalg.norm(v)) for v in (B, M))
    assert float(np.linalg.norm(total.B)) == pytest.approx(parts, rel=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_errors_of_perturbed_linear_systems_stay_below_their_bound(seed):
    """e' = (C + Δ(t))e + δ(t) with |Δ| ≤ R, integrated by an explicit method of order 8."""
    random = np.random.default_rng(seed)
    n = int(random.integers(1, 5))
    C = random.normal(size=(n, n)) * random.choice([0.5, 3.0])
    if n > 1:
        C[0, 1], C[1, 0] = 1.0, -(10.0 ** random.uniform(0, 3))  # an oscillator
    R = 0.2 * random.uniform(size=(n, n)) * random.choice([0.0, 0.1, 1.0])
    B, speed = random.normal(size=(n, n)), random.uniform(1.0, 20.0, size=(n, n))
    push, times = random.normal(size=n) * 0.1, np.array([0.05, 0.2, 0.3])
    linear = Linearisation(C, R, np.zeros((n, 1)), 0.0, 0.0, True)
    found = propagate(linear, ErrorEllipsoid(B), times, np.linalg.norm(push) * times, np.zeros(3))
    for _ in range(20):
        z, phase = random.normal(size=n), random.uniform(0.0, 6.0, size=(n, n))
        rate = lambda t, e, phase=phase: (C + R * np.sin(speed * t + phase)) @ e + push * np.cos(t)  # noqa: E731
        start = B @ (z / np.linalg.norm(z))
        e = solve_ivp(
            rate, (0.0, 0.3), start, method="DOP853", t_eval=times, rtol=1e-11, atol=1e-12
        )
        assert (np.linalg.norm(e.y, axis=0) <= found.bounds * (1.0 + 1e-9)).all()
        assert np.linalg.norm(np.linalg.solve(found.ellipsoid.B, e.y[:, -1])) <= 1.0 + 1e-9
        assert np.linalg.norm(e.y, axis=0).max() <= found.largest * (1.0 + 1e-9)
    if not R.any():
        alone = propagate(linear, ErrorEllipsoid(B), times, np.zeros(3), np.zeros(3))
        exact = np.linalg.norm(scipy.linalg.expm(0.3 * C) @ B, 2)
        assert alone.bounds[-1] == pytest.approx(exact, rel=1e-9)


def test_an_oscillator_of_any_frequency_keeps_its_errors():
    """Over a thousand steps of e'' = −ω²e the bound is that of the exact flow: nothing accumulates."""
    for frequency in (0.01, 1.0, 300.0):
        C = np.array([[0.0, 1.0], [-(frequency**2), 0.0]])
        linear = Linearisation(C, np.zeros((2, 2)), np.zeros((2, 1)), 0.0, 0.0, True)
        error, step = ErrorEllipsoid.ball(1e-6, 2), np.array([0.37 / frequency])
        for _ in range(1000):
            error = propagate(linear, error, step, np.zeros(1), np.zeros(1)).ellipsoid
        exact = 1e-6 * np.linalg.norm(scipy.linalg.expm(370.0 / frequency * C), 2)
        assert error.norm == pytest.approx(exact, rel=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_a_response_at_a_bound_is_not_taken_to_be_inside(seed):
    """P⁻¹y and P P⁻¹y are rounded: a law at the end of its interval may seem to be inside."""
    random = np.random.default_rng(seed)
    entries, low = random.uniform(0.1, 3.0, size=20), random.normal(size=20)
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Diagonal(jnp.asarray(entries)),
        K=dvax.sets.Box(jnp.asarray(low), jnp.asarray(low + 1.0)),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: 3.0 * x,
        control_space=dvax.spaces.Euclidean(20),
    )  # fmt: skip
    system = System(problem, jnp.zeros(20), None, max_cuts=0)
    end = np.where(random.uniform(size=20) < 0.5, low, low + 1.0) / entries
    width = random.uniform(0.0, 1e-3, size=20)
    u = interval(*np.sort([end, end + np.where(end * entries < low + 0.5, width, -width)], axis=0))
    x = interval(u.low / 3.0 - 1e-3, u.high / 3.0 + 1e-3)
    linear = linearisation(system, Region(interval(0.0, 1.0), x, u), 3.0)
    # Slopes of u between 0 and 3 are possible in every entry.
    for slope in (0.0, 3.0):
        rest = linear.R.sum(axis=1) + np.sqrt(2.0) * 3.0 * np.linalg.norm(linear.W, axis=1)
        assert (np.abs(slope - 1.0 - np.diag(linear.C)) <= rest + 1e-9).all()


def test_the_rest_covers_both_sides_of_a_kink_for_laws_of_different_steepness():
    """x' = u₁ with u₁ = clip(−x, 0, 1) beside a law three times as steep: slopes −1 and 0 at x = 0."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(0.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: u[:1],
        h=lambda t, x, u, args: -jnp.stack([x[0], 3.0 * x[0] + 2.0 * u[1]]),
        control_space=dvax.spaces.Euclidean(2),
    )  # fmt: skip
    system = System(problem, jnp.zeros(1), None, max_cuts=0)
    x = interval(np.array([-0.01]), np.array([0.01]))
    linear = linearisation(
        system, Region(interval(0.0, 1.0), x, interval(np.zeros(2), np.full(2, 0.01))), np.sqrt(2.0)
    )
    for slope in (-1.0, 0.0):
        assert abs(slope - linear.C[0, 0]) <= linear.rest(np.ones(1))
    assert linear.rest(np.ones(1)) <= 2.0
