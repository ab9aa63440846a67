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
from dvax.theory.error_ellipsoid import Disturbances, ErrorEllipsoid, _exponentials, propagate
from dvax.theory.linearisation import Linearisation, linearisation
from dvax.theory.local_derivatives import LocalDerivatives, Range, of_region
from dvax.theory.region import Region
from dvax.theory.system import System

SEEDS = st.integers(0, 2**32 - 1)


def over_region(system, region, L):
    """The linearisation over one region, without the axis of its stacks."""
    found = linearisation(system, of_region(system, region), L)
    return None if found is None else at(found, 0)


def at(stack, k):
    """The k-th of a stack of linearisations, as one of them."""
    return Linearisation(
        *(v if name == "L" else v[k : k + 1] for name, v in stack._asdict().items())
    )


def constant(C, R):
    """The linearisation by one matrix with a rest, of a system without a response."""
    n = len(C)
    return Linearisation(C[None], R[None], np.zeros((1, n, 1)), 0.0, np.zeros(1), np.ones(1, bool))


def disturbed(integral):
    return Disturbances(integral, integral, np.zeros(len(integral)))


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
    linear = over_region(system, region, L)
    assert linear is not None
    rates = np.array([[A @ x + f(x, w, np) for x, w in zip(*pair)] for pair in zip(pairs, u)])
    rest = roots * (rates[:, 0] - rates[:, 1]) - e @ linear.C[0].T
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
    linear = over_region(system, region, 3.0)
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
    size = lambda: 10.0 ** random.uniform(-6, 3)  # noqa: E731
    B, semiaxes, radius = (
        random.normal(size=(n, n)) * size(),
        random.uniform(size=n) * size(),
        size(),
    )
    z = random.normal(size=(3, 200, n))
    z /= np.linalg.norm(z, axis=-1, keepdims=True)
    total = ErrorEllipsoid(B).plus(radius, semiaxes)
    sums = z[0] @ B.T + radius * z[1] + semiaxes * z[2]
    inside = np.linalg.norm(np.linalg.solve(total.B, sums.T), axis=0)
    assert (inside <= 1.0 + 1e-6).all()
    assert np.linalg.norm(sums, axis=1).max() <= total.norm * (1.0 + 1e-12)
    parts = sum(float(np.linalg.norm(v)) for v in (B, semiaxes, radius * np.eye(n)))
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
    linear, start = constant(C, R), ErrorEllipsoid(B)
    found = propagate(linear, start, times, [2], disturbed(np.linalg.norm(push) * times))
    for _ in range(20):
        z, phase = random.normal(size=n), random.uniform(0.0, 6.0, size=(n, n))
        rate = lambda t, e, phase=phase: (C + R * np.sin(speed * t + phase)) @ e + push * np.cos(t)  # noqa: E731
        e = solve_ivp(
            rate,
            (0.0, 0.3),
            B @ (z / np.linalg.norm(z)),
            method="DOP853",
            t_eval=times,
            rtol=1e-11,
            atol=1e-12,
        )
        assert (np.linalg.norm(e.y, axis=0) <= found.bounds * (1.0 + 1e-9)).all()
        assert np.linalg.norm(np.linalg.solve(found.ellipsoid.B, e.y[:, -1])) <= 1.0 + 1e-9
        assert np.linalg.norm(e.y, axis=0).max() <= found.largest * (1.0 + 1e-9)
    if not R.any():
        alone = propagate(linear, start, times, [2], disturbed(np.zeros(3)))
        exact = np.linalg.norm(scipy.linalg.expm(0.3 * C) @ B, 2)
        assert alone.bounds[-1] == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_errors_of_linear_systems_that_vary_in_time_stay_below_their_bound(seed):
    """e' = C(t)e + δ(t) with a matrix for each of many intervals, and rests for what C varies in them;
    δ acts at the start of every step of a method, which is charged to the whole of it."""
    random = np.random.default_rng(100 + seed)
    n, count, per_interval = int(random.integers(1, 5)), 40, int(random.integers(1, 4))
    C0, C1 = (random.normal(size=(n, n)) * random.choice([0.5, 3.0]) for _ in range(2))
    frequency, B = random.uniform(0.5, 3.0), random.normal(size=(n, n))
    C = lambda t: C0 + np.sin(frequency * t) * C1  # noqa: E731
    nodes = np.linspace(0.0, 1.0, count + 1)
    times = np.linspace(0.0, 1.0, count * per_interval + 1)[1:]
    ends = [per_interval * (k + 1) - 1 for k in range(count)]
    middle = 0.5 * (nodes[1:] + nodes[:-1])
    matrices = np.stack([C(t) for t in middle])
    R = np.broadcast_to(np.abs(C1) * frequency * 0.5 / count, matrices.shape)
    zeros = np.zeros((count, n, 1))
    linear = Linearisation(matrices, R, zeros, 0.0, np.zeros(count), np.ones(count, bool))
    # Steps of the method that are no parts of the intervals.
    steps = np.linspace(0.0, 1.0, int(random.integers(30, 200)))
    push = random.normal(size=n) * 0.1
    reached = np.searchsorted(steps, times - 1e-12)
    charge = np.linalg.norm(push) * steps
    disturbances = Disturbances(
        charge[reached], np.where(reached > 0, charge[reached - 1], 0.0), np.zeros(len(times))
    )
    found = propagate(linear, ErrorEllipsoid(B), times, ends, disturbances)
    for _ in range(10):
        z = random.normal(size=n)
        rate = lambda t, e: C(t) @ e + push * np.cos(7.0 * t)  # noqa: E731
        e = solve_ivp(
            rate, (0.0, 1.0), B @ (z / np.linalg.norm(z)), method="DOP853", t_eval=times,
            rtol=1e-11, atol=1e-12,
        )  # fmt: skip
        assert (np.linalg.norm(e.y, axis=0) <= found.bounds * (1.0 + 1e-9)).all()
        assert np.linalg.norm(np.linalg.solve(found.ellipsoid.B, e.y[:, -1])) <= 1.0 + 1e-9
        assert np.linalg.norm(e.y, axis=0).max() <= found.largest * (1.0 + 1e-9)


