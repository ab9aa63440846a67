"""A string over a flat obstacle: −u″ + 32 ≥ 0, u ≥ 0, one of them 0, u(0) = u(1) = 1.

It touches on [1/4, 3/4] and is 16(1/4 − x)² beside it. Second differences are exact for parabolas, so
that the error is that of the free boundary alone, and of order 2.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.vi.results import successful

import dvax
from dvax.vi import Auto, GoldenRatio, SemismoothNewton

MOST = 400
COUNTS = np.array([50, 100, 200, 400])


def exact(x):
    return 16.0 * np.maximum(0.25 - np.minimum(x, 1.0 - x), 0.0) ** 2


def errors(solver, counts, most):
    """max |uᵢ − u(xᵢ)| with n points inside (0, 1), for each n in one program: what is to spare of the
    unknowns lies beyond x = 1 and is held at the end's value by an interval of no width."""

    def one(n):
        inside = jnp.arange(most, dtype=float) < n
        square = (n + 1.0) ** 2

        def F(u, _):
            padded = jnp.concatenate([jnp.ones(1), u, jnp.ones(1)])
            return (2.0 * u - padded[:-2] - padded[2:]) * square + 32.0

        K = dvax.sets.Box(jnp.where(inside, 0.0, 1.0), jnp.where(inside, jnp.inf, 1.0))
        return dvax.solve_vi(F, K, jnp.ones(most), solver=solver, tol=1e-7, gamma=9.0)

    vi = jax.jit(jax.vmap(one))(jnp.asarray(counts, float))
    assert successful(vi).all()
    assert np.all(np.asarray(vi.error_bound) <= 1e-7)
    u, found = np.asarray(vi.y), []
    for n, row in zip(counts, u, strict=True):
        x = np.arange(1, n + 1) / (n + 1)
        found.append(np.max(np.abs(row[:n] - exact(x))))
        # It touches where it should, to the width of the grid, and nowhere pierces.
        assert np.all(row >= 0)
        touching = x[row[:n] == 0]
        assert abs(touching.min() - 0.25) < 2.0 / n and abs(touching.max() - 0.75) < 2.0 / n
    print(f"errors {found}, {np.asarray(vi.iterations)} iterations")
    return np.array(found)


def test_obstacle_error_of_second_differences_is_of_order_two():
    found = errors(GoldenRatio(max_steps=50_000), COUNTS[:2], 100)
    np.testing.assert_allclose(found, [3.5e-4, 9.8e-5], rtol=0.05)


@pytest.mark.thorough  # as many iterations as the condition number asks for
def test_obstacle_order_holds_up_to_four_hundred_points():
    found = errors(GoldenRatio(max_steps=500_000), COUNTS, MOST)
    np.testing.assert_allclose(found, [3.5e-4, 9.8e-5, 2.5e-5, 6.2e-6], rtol=0.05)
    orders = np.log(found[:-1] / found[1:]) / np.log((COUNTS[1:] + 1) / (COUNTS[:-1] + 1))
    assert np.all(np.abs(orders - 2.0) < 0.25)


@pytest.mark.thorough
@pytest.mark.parametrize("solver", [Auto(), SemismoothNewton()], ids=lambda s: type(s).__name__)
def test_newton_solves_the_obstacle_with_a_hundred_points(solver):
    found = errors(solver, COUNTS[1:2], 100)
    np.testing.assert_allclose(found, [9.8e-5], rtol=0.05)
