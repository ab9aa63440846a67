"""Bounds without constants: proved along the trajectory, above the true error, and close to it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax.evolution.rows import cut
from dvax.theory.along import BoundAlong

LINE, PLANE = dvax.spaces.Euclidean(()), dvax.spaces.Euclidean(2)


def problem(f, h, K, A=None, control=LINE, **more):
    A = dvax.generators.Scalar(0.0) if A is None else A
    return dvax.Problem(
        A=A, P=dvax.operators.Scaling(1.0), K=K, f=f, h=h, control_space=control, **more
    )


def van_der_pol(mu):
    return problem(
        lambda t, x, u, args: jnp.stack([x[1], mu * (1.0 - x[0] ** 2) * x[1] - x[0] + u]),
        lambda t, x, u, args: -x[1], dvax.sets.Box(-0.5, 0.5),
    ), jnp.array([1.0, 0.0])  # fmt: skip


def pendulum(gain):
    return problem(
        lambda t, x, u, args: jnp.stack([x[1], -4.0 * jnp.sin(x[0]) + u]),
        lambda t, x, u, args: gain * (jnp.pi - x[0]) - x[1] - u, dvax.sets.Box(-1.0, 1.0),
    ), jnp.array([2.0, 0.0])  # fmt: skip


def fishery(price):
    """Prey and predator; the catch of predators grows with their number, up to a quota that moves."""
    return problem(
        lambda t, x, u, args: jnp.stack(
            [x[0] * (1.5 - x[0] - 0.6 * x[1]), x[1] * (0.8 * x[0] - 0.4 - u)]
        ),
        lambda t, x, u, args: price * (x[1] - 0.8),
        lambda t, args: dvax.sets.Box(0.0, 1.0 + 0.5 * jnp.sin(t)),
    ), jnp.array([0.5, 0.5])  # fmt: skip


def harvest(price):
    """A catch without a quota: f is as steep in x as u is large."""
    return problem(
        lambda t, x, u, args: jnp.stack([x[0] * (1.5 - x[0]) - u * x[0], -0.3 * x[1] + u * x[0]]),
        lambda t, x, u, args: price * (x[0] - 0.5), dvax.sets.Box(0.0, jnp.inf),
    ), jnp.array([1.4, 0.0])  # fmt: skip


def lorenz(limit):
    return problem(
        lambda t, x, u, args: jnp.stack(
            [10.0 * (x[1] - x[0]), x[0] * (28.0 - x[2]) - x[1] + u, x[0] * x[1] - 8.0 / 3.0 * x[2]]
        ),
        lambda t, x, u, args: -x[1], dvax.sets.Box(-limit, limit),
    ), jnp.array([1.0, 1.0, 20.0])  # fmt: skip


def reaction(rate):
    """A hot reactor (Arrhenius) whose cooling is limited."""
    return problem(
        lambda t, x, u, args: jnp.stack(
            [1.0 - x[0] - rate * x[0] * jnp.exp(-5.0 / x[1]),
             1.0 - x[1] + 2.0 * rate * x[0] * jnp.exp(-5.0 / x[1]) - u]
        ),
        lambda t, x, u, args: 3.0 * (x[1] - 1.4), dvax.sets.Box(0.0, 0.6),
    ), jnp.array([0.8, 1.1])  # fmt: skip


def two_controls(pull):
    return problem(
        lambda t, x, u, args: jnp.stack([-x[1] * x[0] + u[0], x[0] ** 2 - 2.0 * x[1] + u[1]]),
        lambda t, x, u, args: -pull * x + 0.2 * jnp.stack([x[0] * x[1], x[1]]) - 0.5 * u,
        dvax.sets.Ball(0.0, 0.3), control=PLANE,
    ), jnp.array([1.0, -0.2])  # fmt: skip


def sheared(rate):
    """A generator whose semigroup grows before it decays, M > 1 in this space."""
    return problem(
        lambda t, x, u, args: 0.1 * jnp.stack([jnp.sin(x[1]), x[0] * x[1]]) + jnp.stack([0.0, 1.0]) * u,
        lambda t, x, u, args: -x[1], dvax.sets.Box(-0.2, 0.2),
        A=dvax.generators.Dense(jnp.array([[-1.0, rate], [0.0, -1.5]])),
    ), jnp.array([0.5, 1.0])  # fmt: skip


def spring(stiffness):
    """A mass on a spring, driven to a place by a force with limits. Errors turn: the rate in the norm
    of this space is half the stiffness."""
    gain = 2.5 * stiffness
    return problem(
        lambda t, x, u, args: jnp.stack([0.0, 1.0]) * u,
        lambda t, x, u, args: gain * (0.1 - x[0]) - 0.25 * stiffness * x[1] + 0.1 * stiffness,
        dvax.sets.Box(-0.125 * stiffness, 0.125 * stiffness),
        A=dvax.generators.Dense(jnp.array([[0.0, 1.0], [-stiffness, -1.0]])),
    ), jnp.zeros(2)  # fmt: skip


def chain(stiffness):
    """Three masses; the forces on two of them are limited, move, and depend on each other."""
    K = stiffness * jnp.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    A = jnp.block([[jnp.zeros((3, 3)), jnp.eye(3)], [-K, -0.1 * jnp.eye(3)]])
    return dvax.Problem(
        A=dvax.generators.Dense(A), P=dvax.operators.Dense(jnp.array([[1.0, 0.3], [0.3, 0.8]])),
        K=lambda t, args: dvax.sets.Box(-1.0 - 0.5 * jnp.sin(t), 1.0),
        f=lambda t, x, u, args: jnp.concatenate([jnp.zeros(4), u]) - 0.05 * jnp.sin(x) * x[0],
        h=lambda t, x, u, args: -2.0 * x[4:] - x[1:3] - 0.2 * u[::-1] + jnp.cos(3.0 * t),
        control_space=PLANE,
    ), jnp.array([1.0, 0.0, -0.5, 0.0, 0.5, 0.0])  # fmt: skip


def grid(n):
    """Heat with a reaction x − x³ and heaters with limits."""
    A = dvax.generators.Elliptic(n, 1.0, boundary="dirichlet", diffusion=0.05)
    space = dvax.spaces.L2(jnp.full(n, 1.0 / n))
    return dvax.Problem(
        A=A, P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-0.2, 0.2), f=lambda t, x, u, args: x - x**3 + u,
        h=lambda t, x, u, args: -2.0 * x, state_space=space, control_space=space,
    ), 1.5 * jnp.sin(jnp.pi * (jnp.arange(float(n)) + 0.5) / n)  # fmt: skip


FAMILIES = {
    van_der_pol: (0.1, 1.0, 4.0), pendulum: (0.5, 3.0), fishery: (0.5, 4.0), lorenz: (0.0, 30.0),
    reaction: (5.0, 20.0), harvest: (0.5, 5.0), two_controls: (0.5, 2.0), sheared: (1.0, 10.0, 30.0),
    spring: (1.0, 40.0, 1000.0), chain: (1.0, 30.0),
}  # fmt: skip
SPANS = {lorenz: 1.5}
METHODS = (None, dvax.ETD2RK(), dvax.ExpRosenbrock(), dvax.Implicit())
CASES = [
    (family, value, method)
    for family, values in FAMILIES.items()
    for value in values
    for method in METHODS
]
ALWAYS = {(van_der_pol, 1.0, None), (fishery, 4.0, None), (pendulum, 3.0, None),
          (harvest, 5.0, None)}  # fmt: skip


def largest_ratio(system, x0, span, tol, method, count=40, **more):
    """Check the bound against a tight run; return the largest bound over the largest error."""
    ts = np.linspace(0.0, span, count + 1)[1:]
    sharp = dict(rtol=1e-12, atol=1e-12, method=dvax.ExpRosenbrock())
    exact = dvax.solve(system, x0, 0.0, span, ts=ts, **sharp)
    sol = dvax.solve(system, x0, 0.0, span, ts=ts, rtol=tol, atol=tol, method=method, **more)
    bound = dvax.bound_error(system, sol)
    state, control = system.spaces(x0)
    of_x = np.asarray(jax.vmap(state.norm)(sol.xs - exact.xs))
    of_u = np.asarray(jax.vmap(control.norm)(sol.us - exact.us))
    slack = 1e-10  # of the reference
    assert (of_x <= np.asarray(bound.x) + slack).all() and (
        of_u <= np.asarray(bound.u) + slack
    ).all()
    assert np.isfinite(bound.x).all(), bound
    assert bound.status == "proved", bound
    return float(np.max(np.asarray(bound.x))) / max(float(np.max(of_x)), tol)


# Largest bound over the largest error, or over the tolerance if that is larger.
CLOSE = {
    van_der_pol: 10.0, harvest: 10.0, pendulum: 10.0, fishery: 10.0, lorenz: 10.0, reaction: 10.0,
    spring: 10.0, chain: 10.0, sheared: 10.0, two_controls: 10.0,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("family", "value", "method"), mostly_thorough(CASES, ALWAYS))
def test_bound_without_constants_is_above_the_error_and_of_its_size(family, value, method):
    system, x0 = family(value)
    ratio = largest_ratio(system, x0, SPANS.get(family, 5.0), 1e-6, method)
    assert ratio <= CLOSE.get(family, np.inf)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("family", "value", "span"),
    [(van_der_pol, 1.0, 40.0), (spring, 40.0, 50.0), (chain, 1.0, 50.0), (pendulum, 3.0, 20.0),
     (fishery, 0.5, 40.0), (reaction, 20.0, 20.0)],
)  # fmt: skip
def test_bounds_of_long_runs_stay_close_to_the_error(family, value, span):
    system, x0 = family(value)
    assert largest_ratio(system, x0, span, 1e-6, None) <= 10.0


@pytest.mark.slow
def test_a_bound_that_certifies_nothing_is_not_followed():
    """The state stays at 0, and an initial error of x' = 3x grows by e^{60} over 20 seconds."""
    system = problem(
        lambda t, x, u, args: jnp.stack([3.0 * x[0] + 0.1 * jnp.sin(x[1]) + 0.0 * u, -x[1]]),
        lambda t, x, u, args: -x[0], dvax.sets.Box(-1.0, 1.0),
    )  # fmt: skip
    sol = dvax.solve(system, jnp.zeros(2), 0.0, 20.0, ts=np.array([1.0, 20.0]))
    bound = dvax.bound_error(system, sol, initial_error=1e-6)
    assert np.isfinite(bound.x[0]) and np.isinf(bound.x[1])
    assert "has grown to 1e+06 times the solution" in bound.why