@pytest.mark.parametrize("size", [1e-9, 0.3, 40.0, 1e4])
def test_exponentials_are_exact_to_rounding(size):
    random = np.random.default_rng(0)
    S = random.normal(size=(30, 4, 4))
    M = size * (S - S.swapaxes(1, 2) - np.eye(4) * random.uniform(0.0, 0.1, size=(30, 1, 1)))
    error = np.abs(_exponentials(M) - scipy.linalg.expm(M)).max()
    assert error <= 1e-14 * 4.0 * max(1.0, 10.0 * size)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_differences_lie_in_the_enclosures_of_many_boxes(seed):
    """The derivatives on boxes inside a region, from the slopes of the derivatives, for f, h and K that
    depend on time. Their rest is a part of that over the region."""
    random = np.random.default_rng(1000 + seed)
    n, m, count = int(random.integers(1, 4)), int(random.integers(1, 4)), 12
    B, H = random.normal(size=(n, m)), random.normal(size=(m, n))
    P = np.diag(random.uniform(0.7, 1.5, size=m))
    end, speed = random.uniform(0.2, 1.0, size=m), random.uniform(0.0, 0.5)

    def f(t, x, u, lib):
        return lib.sin(x + t) * x[0] + B @ u * (1.0 + 0.2 * u[0])

    def h(t, x, u, lib):
        return H @ x + 0.3 * lib.cos(x[0] + t) + 0.2 * lib.tanh(u)

    def K(t, args):
        return dvax.sets.Box(jnp.asarray(-end) + speed * t, jnp.asarray(end) + speed * t)

    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Dense(jnp.asarray(P)), K=K,
        f=lambda t, x, u, args: f(t, x, u, jnp), h=lambda t, x, u, args: h(t, x, u, jnp),
        control_space=dvax.spaces.Euclidean(m),
    )  # fmt: skip
    centers, width = 0.2 * random.normal(size=(count, n)), 10.0 ** random.uniform(-4, -1.5)
    nodes = np.linspace(0.0, 1.0, count + 1)
    ts = nodes[:-1, None] + random.uniform(size=(count, 20)) / count
    xs = centers[:, None, None] + width * random.uniform(-1, 1, size=(count, 20, 2, n))
    law = lambda t, x: response_of(  # noqa: E731
        P, -end + speed * t, end + speed * t, lambda u: h(t, x, u, np)
    )
    us = np.array([[[law(t, x) for x in pair] for t, pair in zip(*one)] for one in zip(ts, xs)])
    x = Range(centers - width, centers + width)
    u = Range(us.min(axis=(1, 2)) - 1e-9, us.max(axis=(1, 2)) + 1e-9)
    region = Region(interval(0.0, 1.0), *(
        interval(v.low.min(axis=0), v.high.max(axis=0)) for v in (x, u)
    ))  # fmt: skip
    system = System(problem, jnp.zeros(n), None, max_cuts=0)
    J = LocalDerivatives(system).at(region, Range(nodes[:-1, None], nodes[1:, None]), x, u)
    e, v = xs[:, :, 0] - xs[:, :, 1], us[:, :, 0] - us[:, :, 1]
    L = 1.5 * float(np.max(np.linalg.norm(v, axis=2) / np.linalg.norm(e, axis=2))) + 1e-6
    stack = linearisation(system, J, L)
    whole = over_region(system, region, L).rest(np.ones(n))[0]
    assert np.median(stack.rest(np.ones(n))) < 0.6 * whole
    for k in range(count):
        linear = at(stack, k)
        rates = np.array(
            [[-x + f(t, x, w, np) for x, w in zip(*pair)] for t, *pair in zip(ts[k], xs[k], us[k])]
        )
        rest = rates[:, 0] - rates[:, 1] - e[k] @ linear.C[0].T
        size = np.linalg.norm(e[k], axis=1)
        assert (np.linalg.norm(rest, axis=1) <= linear.rest(np.ones(n)) * size + 1e-11).all()
        assert (np.linalg.norm(v[k], axis=1) <= linear.gain * size + 1e-11).all()


