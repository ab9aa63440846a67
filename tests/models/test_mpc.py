"""Model predictive control against least squares with bounds, a conic solver, and the regulator."""

import itertools

import clarabel
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.integrate import solve_ivp
from scipy.optimize import lsq_linear
from scipy.signal import cont2discrete

import dvax
from dvax.models.mpc import LinearMPC


def chain(**changed):
    """Three masses between two walls, with the force on the first."""
    S = 2 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1)
    given = dict(
        A=np.block([[np.zeros((3, 3)), np.eye(3)], [-S, -0.5 * np.eye(3)]]),
        B=np.eye(6)[:, [3]], Q=np.eye(6), R=np.array([[0.5]]), horizon=12, step=0.25,
        lower=-0.5, upper=0.5,
    )  # fmt: skip
    return LinearMPC(**(given | changed))


@pytest.fixture(scope="module")
def mpc():
    return chain()


def least_squares(H, q, low, up):
    """min ½UᵀHU + qᵀU on a box by SciPy's bounded-variable least squares."""
    root = np.linalg.cholesky(H).T
    return lsq_linear(root, -np.linalg.solve(root.T, q), (low, up), "bvls", tol=1e-15).x


def test_mpc_programme_is_the_cost_of_the_horizon(mpc):
    A, B, *_ = cont2discrete((np.asarray(mpc.A), np.asarray(mpc.B), np.eye(6), 0.0), 0.25)
    # The Riccati equation by going back in time until nothing changes.
    cost = np.eye(6)
    for _ in range(3000):
        K = np.linalg.solve(0.5 + B.T @ cost @ B, B.T @ cost @ A)
        cost = np.eye(6) + 0.5 * K.T @ K + (A - B @ K).T @ cost @ (A - B @ K)
    np.testing.assert_allclose(np.asarray(mpc.terminal), cost, rtol=1e-10)
    np.testing.assert_allclose(np.asarray(mpc.regulator), K, rtol=1e-10)

    def simulated(x, U):
        total = 0.0
        for k, u in enumerate(U):
            total += (x @ x if k else 0.0) + 0.5 * u * u
            x = A @ x + B[:, 0] * u
        return total + x @ cost @ x

    rng = np.random.default_rng(3)
    H, G = np.asarray(mpc.H), np.asarray(mpc.G)
    for _ in range(20):
        x, U = rng.normal(size=6), rng.normal(size=12)
        condensed = U @ H @ U + 2 * x @ G.T @ U
        apart = simulated(x, U) - simulated(x, 0 * U)
        assert condensed == pytest.approx(apart, rel=1e-11)


@pytest.mark.slow
def test_mpc_plan_agrees_with_an_independent_solver_at_many_states(mpc):
    rng = np.random.default_rng(4)
    x = rng.normal(size=(200, 6)) * rng.uniform(0.05, 4.0, (200, 1))
    plans = np.asarray(jax.jit(jax.vmap(lambda x: mpc.plan(0.0, x)))(x))[..., 0]
    held = np.abs(plans) >= 0.5
    assert held.any(axis=1).sum() > 60 and (~held.any(axis=1)).sum() > 20
    for state, plan in zip(x, plans, strict=True):
        other = least_squares(np.asarray(mpc.H), np.asarray(mpc.G) @ state, -0.5, 0.5)
        np.testing.assert_allclose(plan, other, atol=1e-9)


def test_mpc_without_active_limits_is_the_regulator(mpc):
    rng = np.random.default_rng(5)
    x = 0.05 * rng.normal(size=(100, 6))
    moves = np.asarray(jax.jit(jax.vmap(lambda x: mpc.move(0.0, x)))(x))
    np.testing.assert_allclose(moves, -x @ np.asarray(mpc.regulator).T, atol=1e-14)


@pytest.mark.thorough
def test_mpc_slew_limits_agree_with_a_conic_solver():
    mpc = chain(slew=0.15, horizon=8)
    rng = np.random.default_rng(6)
    x = rng.normal(size=(24, 6))
    plans = np.asarray(jax.jit(jax.vmap(lambda x: mpc.plan(0.0, x)))(x))[..., 0]
    D = np.diff(np.eye(8), axis=0)
    rows = np.concatenate([np.eye(8), -np.eye(8), D, -D])
    right = np.concatenate([np.full(16, 0.5), np.full(14, 0.15)])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-13
    for state, plan in zip(x, plans, strict=True):
        other = clarabel.DefaultSolver(
            sp.csc_matrix(np.triu(np.asarray(mpc.H))), np.asarray(mpc.G) @ state,
            sp.csc_matrix(rows), right, [clarabel.NonnegativeConeT(30)], settings,
        ).solve()  # fmt: skip
        np.testing.assert_allclose(plan, np.array(other.x), atol=1e-6)
        assert np.all(rows @ plan <= right + 1e-12)
    assert np.any(np.abs(np.diff(plans, axis=1)) > 0.15 - 1e-9)
    assert mpc.lipschitz.regions is None


