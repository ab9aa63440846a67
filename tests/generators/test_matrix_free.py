"""Sparse and user-defined matrix-free generators: Faber series against matrix exponentials, numerical
ranges against eigenvalues."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from jax.experimental.sparse import BCOO
from tests.selection import mostly_thorough

import dvax
from dvax import generators, spaces
from dvax.theory.certificate import is_declared

N = 40
RNG = np.random.default_rng(4)
WEIGHTS = RNG.uniform(0.2, 3.0, N)


def bands(left, middle, right):
    return scipy.sparse.diags_array([left, middle, right], offsets=[-1, 0, 1], shape=(N, N))


def scattered(rng, n=N, density=0.1):
    return scipy.sparse.random_array((n, n), density=density, rng=rng, data_sampler=rng.normal)


MATRICES = {
    "heat": 200.0 * bands(1.0, -2.0, 1.0),
    "stiff heat": 1e5 * bands(1.0, -2.0, 1.0),
    "advection": 40.0 * bands(1.0, 0.0, -1.0),
    "advection and diffusion": bands(110.0, -100.0, -10.0),
    "far from normal": bands(0.0, -1.5, 3.0),
    "scattered": 3.0 * scattered(RNG),
    "one long row": bands(1.0, -2.0, 1.0)
    + scipy.sparse.coo_array((np.ones(N), (np.full(N, 7), np.arange(N))), shape=(N, N)),
    "weighted heat": scipy.sparse.diags_array(1 / WEIGHTS) @ (100.0 * bands(1.0, -2.0, 1.0)),
    "nothing": scipy.sparse.csr_array((N, N)),
}


def weights_of(name):
    return WEIGHTS if name.startswith("weighted") else 1.0


def exact(A, h, x0, c):
    """x(h) of x' = Ax + Σ cⱼ(t/h)ʲ, from one exponential of a larger matrix; a small imaginary part
    carries a derivative along."""
    n, q = len(x0), len(c)
    block = np.zeros((n + q, n + q), np.result_type(A, h, c))
    block[:n, :n] = h * A
    for j in range(q):
        block[:n, n + j] = h * c[j]
        if j:
            block[n + j, n + j - 1] = j
    return (scipy.linalg.expm(block) @ np.r_[x0, 1.0, np.zeros(q - 1)])[:n]


@jax.jit
def flow(A, h, x0, c):
    return A.propagator(h, 3).step(x0, tuple(c))


X0, C = RNG.normal(size=N), RNG.normal(size=(3, N))


@pytest.mark.slow
@pytest.mark.parametrize("name", MATRICES)
def test_sparse_semigroup_is_the_matrix_exponential(name):
    A = generators.Sparse(MATRICES[name], weights_of(name))
    dense = MATRICES[name].toarray()
    for h in (1e-3, 0.1, 2.0):
        found = np.asarray(flow(A, jnp.asarray(h), jnp.asarray(X0), jnp.asarray(C)))
        expected = exact(dense, h, X0, C)
        # Rounding of A itself moves e^{hA} by as much as h‖A‖ roundings.
        size = 1e-14 * max(10.0, h * np.abs(dense).sum(1).max())
        assert np.abs(found - expected).max() <= size * np.abs(expected).max()


@pytest.mark.slow
def test_sparse_number_of_products_is_as_documented():
    heat = generators.Sparse(MATRICES["heat"]).propagator(jnp.asarray(2.0), 2)
    wave = generators.Sparse(MATRICES["advection"]).propagator(jnp.asarray(2.0), 2)
    assert int(heat.degree) <= 6 * np.sqrt(2.0 * 800) and int(heat.substeps) == 1
    assert int(wave.degree) <= 1.5 * 2.0 * 80 and int(wave.substeps) == 1


def supports(A, w):
    """(θ, λ): the numerical range in the weighted inner product lies in Re(e^{−iθ}z) ≤ λ, exactly."""
    root = np.sqrt(w)
    similar = root[:, None] * A / root[None, :]
    for theta in np.linspace(0.0, np.pi, 25):
        turned = np.exp(-1j * theta) * similar
        yield theta, np.linalg.eigvalsh((turned + turned.conj().T) / 2)[-1]


@pytest.mark.slow
@pytest.mark.parametrize("seed", mostly_thorough(range(20), range(8)))
def test_sparse_numerical_range_lies_in_rectangle_and_ellipse(seed):
    rng = np.random.default_rng(seed)
    n = 12
    A = scattered(rng, n, rng.uniform(0.05, 0.6)).toarray()
    A[np.diag_indices(n)] += rng.normal(size=n) * rng.choice([0.0, 1.0, 10.0])
    if seed % 3 == 0:
        A = A - A.T
    if seed % 4 == 0:
        A[3] = 0.0
        A[:, 3] = 0.0
        A[3, 5] = 20.0
    w = rng.uniform(0.1, 4.0, n) if seed % 2 else np.ones(n)
    found = generators.Sparse(scipy.sparse.csr_array(A), w).numerical_range()
    low, high, height = map(float, found[:3])
    centre, a, b = map(float, found.ellipse)
    for theta, support in supports(A, w):
        cos, sin = np.cos(theta), np.sin(theta)
        assert support <= max(cos * high, cos * low) + height * sin + 1e-10
        assert support <= cos * centre + np.hypot(a * cos, b * sin) + 1e-10


def test_sparse_ellipse_of_constant_coefficients_is_exact():
    found = generators.Sparse(MATRICES["advection and diffusion"]).numerical_range()
    np.testing.assert_allclose(found.ellipse, (-100.0, 100.0, 120.0))
    np.testing.assert_allclose(found[:3], (-200.0, 0.0, 120.0))


@pytest.mark.parametrize("name", ["heat", "far from normal", "weighted heat", "scattered"])
def test_sparse_growth_bound_holds_in_two_norms(name):
    dense, w = MATRICES[name].toarray(), np.broadcast_to(weights_of(name), N)
    A = generators.Sparse(MATRICES[name], weights_of(name))
    other = RNG.uniform(0.5, 2.0, N)
    for space_weights in (w, other):
        M, omega = map(float, A.growth(spaces.L2(space_weights)))
        root = np.sqrt(space_weights)
        for t in (1e-3, 0.1, 1.0):
            similar = root[:, None] * scipy.linalg.expm(t * dense) / root[None, :]
            assert np.linalg.norm(similar, 2) <= M * np.exp(omega * t) * (1 + 1e-10)
    assert float(A.growth(spaces.L2(w)).M) == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("own", [False, True])
def test_sparse_adjoint_and_its_semigroup_are_correct(own):
    name = "weighted heat" if own else "advection and diffusion"
    A = generators.Sparse(MATRICES[name], weights_of(name))
    space = spaces.L2(RNG.uniform(0.5, 2.0, N))
    adjoint = A.adjoint(space)
    v, w = jnp.asarray(C[0]), jnp.asarray(C[1])
    for apply, back in (
        (A.apply, adjoint.apply),
        (lambda v: A.semigroup(0.1, v), lambda v: adjoint.semigroup(0.1, v)),
    ):
        there = float(space.inner(apply(v), w))
        assert there == pytest.approx(float(space.inner(v, back(w))), rel=1e-10)
    M, omega = map(float, adjoint.growth(space))
    assert float(space.norm(adjoint.semigroup(0.1, v))) <= M * np.exp(0.1 * omega) * float(
        space.norm(v)
    ) * (1 + 1e-10)


@pytest.mark.thorough
def test_sparse_derivatives_in_all_arguments_in_both_modes():
    pattern = MATRICES["advection and diffusion"].tocoo()
    places = jnp.asarray(np.stack([pattern.row, pattern.col], 1))

    def end(values, h, x0, c):
        A = generators.Sparse(BCOO((values, places), shape=(N, N)))
        return A.propagator(h, 2).step(x0, tuple(c))

    given = (jnp.asarray(pattern.data), jnp.asarray(0.05), jnp.asarray(X0), jnp.asarray(C[:2]))
    along = tuple(jnp.asarray(RNG.normal(size=v.shape)) for v in given)
    _, forward = jax.jit(lambda a, b: jax.jvp(end, a, b))(given, along)

    values, h, x0, c = (
        np.asarray(v) + 1e-30j * np.asarray(d) for v, d in zip(given, along, strict=True)
    )
    A = scipy.sparse.coo_array((values, (pattern.row, pattern.col)), shape=(N, N)).toarray()
    slope = exact(A, h, x0, c).imag / 1e-30
    np.testing.assert_allclose(np.asarray(forward), slope, rtol=1e-10, atol=1e-11)
    weight = jnp.asarray(C[2])
    back = jax.jit(jax.grad(lambda a: weight @ end(*a)))(given)
    total = sum(float(jnp.vdot(a, b)) for a, b in zip(back, along, strict=True))
    assert total == pytest.approx(float(weight @ forward), rel=1e-10)


@pytest.mark.thorough
def test_sparse_derivative_at_zero_is_the_operator():
    # A Krylov space has nothing to show there; a polynomial is the same everywhere.
    pattern = MATRICES["advection and diffusion"]
    A = generators.Sparse(pattern)
    jacobian = jax.jit(jax.jacrev(lambda x0: A.semigroup(0.05, x0)))(jnp.zeros(N))
    np.testing.assert_allclose(
        np.asarray(jacobian), scipy.linalg.expm(0.05 * pattern.toarray()), atol=1e-12
    )


@pytest.mark.slow
def test_derivative_of_a_step_of_length_zero_is_the_mean_rate():
    A = generators.Sparse(MATRICES["heat"])
    x0, *c = jnp.asarray(np.random.default_rng(4).normal(size=(4, len(X0))))
    end = lambda h: A.propagator(h, 4).step(x0, tuple(c))  # noqa: E731
    expected = MATRICES["heat"] @ np.asarray(x0) + sum(v / (j + 1) for j, v in enumerate(c))
    rate = jax.jvp(end, (jnp.asarray(0.0),), (jnp.asarray(1.0),))[1]
    np.testing.assert_allclose(rate, expected, rtol=1e-11)
    pulled = jax.grad(lambda h: jnp.sum(x0 * end(h)))(0.0)
    assert float(pulled) == pytest.approx(float(x0 @ expected), rel=1e-11)


def test_sparse_batch_equals_its_lanes():
    A = generators.Sparse(MATRICES["heat"])
    hs = jnp.asarray([1e-3, 0.05, 2.0])
    x0 = jnp.asarray(X0)
    together = jax.jit(jax.vmap(lambda h: A.semigroup(h, x0)))(hs)
    for h, found in zip(hs, together, strict=True):
        np.testing.assert_allclose(np.asarray(found), np.asarray(A.semigroup(h, x0)), atol=1e-13)


class Waves(generators.AbstractMatrixFree):
    """(q, p)' = (p, q'') on a ring, with q measured by its slope: a tuple, and skew."""

    stiffness: float

    def apply(self, v):
        q, p = v
        slope = lambda u: self.stiffness * (jnp.roll(u, -1) - u)  # noqa: E731
        back = lambda u: self.stiffness * (u - jnp.roll(u, 1))  # noqa: E731
        return slope(p), back(q)

    def numerical_range(self):
        return generators.Range(0.0, 0.0, 2.0 * self.stiffness)


