"""Derivatives where the state stands still: no error of the state limits the steps there, so that the
linearised equation v' = (A + Df̃)v has to. Oracle: the exponential of its matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import cumulative_trapezoid, solve_ivp
from tests.selection import mostly_thorough

import dvax

SHARE = 10.0
"""Relative error of a derivative within the time 1/σ, in tolerances, as `TangentLimit` states it."""


def real(k, n, rng):
    return _rotated(-np.diag(np.geomspace(1.0, k, n)), rng)


def unstable(k, n, rng):
    return _rotated(np.diag([2.0, *-np.geomspace(1.0, k, n - 1)]), rng)


def oscillating(k, n, rng):
    turns = [np.array([[0.0, w], [-w, 0.0]]) for w in np.geomspace(1.0, k, n // 2)]
    return _rotated(scipy.linalg.block_diag(*turns), rng)


def positions_and_velocities(k, n, rng):
    m = n // 2
    return np.block(
        [
            [np.zeros((m, m)), np.eye(m)],
            [-np.diag(np.geomspace(1.0, k**2, m)), -0.1 * np.eye(m)],
        ]
    )


def decaying_beside_oscillating(k, n, rng):
    w = k * rng.uniform(0.2, 1.05)
    parts = np.array([[0.0, w], [-w, 0.0]]), -np.diag(np.geomspace(k / 5.0, k, n - 2))
    return scipy.linalg.block_diag(*parts)


def _rotated(L, rng):
    Q = np.linalg.qr(rng.normal(size=L.shape))[0]
    return Q @ L @ Q.T


PROBLEM = dvax.Problem(
    A=dvax.generators.Zero(),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(-1e9, 1e9),
    f=lambda t, x, u, args: args["B"] @ (x - args["p"]) + u,
    h=lambda t, x, u, args: 0.1 * (x - args["p"]) ** 2 - 0.5 * u,
)
"""x' = B(x − p) + u, with a response that is flat where x = p."""

METHODS = {
    "DormandPrince": (dvax.DormandPrince(), 1e-6, 100.0),
    "ETD4RK": (dvax.ETD4RK(), 1e-6, 100.0),
    "ETD2RK": (dvax.ETD2RK(), 1e-4, 30.0),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "name"),
    mostly_thorough(
        [
            (kind, name)
            for kind in (
                real,
                unstable,
                oscillating,
                positions_and_velocities,
                decaying_beside_oscillating,
            )
            for name in METHODS
        ],
        always=[
            (real, "ETD4RK"),
            (positions_and_velocities, "DormandPrince"),
            (decaying_beside_oscillating, "DormandPrince"),
        ],
    ),
)
def test_from_rest_a_derivative_is_the_exponential_of_the_matrix(kind, name):
    method, rtol, fastest = METHODS[name]
    rng, T, n = np.random.default_rng(3), 3.0, 6

    def last(x0, p, B, w):
        args = {"B": B, "p": p}
        solution = dvax.solve(PROBLEM, x0, 0.0, T, args, method=method, rtol=rtol, atol=1e-3 * rtol)
        return jnp.dot(w, solution.xs[-1])

    for k in (fastest, fastest / 10, fastest / 100):
        B = kind(k, n, rng)
        p, w = rng.normal(size=(2, n))
        of_x0, of_p = jax.grad(last, (0, 1))(*map(jnp.asarray, (p, p, B, w)))
        E = scipy.linalg.expm(B * T)
        sigma = np.max(np.abs(np.linalg.eigvals(B)))
        size = np.linalg.norm(w) * max(1.0, np.linalg.norm(E, 2))
        most = SHARE * rtol * (1.0 + sigma * T) * size
        assert np.linalg.norm(of_x0 - E.T @ w) <= most
        assert np.linalg.norm(of_p - (w - E.T @ w)) <= most


@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_parts_at_rest_limit_the_steps_beside_a_part_that_moves(mode):
    # A slow oscillation chooses steps of 10⁻¹; beside it a part with the rate k stands at p.
    problem = dvax.Problem(
        A=dvax.generators.Zero(),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-1.0, 1.0),
        f=lambda t, x, u, a: jnp.stack([x[1], -x[0], -a[0] * (x[2] - a[1])]) + 0.0 * u,
        h=lambda t, x, u, a: -u,
    )

    def last(p, k):
        x0, args = jnp.array([1.0, 0.0, 2.0]), jnp.stack([k, p])
        method = dvax.DormandPrince()
        return dvax.solve(problem, x0, 0.0, 5.0, args, method=method, adjoint=mode).xs[-1, 2]

    derivative = jax.jacfwd(last) if mode == "forward" else jax.grad(last)
    for k in (1.0, 30.0, 1000.0):
        assert derivative(2.0, k) == pytest.approx(-np.expm1(-5.0 * k), abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [1.0, 0.0])
