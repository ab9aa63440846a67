"""The speed of a moving set bounds how fast the projection of any point moves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax.theory.set_motion import set_motion
from dvax.theory.system import System

sets, spaces = dvax.sets, dvax.spaces
WEIGHTS = jnp.array([0.2, 1.0, 3.0, 0.7, 1.6])
NORMAL = jnp.array([1.0, -2.0, 0.5, 0.0, 1.5])
SHAPE = jnp.diag(jnp.array([1.0, 4.0, 0.3, 2.0, 0.8])) + 0.1
ONE_ROW = jnp.array([[1.0, 1.0, 1.0, 1.0, 1.0]])
TWO_ROWS = jnp.array([[1.0, -2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.5, 1.0, 0.0]])


def center(t):
    return jnp.array([1.0, -0.5, 2.0, 0.3, 0.0]) * jnp.sin(2.0 * t)


# Moving sets of five unknowns, and the least share of the proved speed that some point attains.
MOVING = {
    "a box": (lambda t: sets.Box(center(t), center(t) + 1.0 + t), 0.9),
    "a ball": (lambda t: sets.Ball(center(t), 1.0 + 0.5 * t), 0.8),
    "a ball in the 1-norm": (lambda t: sets.L1Ball(center(t), 1.0 + 0.5 * t), 0.8),
    "an ellipsoid with radii": (
        lambda t: sets.Ellipsoid(center(t), radii=jnp.arange(1.0, 6.0)), 0.8,
    ),
    "an ellipsoid with a matrix": (lambda t: sets.Ellipsoid(center(t), shape=SHAPE), 0.8),
    "a half-space": (lambda t: sets.HalfSpace(NORMAL, jnp.cos(t)), 0.9),
    "a hyperplane": (lambda t: sets.Hyperplane(1e-200 * NORMAL, 1e-200 * jnp.cos(t)), 0.9),
    "a simplex": (lambda t: sets.Simplex(1.0 + t**2), 0.9),
    "simplices of two sizes": (
        lambda t: sets.Simplex(jnp.stack([1.0 + t, 2.0 - t]), sizes=(2, 3)), 0.6,
    ),
    "simplices of one total": (lambda t: sets.Simplex(1.0 + t, sizes=(3, 2)), 0.6),
    "a translated polyhedron": (
        lambda t: sets.Translated(sets.Polyhedron(TWO_ROWS, jnp.ones(2)), center(t)), 0.2,
    ),
    "a translated ball": (
        lambda t: sets.Translated(sets.Ball(0.0, 1.0 + t), jnp.sin(t)), 0.8,
    ),
    "a box with a moving sum": (
        lambda t: sets.ConstrainedBox(0.0, 1.0, ONE_ROW, (1.0 + t)[None], (1.5 + t)[None]), 0.9,
    ),
    "a moving box with a sum": (
        lambda t: sets.ConstrainedBox(
            0.1 * t, 2.0 + center(t), ONE_ROW, jnp.ones(1), 1.0 + t * jnp.ones(1)
        ), 0.02,
    ),
    "two equations": (
        lambda t: sets.AffineSubspace(TWO_ROWS, jnp.stack([jnp.sin(t), t**2])), 0.6,
    ),
    "a box with two sums": (
        lambda t: sets.ConstrainedBox(
            jnp.full(5, -jnp.inf), 3.0, TWO_ROWS, jnp.stack([jnp.sin(t), jnp.cos(t)]),
            jnp.stack([jnp.sin(t), jnp.cos(t)]),
        ), 0.7,
    ),
}  # fmt: skip
WEIGHTED = ("Euclidean", "weighted")
CASES = [(name, weights) for name in MOVING for weights in WEIGHTED]
ALWAYS = {("simplices of two sizes", "weighted"), ("a moving box with a sum", "weighted"),
          ("a box with two sums", "Euclidean"), ("a half-space", "weighted")}  # fmt: skip


def motion_of(K, space, start):
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=lambda t, args: K(t),
        f=lambda t, x, u, args: x, h=lambda t, x, u, args: u, control_space=space,
    )  # fmt: skip
    return set_motion(System(problem, start, None), 0.0, 1.0, np.zeros(0))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "weights"), mostly_thorough(CASES, ALWAYS))
def test_no_point_moves_faster_than_the_proved_speed(name, weights):
    K, share = MOVING[name]
    space = spaces.Euclidean(5) if weights == "Euclidean" else spaces.L2(WEIGHTS)
    motion = motion_of(K, space, jnp.zeros(5))
    assert motion.is_nonempty and np.isfinite(motion.speed)
    rng = np.random.default_rng(0)
    times = jnp.linspace(0.0, 1.0, 201)
    project = jax.jit(jax.vmap(lambda t, z: K(t).project(z, space), in_axes=(0, None)))
    fastest = 0.0
    for k in range(200):
        z = jnp.asarray(10.0 ** rng.uniform(-1.0, 1.5) * rng.normal(size=5))
        if k < 10:
            z = jnp.zeros(5).at[k // 2].set((-1.0) ** k * 30.0)
        y = np.asarray(project(times, z))
        steps = jax.vmap(space.norm)(jnp.diff(jnp.asarray(y), axis=0))
        fastest = max(fastest, float(jnp.max(steps)) * 200.0)
        assert (y >= np.asarray(motion.low) - 1e-12).all()
        assert (y <= np.asarray(motion.high) + 1e-12).all()
    assert share * motion.speed <= fastest <= motion.speed * (1 + 1e-7) + 1e-9


@pytest.mark.slow
def test_parts_of_a_product_move_independently():
    def K(t):
        return sets.Product(sets.Simplex(1.0 + t), sets.Ball(0.0, 2.0 * t), sets.Box(0.0, 1.0))

    space = spaces.Product(spaces.Euclidean(2), spaces.L2(jnp.ones(3)), spaces.Euclidean(2))
    motion = motion_of(K, space, (jnp.zeros(2), jnp.zeros(3), jnp.zeros(2)))
    assert motion.is_nonempty and motion.speed == pytest.approx(np.sqrt(5.0))


UNKNOWN = {
    "a half-space that turns": lambda t: sets.HalfSpace(jnp.stack([jnp.cos(t), jnp.sin(t)]), 1.0),
    "an ellipsoid that grows": lambda t: sets.Ellipsoid(0.0, radii=1.0 + t),
    "a moving polyhedron": lambda t: sets.Polyhedron(jnp.eye(2), jnp.full(2, 1.0 + t)),
    "rows that share an unknown": lambda t: sets.ConstrainedBox(
        0.0, 1.0, jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.zeros(2), jnp.full(2, 1.0 + t)
    ),
    "rows that change": lambda t: sets.ConstrainedBox(
        0.0, 1.0, jnp.stack([1.0 + t, 1.0])[None], jnp.zeros(1), jnp.ones(1)
    ),
    "a jump": lambda t: sets.Simplex(jnp.where(t < 0.5, 1.0, 2.0)),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", UNKNOWN)
def test_sets_without_a_rule_have_no_finite_speed(name):
    assert motion_of(UNKNOWN[name], spaces.Euclidean(2), jnp.zeros(2)).speed == np.inf


def test_a_sum_that_the_bounds_cannot_reach_is_not_proved_to_be_attained():
    def K(t):
        return sets.ConstrainedBox(0.0, 1.0, ONE_ROW, (4.5 + t)[None], (9.0 + t)[None])

    assert not motion_of(K, spaces.Euclidean(5), jnp.zeros(5)).is_nonempty
