"""Laws on polyhedral sets, balls and cones: enclosures between two points, bounds of trajectories."""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from tests.once import once
from tests.selection import mostly_thorough

import dvax
from dvax import sets
from dvax.evolution.enclosed_projection import by_its_rules
from dvax.evolution.interpolated_response import Place, interpolated, interpolated_projection
from dvax.evolution.moving_set import Motion, has_bounded_motion, motion
from dvax.programs.enclosure import LinearEnclosure, constant, straight
from dvax.sets._conditions import Limits, limits, rows
from dvax.sets._face import face
from dvax.theory.faces import Range, derivatives_on_faces

N = 4
WEIGHTED = dvax.spaces.L2(jnp.array([0.3, 1.0, 2.0, 0.7]))
EUCLIDEAN = dvax.spaces.Euclidean(N)


def polyhedron(rng: np.random.Generator) -> sets.Polyhedron:
    return sets.Polyhedron(rng.normal(size=(5, N)), rng.uniform(0.1, 1.0, size=5))


def with_equation(rng: np.random.Generator) -> sets.Polyhedron:
    E = rng.normal(size=(1, N))
    return sets.Polyhedron(rng.normal(size=(3, N)), rng.uniform(0.1, 1.0, 3), E, np.zeros(1))


def constrained_box(rng: np.random.Generator) -> sets.ConstrainedBox:
    R = rng.normal(size=(2, N))
    return sets.ConstrainedBox(-np.ones(N), np.ones(N), R, [-0.3, 0.0], [0.2, 0.0])


POLYHEDRAL = {
    "simplex": lambda rng: sets.Simplex(1.0),
    "simplices": lambda rng: sets.Simplex(jnp.array([1.0, 0.5]), sizes=(3, 1)),
    "polyhedron": polyhedron,
    "with an equation": with_equation,
    "constrained box": constrained_box,
    "half-space": lambda rng: sets.HalfSpace(rng.normal(size=N), 0.3),
    "hyperplane": lambda rng: sets.Hyperplane(rng.normal(size=N), 0.3),
    "affine": lambda rng: sets.AffineSubspace(rng.normal(size=(2, N)), np.array([0.1, 0.2])),
    "translated": lambda rng: sets.Translated(sets.Simplex(1.0), rng.normal(size=N)),
    "L1": lambda rng: sets.L1Ball(np.zeros(N), 0.5),
}
CURVED = {
    "ball": lambda rng: sets.Ball(jnp.zeros(N), 0.6),
    "cone": lambda rng: sets.SecondOrderCone(0.8),
}


NO_MOTION = Motion(jnp.zeros(()), jnp.zeros(()))


@once
def placed():
    """Compiled programs of sets: y and the face at z."""

    def place(K, space, z):
        return Place(z, K.project(z, space), face(K, z, space))

    return jax.jit(place)


@pytest.mark.slow
@pytest.mark.parametrize("name", POLYHEDRAL)
def test_projection_of_a_line_stays_near_the_line_between_its_ends(name):
    rng = np.random.default_rng(0)
    same = 0
    enclosed = jax.jit(interpolated_projection)
    for trial in range(30):
        K, space = POLYHEDRAL[name](rng), (EUCLIDEAN, WEIGHTED)[trial % 2]
        a = jnp.asarray(rng.normal(size=N))
        b = a + 10.0 ** rng.uniform(-5, 0.5) * rng.normal(size=N)
        line, apart, _ = enclosed(
            K, space, straight(a, b), (placed()(K, space, a), placed()(K, space, b)), jnp.zeros(())
        )
        thetas = np.linspace(0.0, 1.0, 33)[:, None]
        on = lambda p, q, thetas=thetas: (1 - thetas) * np.asarray(p) + thetas * np.asarray(q)  # noqa: E731
        y = jax.vmap(lambda z, K=K, space=space: placed()(K, space, z).y)(on(a, b))
        distance = jax.vmap(space.norm)(y - on(line.a, line.b))
        assert float(jnp.max(distance)) <= float(apart)
        assert float(apart) <= float(space.norm(b - a)) + 1e-6
        same += float(apart) <= 1e-10
    assert same >= 5, "no line stayed on a face"