def test_a_state_on_a_line_limits_the_steps_and_so_does_one_on_a_kink(speed):
    # x = p + vt solves x' = v − l(x − p − vt) − (k − l) max(x − p − vt, 0), on the kink of the law.
    problem = dvax.Problem(
        A=dvax.generators.Zero(),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, jnp.inf),
        f=lambda t, x, u, a: speed - a["l"] * (x - speed * t - 0.5) - (a["k"] - a["l"]) * u,
        h=lambda t, x, u, a: x - speed * t - 0.5,
    )

    def last(x0, k, l):
        args = {"k": k, "l": l}
        return dvax.solve(problem, x0, 0.0, 2.0, args, method=dvax.DormandPrince()).xs[-1]

    k = jnp.array([3.0, 50.0, 2000.0, 5.0])
    # On the line rounding chooses the side of the kink: there both sides are one.
    l = k if speed else jnp.array([50.0, 3.0, 5.0, 2000.0])
    found = jax.vmap(jax.grad(last), (None, 0, 0))(0.5, k, l)
    # On a kink a derivative is one of the two one-sided ones, or lies between them.
    low, high = np.sort([np.exp(-2.0 * k), np.exp(-2.0 * l)], axis=0)
    assert np.all(found >= low - 1e-5) and np.all(found <= high + 1e-5)


@pytest.mark.slow
def test_a_law_at_rest_on_a_stiff_kink_has_the_derivative_of_the_linearised_method():
    # Growth on a substrate with two one-sided bounds on the flux v = (0.08 − λ₁ + λ₂)/ε: x comes to
    # rest on a kink, where an explicit method would take steps of 50 times its stability limit.
    eps = 0.004

    def flux(l):
        return (0.08 - l[0] + l[1]) / eps

    problem = dvax.Problem(
        A=dvax.generators.Zero(),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(jnp.zeros(2), jnp.inf * jnp.ones(2)),
        f=lambda t, x, l, vm: x[0] * jnp.stack([0.08 * flux(l), -flux(l)]),
        h=lambda t, x, l, vm: (
            l - (jnp.stack([vm * x[1] / (0.5 + x[1]) - flux(l), flux(l)]) + 1e-3 * l)
        ),
    )

    def last(vm, method=None):
        return dvax.solve(problem, jnp.array([0.05, 55.5]), 0.0, 12.0, vm, method=method).xs[-1, 0]

    expected = float(jax.grad(last)(10.0, dvax.ExpRosenbrock()))
    assert jax.grad(last)(10.0) == pytest.approx(expected, rel=1e-4)


@pytest.mark.slow
def test_equal_parts_of_a_tuple_that_exchange_limit_the_steps():
    problem = dvax.Problem(
        A=dvax.generators.Product(dvax.generators.Zero(), dvax.generators.Zero()),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-1.0, 1.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, k: (k * jnp.sin(x[1] - x[0]) + 0.0 * u, k * jnp.sin(x[0] - x[1])),
        h=lambda t, x, u, k: -u,
    )

    def last(x0, k):
        return dvax.solve(problem, x0, 0.0, 3.0, k, method=dvax.DormandPrince()).xs[0][-1, 0]

    for k in (1.0, 20.0, 400.0):
        of_one, of_other = jax.grad(last)((2.0 * jnp.ones(4),) * 2, k)
        decayed = 0.5 * np.exp(-6.0 * k)
        assert of_one[0] == pytest.approx(0.5 + decayed, abs=1e-4)
        assert of_other[0] == pytest.approx(0.5 - decayed, abs=1e-4)


