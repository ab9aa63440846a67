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
from dvax.vi import (
    RESULTS,
    Auto,
    Bracketing,
    Extragradient,
    ForwardBackwardForward,
    GoldenRatio,
    SemismoothNewton,
    natural_residual,
)

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


def kojima_shindo(a, b, c):
    """Kojima and Shindo's map (1986) with its published variants: not monotone."""

    def F(x, _):
        return jnp.stack([
            3 * x[0]**2 + 2 * x[0] * x[1] + 2 * x[1]**2 + x[2] + 3 * x[3] - 6,
            2 * x[0]**2 + x[0] + x[1]**2 + a * x[2] + 2 * x[3] - 2,
            3 * x[0]**2 + x[0] * x[1] + 2 * x[1]**2 + 2 * x[2] + b * x[3] - c,
            x[0]**2 + 3 * x[1]**2 + 2 * x[2] + 3 * x[3] - 3,
        ])  # fmt: skip

    return F


def cournot(q, _):
    """Five firms (Murphy, Sherali and Soyster 1982): marginal cost minus marginal revenue."""
    cost, slope = jnp.array([10.0, 8.0, 6.0, 4.0, 2.0]), jnp.array([1.2, 1.1, 1.0, 0.9, 0.8])
    total = jnp.sum(q)
    price = (5000.0 / total) ** (1 / 1.1)
    return cost + (q / 5.0) ** (1.0 / slope) - price + q * price / (1.1 * total)


MCPLIB_STARTS = [
    np.zeros(4), np.ones(4), np.full(4, 100.0), np.array([1.0, 0, 1, 0]), unit(4, 0),
    np.array([0, 1.0, 1, 0]), np.array([0, 1.0, 0, 1]), np.array([1.25, 0, 0, 0.5]),
]  # fmt: skip
DEGENERATE = np.array([np.sqrt(6) / 2, 0, 0, 0.5])

# name: (F, K, solutions, starts)
PROBLEMS = {
    "kojshin": (
        kojima_shindo(10.0, 9.0, 9.0), ORTHANT, [DEGENERATE, np.array([1.0, 0, 3, 0])],
        MCPLIB_STARTS,
    ),
    "josephy": (kojima_shindo(3.0, 3.0, 1.0), ORTHANT, [DEGENERATE], MCPLIB_STARTS),
    "cournot5": (
        cournot, dvax.sets.Box(1e-6, jnp.inf),
        [np.array([36.932510815736, 41.818141660438, 43.706578522274, 42.659239743305,
                   39.178952516625])],
        [np.full(5, 10.0), np.ones(5), np.array([1.0, 50, 3, 80, 20])],
    ),
    "billups": (
        lambda y, _: (y - 1.0) ** 2 - 1.01, ORTHANT, [np.array([2.004987562112089])],
        [np.zeros(1), np.full(1, 0.5), np.full(1, 3.0)],
    ),
    "expweight_box3": (
        expweight, dvax.sets.Box(-1.0, 1.0), [np.array([1.0, -3 / 19, -18 / 19])],
        [np.zeros(3), np.ones(3), np.array([-1.0, 1.0, 1.0])],
    ),
    "kv_ball": (
        lambda y, _: (1.5 - jnp.linalg.norm(y)) * y, dvax.sets.Ball(0.0, 1.0), [np.zeros(5)],
        [0.4 * np.ones(5), unit(5, 0), np.array([5.0, -3.0, 1.0, 0.0, 2.0])],
    ),
    "disk2d": (
        linear([[3.0, 1.0], [2.0, 5.0]], [-5.0, -3.0]), dvax.sets.Ball(0.0, 1.0), None,
        [np.zeros(2), np.array([-1.0, 0.0]), np.array([9.0, -7.0])],
    ),
    "murty10": (linear(murty(10), -np.ones(10)), ORTHANT, [unit(10, 9)], [np.zeros(10), np.ones(10)]),
    "fathi10": (linear(fathi(10), -np.ones(10)), ORTHANT, [unit(10, 0)], [np.zeros(10), np.ones(10)]),
    "ahn10": (
        linear(ahn(10), -np.ones(10)), ORTHANT, [np.linalg.solve(ahn(10), np.ones(10))],
        [np.zeros(10), np.full(10, 7.0)],
    ),
    "munson1": (
        linear([[1.0, 2.0, 3.0], [0.0, 1.0, -1.0], [1.0, 1.0, 0.0]], [-1.0, 1.0, 1.0]), ORTHANT,
        [np.array([1.0, 0.0, 0.0])], [np.zeros(3), np.ones(3)],
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


SOLVERS = {
    "extragradient": Extragradient(),
    "forward-backward-forward": ForwardBackwardForward(),
    "golden ratio": GoldenRatio(),
    "newton": SemismoothNewton(),
    "auto": Auto(),
}


def nearest(y, solutions):
    return min(np.max(np.abs(np.asarray(y) - s)) for s in solutions)


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param("extragradient", marks=pytest.mark.thorough),
        pytest.param("forward-backward-forward", marks=pytest.mark.thorough),
        "golden ratio",
        "newton",
        "auto",
    ],
)
@pytest.mark.parametrize("name", PROBLEMS)
def test_published_problems_are_solved_from_every_start(name, solver):
    F, K, solutions, starts = PROBLEMS[name]
    solutions = [disk2d()] if solutions is None else solutions
    solve = jax.jit(lambda y0: dvax.solve_vi(F, K, y0, solver=SOLVERS[solver], tol=1e-11))
    counts = []
    for start in starts:
        vi = solve(jnp.asarray(start, float))
        assert vi.result == RESULTS.successful
        assert nearest(vi.y, solutions) < 1e-9
        counts.append(int(vi.evaluations))
    print(f"{name}, {solver}: {counts} evaluations of F")
    if solver == "newton":
        assert np.median(counts) <= 100


@pytest.mark.parametrize("name", ["kojshin", "josephy", "cournot5", "expweight_box3", "fathi10"])
def test_newton_solves_from_random_starts_or_says_why_not(name):
    F, K, solutions, starts = PROBLEMS[name]
    size = len(starts[0])
    y0s = np.abs(np.random.default_rng(5).normal(size=(100, size))) * 10.0
    vi = jax.jit(
        jax.vmap(lambda y0: dvax.solve_vi(F, K, y0, solver=SemismoothNewton(), tol=1e-11))
    )(jnp.asarray(y0s))
    good = np.asarray(vi.result == RESULTS.successful)
    assert all(nearest(y, solutions) < 1e-9 for y in np.asarray(vi.y)[good])
    assert good.mean() >= 0.95
    print(f"{name}: {good.sum()} of 100, median {np.median(vi.evaluations):.0f} evaluations")


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
    for name in ("kojshin", "josephy"):
        F, K, solutions, _ = PROBLEMS[name]
        for y in map(jnp.asarray, solutions):
            at = natural_residual(lambda y, F=F: F(y, None), K, dvax.spaces.Euclidean(4), y)
            assert float(jnp.max(jnp.abs(at))) < 1e-14


def test_the_permuted_problem_has_the_permuted_solution():
    F, K, (solution,), _ = PROBLEMS["expweight_box3"]
    for order in itertools.permutations(range(3)):
        back = np.argsort(order)
        vi = dvax.solve_vi(
            lambda y, _, o=order, b=back: F(y[b], None)[np.asarray(o)], K, jnp.zeros(3), tol=1e-11
        )
        np.testing.assert_allclose(np.asarray(vi.y), solution[np.asarray(order)], atol=1e-9)