@pytest.mark.slow
def test_mpc_lipschitz_constants_hold_and_become_sharper(mpc):
    theory, projection, regions = mpc.lipschitz
    assert regions <= projection <= theory
    H, G = np.asarray(mpc.H), np.asarray(mpc.G)
    assert theory == pytest.approx(np.linalg.norm(G, 2) / np.linalg.eigvalsh(H)[0], rel=1e-10)
    # All slopes once more, one set of free moves at a time, by full inverses.
    most = 0.0
    for free in itertools.product([False, True], repeat=12):
        if free[0]:
            I = np.flatnonzero(free)
            most = max(most, np.linalg.norm(np.linalg.inv(H[np.ix_(I, I)])[0] @ G[I]))
    assert regions == pytest.approx(most, rel=1e-10)
    # What is seen stays below, and comes to more than half of it.
    rng = np.random.default_rng(8)
    x = rng.normal(size=(400, 6)) * rng.uniform(0.1, 3.0, (400, 1))
    slopes = jax.jit(jax.vmap(jax.jacfwd(lambda x: mpc.move(0.0, x)[0])))(x)
    seen = np.linalg.norm(np.asarray(slopes), axis=1).max()
    assert 0.5 * regions < seen <= regions * (1 + 1e-12)


def test_mpc_lipschitz_constant_of_several_inputs_is_the_largest_slope():
    mpc = chain(B=np.eye(6)[:, [3, 5]], R=np.diag([0.5, 0.8]), horizon=3, lower=[-0.5, -0.2])
    H, G = np.asarray(mpc.H), np.asarray(mpc.G)
    most = 0.0
    for free in itertools.product([0.0, 1.0], repeat=6):
        D = np.diag(free)
        slope = D @ np.linalg.solve(D @ H @ D + np.eye(6) - D, D @ G)
        most = max(most, np.linalg.norm(slope[:2], 2))
    assert mpc.lipschitz.regions == pytest.approx(most, rel=1e-12)
    plan = np.asarray(mpc.plan(0.0, jnp.full(6, 0.7)))
    low, up = np.tile([-0.5, -0.2], 3), np.full(6, 0.5)
    np.testing.assert_allclose(
        plan.ravel(), least_squares(H, G @ np.full(6, 0.7), low, up), atol=1e-9
    )


@pytest.fixture(scope="module")
def loop(mpc):
    """Three runs, as one batch, and the proof that they approach each other."""
    check = dvax.verify(mpc.problem, t0=0.0, t1=20.0, energy=True)
    x0 = np.array(
        [[1.5, 1.5, 1.5, 0, 0, 0], [-2.0, 0.0, 2.0, 1.0, 0, 0], [0, 0, 0, -1.0, 2.0, 0.5]]
    )
    ts = np.linspace(0.0, 20.0, 41)
    run = lambda x: dvax.solve(  # noqa: E731
        mpc.problem, x, 0.0, 20.0, ts=ts, rtol=1e-7, atol=1e-8, method=dvax.ETD4RK()
    )
    return check, [run(jnp.asarray(x)) for x in x0]


@pytest.mark.thorough
def test_mpc_closed_loop_decay_is_proved_and_observed(mpc, loop):
    check, runs = loop
    assert check.status == "proved" and check.constants.status_of("energy") == "proved"
    overshoot, rate = map(float, check.constants.energy)
    # Far out every input is at a limit, so that no proof can give more than the plant's own decay.
    assert -0.25 < rate < -0.2 and overshoot < 2.0
    assert float(check.constants.growth_rate) > 0.0  # the moduli alone prove no decay
    for one, two in itertools.combinations(runs, 2):
        apart = np.linalg.norm(np.asarray(one.xs) - np.asarray(two.xs), axis=1)
        allowed = overshoot * np.exp(rate * np.asarray(one.ts)) * apart[0]
        assert np.all(apart <= allowed * (1 + 1e-6))
    figures = mpc.figures(runs[0], check.constants)
    assert figures["decay_rate"] == -rate and figures["peak_input"] == 0.5
    assert 0.0 < figures["held"] < 0.5 and figures["lipschitz"] == mpc.lipschitz.regions