def test_matrix_free_subclass_needs_two_methods():
    A = Waves(30.0)
    q, p = jnp.asarray(X0), jnp.asarray(C[0])
    space = spaces.Product(spaces.Euclidean(N), spaces.Euclidean(N))
    A.check(space)
    assert tuple(map(float, A.growth(space))) == (1.0, 0.0)
    there = A.semigroup(1.5, (q, p))
    assert float(space.norm(there)) == pytest.approx(float(space.norm((q, p))), rel=1e-12)
    matrix = np.zeros((2 * N, 2 * N))
    for k in range(2 * N):
        unit = np.eye(2 * N)[k]
        matrix[:, k] = np.concatenate(
            [np.asarray(part) for part in A.apply((jnp.asarray(unit[:N]), jnp.asarray(unit[N:])))]
        )
    expected = scipy.linalg.expm(1.5 * matrix) @ np.concatenate([X0, C[0]])
    np.testing.assert_allclose(np.concatenate(list(map(np.asarray, there))), expected, atol=1e-11)
    back = A.adjoint(space).semigroup(1.5, there)
    np.testing.assert_allclose(np.asarray(back[0]), X0, atol=1e-11)


@pytest.mark.thorough
def test_sparse_solve_equals_that_of_elliptic():
    n = 30
    h = 1.0 / n
    ends = np.r_[-3.0, np.full(n - 2, -2.0), -3.0]
    laplacian = scipy.sparse.diags_array([np.ones(n - 1), ends, np.ones(n - 1)], offsets=[-1, 0, 1])
    pair = (
        generators.Sparse(laplacian / h**2),
        generators.Elliptic(n, boundary="dirichlet", scheme="differences"),
    )
    s = jnp.asarray((np.arange(n) + 0.5) * h)

    def end(A):
        problem = dvax.Problem(
            A=A, P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.3),
            f=lambda t, x, u, args: 5.0 * jnp.sin(3.0 * t) * jnp.exp(-s) + u,
            h=lambda t, x, u, args: 0.4 - 3.0 * x - u,
        )  # fmt: skip
        return dvax.solve(problem, jnp.sin(jnp.pi * s), 0.0, 0.5, rtol=1e-5, method=dvax.ETD2RK())

    ours, theirs = map(end, pair)
    assert ours.enclosed
    np.testing.assert_allclose(np.asarray(ours.xs), np.asarray(theirs.xs), atol=2e-5)
    at_most = 2e-5 * float(jnp.linalg.norm(ours.xs)) + 1e-8
    assert float(jnp.linalg.norm(ours.xs - theirs.xs)) <= at_most


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: generators.Sparse(np.eye(3)), "must be a sparse matrix"),
        (lambda: generators.Sparse(scipy.sparse.csr_array((2, 3))), r"shape \(2, 3\)"),
        (lambda: generators.Sparse(scipy.sparse.csr_array(np.eye(3, dtype=int))), "int"),
        (lambda: generators.Sparse(MATRICES["heat"] * np.nan), "finite"),
        (lambda: generators.Sparse(MATRICES["heat"], np.ones(3)), r"shape \(3,\)"),
        (lambda: generators.Sparse(MATRICES["heat"], np.zeros(N)), "must be positive"),
        (lambda: generators.Sparse(MATRICES["heat"]).check(spaces.Euclidean(N + 1)), "map the"),
        (lambda: Waves(1.0).check(spaces.Euclidean(2)), "Waves.apply"),
    ],
)
def test_sparse_rejects_invalid_arguments(make, word):
    with pytest.raises(dvax.InputError, match=word):
        make()


