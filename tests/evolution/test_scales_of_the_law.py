"""Plain calls with laws on many sets: neither units nor tight tolerances make a law unsolvable.

The state has the unit `size` and the response the unit `unit`: in these units, the solution is always
the same. Matrices, bounds and times are drawn at random.
"""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax import sets

N = 6
SETS = {
    "box": lambda a: sets.Box(-a["unit"] * a["d"][:N], a["unit"] * a["d"][:N]),
    "ball": lambda a: sets.Ball(jnp.zeros(N), a["unit"]),
    "simplex": lambda a: sets.Simplex(a["unit"]),
    "l1": lambda a: sets.L1Ball(jnp.zeros(N), a["unit"]),
    "ellipsoid": lambda a: sets.Ellipsoid(jnp.zeros(N), a["d"][:N] * a["unit"]),
    "cone": lambda a: sets.SecondOrderCone(),
    "half-space": lambda a: sets.HalfSpace(a["G"][0], a["unit"]),
    "polyhedron": lambda a: sets.Polyhedron(a["G"], a["unit"] * a["d"]),
    "constrained box": lambda a: sets.ConstrainedBox(
        -a["unit"] * a["d"][:N],
        a["unit"],
        a["G"][:3],
        -a["unit"] * a["d"][:3],
        a["unit"] * a["d"][3:6],
    ),
    "intersection": lambda a: sets.Intersection(
        sets.Box(0.0, a["unit"] * a["d"][:N]), sets.HalfSpace(jnp.ones(N), a["unit"])
    ),
}


@cache
def problem(name):
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, a: SETS[name](a),
        f=lambda t, x, u, a: a["size"] * (a["drive"] * jnp.sin(t * a["rates"]) - u / a["unit"]),
        h=lambda t, x, u, a: a["unit"] / a["size"] * x - a["M"] @ u,
    )


def data(seed, size=1.0, unit=None):
    rng = np.random.default_rng(seed)
    R = rng.normal(size=(N, N))
    args = {
        "M": 0.3 * np.eye(N) + 0.3 * (R - R.T) + 0.1 * R @ R.T,
        "G": rng.normal(size=(9, N)),
        "d": rng.uniform(0.3, 1.0, 9),
        "drive": rng.uniform(0.5, 3.0),
        "rates": rng.uniform(0.5, 4.0, N),
        "size": size,
        "unit": size if unit is None else unit,
    }
    return size * jnp.asarray(rng.normal(size=N)), {k: jnp.asarray(v) for k, v in args.items()}


def solve(name, seed, size=1.0, rtol=1e-6, t1=2.0, atol=1e-9, unit=None):
    x0, args = data(seed, size, unit)
    sol = dvax.solve(problem(name), x0, 0.0, t1, args, rtol=rtol, atol=atol * size)
    return np.asarray(sol.xs[-1]) / size, sol


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(SETS, {"polyhedron", "constrained box"}))
def test_solution_does_not_depend_on_units(name):
    x, sol = solve(name, 0)
    for size, unit in ((1e-6, 1e-6), (1e6, 1e6), (1.0, 1e-6), (1e6, 1e-3), (1e-3, 1e5)):
        scaled, run = solve(name, 0, size, unit=unit)
        assert np.abs(scaled - x).max() <= 1e-5 * np.abs(x).max()
        assert int(run.stats["steps"]) <= 1.2 * int(sol.stats["steps"]) + 5


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(["simplex", "cone", "polyhedron"], {"simplex"}))
def test_tight_tolerances_are_reached_for_large_responses(name):
    # The default atol is far below the roundoff of the response here.
    for rtol, t1 in ((1e-6, 60.0), (1e-9, 20.0)):
        x, _ = solve(name, 3, rtol=rtol, t1=t1, atol=1e-12)
        for size in (1.0, 1e6):
            x0, args = data(3, size)
            other = dvax.solve(problem(name), x0, 0.0, t1, args, rtol=rtol, max_steps=20_000)
            assert np.abs(np.asarray(other.xs[-1]) / size - x).max() <= 100 * rtol


RATES = {
    "zero": lambda t, x, u, a: (jnp.sin(t) - jnp.sum(u)) * jnp.ones(N),
    "independent": lambda t, x, u, a: jnp.cos(t) * jnp.ones(N),
}
OPTIONS = {"fixed": {"dt": 0.1}, "order 5": {"dt": 0.1, "method": dvax.DormandPrince()}, "none": {}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "options"),
    mostly_thorough(
        [(rate, options) for rate in RATES for options in OPTIONS],
        {("independent", "none")},
    ),
)
def test_law_is_solved_if_the_state_is_zero_or_does_not_depend_on_the_response(rate, options):
    _, args = data(0)
    made = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=SETS["simplex"](args),
        f=RATES[rate], h=lambda t, x, u, a: x - a["M"] @ u,
    )  # fmt: skip
    sol = dvax.solve(made, jnp.zeros(N), 0.0, 1.0, args, ts=[0.0, 1.0], **OPTIONS[options])
    for x, u in zip(sol.xs, sol.us, strict=True):
        np.testing.assert_allclose(u, made.response(1.0, x, args), atol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("name", SETS)
def test_laws_are_solved_over_a_range_of_units_and_tolerances(name):
    for seed in range(8):
        for rtol in (1e-3, 1e-5, 1e-8, 1e-10):
            for t1 in (0.3, 5.0, 100.0):
                x, sol = solve(name, seed, 1.0, rtol, t1, 1e-3 * rtol)
                for size, unit in ((1e-9, 1e-9), (1e9, 1e9), (1e6, 1e-5), (1e-4, 1e6)):
                    scaled, run = solve(name, seed, size, rtol, t1, 1e-3 * rtol, unit)
                    assert np.abs(scaled - x).max() <= 100 * rtol * max(1.0, np.abs(x).max())
                    assert int(run.stats["steps"]) <= 1.5 * int(sol.stats["steps"]) + 20
