"""Properties of every projection, set by set, with and without weights."""

import functools
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from tests.selection import mostly_thorough
from tests.sets.cases import CASES, N

from dvax import sets, spaces

WEIGHTS = {"plain": np.ones(N), "weighted": np.array([0.3, 4.0, 1.0, 2.5])}
SPACES = {"plain": spaces.Euclidean(N), "weighted": spaces.L2(WEIGHTS["weighted"])}
LOT = 24
every_set = pytest.mark.parametrize("name", CASES)
every_other_set = pytest.mark.parametrize("name", mostly_thorough(CASES, list(CASES)[::2]))
every_space = pytest.mark.parametrize(
    "kind", [pytest.param("plain", marks=pytest.mark.thorough), "weighted"]
)


@functools.cache
def compiled(name: str, kind: str):
    """The projection of many points, and for many data, in one call: jit and vmap."""

    def one(data, z):
        return CASES[name].make(data).project(z, SPACES[kind])

    return jax.jit(jax.vmap(one))


def project(name: str, kind: str, z: np.ndarray, data: np.ndarray | None = None) -> np.ndarray:
    """Project points in batches of one size, so that every set is compiled once."""
    data = np.tile(CASES[name].data, (len(z), 1)) if data is None else data
    found = []
    for start in range(0, len(z), LOT):
        part, own = z[start : start + LOT], data[start : start + LOT]
        fill = ((0, LOT - len(part)), (0, 0))
        lot = compiled(name, kind)(np.pad(own, fill, "edge"), np.pad(part, fill, "edge"))
        found.append(np.asarray(lot)[: len(part)])
    return np.concatenate(found)


def points(name: str, count: int = 24) -> np.ndarray:
    """Points near, far, and inside."""
    rng = np.random.default_rng(11)
    z = rng.normal(size=(count, N)) * np.repeat([0.3, 1.0, 3.0, 30.0], count // 4)[:, None]
    z[0] = CASES[name].members(rng)
    return z


@every_space
@every_set
def test_projection_is_the_nearest_point_in_the_norm_of_the_space(name, kind):
    case, w = CASES[name], WEIGHTS[kind]
    rng = np.random.default_rng(5)
    z = points(name)
    p = project(name, kind, z)
    size = 1.0 + np.abs(z).max(axis=1)
    # An intersection stops where its parts agree to 1e-11 (‖z − p‖ + ‖p‖).
    length = np.sqrt(np.sum(w * (z - p) ** 2, axis=1)) + np.sqrt(np.sum(w * p**2, axis=1))
    for q, reach in zip(p, np.maximum(size, length)):
        assert case.violation(q) <= 1e-11 * reach
    np.testing.assert_allclose(project(name, kind, p), p, atol=1e-10)
    # ⟨z − p, v − p⟩ ≤ 0 for members v that were made without the projection.
    for _ in range(30):
        v = case.members(rng)
        assert case.violation(v) <= 1e-12 * (1.0 + np.abs(v).max())
        angle = np.sum(w * (z - p) * (v - p), axis=1)
        assert np.all(angle <= 1e-9 * size**2), angle.max()
    apart, before = (np.sqrt(np.sum(w * np.diff(a, axis=0) ** 2, axis=1)) for a in (p, z))
    assert np.all(apart <= before * (1 + 1e-10) + 1e-10)


def by_faces(z, w, G, d, E, e):
    """The nearest point among those of all faces: every choice of rows of G as equations."""
    best, answer = np.inf, None
    for k in range(min(len(d), len(z)) + 1):
        for held in combinations(range(len(d)), k):
            rows, values = np.vstack([E, G[list(held)]]), np.append(e, d[list(held)])
            scaled = rows / np.sqrt(w)
            y = z - np.linalg.pinv(scaled) @ (rows @ z - values) / np.sqrt(w)
            off = max(np.max(G @ y - d, initial=0.0), np.max(np.abs(rows @ y - values), initial=0))
            far = np.sum(w * (y - z) ** 2)
            if off < 1e-9 * (1 + np.abs(z).max()) and far < best:
                best, answer = far, y
    return answer


@every_space
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.rows is not None])
def test_projection_onto_polyhedral_sets_agrees_with_face_enumeration(name, kind):
    z = points(name, 4)
    exact = [by_faces(v, WEIGHTS[kind], *(CASES[name].rows or ())) for v in z]
    np.testing.assert_allclose(project(name, kind, z), exact, atol=1e-9)


@every_space
@pytest.mark.parametrize(
    "name", ["second-order cone", "ellipsoid, radii", "ellipsoid, matrix", "intersection"]
)
def test_projection_onto_curved_sets_agrees_with_a_general_minimiser(name, kind):
    case, w = CASES[name], WEIGHTS[kind]
    # Smooth conditions for the minimiser, ≥ 0 inside.
    inside = {
        "second-order cone": lambda y: [0.6 * y[0] - np.sqrt(np.sum(y[1:] ** 2) + 1e-24)],
        "intersection": lambda y: [0.3 - y[0], 1.0 - np.sum(y * y)],
        "ellipsoid, radii": lambda y: [1.0 - np.sum(((y - 0.2) / case.data[4:]) ** 2)],
        "ellipsoid, matrix": lambda y: [
            1.0 - (y - 0.2) @ np.linalg.solve(case.data[4:].reshape(4, 4), y - 0.2)
        ],
    }[name]
    z = points(name, 8)[:6]
    for v, p in zip(z, project(name, kind, z)):
        best = scipy.optimize.minimize(
            lambda y, v=v: np.sum(w * (y - v) ** 2),
            np.array([1.0, 0.1, 0.1, 0.1]),
            constraints={"type": "ineq", "fun": inside},
            method="SLSQP",
            options={"ftol": 1e-15, "maxiter": 500},
        )
        ours, theirs = np.sum(w * (p - v) ** 2), best.fun
        assert ours <= theirs * (1 + 1e-7) + 1e-8  # no member is nearer
        np.testing.assert_allclose(p, best.x, atol=2e-4 * (1 + np.abs(v).max()))