def decays(rates, h):
    """Return the number of pieces of a step of a diagonal matrix, after checking its decay."""
    A = generators.Sparse(scipy.sparse.diags_array(rates).tocsr())
    propagator = A.propagator(jnp.asarray(h), 0)
    found = np.asarray(propagator.step(jnp.ones(len(rates)), ()))
    np.testing.assert_allclose(
        found, np.exp(h * rates), atol=1e-13 * h * np.abs(rates).max() ** 0.5
    )
    return int(propagator.substeps)


@pytest.mark.thorough
def test_sparse_stiff_step_is_split_or_returns_nan():
    rates = -np.array([0.0, 1e-6, 1e-6, 0.1, 1.0])
    assert decays(1e6 * rates, 1.0) == 1
    assert decays(1e8 * rates, 1.0) > 1
    A = generators.Sparse(scipy.sparse.diags_array(1e11 * rates).tocsr())
    assert np.isnan(np.asarray(A.semigroup(1.0, jnp.ones(5)))).all()


def test_sparse_propagates_nan():
    places = jnp.asarray([[0, 0], [1, 1]])
    make = lambda values: generators.Sparse(BCOO((values, places), shape=(2, 2)))  # noqa: E731
    end = jax.jit(lambda values, h: make(values).semigroup(h, jnp.ones(2)))
    fine, bad = jnp.array([-1.0, -2.0]), jnp.array([-1.0, jnp.nan])
    np.testing.assert_allclose(np.asarray(end(fine, 1.0)), np.exp([-1.0, -2.0]), rtol=1e-12)
    assert np.isnan(np.asarray(end(bad, 1.0))).any()
    assert np.isnan(np.asarray(end(fine, jnp.nan))).all()
    # So many pieces that they are not computed; the other lane of a batch is none the worse.
    lanes = np.asarray(jax.jit(jax.vmap(end, (None, 0)))(-fine, jnp.array([1.0, 1e4])))
    np.testing.assert_allclose(lanes[0], np.exp([1.0, 2.0]), rtol=1e-11)
    assert np.isnan(lanes[1]).all()


