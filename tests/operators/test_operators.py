"""P: bounded, self-adjoint, coercive (paper, ass:operators)."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from tests.oracles import symmetric_extremes

import dvax
from dvax import operators, spaces


def self_adjoint(rng, weights):
    """A random coercive matrix that is self-adjoint for Σ wᵢ aᵢ bᵢ: W⁻¹ times a symmetric one."""
    n = len(weights)
    root = rng.normal(size=(n, n))
    return (root @ root.T + 0.2 * np.eye(n)) / weights[:, None]


@pytest.mark.parametrize("weighted", [False, True])
def test_dense_spectrum_is_that_of_its_quadratic_form(weighted):
    rng = np.random.default_rng(3 + weighted)
    for n in (1, 2, 5):
        w = rng.uniform(0.1, 3.0, n) if weighted else np.ones(n)
        space = spaces.L2(w) if weighted else spaces.Euclidean(n)
        matrix = self_adjoint(rng, w)
        P = operators.Dense(matrix)
        P.check(space)
        found = P.spectrum(space)
        low, high = symmetric_extremes(matrix, w)
        assert float(found.m) == pytest.approx(low, rel=1e-9)
        assert float(found.norm) == pytest.approx(high, rel=1e-9)
        assert float(found.m_P) == pytest.approx(1 / high, rel=1e-9)
        assert float(found.norm_P_inv) == pytest.approx(1 / low, rel=1e-9)


def test_operator_inverse_undoes_apply():
    rng = np.random.default_rng(5)
    v = rng.normal(size=3)
    matrix = self_adjoint(rng, np.ones(3))
    entries = rng.uniform(0.1, 9.0, 3)
    for P, exact in (
        (operators.Dense(matrix), matrix @ v),
        (operators.Diagonal(entries), entries * v),
        (operators.Scaling(2.5), 2.5 * v),
    ):
        applied = P.apply(jnp.asarray(v))
        np.testing.assert_allclose(np.asarray(applied), exact, rtol=1e-14)
        np.testing.assert_allclose(np.asarray(P.inverse(applied)), v, rtol=1e-11)


def test_product_operator_acts_part_by_part_and_joins_spectra():
    matrix = np.array([[2.0, 0.5], [0.5, 1.0]])
    P = operators.Product(operators.Scaling(0.3), operators.Dense(matrix))
    space = spaces.Product(spaces.Euclidean(4), spaces.Euclidean(2))
    P.check(space)
    whole = scipy.linalg.block_diag(0.3 * np.eye(4), matrix)
    v = np.arange(6.0) - 2.0
    found = P.apply((jnp.asarray(v[:4]), jnp.asarray(v[4:])))
    np.testing.assert_allclose(np.concatenate([np.asarray(p) for p in found]), whole @ v)
    back = P.inverse(found)
    np.testing.assert_allclose(np.concatenate([np.asarray(p) for p in back]), v, atol=1e-14)
    eigenvalues = np.linalg.eigvalsh(whole)
    assert float(P.spectrum(space).m) == pytest.approx(eigenvalues[0], rel=1e-12)
    assert float(P.spectrum(space).norm) == pytest.approx(eigenvalues[-1], rel=1e-12)


PLANE = spaces.Euclidean(2)


@pytest.mark.parametrize(
    ("refused", "word"),
    [
        (lambda: operators.Scaling(0.0), "coercive"),
        (lambda: operators.Scaling(-1.0), "coercive"),
        (lambda: operators.Scaling(float("nan")), "coercive"),
        (lambda: operators.Diagonal(jnp.array([1.0, 0.0])), "coercive"),
        (lambda: operators.Dense(jnp.ones((2, 3))), "square"),
        (lambda: operators.Dense(jnp.array([[2.0, 1.0], [0.0, 2.0]])).check(PLANE), "self-adjoint"),
        (lambda: operators.Dense(jnp.array([[1.0, 2.0], [2.0, 1.0]])).check(PLANE), "coercive"),
        # Symmetric, but not self-adjoint for these weights.
        (
            lambda: operators.Dense(jnp.array([[2.0, 1.0], [1.0, 2.0]])).check(
                spaces.L2(np.array([1.0, 3.0]))
            ),
            "self-adjoint",
        ),
        (lambda: operators.Dense(jnp.eye(3)).check(PLANE), r"\(3, 3\)"),
        (lambda: operators.Diagonal(jnp.ones(3)).check(PLANE), r"\(3,\)"),
        (
            lambda: operators.Product(operators.Scaling(1.0), operators.Scaling(1.0)).check(PLANE),
            "2 parts",
        ),
    ],
)
def test_operators_reject_matrices_that_are_not_self_adjoint_and_coercive(refused, word):
    with pytest.raises(dvax.InputError, match=word):
        refused()
