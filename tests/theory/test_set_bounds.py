"""Boxes around K contain K, and a region of u that K implies restricts nothing."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax.theory.set_bounds import bounds_of_fixed_set, propagate

ROWS = jnp.ones((1, 3))
SETS = {
    "constrained box": dvax.sets.ConstrainedBox(
        0.0, jnp.inf, ROWS, jnp.array([0.5]), jnp.array([2.0])
    ),
    "polyhedron": dvax.sets.Polyhedron(
        jnp.concatenate([-jnp.eye(3), ROWS]), jnp.array([0.0, 0.0, 0.0, 2.0])
    ),
    "equation": dvax.sets.Polyhedron(-jnp.eye(3), jnp.zeros(3), 2.0 * ROWS, jnp.array([4.0])),
}


def bounds(K, n):
    ends = bounds_of_fixed_set(K, jnp.zeros(n))
    assert ends is not None
    return ends


@pytest.mark.parametrize("name", SETS)
def test_bounds_of_a_budget_are_its_total(name):
    low, high = bounds(SETS[name], 3)
    assert low == pytest.approx(np.zeros(3), abs=1e-11)
    assert high == pytest.approx(np.full(3, 2.0), abs=1e-11)


def test_bounds_of_a_half_space_are_infinite():
    low, high = bounds(dvax.sets.Polyhedron(ROWS, jnp.array([2.0])), 3)
    assert np.isneginf(low).all() and np.isposinf(high).all()


def test_bounds_of_a_ball_of_sums_are_its_radius():
    low, high = bounds(dvax.sets.L1Ball(1.0, 0.5), 2)
    assert low == pytest.approx(np.full(2, 0.5)) and high == pytest.approx(np.full(2, 1.5))


@pytest.mark.parametrize("seed", range(20))
def test_propagated_bounds_contain_every_point_of_the_set(seed):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(4, 3)) * (rng.random((4, 3)) < 0.7)
    y = rng.normal(size=(500, 3))
    lower, upper = np.array([-0.8, -np.inf, -1.0]), np.array([np.inf, 0.9, 1.0])
    low, high = -rng.uniform(0.1, 1.5, 4), rng.uniform(0.1, 1.5, 4)
    low[0], high[1] = -np.inf, np.inf
    sums = y @ rows.T
    inside = ((lower <= y) & (y <= upper)).all(1) & ((low <= sums) & (sums <= high)).all(1)
    sharper = propagate(lower, upper, rows, low, high)
    assert inside.any() and (sharper[0] <= y[inside]).all() and (y[inside] <= sharper[1]).all()
    assert (sharper[0] >= lower).all() and (sharper[1] <= upper).all()


def grazing(K):
    """Two stocks and a consumer that distributes its effort, which is at a limit of K at first."""
    return dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=K,
        f=lambda t, x, u, args: x * (1.0 - 0.5 * x) - 0.3 * x * u,
        h=lambda t, x, u, args: u - (2.0 * u - x),
    )  # fmt: skip


KINDS = {
    "box": dvax.sets.Box(0.0, 1.0),
    "constrained box": dvax.sets.ConstrainedBox(
        0.0, 1.0, jnp.ones((1, 2)), jnp.array([0.0]), jnp.array([1.0])
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", mostly_thorough(KINDS, {"box"}))
def test_region_of_u_that_equals_the_box_around_K_admits_responses_at_its_limits(kind):
    problem, x0 = grazing(KINDS[kind]), jnp.array([2.5, 0.0])
    sol = dvax.solve(problem, x0, 0.0, 1.0, ts=jnp.linspace(0.0, 1.0, 5), rtol=1e-8)
    assert float(sol.us[0].max()) == pytest.approx(1.0) and float(sol.us[0].min()) == 0.0
    region = dict(x=(-0.5, 3.0))
    implied = dvax.verify(problem, x0, 0.0, 1.0, **region).constants
    stated = dvax.verify(problem, x0, 0.0, 1.0, u=(0.0, 1.0), **region).constants
    errors = [dvax.bound_error(problem, sol, c).x for c in (implied, stated)]
    assert np.isfinite(errors[1]).all() and np.array_equal(*errors)


@pytest.mark.slow
def test_region_of_u_that_excludes_responses_bounds_only_up_to_them():
    problem, x0 = grazing(dvax.sets.Box(0.0, 1.0)), jnp.array([2.5, 0.1])
    sol = dvax.solve(problem, x0, 0.0, 1.0, ts=jnp.linspace(0.0, 1.0, 5), rtol=1e-8)
    check = dvax.verify(problem, x0, 0.0, 1.0, x=(-0.5, 3.0), u=(0.0, 0.9))
    bound = dvax.bound_error(problem, sol, check.constants)
    assert np.isinf(bound.x[1:]).all()
    reason = (
        "∞ from t = 0.25 on: the region of the constants may be left after t = 0; up to t = 0.25, u"
    )
    assert reason in repr(bound) and "limits are -inf and 0.9" in bound.why
    free = dvax.bound_error(problem, sol, dvax.verify(problem, x0).constants, initial_error=1e308)
    assert np.isinf(free.x[-1]) and "larger than any number" in repr(free)


MOVING = {
    "constrained box": lambda t, args: dvax.sets.ConstrainedBox(
        jnp.zeros(2), 0.02 + 0.01 * jnp.sin(t) * jnp.ones(2), jnp.ones((1, 2)), jnp.zeros(1),
        (0.05 + t)[None],
    ),
    "ball in the 1-norm": lambda t, args: dvax.sets.L1Ball(jnp.zeros(2), 0.02 + 0.01 * jnp.cos(t)),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", MOVING)
def test_bounds_of_a_moving_set_limit_the_region_of_u(kind):
    problem = grazing(MOVING[kind])
    problem = dvax.Problem(
        A=problem.A, P=problem.P, K=MOVING[kind], f=lambda t, x, u, args: -u * x, h=problem.h
    )
    found = dvax.verify(problem, jnp.ones(2), 0.0, 3.0, x=(0.0, 1.0))
    assert found["ass:f_lipschitz"].status == "proved"
    assert 0.03 <= float(found.constants.alpha_f) <= 0.031


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "total"),
    [((4, 3), lambda t: 1.0 + 0.5 * t), ((4, 3), lambda t: jnp.ones(1) + 0.5 * t),
     ((2, 4, 3), lambda t: jnp.array([[1.0], [2.0]]) + 0.5 * t),
     ((4, 3), lambda t: 1.0 + 0.5 * t * jnp.arange(4.0))],
)  # fmt: skip
def test_speed_of_several_simplices_is_the_norm_of_their_speeds(shape, total):
    """Far from K the projection is a corner: each simplex moves by the change of its total."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Simplex(total(t)),
        f=lambda t, x, u, args: -u, h=lambda t, x, u, args: 0.1 * x,
    )  # fmt: skip
    row = dvax.verify(problem, jnp.zeros(shape), 0.0, 1.0)["ass:time_regularity (i)"]
    z = jnp.zeros(shape).at[..., 0].set(99.0)
    ends = (
        dvax.sets.Simplex(total(t)).project(z, dvax.spaces.Euclidean(shape)) for t in (1.0, 0.0)
    )
    moved_by = float(jnp.linalg.norm(jnp.subtract(*ends)))
    claimed = float(re.search(r"ω_K\(r\) = ([0-9.e+-]+) r", row.why).group(1))
    assert row.status == "proved" and moved_by <= claimed * (1 + 1e-5) <= moved_by * (1 + 2e-5)