@pytest.mark.thorough
@pytest.mark.parametrize("tol", [1e-3, 1e-5, 1e-8])
@pytest.mark.parametrize("family", FAMILIES)
def test_bounds_hold_at_other_tolerances(family, tol):
    system, x0 = family(FAMILIES[family][0])
    largest_ratio(system, x0, SPANS.get(family, 5.0), tol, None)


@pytest.mark.slow
def test_heat_with_a_reaction_in_its_weighted_space():
    system, x0 = grid(24)
    assert largest_ratio(system, x0, 2.0, 1e-6, None) <= 10.0


@pytest.mark.slow
def test_states_in_parts_initial_errors_and_many_saved_times():
    system = dvax.Problem(
        A=dvax.generators.Product(dvax.generators.Scalar(-1.0), dvax.generators.Scalar(0.0)),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, args: (args * jnp.sin(x[1]), x[0] * jnp.cos(x[1]) + u),
        h=lambda t, x, u, args: -jnp.sum(x[1]), control_space=LINE,
    )  # fmt: skip
    x0, ts = (
        (jnp.array([0.5, -0.2]), jnp.array([1.0, 2.0])),
        np.sort(np.repeat(np.linspace(0, 2, 40), 3)),
    )
    sol = dvax.solve(system, x0, 0.0, 2.0, 1.5, ts, rtol=1e-4)
    exact = dvax.solve(system, x0, 0.0, 2.0, 1.5, ts, rtol=1e-12, atol=1e-12)
    space = system.spaces(x0)[0]
    error = np.asarray(
        jax.vmap(lambda a, b: space.norm((a[0] - b[0], a[1] - b[1])))(sol.xs, exact.xs)
    )
    bound = dvax.bound_error(system, sol)
    assert bound.x.shape == (120,) and (error <= np.asarray(bound.x)).all()
    # A trajectory that starts 1e-3 away is within the bound of this initial error.
    other = dvax.solve(system, (x0[0] + 1e-3, x0[1]), 0.0, 2.0, 1.5, ts, rtol=1e-12, atol=1e-12)
    moved = dvax.bound_error(system, sol, initial_error=1.5e-3)
    apart = np.asarray(
        jax.vmap(lambda a, b: space.norm((a[0] - b[0], a[1] - b[1])))(sol.xs, other.xs)
    )
    assert (apart <= np.asarray(moved.x)).all() and float(moved.x[0]) >= 1.5e-3
    # And a run that continues has the bound of both.
    first = dvax.solve(system, x0, 0.0, 1.0, 1.5, [1.0], rtol=1e-4)
    second = dvax.solve(
        system, jax.tree.map(lambda v: v[-1], first.xs), 1.0, 2.0, 1.5, [2.0], rtol=1e-4
    )
    both = dvax.bound_error(system, second, initial_error=dvax.bound_error(system, first))
    end = jax.tree.map(lambda a, b: a[-1] - b[-1], second.xs, exact.xs)
    assert float(space.norm(end)) <= float(both.x[-1]) <= 1e-2


