"""C0 and C1 are never below the true error, and the proved contraction factor holds.

The truth comes from trying every face of the box (`tests.oracles`), which shares no idea with a
projection method.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.oracles import affine_box_vi

import dvax
from dvax.sets import Ball, Simplex
from dvax.vi import (
    RESULTS,
    Extragradient,
    ForwardBackwardForward,
    Projection,
    certify,
    natural_residual,
    residual_bound,
)

ORTHONORMAL = dvax.spaces.Euclidean(4)


def random_problem(rng):
    """A strongly monotone affine VI in 4 unknowns on a box with infinite, equal and tight bounds;
    (M, q, lower, upper, γ, L_F)."""
    root, skew = rng.normal(size=(2, 4, 4))
    gamma_wanted = 10.0 ** rng.uniform(-3, 0)
    M = root @ root.T + (skew - skew.T) * rng.uniform(0, 3)
    symmetric = 0.5 * (M + M.T)
    M = M + (gamma_wanted - np.linalg.eigvalsh(symmetric)[0]) * np.eye(4)
    q = rng.normal(size=4) * 10.0 ** rng.uniform(-1, 1.5)
    lower, width = rng.normal(size=4), rng.exponential(size=4) * rng.integers(0, 2, 4)
    upper = lower + width
    lower = np.where(rng.random(4) < 0.2, -np.inf, lower)
    upper = np.where(rng.random(4) < 0.2, np.inf, upper)
    gamma = np.linalg.eigvalsh(0.5 * (M + M.T))[0]
    return M, q, lower, upper, gamma, np.linalg.norm(M, 2)


@jax.jit
def _bounds(M, q, lower, upper, gamma, L, y, tau):
    F, K = lambda y: M @ y + q, dvax.sets.Box(lower, upper)
    made = certify(F, K, ORTHONORMAL, y, tau)
    r = ORTHONORMAL.norm(natural_residual(F, K, ORTHONORMAL, y, tau))
    return made.y, made.w, made.bound(gamma), residual_bound(r, tau, gamma, L)


def check_certificates(cases, seed):
    rng = np.random.default_rng(seed)
    sharpest = [np.inf, np.inf]
    for _ in range(cases):
        M, q, lower, upper, gamma, L = random_problem(rng)
        truth = affine_box_vi(M, q, lower, upper)
        y = truth + rng.normal(size=4) * 10.0 ** rng.uniform(-6, 1)
        tau = 10.0 ** rng.uniform(-2, 1)
        found = _bounds(M, q, lower, upper, gamma, L, jnp.asarray(y), tau)
        ybar, w, c0, c1 = map(np.asarray, found)
        slack = 1e-9 * (1 + np.linalg.norm(truth) + np.linalg.norm(q)) / min(gamma, 1.0)
        error0, error1 = np.linalg.norm(ybar - truth), np.linalg.norm(y - truth)
        assert c0 >= error0 - slack
        assert c1 >= error1 - slack
        # w is what it says: w − F(ȳ) lies in the normal cone of the box at ȳ.
        normal = w - (M @ ybar + q)
        assert np.all(normal[ybar > lower] >= -1e-8 * (1 + np.abs(w).max()))
        assert np.all(normal[ybar < upper] <= 1e-8 * (1 + np.abs(w).max()))
        if error1 > 1e-3:
            sharpest[0] = min(sharpest[0], c0 / max(error0, 1e-12))
            sharpest[1] = min(sharpest[1], c1 / error1)
    print(f"{cases} cases: least bound / error: C0 {sharpest[0]:.3f}, C1 {sharpest[1]:.3f}")
    # Sharp enough to be of use: somewhere the bounds come close to the truth.
    assert sharpest[0] < 10 and sharpest[1] < 20


def test_certificates_are_never_below_the_true_error():
    check_certificates(300, seed=7)


@pytest.mark.thorough  # 10 000 boxes, each with 81 faces tried
def test_certificates_are_never_below_the_true_error_on_many_problems():
    check_certificates(10_000, seed=8)


def test_affine_box_oracle_is_a_fixed_point_of_projection():
    rng = np.random.default_rng(0)
    for _ in range(20):
        M, q, lower, upper, _, L = random_problem(rng)
        y = affine_box_vi(M, q, lower, upper)
        moved = np.clip(y - (M @ y + q) / L, lower, upper)
        np.testing.assert_allclose(moved, y, atol=1e-9)


@pytest.mark.parametrize("known", [True, False], ids=["L_F known", "backtracking"])
def test_extragradient_bound_holds_on_random_boxes(known):
    def run(M, q, lower, upper, gamma, L):
        vi = dvax.solve_vi(
            lambda y, _: M @ y + q, dvax.sets.Box(lower, upper), jnp.zeros(4), gamma=gamma,
            L_F=L if known else None, tol=1e-8, solver=Extragradient(max_steps=200_000),
        )  # fmt: skip
        return vi.y, vi.error_bound, vi.result == dvax.vi.RESULTS.successful

    solve = jax.jit(run)
    rng = np.random.default_rng(11)
    for _ in range(25):
        case = random_problem(rng)
        y, bound, good = solve(*map(jnp.asarray, case))
        error = np.linalg.norm(np.asarray(y) - affine_box_vi(*case[:4]))
        assert bool(good)
        assert error <= float(bound) + 1e-10
        assert error <= 2e-8


# The methods as their docstrings state them, without a line of the library: y⁺ from y.
def _extragradient(F, project, y, lam):
    return project(y - lam * F(project(y - lam * F(y))))


def _forward_backward_forward(F, project, y, lam):
    z = project(y - lam * F(y))
    return z - lam * (F(z) - F(y))


def _projection(F, project, y, lam):
    return project(y - lam * F(y))


# solver, its step, λ of γ and L, and how near to the proven factor some step comes at least
METHODS = {
    "extragradient": (Extragradient(), _extragradient, lambda g, L: 0.7 / L, 0.8),
    "forward-backward-forward": (
        ForwardBackwardForward(), _forward_backward_forward, lambda g, L: 0.7 / L, 0.8,
    ),
    "projection": (Projection(), _projection, lambda g, L: g / L**2, 0.95),
}  # fmt: skip


@pytest.mark.parametrize("name", METHODS)
def test_contraction_factor_holds_for_every_step(name):
    solver, step, length, attained = METHODS[name]
    rng = np.random.default_rng(13)
    worst = 0.0
    for _ in range(30):
        M, q, lower, upper, gamma, L = random_problem(rng)
        truth = affine_box_vi(M, q, lower, upper)
        proved = float(solver.contraction(gamma, L))
        assert 0 < proved < 1

        def project(v, lower=lower, upper=upper):
            return np.clip(v, lower, upper)

        for _ in range(10):
            y = project(truth + rng.normal(size=4) * 10.0 ** rng.uniform(-3, 2))
            before = np.linalg.norm(y - truth)
            if before < 1e-6:
                continue
            after = step(lambda v, M=M, q=q: M @ v + q, project, y, length(gamma, L))
            distance = np.linalg.norm(after - truth)
            worst = max(worst, distance / before / proved)
            assert distance <= proved * before * (1 + 1e-9) + 1e-9
    print(f"{name}: worst measured / proved contraction {worst:.4f}")
    assert worst > attained  # nearly attained, so that a wrong sign in the factor would be seen


@pytest.mark.parametrize("name", METHODS)
def test_contraction_factor_bounds_the_iterations_of_the_solver(name):
    """To gain ten digits, a solver needs at most ln(1e10)/ln(1/q) iterations."""
    # From iteration counts alone: to gain 10 more digits it needs no more than ln(1e10)/ln(1/q).
    solver = METHODS[name][0]
    M, q = np.array([[1.0, 6.0], [-6.0, 1.0]]), np.array([-1.0, 2.0])
    L, gamma = float(np.linalg.norm(M, 2)), 1.0
    F = lambda y, _: jnp.asarray(M) @ y + jnp.asarray(q)  # noqa: E731
    counts = [
        int(
            dvax.solve_vi(
                F, dvax.sets.Box(-9.0, 9.0), jnp.full(2, 5.0), solver=solver, gamma=gamma, L_F=L,
                tol=tol,
            ).iterations
        )
        for tol in (1e-2, 1e-12)
    ]  # fmt: skip
    allowed = np.log(1e10) / -np.log(float(solver.contraction(gamma, L)))
    print(f"{name}: {counts[1] - counts[0]} iterations for ten digits, {allowed:.0f} allowed")
    assert 10 < counts[1] - counts[0] <= allowed + 1


@pytest.mark.slow
@pytest.mark.parametrize("drive", [0.1, 5.0])
@pytest.mark.parametrize("K", [Ball(0.0, 1.0), Simplex(1.0)], ids=["ball", "simplex"])
def test_formula_on_any_set_has_a_certificate(K, drive):
    """F(y) = y − c is solved by a projection, which has no ‖w‖ of its own."""
    vi = dvax.solve_vi(lambda y, args: y - args, K, jnp.zeros(3), jnp.full(3, drive), gamma=1.0)
    exact = K.project(jnp.full(3, drive), dvax.spaces.Euclidean(3))
    assert vi.solver == "ClosedForm" and vi.result == RESULTS.successful
    assert float(jnp.linalg.norm(vi.y - exact)) <= float(vi.error_bound) <= 1e-12
