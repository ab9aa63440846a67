"""The law on small boxes, by medians and face by face: it is satisfied, and its derivative is that of
the face."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.selection import mostly_thorough

import dvax
from dvax.evolution.small_box import Medians, faces, is_small, sides

INF = np.inf


def definite(rng, n):
    root = rng.normal(size=(n, n))
    skew = rng.normal(size=(n, n))
    return root @ root.T + 0.3 * np.eye(n) + 2.0 * (skew - skew.T)


WAYS = [(Medians, 2), (faces, 2), (faces, 3), (faces, 4)]
each_way = pytest.mark.parametrize(("way", "n"), WAYS, ids=["medians", "9", "27", "81 faces"])


@pytest.mark.slow
@each_way
def test_small_box_solution_satisfies_the_law_for_any_bounds(way, n):
    rng = np.random.default_rng(n)
    M = definite(rng, n)
    found = way(jnp.asarray(M))
    solve = jax.jit(jax.vmap(lambda q, low, up: found.solve(q, low, up)))
    count = 2000
    q = rng.normal(size=(count, n)) * rng.choice([0.1, 1.0, 10.0], (count, 1))
    low = np.where(rng.random((count, n)) < 0.3, -INF, -rng.random((count, n)))
    up = np.where(rng.random((count, n)) < 0.3, INF, rng.random((count, n)))
    # Some intervals are a point, and some solutions lie on a bound that does not push.
    narrow = rng.random((count, n)) < 0.1
    low, up = np.where(narrow, 0.2, low), np.where(narrow, 0.2, up)
    touching = slice(0, 200)
    q[touching] = -np.clip(rng.normal(size=(200, n)), low[touching], up[touching]) @ M.T
    y, z, w = map(np.asarray, solve(q, low, up))
    # M is definite, so that what satisfies the law is its one solution.
    size = 1 + np.abs(q).max(axis=1, keepdims=True)
    step = np.clip(y - (y @ M.T + q), low, up)
    assert np.all(np.abs(y - step) <= 1e-12 * size)
    assert np.all((low <= y) & (y <= up))
    assert np.all(np.abs(np.clip(z, low, up) - y) <= 1e-12 * size)
    assert np.all(np.abs(w) <= 1e-12 * size)


MONOTONE = {
    "skew": [[0.0, 2.0], [-2.0, 0.0]],
    "a saddle": [[1.5, 1.0], [-1.0, 0.0]],
    "a saddle, the other way round": [[0.0, 1.0], [-1.0, 1.5]],
    "singular": [[1.0, -2.0], [-2.0, 4.0]],
    "singular to rounding": [[0.1, 0.3], [0.3, 0.9]],
    "alone": [[0.0, 0.0], [0.0, 2.0]],
    "nothing": [[0.0, 0.0], [0.0, 0.0]],
    "a P-matrix that is not monotone": [[1.0, 9.0], [0.0, 1.0]],
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", MONOTONE)
def test_small_box_medians_solve_every_monotone_law(kind):
    """The medians solve every monotone law that has a solution."""
    rng = np.random.default_rng(7)
    M = np.array(MONOTONE[kind])
    count = 3000
    low = -rng.random((count, 2))
    up = rng.random((count, 2))
    q = rng.normal(size=(count, 2))
    q[:100] = rng.integers(-1, 2, (100, 2))
    # A solution of a bounded box always exists; of an unbounded one where q was made from it.
    half = count // 2
    chosen = np.where(rng.random((half, 2)) < 0.5, low[half:], rng.normal(size=(half, 2)))
    up[half:] = np.inf
    chosen = np.maximum(chosen, low[half:])
    push = np.where(chosen == low[half:], rng.random((half, 2)), 0.0)
    q[half:] = push - chosen @ M.T
    found = Medians(jnp.asarray(M))
    y, _, w = map(np.asarray, jax.jit(jax.vmap(found.solve))(q, low, up))
    step = np.clip(y - (y @ M.T + q), low, up)
    size = 1 + np.abs(y).max(axis=1, keepdims=True)
    assert np.all(np.abs(y - step) <= 1e-12 * size)
    assert np.all((low <= y) & (y <= up))
    assert np.all(np.abs(w) <= 1e-12 * size)


@pytest.mark.slow
@pytest.mark.parametrize("way", [Medians, faces])
def test_small_box_derivative_is_that_of_the_face(way):
    """An entry that touches its bound counts as held."""
    M = np.array([[2.0, 0.7], [-0.3, 1.0]])
    found = way(jnp.asarray(M))
    low, up = jnp.full(2, -1.0), jnp.full(2, 1.0)

    def slope(q):
        return np.asarray(jax.jacfwd(lambda q: found.solve(q, low, up).y)(jnp.asarray(q)))

    inside = -M @ np.array([0.2, -0.4])
    np.testing.assert_allclose(slope(inside), -np.linalg.inv(M), rtol=1e-12)
    np.testing.assert_allclose(slope(np.array([-9.0, 0.4])), [[0, 0], [0, -1.0]], atol=1e-12)
    # Free and on its bound at once: y₁ = 1 with F₁ = 0.
    touching = -M @ np.array([1.0, -0.5])
    np.testing.assert_allclose(slope(touching), [[0, 0], [0, -1.0]], atol=1e-12)
    # In M and in the bounds, against differences.
    q = jnp.array([-9.0, 0.4])
    for free in (q, jnp.asarray(inside)):
        of = lambda v: way(v[0]).solve(free, low - v[1], up + v[1]).y  # noqa: B023, E731
        at, along = (jnp.asarray(M), jnp.zeros(2)), (jnp.ones((2, 2)), jnp.array([1.0, -2.0]))
        _, pushed = jax.jvp(of, (at,), (along,))
        there, back = (jax.tree.map(lambda a, b: a + s * b, at, along) for s in (1e-6, -1e-6))  # noqa: B023
        central = (of(there) - of(back)) / 2e-6
        np.testing.assert_allclose(np.asarray(pushed), np.asarray(central), atol=1e-8)


@pytest.mark.thorough
def test_small_box_solve_equals_the_iterated_law():
    M = np.array([[2.0, 0.5], [0.1, 1.0]])
    problem = dvax.Problem(
        A=dvax.generators.Dense(jnp.array([[-0.3, 2.0], [-2.0, -0.1]])),
        P=dvax.operators.Dense(jnp.array([[2.0, 0.5], [0.5, 1.0]])),
        K=lambda t, args: dvax.sets.Box(-jnp.exp(-t) * jnp.ones(2), jnp.array([0.3, jnp.inf])),
        f=lambda t, x, u, args: args * u,
        h=lambda t, x, u, args: x - jnp.asarray(M - np.eye(2)) @ u,
    )
    x0 = jnp.array([2.0, -1.0])

    def end(args, solver):
        run = dict(rtol=1e-6, atol=1e-6, max_steps=4096, vi_solver=solver)
        return dvax.solve(problem, x0, 0.0, 2.0, args=args, **run).xs[-1]

    args = jnp.asarray(-1.5)
    ours, theirs = (end(args, solver) for solver in (None, dvax.vi.ActiveSet()))
    np.testing.assert_allclose(np.asarray(ours), np.asarray(theirs), atol=3e-6)
    slope = jax.grad(lambda a: jnp.sum(end(a, None)))(args)
    step = 1e-4
    central = sum(s * float(jnp.sum(end(args + s * step, None))) for s in (1, -1)) / (2 * step)
    assert float(slope) == pytest.approx(central, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("kind", mostly_thorough(["coupled law", "long f"], ["coupled law"]))
def test_small_box_runs_of_three_methods_agree(kind):
    """A law or an f of many operations is in the program once, and is evaluated in a loop."""
    rng = np.random.default_rng(2)
    coupling = jnp.asarray(np.eye(3) + 0.3 * rng.normal(size=(3, 3)))
    waves = lambda t: sum(jnp.sin(k * t) / k**2 for k in range(1, 31))  # noqa: E731
    drive = waves if kind == "long f" else jnp.sin
    apply = (lambda u: 0.5 * u) if kind == "long f" else (lambda u: coupling @ u)
    problem = dvax.Problem(
        A=dvax.generators.Dense(0.2 * rng.normal(size=(3, 3)) - np.eye(3)),
        P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(-0.4, 0.3),
        f=lambda t, x, u, args: drive(3.0 * t) - u, h=lambda t, x, u, args: x - apply(u),
    )  # fmt: skip

    def solve(**options):
        return np.asarray(
            dvax.solve(problem, jnp.linspace(-1.0, 1.0, 3), 0.0, 2.0, **options).xs[-1]
        )

    exact = solve(rtol=1e-10, atol=1e-12, method=dvax.DormandPrince())
    for method in (dvax.ETD2RK(), dvax.ExpRosenbrock()):
        assert np.abs(solve(method=method, rtol=1e-4) - exact).max() < 1e-3, method


@pytest.mark.slow
def test_small_box_law_without_a_solution_fails():
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(jnp.array([0.0, 0.0]), jnp.array([jnp.inf, jnp.inf])),
        f=lambda t, x, u, args: u,
        h=lambda t, x, u, args: jnp.array([[2.0, -0.3], [0.3, 2.0]]) @ u + 1.0,
    )  # fmt: skip
    with pytest.raises(dvax.SolveError, match="not solved"):
        dvax.solve(problem, jnp.ones(2), 0.0, 1.0)


def test_small_box_applies_to_two_to_four_unknowns():
    assert [is_small(jnp.zeros(n)) for n in (1, 2, 4, 5)] == [False, True, True, False]
    assert not is_small((jnp.zeros(2), jnp.zeros(1)))
    assert sides(4).shape == (81, 4)


@pytest.mark.slow
def test_small_box_law_of_large_gain_is_solved_to_rounding():
    """A bridge of diodes with 1 µS and 1 mΩ: eigenvalues of M from 1e-3 to 1e6."""
    leak, on, s = 1e6, 1e-3, 0.5 * np.array([-1.0, 1.0, 1.0, -1.0])
    signs = np.array([1.0, 1.0, -1.0, -1.0])
    M = jnp.asarray(0.25 * leak * np.outer(signs, signs) + on * np.eye(4))
    problem = dvax.Problem(
        A=dvax.generators.Dense(jnp.array([[-1.0, -1e3], [100.0, 0.0]])),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, jnp.inf),
        f=lambda t, x, u, args: jnp.stack([1e3 * (jnp.asarray(s) @ u), 0.0 * x[0]]),
        h=lambda t, x, u, args: u - M @ u - jnp.asarray(s) * x[0],
        control_space=dvax.spaces.Euclidean(4),
    )
    sol = dvax.solve(
        problem, jnp.array([10.0, 0.0]), 0.0, 0.02, rtol=1e-8, method=dvax.ExpRosenbrock(),
        ts=np.linspace(0.0, 0.02, 9),
    )  # fmt: skip
    for x, u in zip(np.asarray(sol.xs), np.asarray(sol.us), strict=True):
        # By every choice of conducting diodes: the one whose currents and voltages are ≥ 0.
        q, found = s * x[0], []
        for held in itertools.product([False, True], repeat=4):
            free = ~np.array(held)
            y = np.zeros(4)
            y[free] = np.linalg.solve(np.asarray(M)[np.ix_(free, free)], -q[free])
            off = 1e-9 * (1.0 + np.abs(q).max())
            if (y >= -off).all() and (np.asarray(M) @ y + q >= -off).all():
                found.append(y)
        assert min(np.abs(u - y).max() for y in found) <= 1e-6 * (1.0 + np.abs(u).max())