@pytest.mark.slow
def test_mpc_constants_are_proved_by_verify(mpc, loop):
    mine, found = mpc.constants, loop[0].constants
    for name in ("gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f", "omega", "L"):
        assert float(getattr(mine, name)) == pytest.approx(float(getattr(found, name))), name


@pytest.mark.slow
def test_mpc_loop_agrees_with_an_independent_integrator_and_solver(mpc, loop):
    H, G, A, B = map(np.asarray, (mpc.H, mpc.G, mpc.A, mpc.B))
    run = loop[1][0]

    def rate(t, x):
        return A @ x + B[:, 0] * least_squares(H, G @ x, -0.5, 0.5)[0]

    x0 = np.asarray(run.xs[0])
    other = solve_ivp(rate, (0.0, 5.0), x0, "RK45", rtol=1e-8, atol=1e-8, t_eval=[2.5, 5.0])
    np.testing.assert_allclose(np.asarray(run.xs)[[5, 10]], other.y.T, atol=2e-6)


@pytest.mark.thorough
def test_mpc_loop_converges_to_a_reachable_target(mpc):
    # Held by u_s = 0.3 at the first mass: S x_s = (0.3, 0, 0).
    rest = np.array([0.225, 0.15, 0.075, 0.0, 0.0, 0.0])
    there = chain(target=rest, feed=[0.3], disturbance=lambda t: jnp.zeros(6))
    drift = there.problem.A.apply(jnp.asarray(rest)) + there.problem.reduced(0.0, jnp.asarray(rest))
    np.testing.assert_allclose(np.asarray(drift), 0.0, atol=1e-14)
    # Nearby it is the regulator around it, far away the plan of the moved cost.
    x = jnp.asarray(rest) + 0.02
    expected = 0.3 - np.asarray(there.regulator) @ np.full(6, 0.02)
    np.testing.assert_allclose(np.asarray(there.move(0.0, x)), expected, atol=1e-13)
    x = np.array([2.0, -1.0, 0.5, 0.0, 1.0, 0.0])
    q = np.asarray(there.G) @ (x - rest) - np.asarray(there.H) @ np.full(12, 0.3)
    np.testing.assert_allclose(
        np.asarray(there.plan(0.0, jnp.asarray(x)))[:, 0],
        least_squares(np.asarray(there.H), q, -0.5, 0.5), atol=1e-9,
    )  # fmt: skip
    pushed = chain(disturbance=np.arange(6.0))
    apart = pushed.problem.reduced(0.0, jnp.zeros(6)) - mpc.problem.reduced(0.0, jnp.zeros(6))
    np.testing.assert_allclose(np.asarray(apart), np.arange(6.0), atol=1e-14)


BAD = [
    ("A", np.zeros((6, 5))), ("A", np.full((6, 6), np.nan)), ("A", [1.0, 2.0]), ("B", np.zeros((5, 1))),
    ("Q", -np.eye(6)), ("Q", np.eye(5)), ("Q", np.triu(np.ones((6, 6)))), ("R", np.zeros((1, 1))),
    ("R", np.eye(2)), ("horizon", 0), ("horizon", 2.0), ("step", 0.0), ("step", [0.1, 0.2]),
    ("lower", 0.5), ("lower", [0.0, 0.0]), ("upper", np.inf), ("slew", 0.0), ("slew", "slow"),
    ("target", [1.0]), ("feed", np.zeros(3)), ("disturbance", 1),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), BAD)
def test_mpc_rejects_bad_parameters_by_name(name, value):
    with pytest.raises(dvax.InputError) as caught:
        chain(**{name: value})
    assert name in caught.value.problems[0].place and len(caught.value.problems) == 1


def test_mpc_reports_all_bad_parameters_at_once():
    with pytest.raises(dvax.InputError) as caught:
        chain(Q=-np.eye(6), R=np.zeros((1, 1)), B=np.zeros((5, 1)))
    assert len(caught.value.problems) == 3
    with pytest.raises(dvax.InputError) as caught:
        chain(lower="low", target=[1.0], feed=np.zeros(3))
    assert len(caught.value.problems) == 3


def test_mpc_rejects_a_plant_that_cannot_be_stabilised():
    A = np.diag([0.5, 1.0, -1.0, -1.0, -1.0, -1.0])  # the second mode grows, and nothing pushes it
    with pytest.raises(dvax.InputError, match="stabilising"):
        chain(A=A, B=np.eye(6)[:, [0]])