@pytest.mark.slow
def test_sparse_keeps_single_precision_at_equal_cost():
    matrix = MATRICES["stiff heat"].astype(np.float32)
    propagator = generators.Sparse(matrix).propagator(jnp.asarray(0.5, jnp.float32), 2)
    assert int(propagator.substeps) == 1 and int(propagator.degree) < 6 * np.sqrt(0.5 * 4e5)
    x0, c = jnp.asarray(X0, jnp.float32), jnp.asarray(C[:2], jnp.float32)
    found = propagator.step(x0, tuple(c))
    assert found.dtype == jnp.float32
    expected = exact(MATRICES["stiff heat"].toarray(), 0.5, X0, C[:2])
    assert np.max(np.abs(np.asarray(found) - expected)) < 3e-3 * np.max(np.abs(expected))


def test_sparse_ellipse_of_skew_and_decaying_rows_is_bounded():
    matrix = np.diag([0.0, 0.0, -9.0, 5.0]) + np.array(
        [[0, 3, 0, 0], [-3, 0, 2, 0], [0, -2, 0, 0.5], [0, 0, -0.5, 0]]
    )
    for unit in (1.0, 1e6):
        found = generators.Sparse(scipy.sparse.csr_array(unit * matrix)).numerical_range()
        assert found.ellipse is not None
        centre, a, b = (float(v) / unit for v in found.ellipse)
        assert b < 20.0
        for theta, support in supports(matrix, np.ones(4)):
            reach = np.hypot(a * np.cos(theta), b * np.sin(theta))
            assert support <= np.cos(theta) * centre + reach + 1e-10