@pytest.mark.slow
def test_code_with_a_derivative_in_reverse_alone_has_a_gradient():
    @jax.custom_vjp
    def sine(x):
        return jnp.sin(x)

    sine.defvjp(lambda x: (jnp.sin(x), x), lambda x, v: (v * jnp.cos(x),))

    def last(x0, sine):
        problem = dvax.Problem(
            A=dvax.generators.Scalar(-1.0),
            P=dvax.operators.Scaling(1.0),
            K=dvax.sets.Box(-1.0, 1.0),
            f=lambda t, x, u, args: sine(x) + u,
            h=lambda t, x, u, args: -u,
        )
        return dvax.solve(problem, x0, 0.0, 1.0, method=dvax.ETD4RK()).xs[-1]

    expected = float(jax.grad(lambda x0: last(x0, jnp.sin))(1.0))
    assert jax.grad(lambda x0: last(x0, sine))(1.0) == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_units_of_the_state_do_not_change_the_steps():
    # Concentrations in mol/L beside voltages: S B S⁻¹ has the spectral radius of B.
    B = jnp.array([[-1.0, 1.0], [1.0, -2.0]])
    problem = dvax.Problem(
        A=dvax.generators.Zero(),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-1.0, 1.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, s: s * (B @ (x / s - 1.0)) + 0.0 * u,
        h=lambda t, x, u, s: -u,
    )

    def last(x0, s):
        solution = dvax.solve(problem, x0, 0.0, 3.0, s, method=dvax.DormandPrince())
        return solution.xs[-1, 0], solution.stats["steps"]

    exact = scipy.linalg.expm(3.0 * np.asarray(B))[0, 0]
    for start in (0.5, 1.0):
        for s in ([1.0, 1.0], [1e-3, 1e3], [1e-9, 300.0]):
            s = jnp.asarray(s)
            slope, steps = jax.grad(last, has_aux=True)(start * s, s)
            assert slope[0] == pytest.approx(exact, abs=1e-4) and int(steps) <= 60


VARIED = dvax.Problem(
    A=dvax.generators.Zero(),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(-1e9, 1e9),
    control_space=dvax.spaces.Euclidean(()),
    f=lambda t, x, u, a: a["L"] @ (x - 1.0) + gain(t, a) * (a["M"] @ (x - 1.0)) + 0.0 * u,
    h=lambda t, x, u, a: -u,
)
"""x' = (L + g(t) M)(x − 1), at rest in x = 1 however fast g changes."""


def gain(t, a):
    """A table, a pulse and an oscillation."""
    pulse = jnp.exp(-(((t - a["center"]) / a["width"]) ** 2))
    return a["table"](t) + a["pulse"] * pulse + a["wave"] * jnp.cos(a["omega"] * t)


def varied(kind, rng):
    k = {"table": 0.0, "pulse": 0.0, "wave": 0.0, kind: 10.0 ** rng.uniform(0.5, 2.0)}
    if kind == "wave":
        k["wave"] = rng.uniform(1.0, 6.0)
    rows = k["table"] * np.array([0.0, 0.0, *rng.uniform(0.0, 1.0, 2), 0.0])
    n = 3
    return {
        "L": jnp.asarray(_rotated(np.diag(rng.uniform(-1.0, 0.2, n)), rng)),
        "M": jnp.asarray(_rotated(-np.diag([1.0, *rng.uniform(-0.1, 1.0, n - 1)]), rng)),
        "table": dvax.signals.Table(np.linspace(0.0, 6.0, 5), jnp.asarray(rows), kind="linear"),
        "pulse": jnp.asarray(k["pulse"] / 10.0),
        "center": jnp.asarray(rng.uniform(2.0, 5.0)),
        "width": jnp.asarray(rng.uniform(0.3, 1.5)),
        "wave": jnp.asarray(k["wave"]),
        "omega": jnp.asarray(10.0 ** rng.uniform(0.0, 1.5)),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "seed"),
    mostly_thorough(
        [
            (name, kind, seed)
            for name in ("DormandPrince", "ETD4RK", "ExpRosenbrock")
            for kind in ("table", "pulse", "wave")
            for seed in range(4)
        ],
        always=[
            ("DormandPrince", "table", 0),
            ("DormandPrince", "wave", 0),
            ("ETD4RK", "pulse", 0),
            ("ExpRosenbrock", "table", 1),
        ],
    ),
)
def test_at_rest_a_slope_that_changes_in_time_limits_the_steps(name, kind, seed):
    args, T, rtol = varied(kind, np.random.default_rng([seed, len(kind)])), 6.0, 1e-6

    def last(x0, args):
        method = getattr(dvax, name)()
        return dvax.solve(VARIED, x0, 0.0, T, args, method=method, rtol=rtol, atol=1e-9).xs[-1]

    found = jax.jit(jax.jacrev(last))(jnp.ones(3), args)
    matrix = jax.jit(lambda t: args["L"] + gain(t, args) * args["M"])
    exact = solve_ivp(
        lambda t, v: (np.asarray(matrix(t)) @ v.reshape(3, 3)).ravel(),
        (0.0, T), np.eye(3).ravel(), rtol=1e-11, atol=1e-13, max_step=0.02,
    ).y[:, -1].reshape(3, 3)  # fmt: skip
    sigma = max(np.max(np.abs(np.linalg.eigvals(matrix(t)))) for t in np.linspace(0.0, T, 400))
    size = max(1.0, np.linalg.norm(exact, 2))
    assert np.linalg.norm(found - exact) <= SHARE * rtol * (1.0 + sigma * T) * size