def test_an_oscillator_of_any_frequency_keeps_its_errors():
    """Over many steps of e'' = −ω²e the bound is that of the exact flow: nothing accumulates."""
    for frequency in (0.01, 1.0, 300.0):
        C = np.array([[0.0, 1.0], [-(frequency**2), 0.0]])
        linear = constant(C, np.zeros((2, 2)))
        error, step = ErrorEllipsoid.ball(1e-6, 2), np.array([0.37 / frequency])
        for _ in range(200):
            error = propagate(linear, error, step, [0], disturbed(np.zeros(1))).ellipsoid
        exact = 1e-6 * np.linalg.norm(scipy.linalg.expm(74.0 / frequency * C), 2)
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
    linear = over_region(system, Region(interval(0.0, 1.0), x, u), 3.0)
    # Slopes of u between 0 and 3 are possible in every entry.
    for slope in (0.0, 3.0):
        rest = linear.R[0].sum(axis=1) + np.sqrt(2.0) * 3.0 * np.linalg.norm(linear.W[0], axis=1)
        assert (np.abs(slope - 1.0 - np.diag(linear.C[0])) <= rest + 1e-9).all()


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
    linear = over_region(
        system, Region(interval(0.0, 1.0), x, interval(np.zeros(2), np.full(2, 0.01))), np.sqrt(2.0)
    )
    for slope in (-1.0, 0.0):
        assert abs(slope - linear.C[0, 0, 0]) <= linear.rest(np.ones(1))
    assert linear.rest(np.ones(1)) <= 2.0
