"""A law that may have several solutions is named, and one that has one solution is not."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax.evolution import first_run
from dvax.evolution.several_solutions import warn_of_several_solutions

SPREAD = np.array([[2.0, 1.0, 0.0], [1.0, 2.0, 1.0], [0.0, 1.0, 2.0]])

SETS = {
    "Box": dvax.sets.Box(jnp.full(3, -1.0), jnp.full(3, 2.0)),
    "half-bounded": dvax.sets.Box(jnp.zeros(3), jnp.full(3, jnp.inf)),
    "far Box": dvax.sets.Box(jnp.full(3, 1e5), jnp.full(3, 1e5 + 1e-2)),
    "Simplex": dvax.sets.Simplex(1.0),
    "Ball": dvax.sets.Ball(jnp.zeros(3), 1e-3),
    "Polyhedron": dvax.sets.Polyhedron(jnp.array([[1.0, 2.0, 3.0], [-1.0, 0.0, 0.0]]), jnp.ones(2)),
}


def problem(M, K):
    M = jnp.asarray(M)
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=K,
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: x + u - M @ u,
    )  # fmt: skip


def warn(M, K, size=3, constants=None):
    first_run._SEEN.clear()
    warn_of_several_solutions(problem(M, K), 0.0, jnp.zeros(size), None, constants)


@pytest.mark.slow
@pytest.mark.parametrize("K", SETS.values(), ids=SETS)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_law_with_the_wrong_sign_is_named_with_two_points_that_prove_it(K, scale):
    with pytest.warns(UserWarning, match="is not monotone on K at t = 0. For y ="):
        warn(-scale * SPREAD, K)


@pytest.mark.slow
def test_warning_comes_with_the_first_solution_and_not_with_the_second():
    first_run._SEEN.clear()
    wrong = problem(
        np.array([[1.0, 2.0], [2.0, 1.0]]), dvax.sets.Box(jnp.zeros(2), jnp.full(2, 3.0))
    )
    with pytest.warns(UserWarning, match=r"y = \[0.707, 0\] and z = \[0, 0.707\]"):
        dvax.solve(wrong, jnp.zeros(2), 0.0, 0.1)
    dvax.solve(wrong, jnp.ones(2), 0.0, 0.1)
    first_run._SEEN.clear()
    with pytest.warns(UserWarning, match="is not monotone on K"):
        dvax.ensemble(wrong, jnp.zeros((2, 2)), 0.0, 0.1)


@pytest.mark.parametrize("K", SETS.values(), ids=SETS)
def test_monotone_law_is_not_named(K):
    turn = np.array([[0.0, 5.0, 0.0], [-5.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    for M in (SPREAD, SPREAD + 10.0 * turn, turn, np.ones((3, 3))):
        warn(M, K)


@pytest.mark.slow
def test_law_that_is_monotone_on_the_plane_of_the_set_is_not_named():
    for size in (3, 6, 20):
        warn(np.eye(size) - 3.0, dvax.sets.Simplex(2.0), size)
    for size in range(2, 20):
        equation = dvax.sets.AffineSubspace(jnp.ones((1, size)), jnp.ones(1))
        warn(np.eye(size) - 3.0, equation, size)


@pytest.mark.parametrize("size", [2, 5, 12])
def test_law_on_a_box_with_positive_principal_minors_is_not_named(size):
    """A triangular matrix with a positive diagonal is one, whatever its symmetric part."""
    M = np.eye(size) + 4.0 * np.triu(np.ones((size, size)), 1)
    assert np.linalg.eigvalsh(M + M.T)[0] < 0
    warn(M, dvax.sets.Box(jnp.zeros(size), jnp.ones(size)), size)
    # On another set this is no proof.
    with pytest.warns(UserWarning, match="is not monotone"):
        warn(M, dvax.sets.Ball(jnp.zeros(size), 1.0), size)


def test_declared_modulus_is_believed():
    warn(-SPREAD, SETS["Box"], constants=SimpleNamespace(gamma=1.0))


def test_values_that_are_traced_are_not_examined():
    first_run._SEEN.clear()
    own = problem(-SPREAD, SETS["Box"])
    keys = []
    jax.eval_shape(
        lambda x: keys.append(first_run.key_of_first_run(own, 0.0, x, None)), jnp.zeros(3)
    )
    assert keys == [None]