@pytest.mark.slow
@pytest.mark.parametrize("name", CURVED)
def test_projection_onto_a_curved_set_is_enclosed_on_both_sides_and_over_the_kink(name):
    rng = np.random.default_rng(1)
    K, smooth = CURVED[name](rng), 0
    # The projection onto a cone in a weighted space finds a root, and has no rules.
    for space in (EUCLIDEAN,) if name == "cone" else (EUCLIDEAN, WEIGHTED):
        problem = dvax.Problem(
            A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=K, control_space=space,
            f=lambda t, x, u, args: u, h=lambda t, x, u, args: x,
        )  # fmt: skip
        enclosed = jax.jit(
            lambda a, b, space=space, problem=problem: by_its_rules(
                problem, None, space, constant(jnp.zeros(())), straight(a, b), NO_MOTION
            )
        )
        project = jax.jit(jax.vmap(lambda z, space=space: K.project(z, space)))
        for _ in range(60):
            a, length = rng.normal(size=N), 10.0 ** rng.uniform(-4, 0.5)
            b = a + length * rng.normal(size=N)
            q = LinearEnclosure(*map(np.asarray, enclosed(a, b)))
            thetas = np.linspace(0.0, 1.0, 33)[:, None]
            y = project((1 - thetas) * a + thetas * b)
            assert (np.abs(y - ((1 - thetas) * q.a + thetas * q.b)) <= q.dev + 1e-14).all()
            assert float(np.max(q.dev)) <= 2.0 * np.linalg.norm(b - a)
            smooth += float(np.max(q.dev)) <= 1e-2 * length
    assert smooth >= 20


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in POLYHEDRAL if name != "L1"])
def test_conditions_of_a_set_hold_on_it_and_nowhere_else(name):
    rng = np.random.default_rng(2)
    for _ in range(5):
        K = POLYHEDRAL[name](rng)
        R = rows(K, jnp.zeros(N))
        found = limits(K, R, jnp.zeros(N))
        for z in rng.normal(size=(20, N)):
            y = np.asarray(placed()(K, EUCLIDEAN, jnp.asarray(z)).y)
            values = R @ y
            assert (values <= found.high + 1e-9).all() and (values >= found.low - 1e-9).all()
            # Elsewhere one is violated.
            values = R @ z
            holds = (values <= found.high + 1e-12).all() and (values >= found.low - 1e-12).all()
            assert holds == (np.abs(y - z).max() <= 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in POLYHEDRAL if name != "L1"])
def test_differences_of_projections_are_those_of_the_faces(name):
    """p = D(p + q) for the differences p of y and q of z − y, with D between its bounds."""
    rng = np.random.default_rng(3)
    known = unknown = 0
    for _ in range(40):
        K = POLYHEDRAL[name](rng)
        R = rows(K, jnp.zeros(N))
        found = Limits(*(Range(*2 * [np.asarray(v)[None]]) for v in limits(K, R, jnp.zeros(N))))
        z = rng.normal(size=N) * rng.uniform(0.2, 2.0)
        others = z + 10.0 ** rng.uniform(-4, 0) * rng.normal(size=(6, N))
        points = [z, *others]
        y = np.stack([np.asarray(placed()(K, EUCLIDEAN, jnp.asarray(v)).y) for v in points])
        s = np.stack(points) - y
        boxes = [Range(v.min(axis=0)[None], v.max(axis=0)[None]) for v in (y, s)]
        (center, radius), is_known = derivatives_on_faces(R, found, *boxes, 1e-14)
        for k in range(1, len(points)):
            p, q = y[k] - y[0], s[k] - s[0]
            assert (np.abs(p - center[0] @ (p + q)) <= radius[0] @ np.abs(p + q) + 1e-11).all()
        known, unknown = known + int(is_known[0]), unknown + int(not is_known[0])
    assert known >= 5


