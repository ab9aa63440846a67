"""Generators: the semigroup, the flow of a polynomial forcing, and the growth bound."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import solve_ivp
from tests.oracles import symmetric_extremes

import dvax
from dvax import generators, spaces

MATRICES = {
    "symmetric": np.array([[-2.0, 0.5, 0.0], [0.5, -1.0, 0.3], [0.0, 0.3, -0.2]]),
    "skew": np.array([[0.0, 4.0, -1.0], [-4.0, 0.0, 2.0], [1.0, -2.0, 0.0]]),
    "non-normal": np.array([[-1.0, 30.0, 0.0], [0.0, -1.2, 30.0], [0.0, 0.0, -0.9]]),
}


@jax.jit
def _flow(matrix, h, x0, c0, c1, c2):
    return generators.Dense(matrix).propagator(h, 3).step(x0, (c0, c1, c2))


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize("h", [1e-3, 0.7])
def test_propagator_solves_the_equation_with_quadratic_forcing(name, h):
    A = MATRICES[name]
    x0, c = (
        np.array([1.0, -2.0, 0.5]),
        np.array([[0.3, 1.0, -1.0], [2.0, 0.0, 1.0], [1.0, 1.0, 3.0]]),
    )
    found = np.asarray(_flow(jnp.asarray(A), h, jnp.asarray(x0), *map(jnp.asarray, c)))
    exact = solve_ivp(
        lambda t, x: A @ x + c[0] + c[1] * (t / h) + c[2] * (t / h) ** 2,
        (0, h), x0, method="DOP853", rtol=1e-13, atol=1e-13,
    ).y[:, -1]  # fmt: skip
    np.testing.assert_allclose(found, exact, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", MATRICES)
def test_semigroup_is_the_matrix_exponential(name):
    A, v = MATRICES[name], np.array([0.2, 1.0, -0.4])
    found = np.asarray(generators.Dense(A).semigroup(0.9, jnp.asarray(v)))
    np.testing.assert_allclose(found, scipy.linalg.expm(0.9 * A) @ v, rtol=1e-12, atol=1e-13)


def test_semigroup_law_holds():
    A, v = generators.Dense(MATRICES["non-normal"]), jnp.array([0.2, 1.0, -0.4])
    twice = A.semigroup(0.3, A.semigroup(0.5, v))
    np.testing.assert_allclose(np.asarray(A.semigroup(0.8, v)), np.asarray(twice), rtol=1e-13)


def test_scalar_diagonal_dense_and_product_agree_on_the_same_operator():
    a, x0 = np.array([-0.5, -0.5]), np.array([1.0, -3.0])
    c = (jnp.array([0.2, -1.0]), jnp.array([1.0, 2.0]))
    h, x = 0.37, jnp.asarray(x0)
    dense = generators.Dense(np.diag(a)).propagator(h, 2).step(x, c)
    diagonal = generators.Diagonal(a).propagator(h, 2).step(x, c)
    scalar = generators.Scalar(-0.5).propagator(h, 2).step(x, c)
    parts = generators.Product(generators.Scalar(-0.5), generators.Diagonal(a[1:]))
    split = lambda v: (v[0], v[1:])  # noqa: E731
    pair = parts.propagator(h, 2).step(split(x), tuple(map(split, c)))
    nothing = generators.Zero().propagator(h, 2).step(x, c)
    nothing_at_all = generators.Scalar(0.0).propagator(h, 2).step(x, c)
    np.testing.assert_allclose(np.asarray(nothing), np.asarray(nothing_at_all), rtol=1e-14)
    for other in (dense, scalar, jnp.concatenate([pair[0][None], pair[1]])):
        np.testing.assert_allclose(np.asarray(other), np.asarray(diagonal), rtol=1e-14)
    applied = [g.apply(x) for g in (generators.Dense(np.diag(a)), generators.Scalar(-0.5))]
    for other in applied:
        np.testing.assert_allclose(np.asarray(other), a * x0, rtol=1e-15)


@pytest.mark.parametrize("weighted", [False, True])
def test_dense_growth_bound_holds_and_is_sharp_for_random_matrices(weighted):
    rng = np.random.default_rng(20261121 + weighted)
    for _ in range(25):
        n = 4
        A = rng.normal(size=(n, n)) * rng.choice([0.3, 3.0])
        w = rng.uniform(0.05, 5.0, n) if weighted else np.ones(n)
        space = spaces.L2(w) if weighted else spaces.Euclidean(n)
        M, omega = map(float, generators.Dense(A).growth(space))
        root = np.diag(np.sqrt(w))
        for t in (1e-3, 0.1, 1.0, 3.0):
            similar = root @ scipy.linalg.expm(t * A) @ np.linalg.inv(root)
            assert np.linalg.norm(similar, 2) <= M * np.exp(omega * t) * (1 + 1e-10)
        # The bound is attained to first order as t → 0: with M = 1 no smaller ω would do.
        assert omega == pytest.approx(symmetric_extremes(A, w)[1], abs=1e-10)


@pytest.mark.parametrize("weighted", [False, True])
def test_dense_growth_bound_of_a_nonnormal_matrix_decays(weighted):
    # ‖e^{At}‖ rises above 100 before it decays: the logarithmic norm is +149.
    A = np.array([[-1.0, 300.0], [0.0, -1.2]])
    w = np.array([0.3, 2.0]) if weighted else np.ones(2)
    space = spaces.L2(w) if weighted else spaces.Euclidean(2)
    M, omega = map(float, generators.Dense(A, omega=-0.8).growth(space))
    root = np.diag(np.sqrt(w))
    norms = [
        np.linalg.norm(root @ scipy.linalg.expm(t * A) @ np.linalg.inv(root), 2) / np.exp(omega * t)
        for t in np.geomspace(1e-3, 30.0, 200)
    ]
    assert omega == -0.8 and max(norms) > 100 * np.sqrt(w[0] / w[1])
    assert max(norms) <= M <= 20 * max(norms)
    assert float(generators.Dense(A).growth(space).omega) > 50


_growth = jax.jit(lambda A, omega: generators.Dense(A, omega).growth(spaces.Euclidean(len(A))).M)


@pytest.mark.parametrize("n", [1, 3, 20])
def test_dense_growth_constant_is_that_of_lyapunovs_equation_by_a_schur_decomposition(n):
    """Rates from just above the spectrum to far above it; graded and nonnormal matrices."""
    rng, compared = np.random.default_rng(20261126 + n), 0
    for k in range(30):
        graded = np.diag(-(10.0 ** rng.uniform(-4, 4, n)))
        above = np.triu(rng.normal(size=(n, n)), 1) * 10.0 ** rng.uniform(-3, 1)
        A = (graded + above, rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-3, 3))[k % 2]
        size = np.linalg.norm(A, 2)
        omega = np.max(np.linalg.eigvals(A).real) + 10.0 ** rng.uniform(-4, 0) * size
        S = A - omega * np.eye(n)
        Q = scipy.linalg.solve_continuous_lyapunov(S.T, -np.eye(n))
        low, high = np.linalg.eigvalsh(0.5 * (Q + Q.T))[[0, -1]]
        if low < 1e-10 * high:
            continue
        # Rounding enters the smallest eigenvalue of Q relative to the largest.
        close = 1e-8 + 1e-13 * high / low
        assert float(_growth(A, omega)) == pytest.approx(np.sqrt(high / low), rel=close)
        compared += 1
    assert compared >= 20


def test_growth_bounds_of_scalar_diagonal_zero_and_product():
    plane = spaces.Euclidean(2)
    assert float(generators.Scalar(-0.7).growth(plane).omega) == -0.7
    assert float(generators.Diagonal(jnp.array([-3.0, -0.2])).growth(plane).omega) == -0.2
    assert tuple(map(float, generators.Zero().growth(plane))) == (1.0, 0.0)
    both = generators.Product(generators.Scalar(-4.0), generators.Diagonal(jnp.array([-3.0, 0.5])))
    bound = both.growth(spaces.Product(spaces.Euclidean(), plane))
    assert (float(bound.M), float(bound.omega)) == (1.0, 0.5)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: generators.Dense(jnp.ones((2, 3))), r"shape \(2, 3\)"),
        (lambda: generators.Dense(jnp.ones(3)), r"shape \(3,\)"),
        (lambda: generators.Dense(jnp.eye(2), omega=1.0), "above the real part"),
        (lambda: generators.Scalar(True), "True"),
        (lambda: generators.Scalar("fast"), "fast"),
        (lambda: generators.Diagonal(np.array([1, 2])), "int64"),
    ],
)
def test_generators_reject_invalid_arguments(make, word):
    with pytest.raises(dvax.InputError, match=word):
        make()


@pytest.mark.parametrize(
    "A",
    [
        generators.Diagonal(-jnp.ones(3)),
        generators.Dense(-jnp.eye(3)),
        generators.Scalar(-jnp.ones(2)),
        generators.Product(generators.Scalar(-1.0), generators.Scalar(-1.0)),
    ],
)
def test_generator_of_another_size_than_the_state_is_rejected(A):
    with pytest.raises(dvax.InputError, match=r"dvax\.generators"):
        A.check(spaces.Euclidean(2))


def weighted(*shape, alike):
    rng = np.random.default_rng(6)
    return spaces.L2(np.full(shape, 0.3) if alike else rng.uniform(0.2, 2.0, shape))


ADJOINTS = {
    "Zero": (generators.Zero(), weighted(3, alike=False)),
    "Scalar": (generators.Scalar(-2.0), weighted(3, alike=False)),
    "Diagonal": (generators.Diagonal(np.array([-2.0, 0.1, 3.0])), weighted(3, alike=False)),
    "Dense": (generators.Dense(MATRICES["non-normal"]), weighted(3, alike=False)),
    "Elliptic": (
        generators.Elliptic((3, 4), 1.0, ("neumann", "periodic"), velocity=(0.0, 2.0)),
        weighted(3, 4, alike=True),
    ),
    "Rotation": (
        generators.Rotation(np.array([-1.0, 0.2]), np.array([3.0, 1.0])),
        spaces.Product(weighted(2, alike=True), weighted(2, alike=True)),
    ),
    "Product": (
        generators.Product(generators.Dense(MATRICES["skew"]), generators.Scalar(2.0)),
        spaces.Product(weighted(3, alike=False), weighted(2, alike=False)),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ADJOINTS)
def test_adjoint_and_its_semigroup_satisfy_the_inner_product_identity(name):
    A, space = ADJOINTS[name]
    rng = np.random.default_rng(7)
    v, w = (
        jax.tree_util.tree_map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), space.zeros())
        for _ in range(2)
    )
    other = A.adjoint(space)
    for left, right in (
        (A.apply(v), other.apply(w)), (A.semigroup(0.4, v), other.semigroup(0.4, w)),
    ):  # fmt: skip
        assert float(space.inner(left, w)) == pytest.approx(float(space.inner(v, right)), rel=1e-11)


def test_adjoint_of_another_kind_is_rejected():
    with pytest.raises(dvax.InputError, match="no constant coefficients"):
        generators.Elliptic(4).adjoint(weighted(4, alike=False))
    uneven = spaces.Product(spaces.L2(np.ones(2)), spaces.L2(np.full(2, 3.0)))
    with pytest.raises(dvax.InputError, match="no Rotation"):
        generators.Rotation(np.zeros(2), np.ones(2)).adjoint(uneven)


def test_dense_exponential_of_a_matrix_of_any_norm():
    # JAX's own gives NaN beyond a norm of 3·10⁵, and squaring e^{hA} as it stands loses ten digits.
    A = np.array([[-1e9, 3.0], [0.0, -0.5]])
    found = np.asarray(generators.Dense(A).semigroup(2.0, jnp.array([1.0, 1.0])))
    slow = 3.0 / (1e9 - 0.5)
    np.testing.assert_allclose(found, [slow * np.exp(-1.0), np.exp(-1.0)], rtol=1e-13)
    assert not np.isfinite(
        np.asarray(generators.Dense(A * np.nan).semigroup(2.0, jnp.ones(2)))
    ).any()