@pytest.mark.slow
@pytest.mark.parametrize(
    "ts",
    [np.zeros(3), 1.0 - 1e-7 * np.arange(150.0)[::-1], np.linspace(0.0, 1.0, 200)],
    ids=["at the start", "close to the end", "many"],
)  # fmt: skip
def test_any_saved_times_have_a_bound(ts):
    system, x0 = van_der_pol(1.0)
    sol = dvax.solve(system, x0, 0.0, 1.0, ts=ts)
    exact = dvax.solve(system, x0, 0.0, 1.0, ts=ts, rtol=1e-12, atol=1e-12)
    bound = dvax.bound_error(system, sol)
    error = np.linalg.norm(np.asarray(sol.xs - exact.xs), axis=1)
    assert (error <= np.asarray(bound.x) + 1e-11).all() and float(bound.x.max()) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("family", [van_der_pol, spring])
def test_a_solution_in_parts_has_the_bound_of_the_whole(family):
    """As runs of the command line have it, which do not keep the whole solution."""
    system, x0 = family(FAMILIES[family][1])
    sol = dvax.solve(system, x0, 0.0, 4.0, ts=np.linspace(0.0, 4.0, 41))
    whole = np.asarray(dvax.bound_error(system, sol).x)
    parts = [cut(sol, slice(k, k + 10)) for k in range(0, 41, 10)]
    follower = BoundAlong(system, parts[0], np.asarray(sol.ts), 4.0)
    found = [follower.bound(part) for part in parts]
    assert all(bound.status == "proved" and not bound.why for bound in found)
    joined = np.concatenate([np.asarray(bound.x) for bound in found])
    exact = dvax.solve(system, x0, 0.0, 4.0, ts=sol.ts, rtol=1e-12, atol=1e-12)
    assert (np.linalg.norm(np.asarray(sol.xs - exact.xs), axis=1) <= joined + 1e-11).all()
    # Pieces are as long as they are for the whole solution.
    np.testing.assert_allclose(joined, whole, rtol=1e-12)


