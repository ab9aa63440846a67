"""a(y)G(y) is solved as G: the same solution and derivatives, a sharper certificate, less cost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.oracles import affine_box_vi
from tests.selection import mostly_thorough

import dvax
from dvax.sets import Ball, Box, Simplex
from dvax.spaces import L2, Euclidean
from dvax.vi import RESULTS, SemismoothNewton, Weighted

WEIGHT = np.array([[2.0, -1.0, 0.5], [1.0, 3.0, -0.5], [-0.5, 0.5, 1.5]])
SHIFT = np.array([-6.0, -1.0, 2.0])


def bump(q):
    """e^{−‖y‖²} + q ≥ q."""
    return lambda y, _: jnp.exp(-jnp.sum(y * y)) + q


def affine(y, args):
    matrix, b = args
    return matrix @ y + b


def random_case(rng, n):
    """A positive definite matrix, its modulus, and data that hold some entries of y on a bound."""
    half = rng.normal(size=(n, n))
    matrix = 0.3 * half @ half.T / n + 0.4 * np.eye(n) + 2.0 * (half - half.T) / np.sqrt(n)
    mu = float(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0])
    return matrix, rng.normal(size=n) * 2.0, mu


# name: (a, G, M, mu, K, solution): published, or in closed form
FAMILIES = {
    "expweight_box3": (
        bump(0.2), lambda y, _: jnp.asarray(WEIGHT) @ y + jnp.asarray(SHIFT), 0.2, 1.5,
        Box(-1.0, 1.0), np.array([1.0, -3 / 19, -18 / 19]),
    ),
    "kv_ball": (
        lambda y, _: 1.5 - jnp.linalg.norm(y), lambda y, _: y, 0.5, 1.0, Ball(0.0, 1.0),
        np.zeros(5),
    ),
    "paper1d": (
        lambda y, _: 2 + jnp.sin(y[0]), lambda y, _: y - 2.5, 1.0, 1.0, Box(0.0, 3 * np.pi / 2),
        np.array([2.5]),
    ),
    "paper1d, held": (
        lambda y, _: 2 + jnp.sin(y[0]), lambda y, _: y - 9.0, 1.0, 1.0, Box(0.0, 3 * np.pi / 2),
        np.array([3 * np.pi / 2]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", mostly_thorough(FAMILIES, ["paper1d"]))
def test_weighted_published_families_are_solved(name):
    a, G, M, mu, K, solution = FAMILIES[name]
    for law in (Weighted(a, G, M=M, mu=mu), Weighted(a, G, M=M), Weighted(a, G)):
        vi = dvax.solve_vi(law, K, jnp.full(solution.shape, 0.3))
        assert vi.result == RESULTS.successful
        np.testing.assert_allclose(np.asarray(vi.y), solution, atol=1e-10)
        # μ is declared, or proved from the matrix of G.
        assert np.linalg.norm(np.asarray(vi.y) - solution) - 1e-14 <= float(vi.error_bound) <= 1e-10


@pytest.mark.parametrize("name", mostly_thorough(FAMILIES, ["expweight_box3"]))
def test_weighted_needs_no_more_evaluations_than_the_product(name):
    a, G, M, mu, K, solution = FAMILIES[name]
    law, y0 = Weighted(a, G, M=M, mu=mu), jnp.full(solution.shape, 0.3)
    divided = dvax.solve_vi(law, K, y0)
    whole = dvax.solve_vi(lambda y, _: a(y, None) * G(y, None), K, y0)
    assert int(divided.evaluations) <= int(whole.evaluations)
    print(f"{name}: {int(divided.evaluations)} evaluations of G, {int(whole.evaluations)} of aG")


ROUND = (Ball(0.0, 0.8), Simplex(1.0))


@pytest.mark.parametrize(
    "K",
    [pytest.param(K, marks=pytest.mark.thorough) for K in (Box(-1.0, 1.0), *ROUND)],
    ids=lambda K: type(K).__name__,
)
def test_weighted_solution_does_not_depend_on_the_weight(K):
    def both(matrix, b, mu, q):
        law = Weighted(bump(q), affine, M=q, mu=mu)
        solver = SemismoothNewton()
        divided = dvax.solve_vi(law, K, jnp.zeros(5), (matrix, b), tol=1e-12)
        whole = dvax.solve_vi(
            lambda y, args: law(y, args), K, jnp.zeros(5), (matrix, b), solver=solver, tol=1e-12,
            gamma=law.gamma,
        )  # fmt: skip
        plain = dvax.solve_vi(affine, K, jnp.zeros(5), (matrix, b), gamma=mu, tol=1e-12)
        return divided, whole, plain

    solve = jax.jit(both)
    rng = np.random.default_rng(3)
    works = []
    for _ in range(60):
        matrix, b, mu = random_case(rng, 5)
        q = 10.0 ** rng.uniform(-1.5, 0.0)
        divided, whole, plain = solve(*map(jnp.asarray, (matrix, b, mu, q)))
        assert divided.result == RESULTS.successful
        np.testing.assert_array_equal(np.asarray(divided.y), np.asarray(plain.y))
        if whole.result == RESULTS.successful:
            np.testing.assert_allclose(np.asarray(whole.y), np.asarray(divided.y), atol=1e-10)
        works.append((int(divided.evaluations), int(whole.evaluations)))
        if isinstance(K, Box):
            truth = affine_box_vi(matrix, b, np.full(5, -1.0), np.full(5, 1.0))
            assert (
                np.linalg.norm(np.asarray(divided.y) - truth) <= float(divided.error_bound) + 1e-13
            )
    divided, whole = np.array(works).T
    print(
        f"{type(K).__name__}: median evaluations {np.median(divided)} of G, {np.median(whole)} of aG"
    )
    assert divided.mean() < whole.mean()


def test_weighted_certificate_of_G_is_sharper_than_that_of_aG():
    # ‖w‖/μ against ‖a(y)w‖/(Mμ), at points that are not yet solutions.
    solver = SemismoothNewton(max_steps=2)
    solution = FAMILIES["expweight_box3"][-1]
    a, G, M, mu, K, _ = FAMILIES["expweight_box3"]
    law = Weighted(a, G, M=M, mu=mu)
    solve = jax.jit(lambda y0: dvax.solve_vi(law, K, y0, solver=solver))
    for y0 in np.random.default_rng(1).uniform(-1, 1, (20, 3)):
        vi = solve(jnp.asarray(y0))
        error = np.linalg.norm(np.asarray(vi.y) - solution)
        assert error <= float(vi.error_bound) + 1e-14
        weighted_bound = float(a(vi.y, None) * vi.residual / law.gamma)
        assert float(vi.error_bound) <= weighted_bound + 1e-14


@pytest.mark.thorough
def test_weighted_derivatives_equal_those_of_the_product():
    def solution(args, divided):
        law = Weighted(
            lambda y, args: bump(args["q"])(y, None), lambda y, args: args["M"] @ y + args["b"]
        )
        F = law if divided else lambda y, args: law(y, args)
        return dvax.solve_vi(F, Box(-1.0, 1.0), jnp.zeros(3), args, tol=1e-13).y

    args = {"q": jnp.array(0.2), "M": jnp.asarray(WEIGHT), "b": jnp.asarray(SHIFT)}
    whole = jax.jit(lambda args: solution(args, False))
    for jacobian in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(jacobian(lambda args: solution(args, True)))(args)
        assert np.max(np.abs(np.asarray(slopes["q"]))) == 0.0  # the weight moves nothing
        for key in ("M", "b"):
            for place in np.ndindex(args[key].shape):
                h = 1e-5
                up, down = (whole({**args, key: args[key].at[place].add(s)}) for s in (h, -h))
                by_differences = np.asarray(up - down) / (2 * h)
                found = np.asarray(slopes[key])[(slice(None), *place)]
                np.testing.assert_allclose(found, by_differences, atol=2e-9)


def test_weighted_modulus_is_proved_from_an_affine_G():
    rng = np.random.default_rng(5)
    matrix, b, mu = random_case(rng, 4)
    law = Weighted(bump(0.3), affine)
    args = jnp.asarray(matrix), jnp.asarray(b)
    found = law.modulus(jnp.zeros(4), args, Euclidean(4))
    assert found.status == "proved"
    assert mu * (1 - 1e-12) <= float(found.value) <= mu
    # In another inner product it is another number: the least ⟨Jd, d⟩/⟨d, d⟩.
    w = rng.uniform(0.1, 3.0, 4)
    found = law.modulus(jnp.zeros(4), args, L2(w))
    d = rng.normal(size=(4, 20_000))
    quotients = np.sum(w[:, None] * d * (matrix @ d), 0) / np.sum(w[:, None] * d * d, 0)
    assert float(found.value) <= quotients.min() <= float(found.value) + 0.1
    # Declared: taken as it is. Not affine: nothing is claimed.
    assert (
        Weighted(bump(0.3), affine, mu=0.1).modulus(jnp.zeros(4), args, L2(w)).status == "declared"
    )
    bent = Weighted(bump(0.3), lambda y, _: y + y**3)
    assert bent.modulus(jnp.zeros(4), None, Euclidean(4)) is None
    vi = dvax.solve_vi(bent, Ball(0.0, 1.0), jnp.ones(4))
    assert vi.result == RESULTS.successful and vi.error_bound is None


def test_weighted_with_an_indefinite_matrix_has_no_bound():
    # Positive definite on the differences of a simplex only: y₁ + y₂ = 1.
    matrix = jnp.array([[1.0, 2.0], [2.0, 1.0]])
    law = Weighted(bump(0.5), lambda y, _: jnp.array([[3.0, 4.0], [4.0, 3.0]]) @ y - matrix[0])
    for solve in (dvax.solve_vi, jax.jit(dvax.solve_vi, static_argnums=(0,))):
        vi = solve(law, Box(0.0, 1.0), jnp.array([0.4, 0.6]))
        assert np.isinf(float(vi.error_bound))


def test_weighted_with_a_nonpositive_weight_is_reported():
    vi = dvax.solve_vi(
        Weighted(lambda y, _: y - 1.0, lambda y, _: y - 0.5, mu=1.0), Box(0.0, 2.0), 0.0
    )
    assert vi.result == RESULTS.weight_not_positive
    assert np.isinf(float(vi.error_bound))
    vi = dvax.solve_vi(
        Weighted(lambda y, _: jnp.log(y - 1), lambda y, _: y - 0.5), Box(0.0, 2.0), 0.0
    )
    assert vi.result == RESULTS.nonfinite
    law = Weighted(lambda y, _: y - 1.0, lambda y, _: y - 0.5)
    assert np.isnan(float(law(jnp.array(0.5)))) and float(law(jnp.array(2.0))) == 1.5


def test_weighted_with_a_wrong_lower_bound_is_reported():
    law = Weighted(lambda y, c: 2 + jnp.sin(y), lambda y, c: y - c, M=1.5, mu=1.0)
    fine = dvax.solve_vi(law, Box(0.0, 4.7), 0.0, args=1.0)
    assert fine.result == RESULTS.successful
    low = dvax.solve_vi(law, Box(0.0, 4.7), 0.0, args=4.0)
    assert low.result == RESULTS.weight_below_bound
    assert float(low.y) == 4.0 and float(low.error_bound) < 1e-12
    # The very minimum of a is a lower bound, whatever the order in which it was computed.
    law = Weighted(bump(0.2), lambda y, _: y - 5.0, M=float(np.exp(-3.0) + 0.2), mu=1.0)
    assert dvax.solve_vi(law, Box(-1.0, 1.0), jnp.zeros(3)).result == RESULTS.successful


def test_weighted_failure_of_the_inner_solve_is_reported():
    law = Weighted(lambda y, _: -1.0 + 0.0 * y[0], lambda y, _: jnp.exp(y) - 2.0, mu=1.0)
    vi = dvax.solve_vi(law, Ball(0.0, 9.0), jnp.zeros(2), solver=SemismoothNewton(max_steps=1))
    assert vi.result == RESULTS.max_steps


def test_weighted_lanes_have_their_own_results():
    law = Weighted(lambda y, c: y - 1.0, lambda y, c: y - c, M=0.5, mu=1.0)
    solve = jax.vmap(lambda c: dvax.solve_vi(law, Box(0.0, 9.0), jnp.zeros(()), c))
    vi = solve(jnp.array([0.5, 1.2, 3.0]))
    expected = [RESULTS.weight_not_positive, RESULTS.weight_below_bound, RESULTS.successful]
    for lane, word in enumerate(expected):
        assert jax.tree_util.tree_map(lambda leaf, lane=lane: leaf[lane], vi).result == word
    np.testing.assert_allclose(np.asarray(vi.y), [0.5, 1.2, 3.0])


@pytest.mark.slow
def test_weighted_keeps_single_precision():
    y0 = jnp.zeros(3, jnp.float32)
    matrix, shift = jnp.asarray(WEIGHT, jnp.float32), jnp.asarray(SHIFT, jnp.float32)
    for mu in (1.5, None):
        law = Weighted(bump(0.2), lambda y, _: matrix @ y + shift, M=0.2, mu=mu)
        vi = dvax.solve_vi(law, Box(-1.0, 1.0), y0, tol=1e-5)
        assert vi.result == RESULTS.successful
        assert vi.y.dtype == jnp.float32 and float(vi.error_bound) <= 1e-5
        assert law(vi.y).dtype == jnp.float32


def test_weighted_parts_of_a_tuple_share_one_weight():
    law = Weighted(
        lambda y, _: 2 + jnp.sin(y[0]), lambda y, _: (y[0] - 0.5, y[1] + y[0] - 2.0), M=1.0
    )
    K = dvax.sets.Product(Box(0.0, 1.0), Box(0.0, 1.2))
    vi = dvax.solve_vi(law, K, (jnp.array(0.0), jnp.array(0.0)))
    assert vi.result == RESULTS.successful and float(vi.error_bound) < 1e-10
    np.testing.assert_allclose([float(v) for v in vi.y], [0.5, 1.2], atol=1e-12)


def solved(law, **settings):
    return dvax.solve_vi(law, Box(0.0, 1.0), jnp.ones(2), **settings)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: Weighted(bump(1.0), affine, M=0.0), "positive"),
        (lambda: Weighted(bump(1.0), affine, mu=-1.0), "positive"),
        (lambda: Weighted(bump(1.0), affine, mu=np.inf), "finite"),
        (lambda: Weighted(bump(1.0), affine, M=jnp.ones(2)), "one number"),
        (lambda: solved(Weighted(lambda y, _: 1 + y * y, lambda y, _: y)), "one number"),
        (lambda: solved(Weighted(bump(1.0), lambda y, _: y), gamma=1.0), "brings its own moduli"),
        (lambda: solved(Weighted(bump(1.0), lambda y, _: y), L_F=1.0), "brings its own moduli"),
    ],
)  # fmt: skip
def test_weighted_rejects_invalid_arguments(make, word):
    with pytest.raises(dvax.InputError, match=word):
        make()