HEAT = MATRICES["heat"].tocoo()
PLACES = jnp.asarray(np.stack([HEAT.row, HEAT.col], 1))


def chain():
    return dvax.Problem(
        A=lambda args: generators.Sparse(BCOO((args, PLACES), shape=(N, N))),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.3),
        f=lambda t, x, u, args: 1.0 + u, h=lambda t, x, u, args: 0.4 - 3.0 * x - u,
    )  # fmt: skip


@pytest.mark.thorough
def test_sparse_solve_has_derivatives_in_the_entries_of_a_symmetric_matrix():
    values = jnp.asarray(HEAT.data) / 50.0
    x0 = jnp.asarray(np.abs(X0))
    end = lambda v: jnp.sum(  # noqa: E731
        dvax.solve(chain(), x0, 0.0, 0.3, args=v, dt=0.05).xs[-1] ** 2
    )
    slope = np.asarray(jax.jit(jax.grad(end))(values))
    assert np.isfinite(slope).all()
    along = np.random.default_rng(8).normal(size=values.shape)
    step = 1e-5
    central = (float(end(values + step * along)) - float(end(values - step * along))) / (2 * step)
    assert float(slope @ along) == pytest.approx(central, rel=1e-5)


@pytest.mark.thorough
def test_sparse_adaptive_batch_equals_its_lanes():
    values = jnp.asarray(HEAT.data)
    x0 = jnp.asarray(np.abs(X0))
    run = lambda s: dvax.solve(  # noqa: E731
        chain(), x0, 0.0, 0.2, args=s * values, rtol=1e-3, atol=1e-3, method=dvax.ETD4RK()
    ).xs[-1]
    scales = jnp.array([0.01, 1.0])
    together = jax.jit(jax.vmap(run))(scales)
    for scale, found in zip(scales, together, strict=True):
        np.testing.assert_allclose(np.asarray(found), np.asarray(run(scale)), atol=1e-11)


def test_sparse_accepts_a_declared_rectangle():
    known = generators.Range(-800.0, -1.0)
    A = generators.Sparse(MATRICES["heat"], within=known)
    assert float(A.growth(spaces.Euclidean(N)).omega) == -1.0
    np.testing.assert_allclose(
        np.asarray(A.semigroup(0.3, jnp.asarray(X0))),
        scipy.linalg.expm(0.3 * MATRICES["heat"].toarray()) @ X0,
        atol=1e-13,
    )