@pytest.mark.slow
@pytest.mark.parametrize("name", ["DormandPrince", "ExpRosenbrock"])
def test_a_part_that_moves_may_make_a_part_at_rest_stiff(name):
    # k(x₀) rises from 0.1 to `top` while x₀ falls through 1/2; x₁ = 1 stays.
    problem = dvax.Problem(
        A=dvax.generators.Zero(),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-1.0, 1.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, top: (
            jnp.stack([-0.3 * x[0], -stiffness(x[0], top) * (x[1] - 1.0), x[1] - 1.0]) + 0.0 * u
        ),
        h=lambda t, x, u, top: -u,
    )

    def stiffness(x, top):
        return 0.1 + top * jax.nn.sigmoid(40.0 * (0.5 - x))

    def last(x0, top):
        return dvax.solve(problem, x0, 0.0, 6.0, top, method=getattr(dvax, name)()).xs[-1, 2]

    for top in (3.0, 30.0, 300.0):
        found = jax.grad(last)(jnp.array([1.0, 1.0, 0.0]), top)[1]
        t = np.linspace(0.0, 6.0, 200_001)
        rates = stiffness(np.exp(-0.3 * t), top)
        decayed = np.exp(-cumulative_trapezoid(rates, t, initial=0.0))
        assert found == pytest.approx(np.trapezoid(decayed, t), rel=1e-3)


@pytest.mark.slow
def test_a_decay_does_not_hide_an_oscillation_at_rest():
    problem = dvax.Problem(
        A=dvax.generators.Zero(),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-1.0, 1.0),
        control_space=dvax.spaces.Euclidean(()),
        f=lambda t, x, u, a: (
            jnp.stack([-a[0] * (x[0] - 1.0), x[2], -(a[1] ** 2) * jnp.sin(x[1])]) + 0.0 * u
        ),
        h=lambda t, x, u, a: -u,
    )

    def last(x0, a):
        return dvax.solve(problem, x0, 0.0, 3.0, a, method=dvax.DormandPrince()).xs[-1, 1]

    for decay, w in ((20.0, 20.0), (100.0, 80.0), (100.0, 105.0), (100.0, 30.0)):
        found = jax.grad(last)(jnp.array([1.0, 0.0, 0.0]), jnp.array([decay, w]))[1]
        assert found == pytest.approx(np.cos(3.0 * w), abs=1e-5 * (1.0 + 3.0 * w))


@pytest.mark.slow
def test_steps_grow_where_all_derivatives_have_decayed():
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, jnp.inf),
        f=lambda t, x, u, a: a**2 - x**2 - u, h=lambda t, x, u, a: x - a - 1.0,
    )  # fmt: skip

    def end(a, t1):
        sol = dvax.solve(problem, 1.0, 0.0, t1, a, method=dvax.DormandPrince())
        return sol.xs[-1], sol.stats["steps"]

    steps = []
    for t1 in (1.0, 10.0, 100.0):
        # x = a tanh(a t + artanh(1/a)).
        exact = jax.grad(lambda a, t=t1: a * jnp.tanh(a * t + jnp.arctanh(1.0 / a)))(2.0)
        found, count = jax.grad(end, has_aux=True)(2.0, t1)
        assert float(found) == pytest.approx(float(exact), abs=1e-5)
        steps.append(int(count))
    # Ten steps per unit time resolve e^(-4t) to 1e-5; stability needs one.
    assert steps[2] - steps[1] < 4 * 90
