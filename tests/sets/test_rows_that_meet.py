"""Sets with rows that many of their points have in common, or one point only: rows at the ends of their
ranges, dependent and nearly parallel ones, and cones in a subspace."""

import itertools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import dvax
from dvax import sets, spaces


def is_nearest(y, z, normals, gaps, weights):
    """Return whether y satisfies normals · y ≤ bounds (gaps = bounds − normals · y), and W(z − y) is a
    nonnegative sum of the normals of rows without a gap, up to roundoff."""
    lengths = np.linalg.norm(normals, axis=1)
    gaps = gaps / np.where(lengths > 0, lengths, 1.0)
    size = 1.0 + np.abs(y).max()
    if gaps.min() < -1e-9 * size:
        return False
    root = np.sqrt(weights)
    held = normals[(gaps <= 1e-9 * size) & (lengths > 0)] / root
    force = root * (z - y)
    if not len(held):
        return bool(np.linalg.norm(force) <= 1e-8)
    rest = scipy.optimize.nnls(held.T / np.linalg.norm(held, axis=1), force, maxiter=1000)[1]
    return bool(rest <= 1e-8 * (1.0 + np.linalg.norm(force)))


@pytest.mark.slow
@pytest.mark.parametrize(("n", "rows", "seed"), [(2, 5, 0), (4, 3, 1), (5, 5, 2), (6, 1, 3)])
def test_rows_of_whole_numbers_at_the_ends_of_their_ranges(n, rows, seed):
    """Boxes and rows with entries −1, 0 and 1, equations among them, that hold at a common point, often
    a vertex of the box: each row then holds at the end of its range, and some depend on others."""
    rng, count = np.random.default_rng(seed), 1500
    lower = rng.choice([0.0, -1.0, -np.inf], p=[0.6, 0.3, 0.1], size=(count, n))
    upper = rng.choice([0.0, 1.0, 2.0, np.inf], p=[0.1, 0.5, 0.3, 0.1], size=(count, n))
    common = np.clip(rng.integers(-2, 5, size=(count, n)) / 2, lower, upper)
    R = rng.integers(-1, 2, size=(count, rows, n)) * 10.0 ** rng.uniform(
        -3, 3, size=(count, rows, 1)
    )
    sums = np.einsum("kij,kj->ki", R, common)
    low = sums - rng.choice([0.0, 0.5, 1.0, np.inf], size=(count, rows))
    high = sums + rng.choice([0.0, 0.5, np.inf], size=(count, rows))
    z = rng.integers(-8, 9, size=(count, n)) / 2 * rng.choice([1.0, 1e3, 1e6], size=(count, 1))
    weights = 10.0 ** rng.uniform(-2, 2, size=n)
    project = jax.jit(
        jax.vmap(lambda z, *data: sets.ConstrainedBox(*data).project(z, spaces.L2(weights)))
    )
    ys = np.asarray(project(z, lower, upper, R, low, high))
    found = np.isfinite(ys).all(axis=1)
    # A few of these sets, whose rows have sizes from 1e-3 to 1e3, are too hard from 1e6 away.
    assert np.count_nonzero(~found) <= 2
    for k in np.flatnonzero(found):
        normals = np.concatenate([np.eye(n), -np.eye(n), R[k], -R[k]])
        bounds = np.concatenate([upper[k], -lower[k], high[k], -low[k]])
        assert is_nearest(ys[k], z[k], normals, bounds - normals @ ys[k], weights), k


def test_a_row_of_zeros_and_a_projection_to_zero_do_not_hide_a_violated_row():
    K = sets.ConstrainedBox(
        np.array([0.0, -np.inf]), 1.0, np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0]]),
        np.array([-np.inf, -np.inf, 0.5]), np.array([0.0, np.inf, np.inf]),
    )  # fmt: skip
    y = K.project(jnp.array([-1.0, 0.0]), spaces.Euclidean(2))
    np.testing.assert_allclose(np.asarray(y), [0.0, 0.5], atol=1e-15)


