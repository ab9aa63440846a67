"""Lemke's method against solutions that are constructed from their active conditions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.sets import Ball, Polyhedron, Simplex
from dvax.vi import RESULTS, Auto, FrozenVI, Lemke
from dvax.vi.known import Known

N, ROWS, COUNT = 5, 8, 40


def affine(y, data):
    M, q = data
    return M @ y + q


def matrices(rng) -> np.ndarray:
    """Positive definite, and not symmetric."""
    half, skew = rng.normal(size=(2, COUNT, N, N))
    transposed = np.swapaxes(half, 1, 2), np.swapaxes(skew, 1, 2)
    return half @ transposed[0] / N + 0.1 * np.eye(N) + skew - transposed[1]


@pytest.mark.slow
def test_solutions_on_polyhedra_are_found_with_one_certificate() -> None:
    """y* with G y* = d on the active rows, and F(y*) = −Gᵀλ for multipliers λ of them alone."""
    rng = np.random.default_rng(0)
    M, y = matrices(rng), rng.normal(size=(COUNT, N))
    G = rng.normal(size=(COUNT, ROWS, N))
    active = rng.permuted(np.tile(np.arange(ROWS) < 3, (COUNT, 1)), axis=1)
    multipliers = np.where(active, rng.exponential(size=(COUNT, ROWS)), 0.0)
    slack = np.where(active, 0.0, rng.exponential(size=(COUNT, ROWS)))
    d = np.einsum("kij,kj->ki", G, y) + slack
    q = -np.einsum("kij,kj->ki", M, y) - np.einsum("kij,ki->kj", G, multipliers)

    @jax.jit
    @jax.vmap
    def solved(M, q, G, d):
        return dvax.solve_vi(
            affine, Polyhedron(G, d), jnp.zeros(N), (M, q), solver=Lemke(), tol=1e-9
        )

    found = solved(*map(jnp.asarray, (M, q, G, d)))
    assert bool(jnp.all(found.result == RESULTS.successful))
    assert int(jnp.max(found.iterations)) == 1
    np.testing.assert_allclose(found.y, y, atol=1e-8)


def test_solutions_on_simplices_are_found_with_one_certificate() -> None:
    """y* ≥ 0 with Σ y* = total, where F(y*) = μ on the positive entries and F(y*) ≥ μ on the others."""
    rng = np.random.default_rng(1)
    M = matrices(rng)
    positive = rng.random((COUNT, N)) < 0.5
    positive[:, 0] = True
    y = np.where(positive, rng.exponential(size=(COUNT, N)), 0.0)
    values = rng.normal(size=(COUNT, 1)) + np.where(positive, 0.0, rng.exponential(size=(COUNT, N)))
    q = values - np.einsum("kij,kj->ki", M, y)

    @jax.jit
    @jax.vmap
    def solved(M, q, total):
        K = Simplex(total)
        return dvax.solve_vi(affine, K, jnp.zeros(N), (M, q), solver=Auto(), tol=1e-9)

    found = solved(*map(jnp.asarray, (M, q, y.sum(axis=1))))
    assert found.solver == "Lemke"
    assert int(jnp.max(found.iterations)) == 1
    np.testing.assert_allclose(found.y, y, atol=1e-8)


def test_the_weights_of_the_space_are_those_of_the_law() -> None:
    """⟨F(y), v − y⟩ with the weight w on every entry has the solution for F, whatever w; with weights
    of their own, that for wF in the plain product."""
    rng = np.random.default_rng(2)
    M, q, w = matrices(rng)[0], rng.normal(size=N), rng.uniform(0.5, 2.0, N)
    data, K, y0 = (jnp.asarray(M), jnp.asarray(q)), Simplex(1.0), jnp.zeros(N)
    weighted = (jnp.asarray(w[:, None] * M), jnp.asarray(w * q))
    space = dvax.spaces.L2(jnp.asarray(w))
    one = dvax.solve_vi(affine, K, y0, data, solver=Lemke(), space=space)
    two = dvax.solve_vi(affine, K, y0, weighted, solver=Lemke())
    assert int(one.iterations) == 1
    np.testing.assert_allclose(one.y, two.y, atol=1e-10)


@pytest.mark.slow
def test_the_derivative_is_that_on_the_face() -> None:
    """On the face y₃ = 0 of the simplex, (y₁, y₂, μ) solves a linear system, whose derivative in q is a
    column of its inverse."""
    M = jnp.array([[3.0, 1.0, 0.0], [-1.0, 2.0, 0.0], [0.0, 0.0, 1.0]])
    q = jnp.array([0.1, 0.0, 9.0])

    def y(q):
        return dvax.solve_vi(affine, Simplex(1.0), jnp.ones(3) / 3, (M, q), solver=Lemke()).y

    system = np.array([[3.0, 1.0, -1.0], [-1.0, 2.0, -1.0], [1.0, 1.0, 0.0]])
    expected = np.zeros((3, 3))
    expected[:2, :2] = -np.linalg.inv(system)[:2, :2]
    np.testing.assert_allclose(jax.jacfwd(y)(q), expected, atol=1e-10)
    np.testing.assert_allclose(jax.jacrev(y)(q), expected, atol=1e-10)


@pytest.mark.slow
def test_a_known_solution_has_the_derivative_on_its_face() -> None:
    """On the active rows G_A y = d_A the derivative in (−q, d_A) is a block of the inverse of the
    matrix [M G_Aᵀ; G_A 0]."""
    rng = np.random.default_rng(3)
    M, y = matrices(rng), rng.normal(size=(COUNT, N))
    G = rng.normal(size=(COUNT, ROWS, N))
    multipliers = np.where(np.arange(ROWS) < 3, rng.exponential(size=(COUNT, ROWS)) + 0.1, 0.0)
    slack = np.where(np.arange(ROWS) < 3, 0.0, rng.exponential(size=(COUNT, ROWS)) + 0.1)
    d = np.einsum("kij,kj->ki", G, y) + slack
    q = -np.einsum("kij,kj->ki", M, y) - np.einsum("kij,ki->kj", G, multipliers)

    def known(data, M, G, y):
        q, d = data
        vi = FrozenVI(lambda v: M @ v + q, Polyhedron(G, d), dvax.spaces.Euclidean(N))
        return Known().solve(vi, y, 1.0).y

    arrays = map(jnp.asarray, (M, G, y))
    of_q, of_d = jax.jit(jax.vmap(jax.jacfwd(known)))((jnp.asarray(q), jnp.asarray(d)), *arrays)
    zero = np.zeros((3, 3))
    for k in range(COUNT):
        rows = G[k, :3]
        inverse = np.linalg.inv(np.block([[M[k], rows.T], [rows, zero]]))
        np.testing.assert_allclose(of_q[k], -inverse[:N, :N], atol=1e-8)
        np.testing.assert_allclose(of_d[k][:, :3], inverse[:N, N:], atol=1e-8)
        np.testing.assert_array_equal(of_d[k][:, 3:], 0.0)


def test_iterations_take_over_where_pivoting_fails() -> None:
    """M = 0 is not positive definite: the solution is the vertex of the smallest q."""
    data = jnp.zeros((3, 3)), jnp.array([1.0, -2.0, 0.5])
    found = dvax.solve_vi(affine, Simplex(2.0), jnp.ones(3), data, solver=Lemke())
    assert found.result == RESULTS.successful
    assert found.y.tolist() == [0.0, 2.0, 0.0]


@pytest.mark.parametrize(
    ("F", "K"),
    [
        (lambda y, args: y**3 + y, Simplex(1.0)),
        (lambda y, args: jnp.array([[2.0, 1.0], [0.0, 2.0]]) @ y, Ball(0.0, 1.0)),
    ],
    ids=["nonlinear", "ball"],
)
def test_other_laws_are_refused(F, K) -> None:
    with pytest.raises(dvax.InputError, match="affine"):
        dvax.solve_vi(F, K, jnp.zeros(2), solver=Lemke())
