"""Derivatives of a solution with respect to all data in F and K, by the implicit function theorem."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax.sets import Ball, Box
from dvax.vi import Auto, Bracketing, Extragradient, implicit

M = np.array([[2.0, -0.7, 0.1], [0.7, 1.5, 0.4], [0.0, -0.4, 1.0]])
Q = np.array([-1.0, -3.0, 4.0])


def box_solution(q):
    vi = dvax.solve_vi(
        lambda y, q: jnp.asarray(M) @ y + q, Box(-1.0, 1.0), jnp.zeros(3), q, tol=1e-13
    )
    return vi.y


@pytest.mark.slow
def test_derivative_on_a_box_is_the_inverse_of_the_free_block():
    y = np.asarray(box_solution(jnp.asarray(Q)))
    free = np.abs(y) < 1 - 1e-6
    assert 0 < free.sum() < 3  # one entry free, the others held: both kinds are tested
    exact = np.zeros((3, 3))
    exact[np.ix_(free, free)] = -np.linalg.inv(M[np.ix_(free, free)])
    for jacobian in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jacobian(box_solution)(jnp.asarray(Q)), exact, atol=1e-11)


@pytest.mark.thorough
def test_derivative_of_held_entries_is_that_of_their_bound():
    def solution(upper):
        F = lambda y, _: jnp.asarray(M) @ y + jnp.asarray(Q)  # noqa: E731
        return dvax.solve_vi(F, Box(-1.0, upper), jnp.zeros(3), tol=1e-13).y

    upper = np.full(3, 0.9)
    y = np.asarray(solution(jnp.asarray(upper)))
    h = 1e-5
    at = lambda upper: np.asarray(solution(jnp.asarray(upper)))  # noqa: E731
    columns = [(at(upper + h * e) - at(upper - h * e)) / (2 * h) for e in np.eye(3)]
    by_differences = np.stack(columns, axis=1)
    assert np.any(y == 0.9) and np.any(np.abs(by_differences) > 0.5)
    for jacobian in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(
            jacobian(solution)(jnp.asarray(upper)), by_differences, rtol=1e-6, atol=1e-9
        )


@pytest.mark.slow
def test_derivative_on_a_ball_satisfies_the_lagrange_conditions():
    # My + q + μy = 0, |y| = r: differentiate these two equations by hand.
    q, r = np.array([-5.0, -3.0, 1.0]), 0.8

    def solution(q, r):
        F = lambda y, q: jnp.asarray(M) @ y + q  # noqa: E731
        return dvax.solve_vi(F, Ball(0.0, r), jnp.zeros(3), q, tol=1e-13).y

    y = np.asarray(solution(jnp.asarray(q), r))
    mu = -(y @ (M @ y + q)) / (y @ y)
    assert mu > 0.1
    system = np.block([[M + mu * np.eye(3), y[:, None]], [y[None, :], np.zeros((1, 1))]])
    dq = np.linalg.solve(system, np.vstack([-np.eye(3), np.zeros((1, 3))]))[:3]
    dr = np.linalg.solve(system, np.array([0.0, 0.0, 0.0, r]))[:3]
    for jacobian in (jax.jacfwd, jax.jacrev):
        found = jacobian(solution, argnums=(0, 1))(jnp.asarray(q), r)
        np.testing.assert_allclose(np.asarray(found[0]), dq, atol=1e-10)
        np.testing.assert_allclose(np.asarray(found[1]), dr, atol=1e-10)


SOLVERS = [Bracketing(), Extragradient(), Auto()]


@pytest.mark.slow
@pytest.mark.parametrize("solver", mostly_thorough(SOLVERS, SOLVERS[2:]))
def test_derivatives_of_a_nonlinear_law_of_first_and_second_order(solver):
    # y³ + y = c on [−10, 10]: y' = 1/(3y² + 1), y'' = −6y/(3y² + 1)³.
    def solution(c):
        F = lambda y, c: y**3 + y - c  # noqa: E731
        return dvax.solve_vi(F, Box(-10.0, 10.0), jnp.ones(()), c, solver, tol=1e-13).y

    y = 1.3
    c = y**3 + y
    slope, curvature = 1 / (3 * y**2 + 1), -6 * y / (3 * y**2 + 1) ** 3
    assert float(solution(c)) == pytest.approx(y, abs=1e-12)
    assert float(jax.grad(solution)(c)) == pytest.approx(slope, rel=1e-10)
    assert float(jax.jvp(solution, (c,), (1.0,))[1]) == pytest.approx(slope, rel=1e-10)
    for second in (
        jax.hessian(solution),
        jax.grad(jax.grad(solution)),
        jax.jacfwd(jax.jacfwd(solution)),
    ):
        assert float(second(c)) == pytest.approx(curvature, rel=1e-8)


@pytest.mark.slow
def test_jvp_and_vjp_are_transposes_and_agree_with_differences():
    rng = np.random.default_rng(2)

    def solution(theta):
        F = lambda y, th: (jnp.exp(-jnp.sum(y * y)) + 0.2) * (jnp.asarray(M) @ y + th)  # noqa: E731
        return dvax.solve_vi(F, Box(-1.0, 1.0), jnp.zeros(3), theta, tol=1e-13).y

    theta, d, w = rng.normal(size=(3, 3))
    theta = np.array([-1.0, -6.0, 0.3])
    _, forward = jax.jvp(solution, (jnp.asarray(theta),), (jnp.asarray(d),))
    _, pull = jax.vjp(solution, jnp.asarray(theta))
    assert float(w @ np.asarray(forward)) == pytest.approx(
        float(np.asarray(pull(jnp.asarray(w))[0]) @ d), rel=1e-11
    )
    h = 1e-5
    ends = [np.asarray(solution(jnp.asarray(theta + s * h * d))) for s in (1, -1)]
    np.testing.assert_allclose(
        np.asarray(forward), (ends[0] - ends[1]) / (2 * h), rtol=1e-6, atol=1e-9
    )


def test_derivative_in_the_guess_is_zero():
    F = lambda y, _: y**3 + y - 2.0  # noqa: E731
    for solver in (Bracketing(), Extragradient()):
        slope = jax.grad(lambda y0, s=solver: dvax.solve_vi(F, Box(-5.0, 5.0), y0, solver=s).y)(0.4)
        assert float(slope) == 0.0


def chain(n, pull, left_pull):
    """A law on a chain of n unknowns, coupled to their neighbours."""

    def F(y, args):
        left, right = jnp.roll(y, 1).at[0].set(0.0), jnp.roll(y, -1).at[-1].set(0.0)
        return y + pull * (2 * y - left_pull * left - right) + 0.1 * y**3 - args

    drive = 2.0 + 4.0 * np.sin(np.arange(n) / 7.0)
    return F, jnp.asarray(drive), Box(0.0, 1.5)


@pytest.mark.thorough
def test_derivatives_of_large_problems_use_gmres_in_both_modes(monkeypatch):
    monkeypatch.setattr(implicit, "_MAX_DENSE_UNKNOWNS", 32)
    F, drive, K = chain(150, 0.4, 0.7)
    weights = np.cos(np.arange(len(drive)))
    solved = lambda q: dvax.solve_vi(F, K, jnp.zeros_like(q), q, dvax.vi.ActiveSet(dense=2000)).y  # noqa: E731
    y = np.asarray(solved(drive))
    free = (y > 0.0) & (y < 1.5)
    matrix = np.asarray(jax.jacfwd(F)(jnp.asarray(y), drive))[np.ix_(free, free)]
    exact = np.zeros(len(y))
    exact[free] = np.linalg.solve(matrix.T, weights[free])
    found = jax.grad(lambda q: jnp.sum(weights * solved(q)))(drive)
    assert 10 < free.sum() < 140
    np.testing.assert_allclose(np.asarray(found), exact, atol=1e-9)
    along = np.sin(3.0 * np.arange(len(y)))
    _, change = jax.jvp(solved, (drive,), (jnp.asarray(along),))
    np.testing.assert_allclose(weights @ np.asarray(change), exact @ along, rtol=1e-9)


@pytest.mark.thorough
def test_derivatives_of_large_problems_in_single_precision(monkeypatch):
    monkeypatch.setattr(implicit, "_MAX_DENSE_UNKNOWNS", 32)
    F, drive, K = chain(150, 0.4, 0.7)
    drive = jnp.asarray(drive, jnp.float32)
    K = Box(jnp.float32(0.0), jnp.float32(1.5))
    solver = dvax.vi.ActiveSet(dense=2000)
    solved = lambda q: dvax.solve_vi(F, K, jnp.zeros_like(q), q, solver, 1e-4).y  # noqa: E731
    _, change = jax.jvp(solved, (drive,), (jnp.ones_like(drive),))
    _, exact = jax.jvp(
        lambda q: dvax.solve_vi(F, Box(0.0, 1.5), jnp.zeros_like(q), q, solver).y,
        (jnp.asarray(drive, float),), (jnp.ones(len(drive)),),
    )  # fmt: skip
    # An entry that rounding puts on the other side of its bound moves otherwise.
    assert np.mean(np.abs(np.asarray(change) - np.asarray(exact)) < 1e-3) > 0.99


@pytest.mark.thorough
def test_derivative_of_a_very_stiff_chain_is_correct_or_nan():
    # A thousand iterations without a preconditioner do not solve it.
    F, drive, K = chain(1200, 1e9, 1.0)
    K = Box(-1e12, 1e12)
    solved = lambda q: dvax.solve_vi(F, K, jnp.zeros_like(q), q, dvax.vi.ActiveSet(dense=2000)).y  # noqa: E731
    y = solved(drive)
    assert np.all(np.isfinite(np.asarray(y)))
    found = np.asarray(jax.grad(lambda q: jnp.sum(solved(q)))(drive))
    slope = np.asarray(jax.jacfwd(F)(y, drive))
    exact = np.linalg.solve(slope.T, np.ones(len(drive)))
    correct = np.max(np.abs(found - exact)) <= 1e-6 * np.max(np.abs(exact))
    assert correct or np.all(np.isnan(found))
