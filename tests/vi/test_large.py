"""Laws of thousands of unknowns, coupled by a matrix of any condition number, without options.

F(y) = y + κ(L + sS)y + c y³ − (1 + √κ) b on a grid of m × m points, with the five-point Laplacian L ≥ 0
and the skew central difference S: μ = 1, and ‖F′‖ ≈ 8κ. Solutions are checked by SciPy's matrices and
projections written in NumPy: since μ = 1, ‖y − y*‖ ≤ (1 + ‖F′‖) ‖y − proj_K(y − F(y))‖.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

import dvax
from dvax.vi.matrix_free import is_self_adjoint

POINTS = 40
CONDITIONS = (1e-2, 1.0, 1e2, 1e4, 1e6)


def project_simplex(z, total):
    ordered = np.sort(z)[::-1]
    sums = np.cumsum(ordered) - total
    count = np.nonzero(ordered > sums / np.arange(1, len(z) + 1))[0][-1]
    return np.maximum(z - sums[count] / (count + 1), 0.0)


def project_cone(z):
    t, v = z[0], z[1:]
    r = np.linalg.norm(v)
    if r <= abs(t):
        return z if t >= 0 else 0.0 * z
    half = 0.5 * (1.0 + t / r)
    return np.concatenate([[half * r], half * v])


def project_half_space(z, offset):
    return z - max(np.sum(z) - offset, 0.0) / len(z)


SETS = {
    "half line": (dvax.sets.Box(0.0, jnp.inf), lambda z: np.maximum(z, 0.0)),
    "interval": (dvax.sets.Box(-0.1, 0.15), lambda z: np.clip(z, -0.1, 0.15)),
    "whole space": (dvax.sets.WholeSpace(), lambda z: z),
    "ball": (
        dvax.sets.Ball(0.0, 0.1 * POINTS),
        lambda z: z * min(1.0, 0.1 * POINTS / np.linalg.norm(z)),
    ),
    "simplex": (dvax.sets.Simplex(1.0 * POINTS), partial(project_simplex, total=1.0 * POINTS)),
    "cone": (dvax.sets.SecondOrderCone(), project_cone),
    "half space": (
        dvax.sets.HalfSpace(jnp.ones(POINTS**2), -1.0 * POINTS),
        partial(project_half_space, offset=-1.0 * POINTS),
    ),
}


def load(shift):
    x, y = np.meshgrid(np.linspace(-1, 1, POINTS), np.linspace(-1, 1, POINTS))
    return (np.exp(-8.0 * ((x - shift) ** 2 + y**2)) - 0.4).ravel()


def as_matrix(kappa, skew):
    one = sp.identity(POINTS)
    second = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], (POINTS, POINTS))
    first = sp.diags([-1.0, 1.0], [-1, 1], (POINTS, POINTS))
    laplacian = sp.kron(one, second) + sp.kron(second, one)
    return sp.identity(POINTS**2) + kappa * (laplacian + skew * sp.kron(one, first))


def F(y, args):
    kappa, skew, cubic, b = args
    v = jnp.pad(y.reshape(POINTS, POINTS), 1)
    east, west, north, south = v[1:-1, 2:], v[1:-1, :-2], v[2:, 1:-1], v[:-2, 1:-1]
    laplacian = 4.0 * v[1:-1, 1:-1] - east - west - north - south
    coupling = (laplacian + skew * (east - west)).ravel()
    return y + kappa * coupling + cubic * y**3 - (1.0 + jnp.sqrt(kappa)) * b


def check(name, kappa, skew, cubic, shift):
    # Not below the rounding error of F, whose terms are up to κ(8 + skew)‖y‖.
    tol = 1e-9 + 1e-14 * kappa * (8.0 + skew)
    K, project = SETS[name]
    b = load(shift)
    args = (kappa, skew, cubic, jnp.asarray(b))
    vi = dvax.solve_vi(F, K, jnp.zeros(POINTS**2), args, tol=tol)
    y = np.asarray(vi.y)
    value = as_matrix(kappa, skew) @ y + cubic * y**3 - (1.0 + np.sqrt(kappa)) * b
    step = 1.0 / (1.0 + 8.0 * kappa)
    residual = np.linalg.norm(y - project(y - step * value)) / step
    assert vi.result == dvax.vi.RESULTS.successful, (name, kappa, skew, cubic)
    assert residual < 4.0 * tol, (name, kappa, skew, cubic, residual)
    return vi


@pytest.mark.slow
@pytest.mark.parametrize("name", ["half line", "ball"])
def test_laws_of_any_condition_are_solved(name):
    for kappa in CONDITIONS:
        for skew in (0.0, 0.3):
            vi = check(name, kappa, skew, 0.0, 0.3)
            # GoldenRatio takes 20,000 evaluations or more at the larger κ.
            assert int(vi.evaluations) < 150
    assert vi.solver == ("ActiveSet" if name == "half line" else "SemismoothNewton")


@pytest.mark.thorough
@pytest.mark.parametrize("name", SETS)
def test_laws_of_any_condition_skewness_and_curvature_are_solved_on_every_set(name):
    rng = np.random.default_rng(0)
    for kappa in CONDITIONS:
        for skew in (0.0, 0.1, 1.0, 10.0):
            for cubic in (0.0, 1.0):
                check(name, kappa, skew, cubic, rng.uniform(-0.8, 0.8))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["half line", "ball", "simplex", "cone"])
def test_derivatives_of_large_laws_are_those_of_the_solution(name):
    K, _ = SETS[name]
    weights, b = np.cos(np.arange(POINTS**2)), jnp.asarray(load(0.3))

    def total(factor, kappa, skew):
        args = (kappa, skew, 0.0, factor * b)
        return jnp.sum(weights * dvax.solve_vi(F, K, jnp.zeros(POINTS**2), args, tol=1e-11).y)

    for kappa in CONDITIONS[:4]:
        for skew in (0.0, 0.3):
            value = float(jax.grad(total)(1.0, kappa, skew))
            change = 1e-5
            quotient = total(1.0 + change, kappa, skew) - total(1.0 - change, kappa, skew)
            np.testing.assert_allclose(value, float(quotient) / (2 * change), rtol=1e-5)


@pytest.mark.slow
def test_a_problem_with_an_obstacle_on_a_fine_grid_is_solved_without_options():
    args = (jnp.asarray(10.0), 0.0, 0.0, jnp.asarray(load(0.3)))
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, jnp.inf),
        f=lambda t, x, u, args: u,
        h=lambda t, x, u, args: u - F(u, args) + 0.1 * x,
    )
    sol = dvax.solve(problem, jnp.zeros(POINTS**2), 0.0, 0.2, args=args, rtol=1e-4)
    x = np.asarray(sol.xs[-1])
    u = np.asarray(problem.response(0.2, x, args))
    # h − u = −F(u) + x/10 must be in N_K(u).
    value = as_matrix(10.0, 0.0) @ u - (1.0 + np.sqrt(10.0)) * load(0.3) - 0.1 * x
    assert 0.1 < np.mean(u > 0) < 0.9
    assert np.linalg.norm(np.minimum(u, value)) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("points", [40, 150])
def test_symmetric_laws_are_recognised_in_single_and_in_double_precision(dtype, points):
    def slope(skew, kappa, y):
        v = jnp.pad(y.reshape(points, points), 1)
        east, west, north, south = v[1:-1, 2:], v[1:-1, :-2], v[2:, 1:-1], v[:-2, 1:-1]
        laplacian = 4.0 * v[1:-1, 1:-1] - east - west - north - south
        return y + kappa * (laplacian + skew * (east - west)).ravel()

    like, weights = jnp.zeros(points**2, dtype), jnp.asarray(0.5, dtype)
    for kappa in CONDITIONS:
        assert is_self_adjoint(partial(slope, 0.0, kappa), like, weights)
        if kappa >= 1.0:
            assert not is_self_adjoint(partial(slope, 0.3, kappa), like, weights)


@pytest.mark.parametrize("skew", [0.0, 0.3])
def test_laws_in_single_precision_are_solved_in_a_process_of_double_precision(skew):
    kappa, b = 100.0, load(0.3)
    args = (np.float32(kappa), np.float32(skew), np.float32(0.0), jnp.asarray(b, jnp.float32))
    K = dvax.sets.Box(np.float32(0.0), np.float32(jnp.inf))
    vi = dvax.solve_vi(F, K, jnp.zeros(POINTS**2, jnp.float32), args, tol=np.float32(1e-3))
    y = np.asarray(vi.y)
    value = as_matrix(kappa, skew) @ y - (1.0 + np.sqrt(kappa)) * b
    assert y.dtype == np.float32
    # Roundoff of F is about 8κ ‖y‖ ε.
    assert np.linalg.norm(np.minimum(y, value)) < 2e-3 + 8 * kappa * 1e-7 * np.linalg.norm(y)
