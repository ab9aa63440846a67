"""Plain calls with laws on many sets: neither units nor tight tolerances make a law unsolvable.

Every function and set here is positively homogeneous, so that the solution from s·x₀ with the data s·d
is s times the one from x₀. Matrices, bounds and times are drawn at random.
"""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax import sets

N = 6
SETS = {
    "box": lambda a: sets.Box(-a["size"] * a["d"][:N], a["size"] * a["d"][:N]),
    "ball": lambda a: sets.Ball(jnp.zeros(N), a["size"]),
    "simplex": lambda a: sets.Simplex(a["size"]),
    "l1": lambda a: sets.L1Ball(jnp.zeros(N), a["size"]),
    "ellipsoid": lambda a: sets.Ellipsoid(jnp.zeros(N), a["d"][:N] * a["size"]),
    "cone": lambda a: sets.SecondOrderCone(),
    "half-space": lambda a: sets.HalfSpace(a["G"][0], a["size"]),
    "polyhedron": lambda a: sets.Polyhedron(a["G"], a["size"] * a["d"]),
    "intersection": lambda a: sets.Intersection(
        sets.Box(0.0, a["size"] * a["d"][:N]), sets.HalfSpace(jnp.ones(N), a["size"])
    ),
}


@cache
def problem(name):
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, a: SETS[name](a),
        f=lambda t, x, u, a: a["drive"] * a["size"] * jnp.sin(t * a["rates"]) - u,
        h=lambda t, x, u, a: x - a["M"] @ u,
    )


def data(seed, size=1.0):
    rng = np.random.default_rng(seed)
    R = rng.normal(size=(N, N))
    args = {
        "M": 0.3 * np.eye(N) + 0.3 * (R - R.T) + 0.1 * R @ R.T,
        "G": rng.normal(size=(9, N)),
        "d": rng.uniform(0.3, 1.0, 9),
        "drive": rng.uniform(0.5, 3.0),
        "rates": rng.uniform(0.5, 4.0, N),
        "size": size,
    }
    return size * jnp.asarray(rng.normal(size=N)), {k: jnp.asarray(v) for k, v in args.items()}


def solve(name, seed, size=1.0, rtol=1e-6, t1=2.0, atol=1e-9):
    x0, args = data(seed, size)
    sol = dvax.solve(problem(name), x0, 0.0, t1, args, rtol=rtol, atol=atol * size)
    return np.asarray(sol.xs[-1]) / size, sol


@pytest.mark.parametrize("name", SETS)
def test_solution_does_not_depend_on_units(name):
    x, sol = solve(name, 0)
    for size in (2.0**-20, 2.0**20):
        scaled, run = solve(name, 0, size)
        assert np.abs(scaled - x).max() <= 1e-5 * np.abs(x).max()
        assert int(run.stats["steps"]) <= 1.2 * int(sol.stats["steps"]) + 5


@pytest.mark.parametrize("name", ["simplex", "cone", "polyhedron"])
def test_tight_tolerances_are_reached_for_large_responses(name):
    # The default atol is far below the roundoff of the response here.
    for rtol, t1 in ((1e-6, 60.0), (1e-9, 20.0)):
        x, _ = solve(name, 3, rtol=rtol, t1=t1, atol=1e-12)
        for size in (1.0, 1e6):
            x0, args = data(3, size)
            other = dvax.solve(problem(name), x0, 0.0, t1, args, rtol=rtol, max_steps=20_000)
            assert np.abs(np.asarray(other.xs[-1]) / size - x).max() <= 100 * rtol


@pytest.mark.thorough
@pytest.mark.parametrize("name", SETS)
def test_laws_are_solved_over_a_range_of_units_and_tolerances(name):
    for seed in range(8):
        for rtol in (1e-3, 1e-5, 1e-8, 1e-10):
            for t1 in (0.3, 5.0, 100.0):
                x, sol = solve(name, seed, 1.0, rtol, t1, 1e-3 * rtol)
                for size in (1e-9, 1e3, 1e9):
                    scaled, run = solve(name, seed, size, rtol, t1, 1e-3 * rtol)
                    assert np.abs(scaled - x).max() <= 100 * rtol * max(1.0, np.abs(x).max())
                    assert int(run.stats["steps"]) <= 1.5 * int(sol.stats["steps"]) + 20
