"""Derivatives with respect to all data in K and F, against those of the Lagrange conditions by hand.

Where G holds (Gy = d, G of full rank) with multipliers ν, My + q + Gᵀν = 0 and Gy = d; differentiated,

    M dy + Gᵀdν = −dM y − dq − dGᵀν,    G dy = dd − dG y.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax.sets import Ball, Box, Polyhedron, Simplex
from dvax.vi import Auto, Extragradient, GoldenRatio, SemismoothNewton

M = np.array(
    [[2.0, -0.7, 0.1, 0.0], [0.7, 1.5, 0.4, -0.3], [0.0, -0.4, 1.0, 0.2], [0.5, 0, 0, 1.8]]
)
Q = np.array([-1.0, -3.0, 4.0, 0.5])


def solve(K, args, solver=None, tol=1e-13):
    return dvax.solve_vi(
        lambda y, args: args[0] @ y + args[1], K, jnp.full(4, 0.25), args, solver, tol=tol
    ).y


def by_hand(y, G, nu, dM=0.0, dq=0.0, dG=0.0, dd=0.0, M=M):
    """dy for active rows G and their multipliers ν."""
    rows = len(G)
    system = np.block([[M, G.T], [G, np.zeros((rows, rows))]])
    dM, dG = np.broadcast_to(dM, M.shape), np.broadcast_to(dG, G.shape)
    right = np.concatenate([-dM @ y - dq - dG.T @ nu, np.broadcast_to(dd, rows) - dG @ y])
    return np.linalg.solve(system, right)[:4]


def jvp_and_vjp(solution, at, rng):
    """(y, a random direction, dy along it forward, dy along it by four pullbacks), in one program."""
    flat, unravel = jax.flatten_util.ravel_pytree(jax.tree.map(jnp.asarray, at))
    direction = jnp.asarray(rng.normal(size=flat.shape))

    def both(flat, direction):
        f = lambda v: solution(unravel(v))  # noqa: E731
        y, forward = jax.jvp(f, (flat,), (direction,))
        pull = jax.vjp(f, flat)[1]
        return y, forward, jax.vmap(pull)(jnp.eye(4))[0] @ direction

    y, forward, back = map(np.asarray, jax.jit(both)(flat, direction))
    return y, jax.tree.map(np.asarray, unravel(direction)), forward, back


@pytest.mark.thorough  # a long program: the active set, and derivatives of a pseudo-inverse
def test_derivative_on_a_polyhedron_in_rows_offsets_and_operator():
    G = np.array(
        [[1.0, 1.0, 0.0, 0.0], [0.0, 1.0, -1.0, 0.5], [-1.0, 0.0, 0.0, -1.0], [0, 0, -1, 0]]
    )
    d = np.array([0.7, 1.0, 5.0, 0.8])
    at = (M, Q, G, d)
    y, (dM, dq, dG, dd), forward, back = jvp_and_vjp(
        lambda v: solve(Polyhedron(v[2], v[3]), (v[0], v[1])), at, np.random.default_rng(0)
    )
    held = np.isclose(G @ y, d, atol=1e-10)
    assert 0 < held.sum() < 4
    nu = np.linalg.lstsq(G[held].T, -(M @ y + Q), rcond=None)[0]
    assert np.all(nu > 0.05)  # held for good, so that the derivative exists
    np.testing.assert_allclose(M @ y + Q + G[held].T @ nu, 0, atol=1e-10)
    exact = by_hand(y, G[held], nu, dM, dq, dG[held], dd[held])
    np.testing.assert_allclose(forward, exact, atol=1e-9)
    np.testing.assert_allclose(back, exact, atol=1e-9)


@pytest.mark.slow
def test_derivative_on_a_simplex_in_its_total():
    at = (M, Q, np.array(1.7))
    y, (dM, dq, dtotal), forward, back = jvp_and_vjp(
        lambda v: solve(Simplex(v[2]), (v[0], v[1])), at, np.random.default_rng(1)
    )
    assert y.sum() == pytest.approx(1.7, abs=1e-12) and 0 < np.sum(y == 0) < 3
    G = np.vstack([np.ones(4), -np.eye(4)[y == 0]])
    nu = np.linalg.lstsq(G.T, -(M @ y + Q), rcond=None)[0]
    assert np.all(nu[1:] > 0.05)
    exact = by_hand(y, G, nu, dM, dq, 0.0, np.append(dtotal, np.zeros(len(G) - 1)))
    np.testing.assert_allclose(forward, exact, atol=1e-9)
    np.testing.assert_allclose(back, exact, atol=1e-9)


@pytest.mark.thorough  # beside `test_derivatives.py`, the center
def test_derivative_on_a_ball_in_center_and_radius():
    # The one row is (y − c)ᵀ, which turns with y: ν stands on the diagonal as well.
    center, radius = np.array([0.3, -0.2, 0.1, 0.0]), np.array(0.8)
    y, (dM, dq, dc, dr), forward, back = jvp_and_vjp(
        lambda v: solve(Ball(v[2], v[3]), (v[0], v[1])), (M, Q, center, radius),
        np.random.default_rng(2),
    )  # fmt: skip
    G = (y - center)[None]
    nu = -(G @ (M @ y + Q)) / radius**2
    assert nu[0] > 0.05 and np.linalg.norm(G) == pytest.approx(0.8, abs=1e-12)
    # ν(y − c) and |y − c|² = r² differentiated: dG = −dc, and (y − c)·(dy − dc) = r dr.
    turned = M + nu[0] * np.eye(4)
    right = np.append(-dM @ y - dq + nu[0] * dc, G[0] @ dc + radius * dr)
    exact = np.linalg.solve(np.block([[turned, G.T], [G, np.zeros((1, 1))]]), right)[:4]
    np.testing.assert_allclose(forward, exact, atol=1e-9)
    np.testing.assert_allclose(back, exact, atol=1e-9)


# At y = (0, 1) both are on a bound of [0, 1]², and F = (0, −1) there: the first entry just touches.
TOUCHING = (np.array([[2.0, 1.0], [-1.0, 3.0]]), np.array([-1.0, -4.0]))


@pytest.mark.parametrize(
    "solver",
    [
        Auto(),
        *(
            pytest.param(s, marks=pytest.mark.thorough)
            for s in (SemismoothNewton(), Extragradient(), GoldenRatio())
        ),
    ],
    ids=lambda s: type(s).__name__,
)
def test_derivative_of_an_entry_that_touches_its_bound_is_the_held_one(solver):
    # The convention of AbstractSet.
    by_q, by_lower = touching(solver, np.array([0.0, 1.0]))
    np.testing.assert_array_equal(by_q, np.zeros((2, 2)))
    np.testing.assert_allclose(by_lower, [[1.0, 0.0], [0.0, 0.0]], atol=1e-15)


# From elsewhere y₁ may end a rounding above 0, where nothing holds it.
@pytest.mark.thorough
@pytest.mark.parametrize(
    "solver",
    mostly_thorough([Auto(), GoldenRatio()], [Auto()]),
    ids=lambda s: type(s).__name__,
)
def test_derivative_of_an_entry_near_its_bound_is_one_sided(solver):
    by_q, by_lower = touching(solver, np.zeros(2))
    free = np.array_equal(by_q, [[-0.5, 0.0], [0.0, 0.0]]) and not by_lower.any()
    held = not by_q.any() and np.array_equal(by_lower, [[1.0, 0.0], [0.0, 0.0]])
    assert free or held


def touching(solver, start):
    """dy/dq and dy/dlower. From one side dy₁/dq₁ is −1/2, from the other 0."""

    def solution(q, lower):
        vi = dvax.solve_vi(
            lambda y, q: jnp.asarray(TOUCHING[0]) @ y + q, Box(lower, 1.0), jnp.asarray(start), q,
            solver, tol=1e-12,
        )  # fmt: skip
        return vi.y

    q, lower = jnp.asarray(TOUCHING[1]), jnp.zeros(2)
    np.testing.assert_allclose(solution(q, lower), [0.0, 1.0], rtol=0, atol=1e-12)
    by_q, by_lower = jax.jit(jax.jacfwd(solution, argnums=(0, 1)))(q, lower)
    return np.asarray(by_q), np.asarray(by_lower)


@pytest.mark.thorough  # three programs, and their derivatives' derivatives
@pytest.mark.parametrize("kind", mostly_thorough(["box", "ball", "simplex"], ["ball"]))
def test_second_derivatives_of_a_smooth_solution(kind):
    # Central differences of the first derivative, which the tests above compare with formulas.
    make = {"box": lambda s: Box(-1.0, s), "ball": lambda s: Ball(0.0, s), "simplex": Simplex}[kind]

    def solution(p):
        F = lambda y, q: jnp.asarray(M) @ y + 0.3 * y**3 + q * q[::-1]  # noqa: E731
        vi = dvax.solve_vi(F, make(p[4]), jnp.full(4, 0.25), p[:4], tol=1e-13)
        return vi.y @ jnp.array([1.0, -2.0, 0.5, 3.0])

    p = jnp.asarray(np.append([-1.0, -1.5, 2.0, 0.7], 0.9))
    gradient = jax.jit(jax.grad(solution))
    h = 1e-5
    columns = [(gradient(p + h * e) - gradient(p - h * e)) / (2 * h) for e in jnp.eye(5)]
    exact = np.stack(columns)
    assert np.abs(exact).max() > 0.1
    for second in (jax.hessian(solution), jax.jacfwd(jax.jacrev(solution))):
        np.testing.assert_allclose(jax.jit(second)(p), exact, atol=1e-7)
