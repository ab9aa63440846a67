"""Published variational inequalities (`tests.vi.problems`), from their published starts and 100 others:
a solver is within 1e-9 of a solution, or reports a failure."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from tests.vi.problems import ORTHANT, PROBLEMS, disk2d
from tests.vi.results import reasons, successful

import dvax
from dvax.vi import (
    Auto,
    Bracketing,
    Extragradient,
    ForwardBackwardForward,
    GoldenRatio,
    Projection,
    SemismoothNewton,
)

SOLVERS = {
    "newton": SemismoothNewton(),
    "auto": Auto(),
    "golden ratio": GoldenRatio(),
    "extragradient": Extragradient(),
    "forward-backward-forward": ForwardBackwardForward(),
    "projection": Projection(max_steps=2000),
}
# Long programs, as every projection is an iteration of its own.
LONG = {"mathiesen", "mathiesen as an intersection", "fukushima1", "fukushima2"}
EVERY_RUN = [name for name in PROBLEMS if name not in LONG][::4]
# In every run, beside Newton's method on the others and what is chosen where that is another.
OFTEN = {
    ("auto", "kojshin"), ("golden ratio", "cournot5"),
}  # fmt: skip
_compiled: dict[Any, Any] = {}


def solved(name, solver):
    """All lanes at once, published starts first; problems of one form share one program."""
    problem = PROBLEMS[name]
    # Starts in the middle of the cone where they are few, so that problems share shapes.
    others = problem.far(np.random.default_rng(5), 108 - len(problem.starts))
    y0s = jnp.asarray(np.vstack([*problem.starts, others]))
    if isinstance(solver, Auto):
        solver = solver.choose(lambda y: problem.F(y, problem.args), problem.K, y0s[0])
    key = problem.F, id(problem.K), repr(solver), problem.tol

    def one(y0, args):
        return dvax.solve_vi(problem.F, problem.K, y0, args, solver=solver, tol=problem.tol)

    run = _compiled.setdefault(key, jax.jit(jax.vmap(one, in_axes=(0, None))))
    args = jax.tree.map(lambda given: jnp.asarray(given, float), problem.args)
    return run(y0s, args), len(problem.starts)


def cases():
    for solver, name in itertools.product(SOLVERS, PROBLEMS):
        usual = solver == "newton" and name in EVERY_RUN
        often = usual or (solver, name) in OFTEN
        yield pytest.param(name, solver, marks=() if often else pytest.mark.thorough)


@pytest.mark.parametrize(("name", "solver"), list(cases()))
def test_solvers_solve_published_problems_or_report_failure(name, solver):
    problem = PROBLEMS[name]
    vi, published = solved(name, SOLVERS[solver])
    good = successful(vi)
    y, residual = np.asarray(vi.y), np.asarray(vi.residual)
    error = np.min([np.max(np.abs(y - s), axis=1) for s in problem.solutions], axis=0)
    evaluations = np.median(np.asarray(vi.evaluations)[good]) if good.any() else np.nan
    print(
        f"{name}, {solver}: {good.sum()} of {len(good)}, median {evaluations:.0f} evaluations of F, "
        f"largest error {error[good].max(initial=0):.1e}; else {reasons(vi, ~good)}"
    )
    # Whoever is successful is right; who is not has said why.
    assert np.all(error[good] < 1e-9)
    assert np.all(residual[good] <= problem.tol)
    if solver != "projection":  # proved for strongly pseudomonotone F alone, and slow
        assert good[:published].all()
        assert good.mean() >= 0.95
    if solver == "newton":
        assert evaluations <= 100


def projections(K):
    """The projection of many points on K, compiled once for all problems with this set."""
    project = jax.vmap(lambda z: K.project(z, dvax.spaces.Euclidean(z.shape)))
    return _compiled.setdefault(id(K), jax.jit(project))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", sorted({*PROBLEMS} - {"fukushima2", "mathiesen as an intersection"})
)
def test_published_solutions_satisfy_the_first_order_conditions(name):
    # ⟨F(y*), v − y*⟩ ≥ 0 for many v of K, as the inequality is written. (Where K is an intersection,
    # the published multipliers below say it.)
    problem = PROBLEMS[name]
    K = projections(problem.K)
    for y in problem.solutions:
        F = np.asarray(problem.F(jnp.asarray(y), problem.args))
        rays = np.vstack(
            [problem.far(np.random.default_rng(1), 200), np.eye(len(y)), -np.eye(len(y))]
        )
        points = np.asarray(K(jnp.asarray(rays)))
        points = points[np.all(np.isfinite(points), axis=1)]
        assert len(points) > 150
        assert np.min((points - y) @ F) >= -1e-8 * (1 + np.abs(points).max())


def gradient(a, x):
    return 2 * np.asarray(a) * x


def at(name, x):
    return np.asarray(PROBLEMS[name].F(jnp.asarray(x), PROBLEMS[name].args))


def test_published_multipliers_balance_the_operator():
    first, second = PROBLEMS["fukushima1"].solutions[0], PROBLEMS["fukushima2"].solutions[0]
    np.testing.assert_allclose(
        at("fukushima1", first) + 0.9 * gradient([1, 0.4, 0.6], first), 0, atol=1e-14
    )
    pull = 1.9092031846163 * gradient([1, 0.4, 0.6], second) - 1.2787459374125
    np.testing.assert_allclose(at("fukushima2", second) + pull, 0, atol=1e-10)
    assert second @ ([1, 0.4, 0.6] * second) == pytest.approx(1, abs=1e-11)
    assert np.sum(second) == pytest.approx(np.sqrt(3), abs=1e-11)
    prices = PROBLEMS["mathiesen"].solutions[0]
    pull = 3.0 * np.array([1, -1, -1])
    np.testing.assert_allclose(at("mathiesen", prices) + pull, 0, atol=1e-14)
    np.testing.assert_allclose(at("traffic3", np.array([50.0, 0, 50])), [100, 175, 100], atol=1e-13)
    y = disk2d()
    np.testing.assert_allclose(y, [0.988988885652, 0.147989810655], atol=1e-11)
    np.testing.assert_allclose(at("disk2d", y) + 0.95301552916 * gradient([1, 1], y), 0, atol=1e-10)


def test_simplex_problem_has_seven_solutions_by_enumeration_of_faces():
    # On each face F = μ1 for some μ and Σx = 4; off it F ≥ μ. Every face, many starts, by MINPACK.
    def F(x):
        quadratic = [[3, 2, 0, 0, 2], [2, 0, 0, 0, 1], [3, 1, 0, 0, 2], [1, 0, 0, 0, 3]]
        rest = [[0, 0, 1, 3], [1, 0, 3, 2], [0, 0, 2, 9], [0, 0, 2, 3]]
        squares = np.array([x[0] ** 2, x[0] * x[1], 0, 0, x[1] ** 2])
        return np.array(quadratic) @ squares + np.array(rest) @ x - [6, 2, 9, 3]

    rng, found = np.random.default_rng(0), []
    for face in (np.flatnonzero([(k >> i) & 1 for i in range(4)]) for k in range(1, 16)):

        def equations(p, face=face):
            x = np.zeros(4)
            x[face] = p[:-1]
            return np.append(F(x)[face] - p[-1], x.sum() - 4)

        for _ in range(12):
            p0 = np.append(4 * rng.dirichlet(np.ones(len(face))), 10 * rng.normal())
            p, _, _, _ = scipy.optimize.fsolve(equations, p0, full_output=True, xtol=1e-13)
            x = np.zeros(4)
            x[face] = p[:-1]
            fits = np.max(np.abs(equations(p))) < 1e-9 and x.min() >= 0
            if fits and np.min(F(x) - p[-1]) >= -1e-9:
                found.append(x)
    listed = PROBLEMS["kojshin_simplex"].solutions
    nearest = [int(np.argmin([np.max(np.abs(x - s)) for s in listed])) for x in found]
    assert max(np.max(np.abs(x - listed[k])) for x, k in zip(found, nearest)) < 1e-9
    assert set(nearest) == set(range(7))


@pytest.mark.slow
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


def test_billups_problem_is_solved_by_bracketing_from_any_start():
    # (x − 1)² − 1.01 on [0, ∞) has the root 1 + √1.01; merit functions stall at 0.
    for start in (0.0, 0.5, 3.0, 100.0):
        vi = dvax.solve_vi(lambda y, _: (y - 1.0) ** 2 - 1.01, ORTHANT, jnp.asarray(start))
        assert float(vi.y) == pytest.approx(2.004987562112089, abs=1e-9)


def test_permuted_problem_has_the_permuted_solution():
    F, K, (solution,) = PROBLEMS["expweight_box3"][:3]
    solve = jax.jit(
        lambda order, back: (
            dvax.solve_vi(
                lambda y, at: F(y[at[1]], None)[at[0]], K, jnp.zeros(3), (order, back), tol=1e-11
            ).y
        )
    )
    for order in map(np.array, itertools.permutations(range(3))):
        np.testing.assert_allclose(solve(order, np.argsort(order)), solution[order], atol=1e-9)
