"""Kinks, degenerate sets, distant points, and sets that are empty under tracing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax import sets, spaces

PLANE = spaces.Euclidean(2)
UNEVEN = spaces.L2(np.array([1.0, 4.0]))
SQUARE = np.vstack([np.eye(2), -np.eye(2)])


def slope(K, z, space=PLANE):
    return np.asarray(jax.jit(jax.jacfwd(lambda v: K.project(v, space)))(jnp.asarray(z)))


def tangent(*normals):
    """The projection onto the orthogonal complement of the active normals."""
    rows = np.array(normals, float)
    return np.eye(rows.shape[1]) - np.linalg.pinv(rows) @ rows


ON_THE_EDGE = {
    "half-space": (sets.HalfSpace(np.array([1.0, 1.0]), 1.0), [0.5, 0.5], [[1, 1]]),
    "simplex": (sets.Simplex(1.0), [1.0, 0.0], [[1, 0], [0, 1]]),
    "ℓ1 ball": (sets.L1Ball(0.0, 1.0), [0.25, 0.75], [[1, 1]]),
    "cone": (sets.SecondOrderCone(), [1.0, 1.0], [[1, -1]]),
    "apex": (sets.SecondOrderCone(), [0.0, 0.0], [[1, 0], [0, 1]]),
    "polyhedron": (sets.Polyhedron(SQUARE, np.ones(4)), [1.0, 0.5], [[1, 0]]),
    "corner": (sets.Polyhedron(SQUARE, np.ones(4)), [1.0, 1.0], [[1, 0], [0, 1]]),
    "moved": (sets.Translated(sets.Polyhedron(SQUARE, np.ones(4)), 1.0), [2.0, 0.5], [[1, 0]]),
    "intersection": (
        sets.Intersection(sets.Box(0.0, 1.0), sets.HalfSpace(np.array([1.0, 1.0]), 9.0)),
        [1.0, 0.5],
        [[1, 0]],
    ),
}


@pytest.mark.parametrize("name", mostly_thorough(ON_THE_EDGE, ["half-space", "apex"]))
def test_projection_derivative_on_the_boundary_is_the_held_one(name):
    K, z, normals = ON_THE_EDGE[name]
    np.testing.assert_allclose(np.asarray(K.project(jnp.asarray(z), PLANE)), z, atol=1e-15)
    np.testing.assert_allclose(slope(K, z), tangent(*normals), atol=1e-12)


@pytest.mark.thorough
def test_ellipsoid_derivative_on_the_boundary_is_tangential():
    K = sets.Ellipsoid(0.0, radii=jnp.array([2.0, 1.0]))
    s = slope(K, [2.0, 0.0])
    np.testing.assert_allclose(s[0], [0.0, 0.0], atol=1e-12)
    turned = sets.Ellipsoid(0.0, shape=np.diag([4.0, 1.0]))
    np.testing.assert_allclose(slope(turned, [2.0, 0.0]), s, atol=1e-12)


def test_projection_derivative_in_the_data_of_held_points():
    z = jnp.array([2.0, 2.0])
    compiled = lambda first: jax.jit(jax.grad(first))  # noqa: E731
    edge = compiled(lambda b: sets.HalfSpace(jnp.ones(2), b).project(z, PLANE)[0])
    assert float(edge(1.0)) == pytest.approx(0.5)
    total = compiled(lambda t: sets.Simplex(t).project(jnp.array([3.0, 0.0]), PLANE)[0])
    assert float(total(1.0)) == pytest.approx(1.0)
    assert float(total(0.0)) == pytest.approx(1.0)  # to the right: on the largest
    twice = np.array([[1.0, 0.0], [2.0, 0.0]])
    shared = compiled(lambda d: sets.Polyhedron(twice, d).project(z, PLANE)[0])
    np.testing.assert_allclose(shared(jnp.array([1.0, 2.0])), [0.5, 0.25])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["inequality", "equation"])
def test_at_a_vertex_that_a_row_and_all_bounds_share_the_row_moves_the_point(kind):
    # A shared limit that is a multiple of the single ones: y = 1 for the k largest z/w, else 0.
    n = 8
    rng = np.random.default_rng(5)
    space, rows = spaces.L2(np.exp(rng.normal(size=n))), np.ones((1, n))

    def project(z, upper, limit, row):
        low = limit if kind == "equation" else jnp.array([-jnp.inf])
        return sets.ConstrainedBox(0.0, upper, row, low, limit).project(z, space)

    derivative = jax.jit(jax.jacfwd(project, (1, 2)))
    onto = jax.jit(project)
    for scale in ([1.0] * n, rng.uniform(0.5, 2.0, n)):
        row = jnp.asarray(rows * scale)
        for k in (1, 3, n):
            z = jnp.asarray(30.0 * np.where(np.arange(n) < k, 1.0, -1.0) + rng.normal(size=n))
            z, upper = jnp.asarray(rng.permutation(z)), jnp.ones(n)
            limit = row @ jnp.where(z > 0, 1.0, 0.0)
            of_upper, of_limit = derivative(z, upper, limit, row)
            y = onto(z, upper, limit, row)
            np.testing.assert_allclose(y, np.where(z > 0, 1.0, 0.0), atol=1e-12)
            np.testing.assert_allclose(row @ of_limit, 1.0, rtol=1e-9)
            np.testing.assert_allclose(row @ of_upper, 0.0, atol=1e-9)
            step = -1e-4
            tightened = (onto(z, upper, limit + step, row) - y) / step
            np.testing.assert_allclose(of_limit[:, 0], tightened, atol=1e-7)


@pytest.mark.thorough
def test_projection_second_derivatives_are_those_of_the_face():
    K, z = sets.Ellipsoid(0.0, radii=jnp.array([2.0, 1.0])), jnp.array([3.0, 2.0])
    one = lambda v: K.project(v, UNEVEN)[0]  # noqa: E731
    exact = np.asarray(jax.hessian(one)(z))
    step = 1e-5
    gradient = jax.jit(jax.grad(one))
    for i, e in enumerate(np.eye(2)):
        central = (gradient(z + step * e) - gradient(z - step * e)) / (2 * step)
        np.testing.assert_allclose(exact[i], central, rtol=1e-5, atol=1e-8)
    flat = sets.Polyhedron(SQUARE, np.ones(4))
    assert np.all(np.asarray(jax.hessian(lambda v: flat.project(v, UNEVEN)[0])(z)) == 0.0)


DEGENERATE = {
    "total 0": (sets.Simplex(0.0), [1.0, -2.0], [0.0, 0.0]),
    "radius 0": (sets.L1Ball(jnp.array([1.0, 2.0]), 0.0), [5.0, 5.0], [1.0, 2.0]),
    "one entry a simplex": (sets.Simplex(2.0, sizes=[1, 1]), [-3.0, 9.0], [2.0, 2.0]),
    "equal entries": (sets.Simplex(1.0), [7.0, 7.0], [0.5, 0.5]),
    "one point": (
        sets.Polyhedron(SQUARE, np.array([0.3, 0.1, -0.3, -0.1])), [5.0, -7.0], [0.3, 0.1]),
    "repeated rows": (
        sets.Polyhedron(np.vstack([SQUARE, SQUARE, 3 * SQUARE]), np.r_[np.ones(8), 3 * np.ones(4)]),
        [5.0, -7.0], [1.0, -1.0]),
    "a row of nothing": (
        sets.Polyhedron(np.array([[0.0, 0.0], [1.0, 0.0]]), np.ones(2)), [5.0, 4.0], [1.0, 4.0]),
    "a free row": (
        sets.Polyhedron(np.eye(2), np.array([np.inf, 1.0])), [5.0, 4.0], [5.0, 1.0]),
    "more rows than a corner needs": (
        sets.Polyhedron(np.array([[1.0, 0], [0, 1], [1, 1], [1, 2]]), np.array([1.0, 1, 2, 3])),
        [3.0, 4.0], [1.0, 1.0]),
    "repeated equations": (
        sets.AffineSubspace(np.array([[1.0, 1.0], [2.0, 2.0]]), np.array([1.0, 2.0])),
        [2.0, 1.0], [1.0, 0.0]),
    "an inequality along an equation": (
        sets.Polyhedron(np.array([[1.0, 1.0]]), np.array([1.0]), np.array([[1.0, 1.0]]),
                        np.array([1.0])), [2.0, 1.0], [1.0, 0.0]),
    "one common point": (
        sets.Intersection(sets.Box(0.0, 1.0), sets.HalfSpace(-np.ones(2), -2.0)),
        [0.0, 0.5], [1.0, 1.0]),
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("name", mostly_thorough(DEGENERATE, list(DEGENERATE)[1::3]))
def test_projection_onto_degenerate_sets(name):
    K, z, exact = DEGENERATE[name]
    found = np.asarray(jax.jit(lambda z: K.project(z, PLANE))(jnp.asarray(z)))
    np.testing.assert_allclose(found, exact, atol=1e-11)
    assert np.all(np.isfinite(slope(K, z)))


@pytest.mark.thorough
@pytest.mark.parametrize("unit", mostly_thorough([1e-8, 1e8], [1e-8]))
def test_projection_is_scale_invariant(unit):
    z = np.array([3.0, 1.0])
    S = np.array([[2.0, 0.3], [0.3, 0.5]])

    def make(u):
        return [
            sets.HalfSpace(np.array([1.0, 2.0]), u),
            sets.AffineSubspace(np.array([[1.0, 2.0]]) / u, np.ones(1)),
            sets.Simplex(u),
            sets.L1Ball(0.0, u),
            sets.SecondOrderCone(0.5),
            sets.Ellipsoid(0.0, radii=jnp.array([1.0, 0.3]) * u),
            sets.Ellipsoid(0.0, shape=S * u * u),
            sets.Polyhedron(SQUARE / u, np.ones(4)),
            sets.Polyhedron(SQUARE, np.ones(4) * u, np.ones((1, 2)), np.array([u])),
        ]

    for K, scaled in zip(make(1.0), make(unit), strict=True):
        expected = np.asarray(K.project(jnp.asarray(z), UNEVEN))
        found = np.asarray(scaled.project(jnp.asarray(unit * z), UNEVEN)) / unit
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("space", [PLANE, UNEVEN], ids=["plain", "weighted"])
def test_projection_of_distant_points_keeps_all_digits(space):
    z = jnp.array([1e8, 1e8 + 1.0])
    p = np.asarray(sets.Simplex(3.0).project(z, space))
    assert p.sum() == pytest.approx(3.0, abs=1e-14)
    corner = sets.Polyhedron(SQUARE, np.array([0.1, 0.2, 0.0, 0.0])).project(z, space)
    np.testing.assert_allclose(np.asarray(corner), [0.1, 0.2], rtol=1e-14)
    far = sets.Ellipsoid(0.0, radii=1.0).project(z, PLANE)
    np.testing.assert_allclose(np.asarray(far), np.sqrt(0.5), rtol=1e-8)


SIDES = np.vstack([np.eye(6), -np.eye(6), np.ones((1, 6))])
ROWS = np.random.default_rng(3).normal(size=(3, 6))
# name: (set of size one, the largest distance, digits of the conditions there)
FAR_AWAY = {
    "one row": (
        sets.ConstrainedBox(0.0, 0.2, np.ones((1, 6)), np.zeros(1), np.full(1, 0.5)), 1e60, 1e-11,
    ),
    "an equation": (
        sets.ConstrainedBox(0.0, 0.2, np.ones((1, 6)), np.full(1, 0.5), np.full(1, 0.5)), 1e60, 1e-11,
    ),
    "three rows": (
        sets.ConstrainedBox(-1.0, 1.0, ROWS, np.full(3, -0.5), np.full(3, 0.3)), 1e12, 1e-10,
    ),
    "half-open": (
        sets.ConstrainedBox(0.0, np.inf, np.abs(ROWS[:2]), np.full(2, -np.inf), np.ones(2)),
        1e12, 1e-10,
    ),
    "polyhedron": (sets.Polyhedron(SIDES, np.append(np.ones(12), 1.0)), 1e18, 1e-13),
    "equations": (
        sets.Polyhedron(SIDES[:12], np.ones(12), np.ones((1, 6)), np.array([0.5])), 1e12, 1e-13,
    ),
    "simplex": (sets.Simplex(1.0), 1e18, 1e-13),
    "ℓ1 ball": (sets.L1Ball(0.0, 1.0), 1e18, 1e-13),
    "ball": (sets.Ball(0.0, 1.0), 1e18, 1e-13),
    "ellipsoid": (sets.Ellipsoid(0.0, radii=np.geomspace(0.01, 1.0, 6)), 1e18, 1e-13),
    "intersection": (
        sets.Intersection(sets.Box(-1.0, 1.0), sets.HalfSpace(np.ones(6), 1.0)), 1e6, 1e-3,
    ),
    "two balls": (
        sets.Intersection(sets.Ball(0.0, 1.0), sets.Ball(np.eye(6)[0] * 1.5, 1.0)), 1e5, 1e-4,
    ),
    "ball and half-space": (
        sets.Intersection(sets.Ball(0.0, 1.0), sets.HalfSpace(np.ones(6), 0.5)), 1e6, 1e-3,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", FAR_AWAY)
def test_projection_from_any_distance_is_in_the_set_and_nearest(name):
    """⟨z − y, v − y⟩ ≤ 0 for v in K, and y is its own projection, up to roundoff of z in the first and
    up to roundoff of y in the second."""
    K, farthest, digits = FAR_AWAY[name]
    rng = np.random.default_rng(0)
    distances = np.geomspace(1.0, farthest, 40)[:, None]
    # Half of the points lie in all directions, the others have entries that almost agree.
    agreeing = 1.0 + rng.uniform(size=(20, 6)) * 10.0 ** rng.uniform(-16, 0, size=(20, 1))
    z = distances * np.stack([rng.normal(size=(20, 6)), agreeing], axis=1).reshape(40, 6)
    project = jax.jit(jax.vmap(lambda v: K.project(v, spaces.Euclidean(6))))
    y, others = np.asarray(project(z)), np.asarray(project(rng.normal(size=(40, 6))))
    np.testing.assert_allclose(np.asarray(project(y)), y, atol=digits, rtol=0)
    steps = others[None, :, :] - y[:, None, :]
    lengths = np.linalg.norm(z - y, axis=1)[:, None] * (1.0 + np.linalg.norm(steps, axis=2))
    ahead = np.einsum("ijk,ik->ij", steps, z - y)
    assert np.all(ahead <= max(1e-2 * digits, 1e-11) * lengths)


TURNS_OUT_EMPTY = {
    "half-space": lambda a: sets.HalfSpace(0.0 * a * jnp.ones(2), 1.0),
    "hyperplane": lambda a: sets.Hyperplane(0.0 * a * jnp.ones(2), 0.0),
    "equations": lambda a: sets.AffineSubspace(jnp.ones((2, 2)), jnp.array([0.0, 1.0]) * a),
    "simplex": lambda a: sets.Simplex(-a),
    "simplices": lambda a: sets.Simplex(-a, sizes=(1, 1)),
    "ℓ1 ball": lambda a: sets.L1Ball(0.0, -a),
    "cone": lambda a: sets.SecondOrderCone(-a),
    "radii": lambda a: sets.Ellipsoid(0.0, radii=-a),
    "matrix": lambda a: sets.Ellipsoid(0.0, shape=jnp.diag(jnp.array([1.0, -1.0])) * a),
    "polyhedron": lambda a: sets.Polyhedron(SQUARE, -a * jnp.ones(4)),
    "polyhedron, equations": lambda a: sets.Polyhedron(
        SQUARE, a * jnp.ones(4), jnp.ones((2, 2)), jnp.array([0.0, 1.0]) * a
    ),
    "polyhedron, both": lambda a: sets.Polyhedron(
        SQUARE, a * jnp.ones(4), jnp.ones((1, 2)), 9.0 * a * jnp.ones(1)
    ),
    "scaled": lambda a: sets.Scaled(sets.Box(0.0, 1.0), 0.0 * a),
    "intersection": lambda a: sets.Intersection(
        sets.Box(0.0, a), sets.HalfSpace(-jnp.ones(2), -3.0 * a), max_cycles=200
    ),
}


@pytest.mark.parametrize("name", mostly_thorough(TURNS_OUT_EMPTY, list(TURNS_OUT_EMPTY)[::2]))
def test_projection_onto_a_traced_empty_set_is_nan(name):
    found = jax.jit(lambda a, z: TURNS_OUT_EMPTY[name](a).project(z, PLANE))(
        1.0, jnp.array([0.1, 0.2])
    )
    assert np.all(np.isnan(np.asarray(found)))


def test_moving_set_works_in_a_problem():
    def K(t, args):
        return sets.Polyhedron(jnp.ones((1, 2)), args["cap"] + t)

    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=K,
        f=lambda t, x, u, args: u,
        h=lambda t, x, u, args: 2.0 + x - u,
    )
    cap = jax.jit(lambda c: problem.response(0.5, jnp.zeros(2), {"cap": c[None]})[0])
    assert float(cap(jnp.asarray(0.5))) == pytest.approx(0.5)
    assert float(jax.grad(cap)(jnp.asarray(0.5))) == pytest.approx(0.5)


def test_intervals_of_translated_scaled_and_intersected_boxes():
    like, box = jnp.zeros(2), sets.Box(0.0, 1.0)
    ends = lambda K: [np.asarray(e).tolist() for e in K.intervals(like)]  # noqa: E731
    assert ends(sets.Translated(box, 1.0)) == [[1.0, 1.0], [2.0, 2.0]]
    assert ends(sets.Scaled(box, -2.0)) == [[-2.0, -2.0], [0.0, 0.0]]
    assert ends(sets.Intersection(box, sets.Box(0.5, 3.0))) == [[0.5, 0.5], [1.0, 1.0]]
    for K in (sets.Translated(sets.Simplex(1.0), 1.0), sets.Scaled(sets.Simplex(1.0), 1.0)):
        assert K.intervals(like) is None
    assert sets.Intersection(box, sets.Simplex(1.0)).intervals(like) is None


def test_half_space_over_a_tuple_couples_its_parts():
    space = spaces.Product(PLANE, spaces.L2(np.array([4.0])))
    K = sets.HalfSpace((np.array([1.0, 0.0]), np.array([2.0])), 0.0)
    z = (jnp.array([2.0, 5.0]), jnp.array([1.0]))
    K.check(z)
    # Σ a²/w = 1 + 1, the excess 4: a step of 2 along a/w = (1, 0; ½).
    p = K.project(z, space)
    np.testing.assert_allclose(np.concatenate([np.asarray(q) for q in p]), [0.0, 5.0, 0.0])
    both = sets.Intersection(K, sets.Product(sets.Box(0.5, 9.0), sets.WholeSpace()))
    q = both.project(z, space)
    assert float(K.distance(q, space)) < 1e-9 and float(q[0][0]) == pytest.approx(0.5)


def test_cones_and_simplices_use_the_last_axis():
    z = np.random.default_rng(0).normal(size=(2, 3, 4))
    whole, part = spaces.L2(np.ones((2, 3, 4)) * [1.0, 2, 3, 4]), spaces.L2(np.arange(1.0, 5))
    for K, one in (
        (sets.Simplex(jnp.ones((2, 1))), sets.Simplex(1.0)),
        (sets.SecondOrderCone(jnp.full(3, 0.5)), sets.SecondOrderCone(0.5)),
    ):
        K.check(jnp.asarray(z))
        found = np.asarray(jax.jit(lambda v, K=K: K.project(v, whole))(jnp.asarray(z)))
        alone = jax.jit(lambda v, K=one: K.project(v, part))
        for row in np.ndindex(2, 3):
            np.testing.assert_allclose(found[row], alone(jnp.asarray(z[row])), atol=1e-14)


def test_simplices_of_unequal_size_equal_single_ones():
    rng = np.random.default_rng(4)
    sizes, totals = rng.integers(1, 40, 60), rng.uniform(0, 3, 60)
    z, w = rng.normal(size=sizes.sum()), rng.uniform(0.2, 3.0, sizes.sum())
    K, space = sets.Simplex(totals, sizes=sizes), spaces.L2(w)
    K.check(jnp.asarray(z))
    found = np.asarray(jax.jit(lambda z: K.project(z, space))(jnp.asarray(z)))
    ends = np.cumsum(sizes)[:-1]
    for p, v, own, total in zip(*(np.split(a, ends) for a in (found, z, w)), totals):
        # τ from the sorted breakpoints wᵢzᵢ.
        order = np.argsort(-own * v)
        levels = (np.cumsum(v[order]) - total) / np.cumsum(1 / own[order])
        count = np.max(np.flatnonzero(own[order] * v[order] > levels), initial=0)
        np.testing.assert_allclose(p, np.maximum(v - levels[count] / own, 0.0), atol=1e-13)


@pytest.mark.thorough
def test_cone_projection_to_the_apex_is_exact_at_any_distance():
    """For points of the polar cone, the apex is the projection and every row counts as held."""
    rng = np.random.default_rng(8)
    for n in (2, 3, 5):
        rows = rng.normal(size=(n, n))
        K = dvax.sets.Polyhedron(jnp.asarray(rows), jnp.zeros(n))
        space = dvax.spaces.Euclidean(n)
        shares = rng.uniform(0.1, 1.0, (40, n)) * 10.0 ** rng.uniform(-14, 6, (40, 1))
        found = np.asarray(
            jax.jit(jax.vmap(lambda z, K=K, s=space: K.project(z, s)))(shares @ rows)
        )
        assert np.all(np.abs(found) <= 1e-14 * np.linalg.norm(shares @ rows, axis=1)[:, None])


def test_sets_of_concrete_numbers_can_be_created_under_tracing():
    radius, rows = jnp.asarray(0.8), jnp.eye(2)
    made = lambda t: (  # noqa: E731
        sets.Ball(t * jnp.ones(2), radius).project(jnp.full(2, 3.0), PLANE)
        + sets.Polyhedron(rows, jnp.ones(2)).project(t * jnp.ones(2), PLANE)
    )
    assert np.all(np.isfinite(np.asarray(jax.jit(made)(0.5))))
    inside_out = -radius
    with pytest.raises(dvax.InputError, match="must be finite and ≥ 0"):
        jax.jit(lambda t: sets.Ball(t, inside_out).project(jnp.ones(2), PLANE))(0.5)


@pytest.mark.slow
def test_bounds_of_a_moving_constrained_box_may_be_python_numbers():
    """Traced once more, a number that depends on nothing is no array of JAX."""
    ones = jnp.ones((1, 2))
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        K=lambda t, cap: sets.ConstrainedBox(0.0, 1.0, ones, jnp.zeros(1), cap * jnp.ones(1)),
        f=lambda t, x, u, cap: u, h=lambda t, x, u, cap: 1.0 + 0.0 * x,
    )  # fmt: skip
    # u is half the cap, and x' = −x + u.
    end = lambda cap: dvax.solve(problem, jnp.zeros(2), 0.0, 1.0, cap).xs[-1, 0]  # noqa: E731
    value, slope_of_cap = jax.value_and_grad(end)(1.5)
    np.testing.assert_allclose([value / 1.5, slope_of_cap], 0.5 * (1.0 - np.exp(-1.0)), rtol=1e-5)