def test_sparse_bound_from_a_declared_range_is_declared():
    known = generators.Range(-800.0, 0.0, proved=True)
    ours = generators.Sparse(MATRICES["heat"])
    theirs = generators.Sparse(MATRICES["heat"], within=known)
    assert not is_declared(ours) and is_declared(theirs) and is_declared(Waves(1.0))
    assert is_declared(theirs.adjoint(spaces.Euclidean(N)))
    assert is_declared(generators.Product(ours, theirs))
    assert not is_declared(generators.Product(ours, generators.Scalar(-1.0)))


def expm_step(A, h, x0, c0):
    """The flow over h for x' = A x + c₀, by the exponential of an augmented matrix."""
    n = len(x0)
    joined = jnp.zeros((n + 1, n + 1)).at[:n, :n].set(A).at[:n, n].set(c0)
    return (jax.scipy.linalg.expm(h * joined) @ jnp.append(x0, 1.0))[:n]


CASES = [(which, h) for which in [(0,), (1,), (0, 1), (2,), (0, 1, 2)] for h in (0.05, 3.0)]


@pytest.mark.slow
@pytest.mark.parametrize(("which", "h"), mostly_thorough(CASES, {((0, 1), 3.0)}))
def test_sparse_derivatives_of_the_flow_in_any_of_its_inputs(which, h):
    rng = np.random.default_rng(7)
    matrix = np.triu(np.tril(rng.normal(size=(5, 5)), 1), -1) + 2.0 * np.eye(5)
    A, w = generators.Sparse(scipy.sparse.csr_array(matrix)), jnp.asarray(rng.normal(size=5))
    if h == 3.0:
        assert int(A.propagator(jnp.asarray(h), 2).substeps) > 1
    x0, c0 = jnp.asarray(rng.normal(size=(2, 5)))
    ours = lambda x0, c0, h: w @ A.propagator(h, 2).step(x0, (c0,))  # noqa: E731
    theirs = lambda x0, c0, h: w @ expm_step(jnp.asarray(matrix), h, x0, c0)  # noqa: E731
    given = x0, c0, jnp.asarray(h)
    for order in (jax.grad, lambda f, at: jax.jacfwd(jax.grad(f, at), at)):
        for a, b in zip(
            jax.tree_util.tree_leaves(jax.jit(order(ours, which))(*given)),
            jax.tree_util.tree_leaves(order(theirs, which)(*given)), strict=True,
        ):  # fmt: skip
            scale = float(jnp.abs(b).max()) + 1e-300
            np.testing.assert_allclose(np.asarray(a) / scale, np.asarray(b) / scale, atol=1e-9)


def expm_flow(A, h, x0, c):
    """The flow over h for x' = A x + Σⱼ cⱼ (s/h)ʲ, by the exponential of an augmented matrix."""
    n, terms = len(x0), len(c)
    joined = (
        jnp.zeros((n + terms, n + terms)).at[:n, :n].set(A).at[:n, n:].set(jnp.stack(c, axis=1))
    )
    powers = jnp.diag(jnp.arange(1.0, terms), -1) / h
    joined = joined.at[n:, n:].set(powers)
    start = jnp.concatenate([x0, jnp.ones(1), jnp.zeros(terms - 1)])
    return (jax.scipy.linalg.expm(h * joined, max_squarings=30) @ start)[:n]


