"""Structured operators agree with their matrices."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from tests.oracles import symmetric_extremes

import dvax
from dvax import operators, spaces

RNG = np.random.default_rng(3)


def matrix_of(P, shape):
    n = int(np.prod(shape))
    columns = jax.vmap(lambda v: P.apply(v.reshape(shape)).reshape(-1))(jnp.eye(n))
    return np.asarray(columns).T


def check_all(P, space, matrix, shape):
    """apply, inverse, spectrum and the derivative of the inverse, against the matrix."""
    P.check(space)
    v = RNG.normal(size=shape)
    np.testing.assert_allclose(np.asarray(P.apply(jnp.asarray(v))).ravel(), matrix @ v.ravel())
    back = np.asarray(jax.jit(lambda v: P.inverse(v))(jnp.asarray(v))).ravel()
    np.testing.assert_allclose(back, np.linalg.solve(matrix, v.ravel()), rtol=1e-9, atol=1e-10)
    ends = P.spectrum(space)
    low, high = symmetric_extremes(matrix, np.broadcast_to(space.weights(), shape).ravel())
    if ends.exact:
        assert (float(ends.m), float(ends.norm)) == pytest.approx((low, high), rel=1e-9)
    else:
        assert float(ends.m) <= low * (1 + 1e-12) and float(ends.norm) >= high * (1 - 1e-12)
    return ends


@pytest.mark.parametrize("n", [7, 8])
def test_convolution_equals_the_circulant_matrix_of_its_kernel(n):
    symbol = 1.0 / (0.3 + np.arange(n // 2 + 1))
    P = operators.Convolution(symbol, n)
    ends = check_all(P, spaces.L2(np.full(n, 0.1)), scipy.linalg.circulant(
        np.fft.irfft(symbol, n)), (n,))  # fmt: skip
    assert ends.exact


@pytest.mark.thorough
@pytest.mark.parametrize("shape", [(4, 6), (5, 3)])
def test_convolution_in_two_dimensions(shape):
    k = np.hypot(*np.meshgrid(
        np.fft.fftfreq(shape[0], 1 / shape[0]), np.fft.rfftfreq(shape[1], 1 / shape[1]),
        indexing="ij"))  # fmt: skip
    P = operators.Convolution(1.0 / (1.0 + k), shape)
    matrix = matrix_of(P, shape)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-15)
    # Shifting the input shifts the output.
    v = RNG.normal(size=shape)
    moved = P.apply(jnp.asarray(np.roll(v, (1, 2), (0, 1))))
    np.testing.assert_allclose(moved, np.roll(P.apply(jnp.asarray(v)), (1, 2), (0, 1)), atol=1e-15)
    check_all(P, spaces.Euclidean(shape), matrix, shape)


@pytest.mark.slow
@pytest.mark.parametrize("s", [[2.0, 0.5], [2.0, -0.02]])
def test_low_rank_operator_equals_its_matrix(s):
    n, s = 6, np.array(s)
    U, d = RNG.normal(size=(n, 2)), RNG.uniform(0.5, 2.0, n)
    for diagonal in (d, 0.7):
        P = operators.LowRank(diagonal, U, s)
        matrix = np.diag(np.broadcast_to(diagonal, n)) + U @ np.diag(s) @ U.T
        assert check_all(P, spaces.Euclidean(n), matrix, (n,)).exact
    # Entries that weigh the same may be coupled.
    w = np.array([1.0, 1.0, 1.0, 3.0, 3.0, 3.0])
    blocks = np.zeros((n, 2))
    blocks[:3, 0], blocks[3:, 1] = 1.0, [1.0, -2.0, 0.5]
    matrix = np.diag(d) + blocks @ np.diag(s) @ blocks.T
    check_all(operators.LowRank(d, blocks, s), spaces.L2(w), matrix, (n,))


@pytest.mark.slow
def test_low_rank_spectrum_of_a_large_operator_is_marked_as_bounds():
    n = 600
    U, d = RNG.normal(size=(n, 2)) / 20, RNG.uniform(0.5, 2.0, n)
    s = np.array([3.0, -0.2])
    P = operators.LowRank(d, U, s)
    P.check(spaces.Euclidean(n))
    ends = P.spectrum(spaces.Euclidean(n))
    exact = np.linalg.eigvalsh(np.diag(d) + U @ np.diag(s) @ U.T)
    assert not ends.exact and not ends.declared
    assert 0 < float(ends.m) <= exact[0] and float(ends.norm) >= exact[-1]
    full = operators.LowRank(2.0, np.eye(3), np.array([1.0, 1.0, 3.0]))  # 2 is not in its spectrum
    assert check_all(full, spaces.Euclidean(3), np.diag([3.0, 3.0, 5.0]), (3,)).exact


def test_matrix_free_inverse_uses_the_inner_product_of_the_space():
    n = 8
    root = RNG.normal(size=(n, n))
    symmetric = root @ root.T + np.eye(n)
    weights = np.arange(1.0, n + 1)
    for space, w in ((spaces.Euclidean(n), np.ones(n)), (spaces.L2(weights), weights)):
        matrix = symmetric / w[:, None]
        low, high = symmetric_extremes(matrix, w)
        own = 1.0 if isinstance(space, spaces.Euclidean) else w
        act = functools.partial(jnp.matmul, jnp.asarray(matrix))
        P = operators.MatrixFree(act, 0.9 * low, 1.1 * high, weights=own)
        ends = check_all(P, space, matrix, (n,))
        assert ends.declared and not ends.exact
        pair = operators.Product(P, operators.Scaling(1.0))
        both = pair.spectrum(spaces.Product(space, spaces.Euclidean()))
        assert both.declared and not both.exact


@pytest.mark.slow
def test_matrix_free_inverse_is_differentiated_implicitly():
    M, v = jnp.array([[2.0, 0.5], [0.5, 1.0]]), jnp.array([1.0, 2.0])

    def free(a):
        return jnp.sum(operators.MatrixFree(lambda u: a * (M @ u), 0.1, 9.0).inverse(v))

    def exact(a):
        return jnp.sum(jnp.linalg.solve(a * M, v))

    np.testing.assert_allclose(jax.grad(free)(1.3), jax.grad(exact)(1.3), rtol=1e-10)
    np.testing.assert_allclose(
        jax.jvp(free, (1.3,), (1.0,))[1], jax.jvp(exact, (1.3,), (1.0,))[1], rtol=1e-10
    )


def test_matrix_free_inverse_without_convergence_is_nan():
    skew = operators.MatrixFree(lambda v: jnp.array([v[1], -v[0]]), 0.5, 2.0)
    assert not np.all(np.isfinite(np.asarray(skew.inverse(jnp.array([1.0, 2.0])))))


PLANE, UNEVEN = spaces.Euclidean(2), spaces.L2(np.array([1.0, 2.0]))
ONES = np.ones((2, 1))


@pytest.mark.parametrize(
    ("refused", "word"),
    [
        (lambda: operators.Convolution(np.array([1.0, 0.0]), 2), "coercive"),
        (lambda: operators.Convolution(np.ones(2), 5), "rfftn"),
        (lambda: operators.Convolution(np.ones((2, 2, 2)), (2, 2, 2)), "one or two"),
        (lambda: operators.Convolution(np.array([[1.0], [2.0], [3.0]]), (3, 1)), "real"),
        (lambda: operators.Convolution(np.ones(2), 2).check(UNEVEN), "same weight"),
        (lambda: operators.Convolution(np.ones(2), 3).check(PLANE), r"\(3,\)"),
        (lambda: operators.LowRank(1.0, ONES, np.array([0.0])), "not 0"),
        (lambda: operators.LowRank(-1.0, ONES, np.array([1.0])), "positive"),
        (lambda: operators.LowRank(1.0, ONES, np.ones(2)), "shapes"),
        (lambda: operators.LowRank(1.0, ONES, np.array([-0.6])).check(PLANE), "coercive"),
        (lambda: operators.LowRank(1.0, ONES, np.ones(1)).check(UNEVEN), "self-adjoint"),
        (lambda: operators.LowRank(1.0, ONES, np.ones(1)).check(spaces.Euclidean(3)), r"\(3,\)"),
        (lambda: operators.MatrixFree(lambda v: v, 2.0, 1.0), "0 < m"),
        (lambda: operators.MatrixFree(lambda v: v[:1], 1.0, 1.0).check(PLANE), r"\(1,\)"),
        (lambda: operators.MatrixFree(lambda v: v * v, 1.0, 2.0).check(PLANE), "linear"),
        (
            lambda: operators.MatrixFree(
                lambda v: v + jnp.array([0.0, 1.0]) * v[0], 0.3, 2.0
            ).check(PLANE),
            "self-adjoint",
        ),
        (lambda: operators.MatrixFree(lambda v: 5.0 * v, 1.0, 2.0).check(PLANE), "enclose"),
        (lambda: operators.MatrixFree(lambda v: v, 1.0, 1.0).check(UNEVEN), "weights="),
    ],
)
def test_structured_operators_reject_data_that_are_not_coercive(refused, word):
    with pytest.raises(dvax.InputError, match=word):
        refused()
