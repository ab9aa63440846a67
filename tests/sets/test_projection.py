"""proj_K(z) is the one p ∈ K with ⟨z − p, v − p⟩ ≤ 0 for all v ∈ K, in the norm of the space."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import dvax
from dvax import sets, spaces

WEIGHTS = np.array([0.05, 4.0, 1.0])
SPACE = spaces.L2(WEIGHTS)
numbers = st.floats(-50, 50)
vectors = hnp.arrays(float, 3, elements=numbers)


@st.composite
def boxes(draw):
    """Intervals that may be one point, a half line, or the whole line, entry by entry."""
    ends = np.sort(draw(hnp.arrays(float, (2, 3), elements=numbers)), axis=0)
    kind = draw(
        st.lists(
            st.sampled_from(["both", "point", "lower", "upper", "free"]), min_size=3, max_size=3
        )
    )
    low, up = ends.copy()
    for i, k in enumerate(kind):
        low[i] = -np.inf if k in ("upper", "free") else low[i]
        up[i] = {"point": low[i], "lower": np.inf, "free": np.inf}.get(k, up[i])
    return sets.Box(low, up)


balls = st.builds(sets.Ball, vectors.map(jnp.asarray), st.one_of(st.just(0.0), st.floats(1e-3, 60)))
kinds = st.one_of(boxes(), balls, st.just(sets.WholeSpace()))


@jax.jit
def _project(K, z):
    return K.project(z, SPACE)


def project(K, z):
    return np.asarray(_project(K, jnp.asarray(z)))


def norm(v):
    return np.sqrt(np.sum(WEIGHTS * v * v))


@given(kinds, vectors)
@settings(max_examples=150)
def test_projection_lies_in_the_set_and_is_idempotent(K, z):
    p = project(K, z)
    again = project(K, p)
    np.testing.assert_allclose(again, p, rtol=1e-14, atol=1e-12)
    if isinstance(K, sets.Box):
        assert np.all(p >= np.asarray(K.lower)) and np.all(p <= np.asarray(K.upper))
    elif isinstance(K, sets.Ball):
        assert norm(p - np.asarray(K.center)) <= float(K.radius) + 1e-12 * (1 + norm(p))
    else:
        assert np.array_equal(p, z)


@given(kinds, vectors, vectors)
@settings(max_examples=150)
def test_projection_is_nonexpansive(K, a, b):
    assert norm(project(K, a) - project(K, b)) <= norm(a - b) * (1 + 1e-12) + 1e-12


@given(kinds, vectors, vectors)
@settings(max_examples=150)
def test_projection_satisfies_the_variational_inequality(K, z, other):
    """No point of the set makes an acute angle with the residual."""
    p, v = project(K, z), project(K, other)
    angle = np.sum(WEIGHTS * (z - p) * (v - p))
    assert angle <= 1e-11 * (1 + norm(z - p) * (1 + norm(v - p)))


@given(kinds, vectors, vectors)
@settings(max_examples=50)
def test_projection_is_the_nearest_point(K, z, other):
    v = project(K, other)
    assert norm(z - project(K, z)) <= norm(z - v) + 1e-11


def test_projection_onto_ball_is_nearest_in_the_norm_of_the_space():
    # By brute force over the boundary of {‖y‖_w ≤ 1} in the plane: an ellipse, where the Euclidean
    # nearest point is another one.
    w, z = np.array([1.0, 9.0]), np.array([2.0, 1.0])
    space = spaces.L2(w)
    angles = np.linspace(0, 2 * np.pi, 200_001)
    rim = np.stack([np.cos(angles), np.sin(angles) / 3.0], axis=1)
    nearest = rim[np.argmin(np.sum(w * (rim - z) ** 2, axis=1))]
    found = np.asarray(sets.Ball(0.0, 1.0).project(jnp.asarray(z), space))
    np.testing.assert_allclose(found, nearest, atol=1e-4)
    euclidean = np.asarray(sets.Ball(0.0, 1.0).project(jnp.asarray(z), spaces.Euclidean(2)))
    assert np.linalg.norm(found - euclidean) > 0.1


def test_projection_onto_product_acts_part_by_part():
    K = sets.Product(
        sets.Ball(jnp.array([1.0, 0.0]), 2.0), sets.Box(0.0, np.inf), sets.WholeSpace()
    )
    space = spaces.Product(
        spaces.L2(np.array([1.0, 0.25])), spaces.Euclidean(2), spaces.Euclidean()
    )
    z = (jnp.array([1.0, 10.0]), jnp.array([-1.0, 3.0]), jnp.asarray(-7.0))
    ball, box, free = (np.asarray(p) for p in K.project(z, space))
    np.testing.assert_allclose(ball, [1.0, 4.0])  # ‖(0, y)‖ = y/2 in these weights
    np.testing.assert_allclose(box, [0.0, 3.0])
    assert free == -7.0
    # √(‖(0, 6)‖² + 1 + 0) with ‖(0, 6)‖ = 3.
    assert float(K.distance(z, space)) == pytest.approx(np.sqrt(10.0))


def test_set_distance_membership_and_normal_cone_residual():
    K, line = sets.Box(0.0, 1.0), spaces.Euclidean()
    assert float(K.distance(jnp.asarray(3.5), line)) == 2.5
    assert bool(K.contains(jnp.asarray(1.0), line))
    assert not bool(K.contains(jnp.asarray(1.1), line))
    assert bool(K.contains(jnp.asarray(1.1), line, tol=0.2))
    # N_K(1) = [0, ∞), N_K(½) = {0}, N_K(0) = (−∞, 0].
    for y, xi, inside in (
        (1.0, 5.0, True),
        (1.0, -1.0, False),
        (0.5, 0.1, False),
        (0.0, -3.0, True),
    ):
        residual = float(K.normal_cone_residual(jnp.asarray(y), jnp.asarray(xi), line))
        assert (residual == 0.0) is inside


def test_set_intervals_exist_for_pointwise_intervals_only():
    like = jnp.zeros(3)
    low, up = sets.Box(0.0, jnp.array([1.0, 2.0, np.inf])).intervals(like)
    assert np.asarray(low).tolist() == [0.0, 0.0, 0.0]
    assert np.asarray(up).tolist() == [1.0, 2.0, np.inf]
    assert sets.Ball(0.0, 1.0).intervals(like) is None
    pair = sets.Product(sets.Box(0.0, 1.0), sets.Ball(0.0, 1.0))
    assert pair.intervals((like, like)) is None
    both = sets.Product(sets.Box(0.0, 1.0), sets.WholeSpace()).intervals((like, like))
    assert both is not None
    low, up = both
    assert np.all(np.asarray(low[1]) == -np.inf) and np.all(np.asarray(up[0]) == 1.0)


# The convention at kinks: a point exactly on the boundary counts as held by it.


@pytest.mark.parametrize(("z", "slope"), [(-0.1, 0), (0.0, 0), (0.3, 1), (0.5, 0), (0.9, 0)])
def test_box_derivative_on_a_bound_is_the_held_one(z, slope):
    K, line = sets.Box(0.0, 0.5), spaces.Euclidean()
    assert float(jax.grad(lambda z: K.project(z, line))(z)) == slope
    assert float(jax.jvp(lambda z: K.project(z, line), (z,), (1.0,))[1]) == slope


def test_box_derivative_of_held_points_is_that_of_the_bound():
    """An interval of length 0 moves with its lower bound."""
    line = spaces.Euclidean()
    moved = jax.grad(lambda low, up, z: sets.Box(low, up).project(z, line), argnums=(0, 1, 2))
    assert [float(g) for g in moved(0.0, 0.5, 0.5)] == [0.0, 1.0, 0.0]
    assert [float(g) for g in moved(0.0, 0.5, 0.0)] == [1.0, 0.0, 0.0]
    assert [float(g) for g in moved(0.2, 0.2, 0.2)] == [1.0, 0.0, 0.0]


def test_ball_derivative_on_the_boundary_is_the_held_one():
    plane, z = spaces.Euclidean(2), np.array([0.6, 0.8])
    slope = jax.jacfwd(lambda z: sets.Ball(0.0, 1.0).project(z, plane))
    # On the unit circle: I − zzᵀ, the tangential part; inside: I.
    np.testing.assert_allclose(slope(jnp.asarray(z)), np.eye(2) - np.outer(z, z), atol=1e-15)
    np.testing.assert_allclose(slope(jnp.asarray(0.9 * z)), np.eye(2))
    far = 3.0 * z
    np.testing.assert_allclose(
        slope(jnp.asarray(far)), (np.eye(2) - np.outer(z, z)) / 3.0, atol=1e-15
    )
    # A ball of radius 0 is a point, and a point does not move.
    point = jax.jacfwd(lambda z: sets.Ball(jnp.asarray(z * 0 + 1.0), 0.0).project(z, plane))
    assert np.all(np.asarray(point(jnp.ones(2))) == 0.0)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: sets.Box(1.0, 0.0), "lower ≤ upper"),
        (lambda: sets.Box(jnp.array([0.0, 3.0]), jnp.array([1.0, 2.0])), "empty"),
        (lambda: sets.Box(float("nan"), 1.0), "lower"),
        (lambda: sets.Box(np.inf, np.inf), r"\+∞"),
        (lambda: sets.Box(-np.inf, -np.inf), "−∞"),
        (lambda: sets.Ball(0.0, -1.0), "radius"),
        (lambda: sets.Ball(0.0, np.inf), "radius"),
        (lambda: sets.Ball(0.0, np.nan), "radius"),
        (lambda: sets.Ball(jnp.array([np.nan, 0.0]), 1.0), "center"),
        (lambda: sets.Box(jnp.zeros(3), 1.0).check(jnp.zeros(2)), r"\(3,\)"),
        (lambda: sets.Box(0.0, jnp.ones((2, 2))).check(jnp.zeros(2)), r"\(2, 2\)"),
        (lambda: sets.Box(0.0, 1.0).check((jnp.zeros(2), jnp.zeros(3))), "2 parts"),
        (lambda: sets.Ball(jnp.zeros(3), 1.0).check(jnp.zeros(2)), r"\(3,\)"),
        (lambda: sets.Ball(0.0, jnp.ones(2)).check(jnp.zeros(2)), "radius"),
        (lambda: sets.Product(sets.Box(0.0, 1.0)).check(jnp.zeros(2)), "1 parts"),
    ],
)
def test_sets_reject_empty_or_misshapen_data(make, word):
    with pytest.raises(dvax.InputError, match=word):
        make()


@pytest.mark.parametrize(
    "K",
    [
        lambda a: sets.Box(a, -a),
        lambda a: sets.Box(0.0, a * np.nan),
        lambda a: sets.Ball(0.0, -a),
        lambda a: sets.Ball(a * np.nan, 1.0),
    ],
)
def test_projection_onto_an_empty_set_under_jit_is_nan(K):
    # Nothing can be raised there, so that what comes out must not look like a solution.
    found = jax.jit(lambda a, z: K(a).project(z, spaces.Euclidean(2)))(1.0, jnp.array([0.1, 0.2]))
    assert not np.any(np.isfinite(np.asarray(found)))


def test_projection_propagates_nan():
    plane, z = spaces.Euclidean(2), jnp.array([np.nan, 0.1])
    for K in (sets.Box(0.0, 1.0), sets.Ball(0.0, 1.0), sets.WholeSpace()):
        assert np.isnan(np.asarray(K.project(z, plane))[0])