@pytest.mark.slow
def test_a_bound_with_less_work_has_a_larger_tolerance():
    system, x0 = van_der_pol(FAMILIES[van_der_pol][1])
    sol = dvax.solve(system, x0, 0.0, 4.0, ts=np.linspace(0.0, 4.0, 41))
    parts = [cut(sol, slice(k, k + 10)) for k in range(0, 41, 10)]
    follower = BoundAlong(system, sol, np.asarray(sol.ts), 4.0)
    follower.bound(sol)
    work = follower.steps // 2
    half = BoundAlong(system, sol, np.asarray(sol.ts), 4.0, max_steps=work)
    half_bound = half.bound(sol)
    assert half_bound.x[-1] < np.inf and half.steps <= work
    bound = dvax.bound_error(system, sol, max_steps=work)
    np.testing.assert_allclose(bound.x, half_bound.x, rtol=1e-12)
    # No step is left for the parts behind a limit.
    short = BoundAlong(system, parts[0], np.asarray(sol.ts), 4.0, max_steps=100)
    assert np.isinf(short.bound(parts[0]).x[-1]) and "steps and did not reach" in short.why
    assert np.isinf(short.bound(parts[1]).x).all()


@pytest.mark.slow
def test_the_work_of_a_bound_has_a_limit():
    """A fast mode that only the law damps: it has the time scale 1e-7 of the run."""
    stiff = dvax.Problem(
        A=dvax.generators.Scalar(0.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, args: jnp.stack([jnp.cos(3.0 * t) - 1e7 * x[0], x[0] ** 3 + u]),
        h=lambda t, x, u, args: x[1] - u, control_space=dvax.spaces.Euclidean(()),
    )  # fmt: skip
    sol = dvax.solve(stiff, jnp.array([0.0, 0.5]), 0.0, 1.0, throw=False)
    bound = dvax.bound_error(stiff, sol, max_steps=2000)
    assert np.isinf(bound.x[-1])
    assert "a larger max_steps of dvax.bound_error" in bound.why
    with pytest.raises(dvax.InputError, match="an integer ≥ 1"):
        dvax.bound_error(stiff, sol, max_steps=0)


@jax.custom_jvp
def _ruled(x):
    return jnp.tanh(x)


@_ruled.defjvp
def _zero(primals, tangents):
    return _ruled(*primals), jnp.zeros_like(primals[0])


@jax.custom_vjp
def _ruled_backwards(x):
    return jnp.tanh(x)


_ruled_backwards.defvjp(lambda x: (_ruled_backwards(x), ()), lambda _, g: (jnp.zeros_like(g),))


def _ruled_in_a_loop(x):
    return jax.lax.fori_loop(0, 2, lambda _, v: 0.5 * (v + _ruled(x)), _ruled(x))


@pytest.mark.slow
@pytest.mark.parametrize(
    "growth", [jax.lax.stop_gradient, _ruled, _ruled_backwards, _ruled_in_a_loop, jax.nn.relu]
)
def test_derivative_rules_of_functions_do_not_change_a_bound(growth):
    """x' = growth(x) near 0, where growth is x, and an error grows as e^t, whatever its derivative by
    JAX is."""
    system = problem(
        lambda t, x, u, args: growth(x) + 0.0 * u, lambda t, x, u, args: -x[0],
        dvax.sets.Box(-1.0, 1.0),
    )  # fmt: skip
    ts = np.linspace(0.0, 5.0, 6)[1:]
    sol = dvax.solve(system, jnp.array([1e-3]), 0.0, 5.0, ts=ts)
    other = dvax.solve(system, jnp.array([1e-3 + 1e-6]), 0.0, 5.0, ts=ts, rtol=1e-12, atol=1e-15)
    bound = dvax.bound_error(system, sol, initial_error=1e-6)
    apart = np.abs(np.asarray(other.xs - sol.xs)[:, 0])
    assert (apart <= np.asarray(bound.x)).all() and apart[-1] > 1e-4
    assert float(bound.x[-1]) < 2.0 * apart[-1]


@pytest.mark.slow
@pytest.mark.parametrize("scale", [3.0, 49.0])
def test_a_response_at_its_bound_in_single_precision(scale):
    """x' = −5(u − 1) with u = min(x, 1), where 1/P is rounded: from 1 + 1e-3 no state moves."""
    limit = jnp.float32(scale)
    system = dvax.Problem(
        A=dvax.generators.Scalar(jnp.float32(0.0)), P=dvax.operators.Scaling(limit),
        K=dvax.sets.Box(-limit, limit),
        f=lambda t, x, u, args: -5.0 * (u - 1.0), h=lambda t, x, u, args: x,
    )  # fmt: skip
    with jax.numpy_dtype_promotion("standard"):
        sol = dvax.solve(system, jnp.ones(1, jnp.float32), 0.0, 4.0, ts=[1.0, 4.0], rtol=1e-3)
        bound = dvax.bound_error(system, sol, initial_error=1e-3)
    assert bound.x.dtype == jnp.float32 and 1e-3 <= float(bound.x[-1]) < 2e-3


@pytest.mark.slow
def test_a_part_that_has_its_start_alone_is_followed_by_the_next_one():
    system, x0 = spring(40.0)
    sol = dvax.solve(system, x0, 0.0, 4.0, ts=np.linspace(0.0, 4.0, 9))
    follower = BoundAlong(system, sol, np.asarray(sol.ts), 4.0)
    first, rest = (follower.bound(cut(sol, part)) for part in (slice(1), slice(1, None)))
    # The next part may have the last time of the one before again.
    again = follower.bound(cut(sol, slice(8, None)))
    assert float(again.x[-1]) == float(rest.x[-1])
    assert float(first.x[0]) == 0.0 and float(rest.x.max()) < 1e-8


@pytest.mark.slow
def test_a_bound_in_single_precision():
    system, x0 = van_der_pol(1.0)
    sol = dvax.solve(system, x0.astype(jnp.float32), 0.0, 3.0, ts=[1.0, 2.0, 3.0], rtol=1e-4)
    exact = dvax.solve(system, x0, 0.0, 3.0, ts=[1.0, 2.0, 3.0], rtol=1e-12, atol=1e-12)
    with jax.numpy_dtype_promotion("standard"):  # the constants are proved in double precision
        bound = dvax.bound_error(system, sol)
    error = np.linalg.norm(np.asarray(sol.xs, float) - np.asarray(exact.xs), axis=1)
    assert bound.x.dtype == jnp.float32 and (error <= np.asarray(bound.x, float)).all()


@pytest.mark.slow
def test_where_no_tube_holds_the_bound_is_infinite_and_says_why():
    """The solution 1/(1 − t) of x' = x² leaves every region before t = 1."""
    system = problem(
        lambda t, x, u, args: x**2 + 0.0 * u, lambda t, x, u, args: -x, dvax.sets.Box(-1.0, 1.0)
    )
    ts = np.array([0.5, 0.9, 0.999999])
    sol = dvax.solve(system, 1.0, 0.0, 0.999999, ts=ts, rtol=1e-3)
    bound = dvax.bound_error(system, sol)
    assert np.isfinite(bound.x[0]) and abs(2.0 - float(sol.xs[0])) <= float(bound.x[0])
    assert np.isinf(bound.x[-1]) and "from t = 0.99" in bound.why and bound.why in repr(bound)


@pytest.mark.slow
def test_what_cannot_be_proved_is_refused():
    opaque = problem(
        lambda t, x, u, args: jnp.fft.irfft(jnp.fft.rfft(x) ** 2, 4) + u,
        lambda t, x, u, args: -x, dvax.sets.Box(-1.0, 1.0), control=dvax.spaces.Euclidean(4),
    )  # fmt: skip
    sol = dvax.solve(opaque, jnp.full(4, 0.1), 0.0, 0.1)
    with pytest.raises(dvax.InputError, match="is not proved.*proved along the trajectory"):
        dvax.bound_error(opaque, sol)
    system, x0 = van_der_pol(1.0)
    with pytest.raises(dvax.InputError, match="values, which are traced"):
        jax.jit(lambda x: dvax.bound_error(system, dvax.solve(system, x, 0.0, 1.0)).x)(x0)