def exact_projection(G, d, z):
    """The projection onto {y : G y ≤ d} in rational arithmetic, from all sets of active rows."""
    G, d, z = ([[Fraction(float(v)) for v in row] for row in M] for M in (G, [d], [z]))
    (d,), (z,) = d, z
    dot = lambda a, b: sum(v * w for v, w in zip(a, b, strict=True))  # noqa: E731
    for size in range(len(z) + 1):
        for active in itertools.combinations(range(len(G)), size):
            rows = [[dot(G[i], G[j]) for j in active] + [dot(G[i], z) - d[i]] for i in active]
            for c in range(size):  # Gauss–Jordan elimination
                pivot = next((r for r in range(c, size) if rows[r][c]), None)
                if pivot is None:
                    break
                rows[c], rows[pivot] = rows[pivot], rows[c]
                rows[c] = [v / rows[c][c] for v in rows[c]]
                for r in set(range(size)) - {c}:
                    rows[r] = [v - rows[r][c] * w for v, w in zip(rows[r], rows[c], strict=True)]
            else:
                mu = [row[-1] for row in rows]
                pairs = list(zip(mu, (G[i] for i in active), strict=True))
                y = [v - sum(m * row[c] for m, row in pairs) for c, v in enumerate(z)]
                inside = all(dot(row, y) <= bound for row, bound in zip(G, d, strict=True))
                if inside and all(m >= 0 for m in mu):
                    return np.array([float(v) for v in y])
    return None


@pytest.mark.parametrize("angle", [1e-1, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7])
def test_nearly_parallel_rows_are_both_satisfied(angle):
    """y₁ ≤ 1 and y₁ + a y₂ ≤ 1 − b: the first row alone is violated by b, however small, and both
    together move y by b/a. Before, a violation of 2e-12 counted as roundoff, and y was wrong by
    2e-12/a."""
    project = jax.jit(lambda G, d, z: sets.Polyhedron(G, d).project(z, spaces.Euclidean(2)))
    for b in (1e-11, 2e-12, 1e-12, 1e-13, 0.0, -1e-12):
        for z in ([2.0, 0.0], [2.0, -1.0], [1.5, 3.0]):
            G, d = np.array([[1.0, 0.0], [1.0, angle]]), np.array([1.0, 1.0 - b])
            error = np.asarray(project(G, d, np.array(z))) - exact_projection(G, d, z)
            # The roundoff of a row moves y by as much over a.
            assert np.linalg.norm(error) <= 4e-14 / angle


@pytest.mark.slow
def test_the_bounds_of_a_law_on_nearly_parallel_rows_are_above_its_error():
    a, b = 1e-5, 2e-12
    K = sets.Polyhedron(np.array([[1.0, 0.0], [1.0, a]]), np.array([1.0, 1.0 - b]))
    u = exact_projection(K.G, K.d, [2.0, 0.0])
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=K,
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: jnp.array([2.0, 0.0]) + 0.0 * x,
    )  # fmt: skip
    x0 = jnp.array([1.0, 0.0])
    constants = dvax.verify(problem, x0, 0.0, 1.0).constants
    exact = u + (np.asarray(x0) - u) * np.exp(-1.0)
    for given in (None, constants):
        sol = dvax.solve(problem, x0, 0.0, 1.0, rtol=1e-10, atol=1e-10, constants=given)
        bound = dvax.bound_error(problem, sol, constants)
        assert np.linalg.norm(np.asarray(sol.xs[-1]) - exact) <= float(bound.x[-1])
        assert np.linalg.norm(np.asarray(sol.us[-1]) - u) <= float(bound.u[-1])
    answer = dvax.solve_vi(
        lambda y, z: y - z, K, jnp.zeros(2), jnp.array([2.0, 0.0]), gamma=1.0, tol=1e-8
    )
    assert np.linalg.norm(np.asarray(answer.y) - u) <= float(answer.error_bound) <= 1e-8
    # The roundoff of rows at this angle moves y by far more than the roundoff of y.
    assert float(answer.error_bound) > 1e-11 and float(bound.u[-1]) > 1e-11


@pytest.mark.slow
@pytest.mark.parametrize(("n", "rows", "equations"), [(4, 5, 3), (6, 7, 5), (6, 8, 3)])
def test_cones_in_a_subspace_have_a_projection(n, rows, equations):
    """{y : G y ≤ 0, E y = 0}, which is often {0}. Rows that are nearly orthogonal to the subspace had
    roundoff out of it, and the projection was NaN."""
    rng = np.random.default_rng(5)
    G, E, z = (rng.normal(size=(4000, k, n)) for k in (rows, equations, 1))
    project = jax.jit(
        jax.vmap(
            lambda G, E, z: sets.Polyhedron(G, jnp.zeros(rows), E, jnp.zeros(equations)).project(
                z, spaces.Euclidean(n)
            )
        )
    )
    ys = np.asarray(project(G, E, z[:, 0]))
    assert np.isfinite(ys).all()
    for k in range(0, len(ys), 40):
        normals = np.concatenate([G[k], E[k], -E[k]])
        assert is_nearest(ys[k], z[k, 0], normals, -normals @ ys[k], np.ones(n))
