"""Linear systems and pseudoinverses of small matrices, against NumPy's LAPACK."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dvax._small_matrices import MAX_ROWS, eliminate, product, pseudoinverse, solve


def unit_rows(seed: int, m: int, n: int) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(m, n))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 4, MAX_ROWS, MAX_ROWS + 1])
def test_a_system_is_solved(n: int) -> None:
    rng = np.random.default_rng(n)
    M, b = rng.normal(size=(n, n)), rng.normal(size=n)
    np.testing.assert_allclose(
        solve(jnp.asarray(M), jnp.asarray(b)), np.linalg.solve(M, b), rtol=1e-9
    )


def test_a_zero_on_the_diagonal_needs_a_pivot_elsewhere() -> None:
    M = jnp.array([[0.0, 2.0, 0.0], [0.0, 0.0, 4.0], [1.0, 0.0, 0.0]])
    x, pivots = eliminate(M, jnp.array([2.0, 4.0, 3.0]))
    assert x.tolist() == [3.0, 1.0, 1.0]
    assert sorted(abs(pivots).tolist()) == [1.0, 2.0, 4.0]


def test_a_singular_matrix_has_no_finite_solution() -> None:
    assert not bool(jnp.any(jnp.isfinite(solve(jnp.ones((2, 2)), jnp.array([1.0, 2.0])))))


@pytest.mark.thorough
def test_the_derivatives_of_a_solution_are_those_of_the_system() -> None:
    rng = np.random.default_rng(0)
    M, dM, b, db = (jnp.asarray(v) for v in (*rng.normal(size=(2, 5, 5)), *rng.normal(size=(2, 5))))
    x, dx = jax.jvp(solve, (M, b), (dM, db))
    # M dx = db − dM x, and the transposed system backward.
    np.testing.assert_allclose(M @ dx, db - dM @ x, atol=1e-12)
    weights = jnp.arange(5.0)
    _, pull = jax.vjp(solve, M, b)
    back_M, back_b = pull(weights)
    np.testing.assert_allclose(M.T @ back_b, weights, atol=1e-12)
    np.testing.assert_allclose(back_M, -jnp.outer(back_b, x), atol=1e-12)
    # (M + sI)⁻¹ b has the second derivative 2 M⁻³ b at s = 0.
    second = jax.jacfwd(jax.jacrev(lambda s: solve(M + s * jnp.eye(5), b)))(0.0)
    expected = 2.0 * np.linalg.solve(M, np.linalg.solve(M, np.linalg.solve(M, b)))
    np.testing.assert_allclose(second, expected, rtol=1e-8)


def test_a_product_is_that_of_the_matrices() -> None:
    A, B = unit_rows(1, 4, 6), unit_rows(2, 6, 3)
    np.testing.assert_allclose(product(jnp.asarray(A), jnp.asarray(B)), A @ B, atol=1e-15)


def dependent() -> np.ndarray:
    """A repeated row, its negative, a zero row, and a row in the plane of two others."""
    a, b, c = unit_rows(3, 3, 4)
    between = (a + b) / np.linalg.norm(a + b)
    return np.stack([a, b, a, -a, np.zeros(4), between, c])


@pytest.mark.parametrize(
    "rows", [unit_rows(4, 3, 5), unit_rows(5, 7, 4), dependent()], ids=["wide", "tall", "dependent"]
)
def test_a_pseudoinverse_is_that_of_the_singular_values(rows: np.ndarray) -> None:
    np.testing.assert_allclose(pseudoinverse(jnp.asarray(rows)), np.linalg.pinv(rows), atol=1e-12)


def test_the_derivative_of_a_pseudoinverse_is_its_difference_quotient() -> None:
    rows, change = unit_rows(6, 3, 5), np.random.default_rng(7).normal(size=(3, 5))
    _, derivative = jax.jvp(pseudoinverse, (jnp.asarray(rows),), (jnp.asarray(change),))
    h = 1e-5
    quotient = (np.linalg.pinv(rows + h * change) - np.linalg.pinv(rows - h * change)) / (2 * h)
    np.testing.assert_allclose(derivative, quotient, rtol=1e-7, atol=1e-7)
