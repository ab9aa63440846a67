"""The normal at a projection, with the multipliers and the slacks of the conditions of the set."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.once import once

import dvax
from dvax import sets
from dvax.evolution.enclosed_projection import rounding_of
from dvax.evolution.interpolated_response import Place
from dvax.sets._face import face

N = 6
SPACES = {
    "Euclidean": dvax.spaces.Euclidean(N),
    "weighted": dvax.spaces.L2(jnp.array([0.3, 1.0, 2.0, 0.7, 1.4, 0.5])),
}


def rows_of(rng, count):
    return rng.normal(size=(count, N))


def constrained_box(rng):
    high = rng.uniform(0.1, 0.4, size=2)
    return sets.ConstrainedBox(
        -rng.uniform(0.1, 1.0, N), rng.uniform(0.1, 1.0, N), rows_of(rng, 2), [-0.3, high[1]], high
    )


SETS = {
    "box": lambda rng: sets.Box(-rng.uniform(0, 1, N), rng.uniform(0, 1, N)),
    "simplex": lambda rng: sets.Simplex(rng.uniform(0.5, 3.0)),
    "simplices": lambda rng: sets.Simplex(rng.uniform(0.5, 3.0, 2), sizes=(2, 4)),
    "L1": lambda rng: sets.L1Ball(rng.normal(size=N), rng.uniform(0.5, 2.0)),
    "half-space": lambda rng: sets.HalfSpace(rng.normal(size=N), rng.normal()),
    "tiny normal": lambda rng: sets.HalfSpace(1e-200 * rng.normal(size=N), 1e-200),
    "hyperplane": lambda rng: sets.Hyperplane(rng.normal(size=N), rng.normal()),
    "affine": lambda rng: sets.AffineSubspace(rows_of(rng, 2), rng.normal(size=2)),
    "polyhedron": lambda rng: sets.Polyhedron(rows_of(rng, 7), rng.uniform(0, 1, 7)),
    "polyhedron with equations": lambda rng: sets.Polyhedron(
        rows_of(rng, 5), rng.uniform(0, 1, 5), rows_of(rng, 2), np.zeros(2)
    ),
    "constrained box": constrained_box,
    "translated": lambda rng: sets.Translated(sets.Simplex(1.0), rng.normal(size=N)),
    "scaled": lambda rng: sets.Scaled(sets.Simplex(1.0), -2.5),
}


@once
def faces():
    return jax.jit(face)


def summed(multipliers, slacks):
    """Σ μᵢsᵢ, with 0 · ∞ = 0."""
    total = 0.0
    for mu, s in zip(multipliers, slacks, strict=True):
        assert (np.asarray(mu) >= 0.0).all() and (np.asarray(s) >= -1e-14).all()
        total += float(np.sum(np.where(np.asarray(mu) > 0.0, mu * s, 0.0)))
    return total


@pytest.mark.slow
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", SETS)
def test_multipliers_and_slacks_give_the_products_of_normals_and_differences(name, space):
    """⟨v, y − y'⟩ = Σ μᵢs'ᵢ for two points of one set, and v = z − y is normal at y."""
    rng, space = np.random.default_rng(0), SPACES[space]
    several = 0
    for _ in range(8):
        K = SETS[name](rng)
        zs = [jnp.asarray(rng.normal(size=N) * size) for size in (0.3, 1.0, 4.0)]
        found = [faces()(K, z, space) for z in zs]
        for z, one in zip(zs, found, strict=True):
            np.testing.assert_allclose(one.y, K.project(z, space), atol=1e-11)
            np.testing.assert_allclose(one.v, z - one.y, atol=1e-11)
            assert summed(one.multipliers, one.slacks) == 0.0
            for other in found:
                gap = summed(one.multipliers, other.slacks)
                np.testing.assert_allclose(space.inner(one.v, one.y - other.y), gap, atol=1e-10)
                several += gap > 1e-3
    assert several > 5 or name in ("hyperplane", "affine")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["box", "simplex", "simplices", "L1", "half-space", "translated"])
def test_slacks_of_a_set_with_other_data_bound_its_products_with_a_normal(name):
    """⟨v, k − y'⟩ ≤ Σ μᵢs'ᵢ for every k of the set with other data, with equality at its support."""
    rng, space = np.random.default_rng(1), SPACES["weighted"]
    normal = rng.normal(size=N)
    for _ in range(8):
        pair = [SETS[name](rng) for _ in range(2)]
        if name == "half-space":
            pair = [sets.HalfSpace(normal, rng.normal()) for _ in range(2)]
        first, other = (faces()(K, 2.0 * rng.normal(size=N), space) for K in pair)
        gap = summed(first.multipliers, other.slacks)
        far = pair[1].project(other.y + 1e6 * first.v, space)
        products = [space.inner(first.v, k - other.y) for k in (far, *_points(pair[1], rng, space))]
        assert max(products) <= gap + 1e-7
        np.testing.assert_allclose(products[0], gap, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["constrained box", "polyhedron"])
def test_error_of_a_projection_is_below_its_rounding_for_rows_that_are_nearly_parallel(kind):
    """y₁ = 0.1 and y₁ + a y₂ = 0.1 + 0.7a for smaller and smaller a."""
    space = dvax.spaces.Euclidean(3)

    @jax.jit
    def projected(a, z):
        R = jnp.stack([jnp.array([1.0, 0.0, 0.0]), jnp.array([1.0, 0.0, 0.0]).at[1].set(a)])
        e = jnp.stack([0.1, 0.1 + 0.7 * a])
        if kind == "polyhedron":
            K = sets.Polyhedron(jnp.concatenate([R, -R]), jnp.concatenate([e, -e]))
        else:
            K = sets.ConstrainedBox(-5.0, 5.0, R, e, e)
        found = face(K, z, space)
        return found.y, rounding_of(K, space, Place(z, found.y, found))

    largest = 0.0
    for a in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        for z in np.random.default_rng(0).normal(size=(10, 3)):
            y, rounding = projected(a, z)
            error = np.linalg.norm(y - np.array([0.1, 0.7, z[2]]))
            assert error <= float(rounding)
            largest = max(largest, error)
    assert kind == "polyhedron" or largest > 1e-9, "the rounding need not depend on a"


def _points(K, rng, space):
    return [K.project(jnp.asarray(3.0 * rng.normal(size=N)), space) for _ in range(5)]
