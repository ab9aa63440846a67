"""Bounds over interval matrices: the smallest quotient is that of the worst vertex, and a one-sided
constant over a region is no smaller than any rate at which two trajectories separate."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import digamma

import dvax
from dvax.theory.blocks import Block, dominating


def _smallest(matrix: np.ndarray) -> float:
    return float(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0])


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_smallest_quotient_is_that_of_the_worst_vertex(n, seed):
    rng = np.random.default_rng([n, seed])
    center, radius = rng.normal(size=(n, n)), rng.random((n, n)) * rng.choice([0.0, 1.0], (n, n))
    signs = itertools.product((-1.0, 1.0), repeat=n * n)
    vertices = (center + np.reshape(s, (n, n)) * radius for s in signs)
    found = Block(center[None], radius[None]).smallest_quotient()
    assert found == pytest.approx(min(map(_smallest, vertices)), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("n", [5, 9, 40])
def test_smallest_quotient_is_below_that_of_every_member(n):
    rng = np.random.default_rng(n)
    center, radius = rng.normal(size=(3, n, n)), 0.2 * rng.random((3, n, n))
    found = Block(center, radius).smallest_quotient()
    norm = np.linalg.norm(radius + radius.swapaxes(1, 2), 2, axis=(1, 2)) / 2
    assert found >= min(_smallest(c) - r for c, r in zip(center, norm, strict=True)) - 1e-12
    for _ in range(200):
        member = center + rng.choice([-1.0, 1.0], radius.shape) * radius
        assert found <= min(map(_smallest, member)) + 1e-12


@pytest.mark.parametrize("n", [4, 30])
def test_smallest_quotient_is_exact_where_the_diagonal_alone_is_uncertain(n):
    rng = np.random.default_rng(n)
    center, radius = rng.normal(size=(2, n, n)), rng.random((2, n))[:, :, None] * np.eye(n)
    expected = min(map(_smallest, center - radius))
    assert Block(center, radius).smallest_quotient() == pytest.approx(expected, rel=1e-12)


def test_smallest_quotient_of_an_unbounded_entry_is_unbounded():
    radius = np.array([[[0.0, np.inf], [0.0, 1.0]]])
    assert Block(np.eye(2)[None], radius).smallest_quotient() == -np.inf


@pytest.mark.parametrize("n", [1, 2, 6])
def test_dominating_diagonals_exceed_every_quadratic_form_within_the_radius(n):
    rng = np.random.default_rng(n)
    radius = rng.random((1, n, n))
    radius = radius + radius.swapaxes(1, 2)
    d = rng.normal(size=(500, n))
    largest = np.einsum("ki,ij,kj->k", abs(d), radius[0], abs(d))
    for e in dominating(radius):
        assert (largest <= d**2 @ e[0] * (1 + 1e-12)).all()


def _response(C: np.ndarray, D: np.ndarray, c: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Solve 0 ≤ u ≤ 2 ⊥ Du + cu² − Cx for many rows of x by the projected fixed-point iteration."""
    u = np.ones_like(x)
    for _ in range(4000):
        u = np.clip(u - 0.1 * (u @ D.T + c * u**2 - x @ C.T), 0.0, 2.0)
    return u


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_one_sided_constant_is_above_every_rate_of_separation(seed):
    n = 3
    rng = np.random.default_rng(seed)
    M, E, C = rng.normal(size=(n, n)), rng.normal(size=(n, n)), rng.normal(size=(n, n))
    D, c = np.diag(1.0 + rng.random(n)), np.array([0.1, 0.4, 0.0])
    b = np.array([0.5, 0.0, 2.0])

    def f(t, x, u, args):
        return jnp.asarray(M) @ x - jnp.asarray(b) * x**3 + jnp.asarray(E) @ u

    def h(t, x, u, args):
        return u + jnp.asarray(C) @ x - jnp.asarray(D) @ u - jnp.asarray(c) * u**2

    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 2.0), f=f, h=h
    )
    found = dvax.verify(problem, np.zeros(n), 0.0, 1.0, x=(-1.0, 1.5)).constants
    x, y = rng.uniform(-1.0, 1.5, (2, 20_000, n))
    # Near pairs: at an end of the range in some entries, where the cubic term has its extremes.
    x[::2] = np.where(rng.random((10_000, n)) < 0.5, 0.0, x[::2])
    y[::2] = x[::2] + 1e-3 * rng.normal(size=(10_000, n)) * (abs(x[::2]) < 1.4)
    u, v = _response(C, D, c, x), _response(C, D, c, y)
    d = x - y
    change = d @ M.T - b * (x**3 - y**3) + (u - v) @ E.T
    rates = np.sum(change * d, axis=1) / np.sum(d * d, axis=1)
    assert rates.max() <= found.one_sided + 1e-6
    # F is strongly monotone with the least slope of its diagonal.
    assert found.gamma == pytest.approx(np.diag(D).min(), rel=1e-12)


def test_one_sided_constant_of_uncertain_diagonals_is_exact():
    rng = np.random.default_rng(17)
    M = rng.normal(size=(4, 4))
    b = np.array([0.3, 0.0, 1.0, 0.1])
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 2.0),
        f=lambda t, x, u, args: jnp.asarray(M) @ x - jnp.asarray(b) * x**3, h=lambda t, x, u, args: -u,
    )  # fmt: skip
    found = dvax.verify(problem, np.zeros(4), 0.0, 1.0, x=(-1.0, 1.0)).constants
    assert found.one_sided == pytest.approx(-_smallest(-M), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 6])
def test_estimated_gamma_is_close_to_the_least_slope_at_a_corner(n):
    rng = np.random.default_rng(n)
    skew = rng.normal(size=(n, n))
    M = 0.3 * (skew - skew.T) + np.diag(0.5 + rng.random(n))
    c = 0.002 * rng.uniform(-0.1, 1.0, n)

    def h(t, x, u, args):
        # `digamma` has no rule, so there is no proof.
        return x + u - jnp.asarray(M) @ u - jnp.asarray(c) * u**2 - 1e-9 * digamma(u + 3.0)

    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 100.0),
        f=lambda t, x, u, args: u - x, h=h,
    )  # fmt: skip
    found = dvax.verify(problem, np.zeros(n), 0.0, 1.0, x=(-2.0, 2.0)).constants
    corners = itertools.product((0.0, 100.0), repeat=n)
    least = min(_smallest(M + 2.0 * np.diag(c * np.array(u))) for u in corners)
    assert found.status_of("gamma") == "estimated"
    assert least * (1.0 - 1e-6) <= found.gamma <= 1.03 * least
