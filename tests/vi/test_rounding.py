"""The error bound of `solve_vi` includes rounding: against rational arithmetic, down to γ = 2⁻⁴⁰."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough
from tests.vi import exact

import dvax
from dvax.programs.rounding import rounding_error
from dvax.vi import RESULTS

TOL = 1e-10


def cases(n, count, seed):
    """M = γ + BᵀB + skew and q, all dyadic: γ is the modulus of the float matrix exactly. BᵀB has any
    rank, and the skew part any size from nothing to much larger."""
    rng = np.random.default_rng([n, seed])
    gamma = 2.0 ** -rng.integers(0, 41, count)
    M = np.zeros((count, n, n))
    for k in range(count):
        B = rng.integers(-8, 9, (rng.integers(0, n + 1), n)) / 8.0
        S = np.triu(rng.integers(-8, 9, (n, n)), 1) / 8.0 * rng.choice([0.0, 1.0, 16.0])
        M[k] = B.T @ B + S - S.T + gamma[k] * np.eye(n)
    q = rng.integers(-64, 65, (count, n)) / 16.0 * 2.0 ** rng.integers(-6, 7, (count, 1))
    return rng, gamma, M, q


def box_cases(n, count, rng):
    lower = -rng.integers(0, 9, (count, n)) / 4.0
    return lower, lower + rng.integers(0, 17, (count, n)) / 4.0


def rows(n, count, rng):
    G = rng.integers(-4, 5, (count, 4, n)) / 4.0
    G[:, 0] = np.where((G[:, 0] == 0).all(axis=-1, keepdims=True), 1.0, G[:, 0])
    G = np.where((G == 0).all(axis=-1, keepdims=True), 0.5, G)
    return G, rng.integers(1, 17, (count, 4)) / 8.0


SETS = {
    # name: data of K, K of them, the exact solution from them and a guess
    "box": (
        box_cases,
        lambda low, up: dvax.sets.Box(low, up),
        lambda M, q, guess, low, up: exact.box(M, q, low, up, guess),
    ),
    "ball": (
        lambda n, count, rng: (rng.integers(1, 17, count) / 4.0,),
        lambda r: dvax.sets.Ball(0.0, r),
        lambda M, q, guess, r: exact.ball(M, q, r, guess),
    ),
    "simplex": (
        lambda n, count, rng: (rng.integers(1, 17, count) / 4.0,),
        lambda s: dvax.sets.Simplex(s),
        lambda M, q, guess, s: exact.polyhedron(
            M, q, [[-int(i == j) for j in range(len(q))] for i in range(len(q))], [0] * len(q),
            [[1] * len(q)], [s], guess,
        ),
    ),
    "polyhedron": (
        rows,
        lambda G, d: dvax.sets.Polyhedron(G, d),
        lambda M, q, guess, G, d: exact.polyhedron(M, q, G, d, [], [], guess),
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "n", "count", "seed"),
    mostly_thorough(
        [
            *(("box", n, 200, 0) for n in (1, 2, 3, 5, 8, 13, 30)),
            *(("box", n, 40, 0) for n in (6, 60)),
            *(("ball", n, 60, 0) for n in (1, 2, 4, 8)),
            *(("simplex", n, 100, 0) for n in (2, 3, 4, 6)),
            *(("polyhedron", n, 100, 0) for n in (1, 2, 4, 6)),
        ],
        [("box", 6, 40, 0), ("simplex", 4, 100, 0)],
    ),
)
def test_error_bound_with_rounding_holds_and_success_means_within_tol(name, n, count, seed):
    data, make, solution = SETS[name]
    rng, gamma, M, q = cases(n, count, seed)
    given = data(n, count, rng)

    def one(M, q, gamma, *given):
        found = dvax.solve_vi(
            lambda y, a: a[0] @ y + a[1], make(*given), jnp.zeros(n), (M, q), gamma=gamma
        )
        return found.y, found.error_bound, found.result == RESULTS.successful

    ys, bounds, successful = jax.jit(jax.vmap(one))(M, q, gamma, *map(jnp.asarray, given))
    wrong, undecided = [], 0
    for k in range(count):
        y = np.asarray(ys[k])
        if not np.isfinite(y).all():
            assert not successful[k]
            continue
        numbers = [exact.rational(v[k]) for v in (M, q)]
        try:
            truth = solution(*numbers, exact.rational(y), *(exact.rational(v[k]) for v in given))
        except exact.Undecided:
            undecided += 1
            continue
        error = exact.distance(y, truth)
        if not error <= bounds[k] or (successful[k] and error > TOL):
            wrong.append((k, gamma[k], error, float(bounds[k]), bool(successful[k])))
    assert not wrong and undecided <= max(2, count // 100)
    # The bound is of use: no larger than a small multiple of ε(‖M‖‖y‖ + ‖q‖)n/γ, in most cases.
    sizes = [
        np.linalg.norm(M[k], 2) * np.linalg.norm(ys[k]) + np.linalg.norm(q[k]) for k in range(count)
    ]
    usual = TOL + 16 * (n + 8) * 2.0**-52 * np.array(sizes) / gamma
    # Of balls fewer bounds are as narrow (85 % of them).
    assert np.mean(np.asarray(bounds) <= usual) > (0.8 if name == "ball" else 0.9)


@pytest.mark.parametrize("n", [1, 7])
def test_rounding_of_an_affine_map_is_the_textbook_bound(n):
    rng = np.random.default_rng(n)
    for scale in (1.0, 1e8):
        M, y = rng.normal(size=(n, n)) * scale, rng.normal(size=n)
        q = -(M @ y)  # all but cancels
        F = lambda y, M=M, q=q: jnp.asarray(M) @ y + jnp.asarray(q)  # noqa: E731
        bound, proved = rounding_error(F, jnp.asarray(y))
        true = [
            a + b for a, b in
            zip(exact.times(exact.rational(M), exact.rational(y)), exact.rational(q), strict=True)
        ]  # fmt: skip
        error = np.array(
            [
                float(abs(a - b))
                for a, b in zip(exact.rational(F(jnp.asarray(y))), true, strict=True)
            ]
        )
        assert proved and np.all(error <= bound)
        textbook = (n + 3) * 2.0**-52 * (np.abs(M) @ np.abs(y) + np.abs(q))
        assert np.all(bound <= 1.01 * textbook)


@pytest.mark.parametrize("F", [lambda M, y: M @ y + 1.0, lambda M, y: y @ M + 1.0])
def test_rounding_analysis_needs_one_product_for_exact_factors(F):
    """One product gives the value, and one the error: |M||y|."""
    M = jnp.asarray(np.random.default_rng(0).normal(size=(5, 5)))
    traced = jax.make_jaxpr(lambda y: rounding_error(lambda y: F(M, y), y)[0])(jnp.ones(5))
    names = [eqn.primitive.name for eqn in traced.jaxpr.eqns]
    assert names.count("dot_general") == 2


@pytest.mark.slow
def test_rounding_of_nonlinear_laws_is_proved_and_estimated_without_a_rule():
    y = jnp.linspace(-2.0, 3.0, 40)
    smooth = lambda y: y**3 + jnp.tanh(5.0 * y) / (2.0 + jnp.cos(y)) - jnp.exp(y) + jnp.sum(y**2)  # noqa: E731
    bound, proved = rounding_error(smooth, y)
    bound = np.asarray(bound)
    extended = np.asarray(y).astype(np.longdouble)
    true = (
        extended**3 + np.tanh(5.0 * extended) / (2.0 + np.cos(extended)) - np.exp(extended)
        + np.sum(extended**2)
    )  # fmt: skip
    error = np.abs(np.asarray(smooth(y)).astype(np.longdouble) - true)
    assert proved and np.all(error <= bound) and np.all(bound <= 1e-11)
    _, proved = rounding_error(lambda y: jnp.fft.irfft(jnp.fft.rfft(y)), y)
    assert not proved


def test_stalled_is_returned_if_rounding_exceeds_the_tolerance():
    M = jnp.array([[1e6, 3e3], [-3e3, 1e-3]])
    solve = lambda tol: dvax.solve_vi(  # noqa: E731
        lambda y, q: M @ y - q, dvax.sets.Box(-9.0, 9.0), jnp.zeros(2), jnp.ones(2) / 3, tol=tol,
        gamma=1e-3,
    )  # fmt: skip
    assert solve(1e-10).result == RESULTS.stalled
    assert solve(1e2).result == RESULTS.successful
    assert solve(1e-10).rounding_status == "proved"


@pytest.mark.slow
def test_derivative_of_a_failed_solve_vi_is_nan():
    M = jnp.array([[2.0, -1.0], [1.0, 3.0]])

    def y(upper, q, K, steps):
        return dvax.solve_vi(
            lambda y, q: M @ y - q, K(upper), jnp.zeros(2), q,
            solver=dvax.vi.Extragradient(max_steps=steps),
        ).y  # fmt: skip

    box, ball = (
        (lambda up: dvax.sets.Box(-1.0, up)),
        (lambda r: dvax.sets.Ball(0.0, 0.1 * jnp.sum(r))),
    )
    at = jnp.array([4.0, 3.0]), jnp.array([1.0, -2.0])
    for K in (box, ball):
        for derive in (jax.jacrev, jax.jacfwd):
            good = derive(lambda *p, K=K: y(*p, K, 1000), (0, 1))(*at)
            assert all(np.isfinite(v).all() for v in good)
            bad = derive(lambda *p, K=K: y(*p, K, 2), (0, 1))(*at)
            assert all(np.isnan(v).all() for v in bad)


INDEXED = {
    "written": lambda y: (3.0 * y).at[jnp.array([2, 0])].set(y[:2] / 3.0),
    "added": lambda y: (y / 3.0).at[jnp.array([1, 1, 4, 1])].add(y[:4] * 0.1),
    "a block": lambda y: jax.lax.dynamic_update_slice(y / 7.0, y[:2] * 0.1, (1,)),
}


@pytest.mark.slow
@pytest.mark.parametrize("F", INDEXED.values(), ids=INDEXED)
def test_rounding_of_entries_written_or_added_at_places_is_proved_and_holds(F):
    """Against the same operations in double precision."""
    rng = np.random.default_rng(3)
    bound_of = jax.jit(lambda y: rounding_error(F, y)[0])
    assert rounding_error(F, jnp.zeros(5, jnp.float32))[1]
    for _ in range(50):
        y = (rng.normal(size=5) * 10.0 ** rng.integers(-3, 4, 5)).astype(np.float32)
        error = np.abs(np.asarray(F(jnp.asarray(y)), float) - np.asarray(F(jnp.asarray(y, float))))
        bound = np.asarray(bound_of(y))
        assert np.all(error <= bound)
        assert np.all(bound <= 32 * np.finfo(np.float32).eps * (np.abs(y).sum() + 1e-30))