# A formula of its own serves spaces without weights.
OWN_WAY = ("affine subspace", "simplex", "second-order cone", "ellipsoid, matrix", "l1 ball")


EACH = [(name, "plain" if name == "intersection" else "weighted") for name in CASES]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"), mostly_thorough([*EACH, *((name, "plain") for name in OWN_WAY)], EACH[::3])
)
def test_projection_derivatives_in_point_and_data_in_both_modes(name, kind):
    n = len(CASES[name].data)

    def flat(v):
        return CASES[name].make(v[:n]).project(v[n:], SPACES[kind])

    # Functions of one vector: the set's data, then the point. Far from kinks but for bad luck,
    # which the seed rules out.
    rng = np.random.default_rng(23)
    z = np.stack([2.0 * rng.normal(size=N) + 0.37 for _ in range(3)])
    at = np.hstack([np.tile(CASES[name].data, (len(z), 1)), z])
    pull = rng.normal(size=N)

    @jax.jit
    @jax.vmap
    def slopes(v):
        return jax.jacfwd(flat)(v), jax.vjp(flat, v)[1](jnp.asarray(pull))[0]

    forward, reverse = (np.asarray(a) for a in slopes(at))
    np.testing.assert_allclose(reverse, pull @ forward, atol=1e-8 * (1 + np.abs(forward).max()))
    step = 1e-5
    shifts = step * np.concatenate([np.eye(at.shape[1]), -np.eye(at.shape[1])])
    moved = (at[:, None] + shifts).reshape(-1, at.shape[1])
    both = project(name, kind, moved[:, n:], moved[:, :n]).reshape(len(z), 2, -1, N)
    central = np.swapaxes(both[:, 0] - both[:, 1], 1, 2) / (2 * step)
    size = 1 + np.abs(forward).max()
    np.testing.assert_allclose(forward, central, rtol=1e-6, atol=1e-6 * size)


@pytest.mark.thorough
@every_other_set
def test_projection_keeps_single_precision(name):
    data = jnp.asarray(CASES[name].data, jnp.float32)
    z = jnp.asarray(points(name)[5], jnp.float32)
    space = spaces.L2(jnp.asarray(WEIGHTS["weighted"], jnp.float32))
    p = jax.jit(lambda data, z: CASES[name].make(data).project(z, space))(data, z)
    assert p.dtype == jnp.float32
    exact = project(name, "weighted", points(name)[5:6])[0]
    np.testing.assert_allclose(np.asarray(p), exact, atol=3e-5)


@pytest.mark.thorough
@every_other_set
def test_projection_propagates_nan_for_every_set(name):
    z = np.full((1, N), 0.2)
    z[0, 1] = np.nan
    assert np.isnan(project(name, "plain", z)[0, 1])
    assert np.isnan(project(name, "weighted", z)[0, 1])


@pytest.mark.slow
@every_space
@every_other_set
def test_projection_derivative_jumps_exactly_at_sign_changes_of_switches(name, kind):
    case, space = CASES[name], SPACES[kind]
    rng = np.random.default_rng(8)
    # From the inside (the middle of two members) and past it, out to somewhere.
    middle = np.stack([0.5 * (case.members(rng) + case.members(rng)) for _ in range(6)])
    away = 2.0 * rng.normal(size=(6, N))
    ends = np.stack([middle - 0.3 * away, middle + away], axis=1)
    grid = np.linspace(0.0, 1.0, 2001)
    lines = ends[:, :1] + grid[:, None] * (ends[:, 1:] - ends[:, :1])
    K = case.make(jnp.asarray(case.data))
    switches = lambda z: K.switches(z, space)  # noqa: E731
    if switches(jnp.asarray(lines[0, 0])) is None:
        assert name.startswith("intersection")
        return

    @jax.jit
    @jax.vmap
    def look(z):
        signs = [jnp.ravel(s) > 0 for s in switches(z) or ()]
        signs = jnp.concatenate([*signs, jnp.zeros(1, bool)])
        return signs, jax.jacfwd(lambda z: K.project(z, space))(z)

    changes = 0
    for line in lines:
        signs, slopes = map(np.asarray, look(line))
        changed = np.any(np.diff(signs, axis=0), axis=1)
        jump = np.max(np.abs(np.diff(slopes, axis=0)), axis=(1, 2))
        changes += changed.sum()
        # Beside a jump the derivative of a round set turns, the faster the shorter its axes are.
        smooth = np.max(jump, where=~changed, initial=0.0)
        assert smooth < 0.05 and np.all(jump[changed] > 3 * smooth), (smooth, jump[changed])
    assert changes > 0 or name in ("whole space", "hyperplane", "affine subspace")


@pytest.mark.thorough
def test_polyhedron_redundant_row_is_not_a_switch():
    # (1, 1)·y ≤ 0 follows from y ≤ 0: the projection is 0 on the whole quadrant y ≥ 0.
    rows = jnp.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    K, space = sets.Polyhedron(rows, jnp.zeros(3)), spaces.Euclidean(2)
    rng = np.random.default_rng(2)
    z = jnp.asarray(np.abs(rng.normal(size=(200, 2))))
    (signs,) = jax.vmap(lambda z: K.switches(z, space))(z)
    assert not np.any(np.asarray(signs) > 0)