def random_system(seed: int, make):
    rng = np.random.default_rng(seed)
    m = 2
    A = -rng.uniform(0.2, 2.0) * np.eye(m) + rng.normal(size=(m, m))
    B, C = rng.normal(size=(m, N)), rng.normal(size=(N, m))
    S = rng.normal(size=(N, N)) / N
    P = np.eye(N) * rng.uniform(0.5, 2.0) + 0.2 * (S + S.T)
    fast, phase = rng.uniform(1.0, 4.0), rng.uniform(0.0, 6.0, size=N)
    problem = dvax.Problem(
        A=dvax.generators.Dense(A), P=dvax.operators.Dense(P), K=make(rng),
        f=lambda t, x, u, args: B @ u + 0.3 * jnp.sin(x) * jnp.cos(t), control_space=EUCLIDEAN,
        h=lambda t, x, u, args: C @ x + jnp.sin(fast * t + phase) - 0.2 * jnp.tanh(P @ u),
    )  # fmt: skip
    return problem, rng.normal(size=m)


def table(rng: np.random.Generator) -> dvax.signals.Table:
    return dvax.signals.Table(jnp.linspace(0.0, 2.0, 9), jnp.asarray(rng.uniform(-1.0, 1.0, 9)))


def wave(rng: np.random.Generator) -> Callable:
    fast, phase = rng.uniform(1.0, 4.0), rng.uniform(0.0, 6.0)
    return lambda t: jnp.sin(fast * t + phase)


def moving_polyhedron(rng):
    G, d, load = rng.normal(size=(5, N)), rng.uniform(0.3, 1.0, 5), table(rng)
    return lambda t, args: sets.Polyhedron(G, d + 0.2 * load(t))


def moving_constrained_box(rng):
    R, load = rng.normal(size=(2, N)), table(rng)
    sums = lambda t: 0.1 * load(t) * np.ones(2)  # noqa: E731
    return lambda t, args: sets.ConstrainedBox(
        -1.0 - 0.2 * load(t), 1.0, R, sums(t) - np.array([0.3, 0.0]), sums(t)
    )


def moving_sum(rng):
    R, s = rng.normal(size=(1, N)), wave(rng)
    return lambda t, args: sets.ConstrainedBox(
        -1.0 - 0.2 * s(t), 1.0 + 0.1 * s(t), R, 0.4 * s(t)[None], 0.4 * s(t)[None]
    )


def moving_simplices(rng):
    s = wave(rng)
    return lambda t, args: sets.Simplex(jnp.stack([1.5 + s(t), 0.6 + 0.5 * s(2.0 * t)]), (3, 1))


def with_data_of(make):
    """K(t) by a set of two smooth functions of t and a vector."""

    def moving(rng):
        s, r, c = wave(rng), wave(rng), rng.normal(size=N)
        E = rng.normal(size=(2, N))
        return lambda t, args: make(s(t), r(t), c, E)

    return moving


