"""Empty, inconsistent or misshapen sets are rejected before a run."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

import dvax
from dvax import sets

SQUARE = np.vstack([np.eye(2), -np.eye(2)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: sets.HalfSpace(np.zeros(2), 1.0), "not zero"),
        (lambda: sets.HalfSpace(np.ones(2), np.inf), "finite"),
        (lambda: sets.HalfSpace(np.ones(3), 1.0).check(jnp.zeros(2)), r"\(3,\)"),
        (lambda: sets.Hyperplane(np.array([np.nan, 1.0]), 1.0), "normal"),
        (lambda: sets.AffineSubspace(np.ones((2, 2)), np.array([0.0, 1.0])), "empty"),
        (lambda: sets.AffineSubspace(np.zeros((1, 2)), np.ones(1)), "empty"),
        (lambda: sets.AffineSubspace(np.ones((2, 2)), np.ones(3)), "one row"),
        (lambda: sets.AffineSubspace(np.ones((1, 3)), np.ones(1)).check(jnp.zeros(2)), "row"),
        (lambda: sets.Simplex(-1.0), "total"),
        (lambda: sets.Simplex(1.0, sizes=(2, 0)), "≥ 1"),
        (lambda: sets.Simplex(1.0, sizes=()), "≥ 1"),
        (lambda: sets.Simplex(np.ones(3), sizes=(2, 1)), "3"),
        (lambda: sets.Simplex(1.0, sizes=(2, 1)).check(jnp.zeros(2)), "3 entries"),
        (lambda: sets.Simplex(1.0).check(jnp.zeros(())), "last axis"),
        (lambda: sets.Simplex(np.ones(3)).check(jnp.zeros((2, 2))), "totals"),
        (lambda: sets.L1Ball(0.0, -1.0), "radius"),
        (lambda: sets.L1Ball(np.zeros(3), 1.0).check(jnp.zeros(2)), r"\(3,\)"),
        (lambda: sets.SecondOrderCone(0.0), "slope"),
        (lambda: sets.SecondOrderCone().check(jnp.zeros(1)), "two entries"),
        (lambda: sets.Ellipsoid(0.0), "neither"),
        (lambda: sets.Ellipsoid(0.0, radii=np.array([1.0, 0.0])), "half-axes"),
        (lambda: sets.Ellipsoid(0.0, shape=np.diag([1.0, -1.0])), "positive definite"),
        (lambda: sets.Ellipsoid(0.0, shape=np.array([[1.0, 0.2], [0.0, 1.0]])), "symmetric"),
        (lambda: sets.Ellipsoid(0.0, shape=np.eye(3)).check(jnp.zeros(2)), r"\(3, 3\)"),
        (
            lambda: sets.ConstrainedBox(
                0.0, 1.0, np.ones((1, 2)), np.array([3.0]), np.array([4.0])
            ),
            "is 1",
        ),
        (lambda: sets.ConstrainedBox(1.0, 0.0, np.ones((1, 2)), np.zeros(1), np.ones(1)), "upper"),
        (lambda: sets.ConstrainedBox(0.0, 1.0, np.ones((1, 2)), np.ones(1), np.zeros(1)), "high"),
        (lambda: sets.ConstrainedBox(0.0, 1.0, np.ones((1, 2)), np.zeros(2), np.ones(2)), "rows"),
        (
            lambda: sets.ConstrainedBox(
                np.zeros(3), 1.0, np.ones((1, 2)), np.zeros(1), np.ones(1)
            ).check(jnp.zeros(2)),
            "columns",
        ),
        (
            lambda: sets.ConstrainedBox(0.0, 1.0, np.ones((1, 3)), np.zeros(1), np.ones(1)).check(
                jnp.zeros(2)
            ),
            "columns",
        ),
        (lambda: sets.Polyhedron(SQUARE, -np.ones(4)), "is at least 1"),
        (lambda: sets.Polyhedron(np.zeros((1, 2)), -np.ones(1)), "no y satisfies row 0 of G"),
        (lambda: sets.Polyhedron(SQUARE, np.array([1.0, 1, 1, -np.inf])), "of d is −∞"),
        (lambda: sets.Polyhedron(SQUARE, np.array([1.0, 1, 1, np.nan])), "must not be NaN"),
        (lambda: sets.Polyhedron(SQUARE, np.ones(4), np.ones((1, 2))), "both"),
        (
            lambda: sets.Polyhedron(SQUARE, np.ones(4), np.ones((1, 2)), np.array([3.0])),
            "and E y = e",
        ),
        (
            lambda: sets.Polyhedron(SQUARE, np.ones(4), np.ones((2, 2)), np.array([0.0, 1.0])),
            "contradict",
        ),
        (lambda: sets.Polyhedron(SQUARE, np.ones(4)).check(jnp.zeros(3)), r"\(4, 2\)"),
        (lambda: sets.Intersection(), "no sets"),
        (
            lambda: sets.Intersection(sets.Box(0.0, 1.0), sets.Box(2.0, 3.0)).check(jnp.zeros(2)),
            "empty",
        ),
        (lambda: sets.Translated(sets.Box(0.0, 1.0), np.inf), "must be finite"),
        (lambda: sets.Translated(sets.Simplex(1.0), np.ones(3)).check(jnp.zeros(2)), r"\(3,\)"),
        (lambda: sets.Scaled(sets.Box(0.0, 1.0), 0.0), "not 0"),
        (lambda: sets.Scaled(sets.Box(0.0, 1.0), np.ones(2)), "one number"),
    ],
)
def test_empty_or_inconsistent_sets_are_rejected_by_name(make, word):
    with pytest.raises(dvax.InputError, match=word):
        make()


def test_the_rows_that_contradict_each_other_are_named():
    """Rows g and −g with a gap between them, hidden among rows of a large cube."""
    rng = np.random.default_rng(0)
    for n, extra in itertools.product((2, 5, 9), (0, 3, 20)):
        g = rng.normal(size=n)
        others = rng.normal(size=(extra, n))
        rows, bounds = (
            np.concatenate([others, [g, -g]]),
            np.append(np.full(extra, 1e3), [1.0, -1.1]),
        )
        order = rng.permutation(extra + 2)
        guilty = ", ".join(map(str, sorted(np.flatnonzero(order >= extra))))
        with pytest.raises(dvax.InputError, match=f"no y satisfies rows {guilty} of G:"):
            sets.Polyhedron(rows[order], bounds[order])