FLOWS = {
    # Size, decay, symmetry, h, and a property of the propagator.
    "few terms": (1.0, 2.0, 0.5, 0.7, lambda one: int(one.degree) < 40),
    "terms computed again": (40.0, 0.1, -1.0, 3.0, lambda one: int(one.degree) > 128),
    "substeps": (1.0, -2.0, 0.5, 3.0, lambda one: int(one.substeps) > 1),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "terms"),
    mostly_thorough(
        [(name, terms) for name in FLOWS for terms in (1, 2, 3, 4)], {("terms computed again", 3)}
    ),
)
def test_derivatives_of_the_flow_in_the_entries_of_the_matrix_and_in_the_step(name, terms):
    size, decay, symmetry, h, is_such = FLOWS[name]
    rng = np.random.default_rng(8)
    upper = np.diag(rng.normal(size=4), 1)
    matrix = size * (upper + symmetry * upper.T) - np.diag(decay * rng.uniform(0.5, 1.0, 5))
    sparse = BCOO.fromdense(jnp.asarray(matrix))
    w, x0, *c = jnp.asarray(rng.normal(size=(2 + terms, 5)))

    def ours(data, h, x0):
        A = generators.Sparse(BCOO((data, sparse.indices), shape=sparse.shape))
        return w @ A.propagator(h, terms + 1).step(x0, tuple(c))

    @jax.jit
    def theirs(data, h, x0):
        A = BCOO((data, sparse.indices), shape=sparse.shape).todense()
        return w @ expm_flow(A, h, x0, c)

    assert is_such(generators.Sparse(sparse).propagator(jnp.asarray(h), 2))
    given = sparse.data, jnp.asarray(h), x0
    along = (
        jnp.asarray(rng.normal(size=sparse.nse)),
        jnp.asarray(0.6),
        jnp.asarray(rng.normal(size=5)),
    )
    pull = jax.jit(jax.grad(ours, (0, 1, 2)))(*given)
    for a, b in zip(pull, jax.grad(theirs, (0, 1, 2))(*given), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9 * float(jnp.abs(b).max()))
    # Derivatives of the gradient, forward over reverse.
    for at in (0, 1, 2) if name == "few terms" else ():
        of_gradient = jax.jvp(jax.grad(ours, at), given, along)[1]
        expected = jax.jvp(jax.grad(theirs, at), given, along)[1]
        np.testing.assert_allclose(
            of_gradient, expected, atol=1e-8 * float(jnp.abs(expected).max())
        )
    push = jax.jvp(ours, given, along)[1]
    assert float(push) == pytest.approx(float(jax.jvp(theirs, given, along)[1]), rel=1e-8)
    lanes = jax.vmap(jax.grad(ours), (None, 0, None))(given[0], h * jnp.array([0.5, 1.0]), x0)
    np.testing.assert_allclose(lanes[1], pull[0], atol=1e-9 * float(jnp.abs(pull[0]).max()))


@pytest.mark.slow
def test_sparse_gradients_of_a_batch_equal_those_of_its_lanes():
    A = generators.Sparse(MATRICES["heat"])
    hs, x0 = jnp.asarray([1e-3, 0.05, 2.0]), jnp.asarray(X0)
    one = jax.grad(lambda x0, h: jnp.sum(A.semigroup(h, x0) ** 2))
    together = jax.jit(jax.vmap(one, (None, 0)))(x0, hs)
    for h, gradient in zip(hs, together, strict=True):
        np.testing.assert_allclose(np.asarray(gradient), np.asarray(one(x0, h)), atol=1e-13)


@pytest.mark.slow
def test_matrix_free_gradient_of_a_part_of_a_tuple():
    A, h = Waves(3.0), 0.4
    q, p = jnp.asarray(RNG.normal(size=(2, 6)))
    of_q = lambda q: jnp.sum(A.semigroup(h, (q, p))[1] ** 3)  # noqa: E731
    along = jnp.asarray(RNG.normal(size=6))
    slope = (of_q(q + 1e-5 * along) - of_q(q - 1e-5 * along)) / 2e-5
    assert float(jax.grad(of_q)(q) @ along) == pytest.approx(float(slope), rel=1e-8)
    assert float(jax.jvp(of_q, (q,), (along,))[1]) == pytest.approx(float(slope), rel=1e-8)


def test_sparse_gradient_in_the_state_stores_no_terms():
    n = 4000
    heat = scipy.sparse.diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(n, n)).tocsr()
    A, x0 = generators.Sparse(heat), jnp.ones(n)
    pull = jax.jit(jax.grad(lambda x0: jnp.sum(A.semigroup(0.5, x0) ** 2)))
    memory = pull.lower(x0).compile().memory_analysis()
    if memory is not None:
        assert memory.temp_size_in_bytes < 100 * x0.nbytes


@pytest.mark.slow
def test_sparse_gradient_in_the_entries_stores_a_few_hundred_vectors():
    n = 4000
    heat = scipy.sparse.diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(n, n)).tocsr()
    entries, x0 = BCOO.from_scipy_sparse(heat), jnp.ones(n)

    def total(rate):
        A = generators.Sparse(BCOO((rate * entries.data, entries.indices), shape=(n, n)))
        return jnp.sum(A.semigroup(0.5, x0) ** 2)

    memory = jax.jit(jax.grad(total)).lower(1.0).compile().memory_analysis()
    if memory is not None:
        # Up to 8,192 terms.
        assert memory.temp_size_in_bytes < 600 * x0.nbytes