MOVING = {
    "moving box": with_data_of(
        lambda s, r, c, E: sets.Box(-0.6 - 0.3 * s * np.ones(N), 0.3 + 0.2 * r * np.ones(N))
    ),
    "moving simplex": with_data_of(lambda s, r, c, E: sets.Simplex(1.5 + s)),
    "moving simplices": moving_simplices,
    "moving L1": with_data_of(lambda s, r, c, E: sets.L1Ball(c * s, 0.7 + 0.4 * r)),
    "moving ball": with_data_of(lambda s, r, c, E: sets.Ball(0.5 * c * s, 0.7 + 0.4 * r)),
    "moving half-space": with_data_of(lambda s, r, c, E: sets.HalfSpace(c, 0.5 * s)),
    "moving hyperplane": with_data_of(lambda s, r, c, E: sets.Hyperplane(c, 0.5 * s)),
    "moving affine": with_data_of(lambda s, r, c, E: sets.AffineSubspace(E, jnp.stack([s, r]))),
    "translated simplex": with_data_of(
        lambda s, r, c, E: sets.Translated(sets.Simplex(1.0), c * s)
    ),
    "translated ball": with_data_of(
        lambda s, r, c, E: sets.Translated(sets.Ball(jnp.zeros(N), 0.5), c * s)
    ),
    "moving sum": moving_sum,
    "moving polyhedron": moving_polyhedron,
    "moving constrained box": moving_constrained_box,
}
SYSTEMS = {**POLYHEDRAL, **CURVED, **MOVING}


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_response_between_two_points_is_near_the_line_between_their_responses(name):
    """For F(y) = My + sin(y)/4 − q(t) along a line in t, with all its constants by hand."""
    rng = np.random.default_rng(4)
    turned = 0.4 * rng.normal(size=(N, N))
    M = 1.5 * np.eye(N) + turned - turned.T
    gamma, L_F = 1.25, float(np.linalg.norm(M, 2)) + 0.25
    P = dvax.operators.Scaling(1.0)
    K = SYSTEMS[name](rng)
    set_at = lambda s: K if isinstance(K, sets.AbstractSet) else K(s, None)  # noqa: E731
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=P, K=K, control_space=EUCLIDEAN, f=lambda t, x, u, q: 0.0 * u,
        h=lambda t, x, u, q: u - M @ u - 0.25 * jnp.sin(u) + q[0] + t * q[1] + t * t * q[2],
    )  # fmt: skip
    F = lambda y, q: M @ y + 0.25 * jnp.sin(y) - q  # noqa: E731
    solve = jax.jit(
        lambda s, q: dvax.solve_vi(
            F, set_at(s), jnp.zeros(N), q[0] + s * q[1] + s * s * q[2], gamma=gamma, L_F=L_F,
            tol=1e-12,
        ).y
    )  # fmt: skip
    x = constant(jnp.zeros(N))

    @jax.jit
    def between(t, q, y):
        ends = [
            placed()(set_at(s), EUCLIDEAN, v - F(v, q[0] + s * q[1] + s * s * q[2]))
            for v, s in zip(y, (t.a, t.b), strict=True)
        ]
        return interpolated(problem, q, P, t, x, tuple(ends), gamma, L_F)

    for length in (2.0**-3, 2.0**-5, 2.0**-7, 2.0**-10):
        q = jnp.asarray(rng.normal(size=(3, N)))
        t = LinearEnclosure(jnp.asarray(0.0), jnp.asarray(length), jnp.asarray(0.0))
        line = between(t, q, (solve(0.0, q), solve(length, q)))
        for theta in (0.2, 0.5, 0.9):
            exact = solve(theta * length, q)
            guess = (1 - theta) * line.u.a + theta * line.u.b
            distance = float(jnp.linalg.norm(exact - guess))
            assert distance <= float(line.residual) / gamma + 1e-11
        assert float(line.residual) <= 30.0 * length + 1e-6


CASES = [(name, seed) for name in SYSTEMS for seed in range(3)]
OFTEN = [("simplex", 0), ("moving simplex", 0), ("moving constrained box", 0)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), mostly_thorough(CASES, OFTEN))
def test_bounds_along_trajectories_of_coupled_laws_are_proved_hold_and_are_sharp(name, seed):
    problem, x0 = random_system(seed, SYSTEMS[name])
    ts = np.linspace(0.0, 2.0, 6)[1:]
    run = partial(dvax.solve, problem, x0, 0.0, 2.0, ts=ts)
    sol, exact = run(rtol=1e-5), run(rtol=1e-11, atol=1e-12, method=dvax.DormandPrince())
    bound = dvax.bound_error(problem, sol)
    of_x = np.linalg.norm(sol.xs - exact.xs, axis=1)
    of_u = np.linalg.norm(sol.us - exact.us, axis=1)
    assert bound.status == "proved", bound
    assert (of_x <= np.asarray(bound.x) + 1e-10).all()
    assert (of_u <= np.asarray(bound.u) + 1e-10).all()
    assert (np.asarray(bound.x) <= 20.0 * of_x + 1e-5).all()


