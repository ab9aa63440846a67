"""Published variational inequalities, solved to 1e-9 from several starts, by every solver that may.

Sources: Malitsky 2020, Khanh and Vuong 2014, Fukushima 1986, MCPLIB (Billups, Munson), Murty 1988,
Fathi 1979, Ahn 1983; solutions as published, or a closed form beside the problem.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.vi import RESULTS, Auto, Bracketing, Extragradient, natural_residual

ORTHANT = dvax.sets.Box(0.0, jnp.inf)
WEIGHT = np.array([[2.0, -1.0, 0.5], [1.0, 3.0, -0.5], [-0.5, 0.5, 1.5]])


def expweight(y, _):
    return (jnp.exp(-jnp.sum(y * y)) + 0.2) * (WEIGHT @ y + jnp.array([-6.0, -1.0, 2.0]))


def linear(matrix, q):
    return lambda y, _: jnp.asarray(matrix) @ y + jnp.asarray(q)


def murty(n):
    return np.eye(n) + 2 * np.triu(np.ones((n, n)), 1)


def fathi(n):
    i = np.arange(1, n + 1)
    matrix = 4 * np.minimum.outer(i, i) - 2.0
    np.fill_diagonal(matrix, 4 * i - 3.0)
    return matrix


def ahn(n):
    return 4 * np.eye(n) - 2 * np.eye(n, k=1) + np.eye(n, k=-1)


def unit(n, k):
    return np.eye(n)[k]


# name: (F, K, solution, starts)
PROBLEMS = {
    "expweight_box3": (
        expweight, dvax.sets.Box(-1.0, 1.0), np.array([1.0, -3 / 19, -18 / 19]),
        [np.zeros(3), np.ones(3), np.array([-1.0, 1.0, 1.0])],
    ),
    "kv_ball": (
        lambda y, _: (1.5 - jnp.linalg.norm(y)) * y, dvax.sets.Ball(0.0, 1.0), np.zeros(5),
        [0.4 * np.ones(5), unit(5, 0), np.array([5.0, -3.0, 1.0, 0.0, 2.0])],
    ),
    "disk2d": (
        linear([[3.0, 1.0], [2.0, 5.0]], [-5.0, -3.0]), dvax.sets.Ball(0.0, 1.0), None,
        [np.zeros(2), np.array([-1.0, 0.0]), np.array([9.0, -7.0])],
    ),
    "murty10": (linear(murty(10), -np.ones(10)), ORTHANT, unit(10, 9), [np.zeros(10), np.ones(10)]),
    "fathi10": (linear(fathi(10), -np.ones(10)), ORTHANT, unit(10, 0), [np.zeros(10), np.ones(10)]),
    "ahn10": (
        linear(ahn(10), -np.ones(10)), ORTHANT, np.linalg.solve(ahn(10), np.ones(10)),
        [np.zeros(10), np.full(10, 7.0)],
    ),
    "munson1": (
        linear([[1.0, 2.0, 3.0], [0.0, 1.0, -1.0], [1.0, 1.0, 0.0]], [-1.0, 1.0, 1.0]), ORTHANT,
        np.array([1.0, 0.0, 0.0]), [np.zeros(3), np.ones(3)],
    ),
}  # fmt: skip


def disk2d():
    """y = −(M + μI)⁻¹q on the circle: μ is the root of a scalar equation, by bisection."""
    matrix, q = np.array([[3.0, 1.0], [2.0, 5.0]]), np.array([-5.0, -3.0])
    low, high = 0.0, 10.0
    for _ in range(200):
        mu = 0.5 * (low + high)
        y = np.linalg.solve(matrix + mu * np.eye(2), -q)
        low, high = (mu, high) if y @ y > 1 else (low, mu)
    return y


@pytest.mark.parametrize("solver", [Extragradient(), Auto()], ids=["extragradient", "auto"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_published_problems_are_solved_from_every_start(name, solver):
    F, K, solution, starts = PROBLEMS[name]
    solution = disk2d() if solution is None else solution
    solve = jax.jit(lambda y0: dvax.solve_vi(F, K, y0, solver=solver, tol=1e-11))
    for start in starts:
        vi = solve(jnp.asarray(start, float))
        assert vi.result == RESULTS.successful
        np.testing.assert_allclose(np.asarray(vi.y), solution, atol=1e-9)


def test_the_published_digits_of_disk2d():
    np.testing.assert_allclose(disk2d(), [0.988988885652, 0.147989810655], atol=1e-11)


@pytest.mark.parametrize(
    "solver", [Bracketing(), Extragradient()], ids=["bracketing", "extragradient"]
)
def test_paper1d_is_the_clip_of_its_parameter(solver):
    # F(y) = (2 + sin y)(y − c): strongly pseudomonotone with γ = 1 and not monotone.
    K, end = dvax.sets.Box(0.0, 1.5 * np.pi), 1.5 * np.pi
    cs = np.concatenate([np.linspace(-2.0, 7.0, 37), [0.0, end]])
    law = lambda y, c: (2 + jnp.sin(y)) * (y - c)  # noqa: E731
    solve = jax.jit(
        jax.vmap(
            lambda c, y0: dvax.solve_vi(law, K, y0, args=c, solver=solver, tol=1e-11, gamma=1.0),
            in_axes=(0, None),
        )
    )
    for start in (0.0, 2.5, 4.0):
        vi = solve(jnp.asarray(cs), jnp.asarray(start))
        np.testing.assert_allclose(np.asarray(vi.y), np.clip(cs, 0.0, end), atol=1e-9)
        error = np.abs(np.asarray(vi.y) - np.clip(cs, 0.0, end))
        assert np.all(np.asarray(vi.error_bound) >= error - 4e-16 * np.abs(cs))


def test_billups_is_solved_by_bracketing_where_local_methods_are_trapped_at_zero():
    # (x − 1)² − 1.01 on [0, ∞) has the root 1 + √1.01; merit functions stall at 0.
    for start in (0.0, 0.5, 3.0, 100.0):
        vi = dvax.solve_vi(lambda y, _: (y - 1.0) ** 2 - 1.01, ORTHANT, jnp.asarray(start))
        assert float(vi.y) == pytest.approx(2.004987562112089, abs=1e-9)


def test_the_natural_residual_vanishes_at_the_solutions_of_kojima_shindo_and_josephy():
    # Not monotone and partly degenerate: two solutions of one problem, one of the other.
    def F(x, args):
        a, b, c = args
        return jnp.stack([
            3 * x[0]**2 + 2 * x[0] * x[1] + 2 * x[1]**2 + x[2] + 3 * x[3] - 6,
            2 * x[0]**2 + x[0] + x[1]**2 + a * x[2] + 2 * x[3] - 2,
            3 * x[0]**2 + x[0] * x[1] + 2 * x[1]**2 + 2 * x[2] + b * x[3] - c,
            x[0]**2 + 3 * x[1]**2 + 2 * x[2] + 3 * x[3] - 3,
        ])  # fmt: skip

    degenerate = np.array([np.sqrt(6) / 2, 0, 0, 0.5])
    for args, solution in (
        ((10.0, 9.0, 9.0), degenerate), ((10.0, 9.0, 9.0), np.array([1.0, 0, 3, 0])),
        ((3.0, 3.0, 1.0), degenerate),
    ):  # fmt: skip
        at = natural_residual(
            lambda y, args=args: F(y, args),
            ORTHANT,
            dvax.spaces.Euclidean(4),
            jnp.asarray(solution),
        )
        assert float(jnp.max(jnp.abs(at))) < 1e-14


def test_the_permuted_problem_has_the_permuted_solution():
    F, K, solution, _ = PROBLEMS["expweight_box3"]
    for order in itertools.permutations(range(3)):
        back = np.argsort(order)
        vi = dvax.solve_vi(
            lambda y, _, o=order, b=back: F(y[b], None)[np.asarray(o)], K, jnp.zeros(3), tol=1e-11
        )
        np.testing.assert_allclose(np.asarray(vi.y), solution[np.asarray(order)], atol=1e-9)