UNKNOWN = {
    "a normal that turns": lambda t, args: sets.HalfSpace(
        jnp.array([1.0, -0.5]) + 0.3 * jnp.sin(t), 0.2
    ),
    "a factor that moves": lambda t, args: sets.Scaled(sets.Simplex(1.0), 1.5 + 0.5 * jnp.sin(t)),
    "a set that moves in a scaled one": lambda t, args: sets.Scaled(
        sets.Simplex(1.5 + 0.5 * jnp.sin(t)), 2.0
    ),
    "smooth bounds of two rows": lambda t, args: sets.Polyhedron(
        jnp.array([[1.0, 0.5], [-0.5, 1.0]]), 0.3 * jnp.sin(t) * jnp.ones(2)
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(UNKNOWN, ["a normal that turns"]))
def test_sets_whose_motion_has_no_bound_are_sampled(name):
    """With constants a run takes about as many steps as without, and the bound is finite."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=UNKNOWN[name],
        f=lambda t, x, u, args: jnp.sum(u) + 0.0 * x, control_space=dvax.spaces.Euclidean(2),
        h=lambda t, x, u, args: jnp.stack([x[0] + jnp.sin(2.0 * t), -x[0] + jnp.cos(t)]),
    )  # fmt: skip
    constants = dvax.verify(problem, jnp.ones(1), 0.0, 2.0).constants
    sol = dvax.solve(
        problem, jnp.ones(1), 0.0, 2.0, ts=[2.0], constants=constants, method=dvax.ETD2RK()
    )
    bound = dvax.bound_error(problem, sol, constants)
    assert not sol.enclosed and bound.status == "estimated"
    assert float(bound.x[-1]) < 1e-3


@pytest.mark.parametrize("shift", [None, 0.5])
@pytest.mark.parametrize(
    "K", [lambda b: sets.Simplex(2.0 + b), lambda b: sets.Polyhedron(jnp.eye(2), b * jnp.ones(2))]
)
def test_motion_by_a_table_has_a_bound_if_its_times_are_known(K, shift):
    load = table(np.random.default_rng(0))
    at = lambda t: t if shift is None else t + shift  # noqa: E731
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=lambda t, args: K(load(at(t))),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: x,
    )  # fmt: skip
    like, space = jnp.zeros(2), dvax.spaces.Euclidean(2)
    assert has_bounded_motion(problem, None, jnp.zeros(()), like, space) == (shift is None)


def test_limits_of_a_product_are_those_of_its_parts():
    parts = sets.Simplex(jnp.array([1.0, 2.0]), sizes=(2, 1)), sets.HalfSpace(jnp.ones(2), 0.5)
    K, like = sets.Product(*parts), (jnp.zeros(3), jnp.zeros(2))
    R = rows(K, like)
    found = limits(K, R, like)
    assert R.shape == (6, 5) and [len(v) for v in found] == [6, 6, 6]
    np.testing.assert_array_equal(found.high[3:], [1.0, 2.0, 0.5])


@once
def affine_law():
    """x' = Ax + u, u = x + c on {y : ⟨a, y⟩ = b}: a linear system."""
    rng = np.random.default_rng(7)
    A, a, c = rng.normal(size=(3, 3)) - 2.0 * np.eye(3), rng.normal(size=3), rng.normal(size=3)
    problem = dvax.Problem(
        A=dvax.generators.Dense(A), P=dvax.operators.Scaling(1.0), K=sets.Hyperplane(a, 0.4),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: x + c,
        control_space=dvax.spaces.Euclidean(3),
    )  # fmt: skip
    E = np.eye(3) - np.outer(a, a) / (a @ a)
    forcing = E @ c + 0.4 * a / (a @ a)
    return problem, A + E, forcing


@pytest.mark.slow
@pytest.mark.parametrize("gamma", [1.0, 0.5, 0.1])
def test_bound_by_constants_holds_with_a_smaller_modulus_than_that_of_the_run(gamma):
    """A closed form, x' = (A + E)x + p with the projection E. The defect of the law was enclosed by one
    γ, and the certificate has another one."""
    problem, matrix, forcing = affine_law()
    x0 = np.array([1.0, -0.5, 0.3])
    given = dvax.verify(problem, x0, 0.0, 2.0).constants
    statuses = dict(given.statuses)
    names = ("L_F", "alpha_h", "beta_h", "alpha_f", "beta_f", "M", "omega", "m_P", "norm_P_inv")
    other = dvax.Constants(
        gamma=gamma, **{name: getattr(given, name) for name in names}, domain=given.domain,
        status={name: status for name, status in statuses.items() if name in (*names, "gamma")},
    )  # fmt: skip
    big = np.zeros((4, 4))
    big[:3, :3], big[:3, 3] = matrix, forcing
    exact = (expm(2.0 * big) @ np.append(x0, 1.0))[:3]
    for used in (given, other):
        sol = dvax.solve(problem, x0, 0.0, 2.0, rtol=1e-5, method=dvax.ETD2RK(), constants=used)
        assert sol.enclosed
        for constants in (given, other):
            bound = dvax.bound_error(problem, sol, constants)
            assert bound.status == "proved"
            assert np.linalg.norm(sol.xs[-1] - exact) <= float(bound.x[-1])
            # Errors grow with ‖∂h/∂x‖/γ in it.
            assert gamma < 0.5 or float(bound.x[-1]) < 0.1


class Opening(sets.AbstractSet):
    """{y : Σ y ≤ b()} with a bound that the set holds as a function."""

    bound: Callable = eqx.field(static=True)

    def project(self, z, space):
        return z - jnp.maximum(jnp.sum(z) - self.bound(), 0.0) / z.size

    def switches(self, z, space):
        return None

    def intervals(self, like):
        return None

    def check(self, like):
        pass


@pytest.mark.slow
def test_set_of_the_user_that_holds_a_function_of_time_is_not_taken_as_fixed():
    """x' = −x + u with u = sin²(10πt)/2 in both components: steps of 0.1 see K at its zeros alone."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        K=lambda t, args: Opening(lambda: jnp.sin(10.0 * jnp.pi * t) ** 2),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: 2.0 * jnp.ones(2),
    )  # fmt: skip
    x0, w = jnp.zeros(2), 20.0 * np.pi
    part = lambda t: 0.25 - 0.25 * (np.cos(w * t) + w * np.sin(w * t)) / (1.0 + w * w)  # noqa: E731
    exact = (part(2.0) - np.exp(-2.0) * part(0.0)) * np.ones(2)
    constants = dvax.verify(problem, x0, 0.0, 2.0).constants
    sol = dvax.solve(
        problem, x0, 0.0, 2.0, ts=[2.0], method=dvax.ETD2RK(), constants=constants, dt=0.1
    )
    bound = dvax.bound_error(problem, sol, constants)
    assert not sol.enclosed
    error = np.linalg.norm(sol.xs[-1] - exact)
    assert bound.status != "proved" or error <= float(bound.x[-1])


@pytest.mark.slow
@pytest.mark.parametrize("angle", [1e-3, 1e-5, 1e-7, 1e-9, 1e-12])
def test_equations_that_are_nearly_parallel_do_not_lower_the_bound(angle):
    """y₁ = y₂ = 0 by two equations, and x₂ grows like e^{t/2} from an initial error."""
    E = jnp.array([[1.0, 0.0, 0.0], [1.0, angle, 0.0]])
    problem = dvax.Problem(
        A=dvax.generators.Diagonal(jnp.array([-1.0, 0.5, -1.0])), P=dvax.operators.Scaling(1.0),
        K=sets.AffineSubspace(E, jnp.zeros(2)), f=lambda t, x, u, args: u,
        h=lambda t, x, u, args: jnp.array([0.0, -3.0, -3.0]) * x,
    )  # fmt: skip
    x0 = jnp.array([0.0, 1.0, 1.0])
    sol = dvax.solve(problem, x0, 0.0, 2.0, ts=[2.0])
    bound = dvax.bound_error(problem, sol, initial_error=1e-3)
    # Where the projection itself takes them as one equation, y₂ is free and decays.
    grows = abs(float(sol.xs[-1, 1]) - np.e) < 1e-3
    assert grows or angle < 1e-7
    assert not grows or abs(float(sol.xs[-1, 1]) - 1.001 * np.e) <= float(bound.x[-1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["simplex", "half-space", "constrained box", "polyhedron", "ball"])
def test_runs_with_constants_end_in_single_precision(name):
    make = POLYHEDRAL.get(name) or CURVED[name]
    K = jax.tree_util.tree_map(
        lambda leaf: leaf.astype(np.float32) if eqx.is_inexact_array(leaf) else leaf,
        jax.tree_util.tree_map(jnp.asarray, make(np.random.default_rng(5))),
    )
    turned = jnp.eye(N, dtype=jnp.float32) + jnp.asarray(
        np.triu(0.3 * np.ones((N, N)), 1) - np.tril(0.3 * np.ones((N, N)), -1), jnp.float32
    )
    problem = dvax.Problem(
        A=dvax.generators.Scalar(np.float32(-1.0)), K=K,
        P=dvax.operators.Scaling(np.float32(1.0)), f=lambda t, x, u, args: u,
        h=lambda t, x, u, args: u - turned @ u + x,
    )  # fmt: skip
    x0 = np.linspace(1.0, 0.5, N, dtype=np.float32)
    with jax.numpy_dtype_promotion("standard"):
        constants = dvax.verify(problem, x0, 0.0, 2.0).constants
        sol = dvax.solve(
            problem, x0, 0.0, 2.0, ts=[2.0], method=dvax.ETD2RK(), constants=constants,
            rtol=3e-4, atol=3e-4,
        )  # fmt: skip
        bound = dvax.bound_error(problem, sol, constants)
    sharp = dvax.solve(
        dvax.Problem(
            A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
            K=make(np.random.default_rng(5)), f=problem.f,
            h=lambda t, x, u, args: u - np.asarray(turned, float) @ u + x,
        ),
        np.asarray(x0, float), 0.0, 2.0, ts=[2.0], rtol=1e-9, atol=1e-10,
    )  # fmt: skip
    assert sol.enclosed and bound.status == "proved" and int(sol.stats["steps"]) < 500
    error = np.linalg.norm(np.asarray(sol.xs[-1], float) - sharp.xs[-1])
    assert error <= float(bound.x[-1]) <= 0.05


def test_a_polyhedron_that_moves_along_lines_changes_by_an_unknown_distance():
    def found(rate):
        problem = dvax.Problem(
            A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), f=lambda t, x, u, args: u,
            K=lambda t, args: sets.Polyhedron(np.eye(2), (1.0 + rate * t) * np.ones(2)),
            h=lambda t, x, u, args: x,
        )  # fmt: skip
        t = LinearEnclosure(jnp.asarray(0.0), jnp.asarray(0.5), jnp.asarray(0.0))
        return motion(problem, None, t, jnp.zeros(2), dvax.spaces.Euclidean(2))

    assert found(1.0) == (np.inf, 0.0)
    assert found(0.0) == (0.0, 0.0)
