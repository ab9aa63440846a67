"""Directional derivatives at kinks against closed forms and one-sided differences, which share no code
with the variational system; away from kinks against `jax.jvp`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import c1, c1_derivatives
from tests.selection import mostly_thorough

import dvax

ZERO, ONE = dvax.generators.Zero(), dvax.operators.Scaling(1.0)
M = jnp.array([[1.0, 0.8], [-0.6, 0.7]])
"""Couples two entries, and is not symmetric."""


def quotient(problem, x0, t1, args, dx0, dargs):
    """lim (x(ζ + εδζ, η + εδη) − x)/ε by extrapolation to ε = 0, to about 1e-6."""

    def end(eps):
        moved = jax.tree_util.tree_map(lambda a, d: a + eps * d, (x0, args), (dx0, dargs))
        sol = dvax.solve(problem, moved[0], 0.0, t1, moved[1], dt=1e-3, method=dvax.ETD4RK())
        return np.asarray(sol.xs[-1])

    # Not from ε = 0 itself: on the kink the steps of a method lose their order.
    return (-5 * end(1e-4) + 8 * end(2e-4) - 3 * end(3e-4)) / 2e-4


def corner():
    """At rest with both entries on their bounds and without force; nothing is linear."""
    return dvax.Problem(
        A=dvax.generators.Scalar(-0.3), P=dvax.operators.Dense(jnp.array([[1.2, 0.3], [0.3, 0.9]])),
        K=lambda t, args: dvax.sets.Box(0.0 * args["low"], 4.0),
        f=lambda t, x, u, args: M @ u - x + 0.2 * x**2,
        h=lambda t, x, u, args: M @ x + jnp.sin(x) - 0.4 * u + 0.1 * u**2,
    )  # fmt: skip


def disc():
    """Motion on the unit circle, with z on its boundary at all times."""
    spin = jnp.array([[0.0, 2.0], [-2.0, 0.0]])
    return dvax.Problem(
        A=ZERO, P=ONE, K=dvax.sets.Ball(0.0, 1.0), f=lambda t, x, u, args: spin @ x + (x - u),
        h=lambda t, x, u, args: x,
    )  # fmt: skip


def rise():
    """At rest at the upper bound η of u, without force."""
    return dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=ONE, K=lambda t, args: dvax.sets.Box(-5.0, args["top"]),
        f=lambda t, x, u, args: args["top"] * 0.0 + 1.5 - 0.5 * u, h=lambda t, x, u, args: x,
    )  # fmt: skip


def wedge():
    """The corner of a wedge of two rows that are not at right angles."""
    rows = jnp.array([[1.0, 0.4], [-0.3, 1.0]])
    return dvax.Problem(
        A=ZERO, P=ONE, K=dvax.sets.Polyhedron(rows, jnp.zeros(2)),
        f=lambda t, x, u, args: -x + 0.6 * u + 0.1 * x * u, h=lambda t, x, u, args: M @ x - 0.2 * u,
    )  # fmt: skip


LOW = {"low": jnp.zeros(2)}
CASES = {
    "corner, up": (corner, jnp.zeros(2), LOW, jnp.array([1.0, 0.5]), None),
    "corner, across": (corner, jnp.zeros(2), LOW, jnp.array([-1.0, 0.8]), None),
    "corner, down": (corner, jnp.zeros(2), LOW, jnp.array([-0.4, -1.0]), None),
    "disc, out": (disc, jnp.array([1.0, 0.0]), None, jnp.array([1.0, 0.4]), None),
    "disc, in": (disc, jnp.array([1.0, 0.0]), None, jnp.array([-1.0, 0.4]), None),
    "wedge": (wedge, jnp.zeros(2), None, jnp.array([1.0, 0.3]), None),
    "wedge, other side": (wedge, jnp.zeros(2), None, jnp.array([-0.5, 1.0]), None),
    "bound, up": (rise, jnp.array(1.0), {"top": jnp.array(1.0)}, jnp.array(0.0),
                  {"top": jnp.array(1.0)}),
    "bound, down": (rise, jnp.array(1.0), {"top": jnp.array(1.0)}, jnp.array(0.2),
                    {"top": jnp.array(-1.0)}),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(CASES, {"disc, in"}))
def test_directional_derivative_on_a_kink_is_the_limit_of_one_sided_differences(name):
    make, x0, args, dx0, dargs = CASES[name]
    problem = make()
    found = dvax.directional_derivative(problem, x0, 0.0, 1.0, args, dx0=dx0, dargs=dargs)
    assert any(kink.kind == "stays" for kink in found.kinks)
    zero = jax.tree_util.tree_map(jnp.zeros_like, args)
    exact = quotient(problem, x0, 1.0, args, dx0, zero if dargs is None else dargs)
    np.testing.assert_allclose(np.asarray(found.dxs[-1]), exact, atol=1e-4, rtol=1e-4)
    # Not linear in the direction, or it would have been no kink.
    minus = jax.tree_util.tree_map(jnp.negative, (dx0, dargs))
    back = dvax.directional_derivative(problem, x0, 0.0, 1.0, args, dx0=minus[0], dargs=minus[1])
    assert np.max(np.abs(np.asarray(found.dxs[-1] + back.dxs[-1]))) > 1e-3


@pytest.mark.thorough
def test_directional_derivative_at_rest_on_a_kink_depends_on_the_side():
    rest = dvax.Problem(
        A=ZERO, P=ONE, K=dvax.sets.Box(0.0, 9.0), f=lambda t, x, u, args: u - 2.0 * x,
        h=lambda t, x, u, args: x,
    )  # fmt: skip
    ts = np.array([0.5, 1.0])
    for size, rate in ((3.0, 1.0), (-2.0, 2.0)):
        found = dvax.directional_derivative(rest, 0.0, 0.0, 1.0, dx0=size, ts=ts)
        np.testing.assert_allclose(np.asarray(found.dxs), size * np.exp(-rate * ts), rtol=1e-6)
        np.testing.assert_allclose(
            np.asarray(found.dus), np.maximum(size * np.exp(-rate * ts), 0.0), rtol=1e-6, atol=1e-12
        )


@pytest.mark.thorough
def test_directional_derivative_across_kinks_is_the_ordinary_derivative():
    case = c1()
    by_start, _ = c1_derivatives()
    found = dvax.directional_derivative(case.problem, -1.0, 0.0, 2.0, case.args, dx0=1.0)
    assert [kink.kind for kink in found.kinks] == ["crosses", "crosses"]
    assert float(found.dxs[-1]) == pytest.approx(by_start, rel=1e-6)


@pytest.mark.thorough
def test_directional_derivative_in_every_parameter_equals_jvp():
    """For parameters of A, P, K, f and h, away from kinks."""
    problem = dvax.Problem(
        A=lambda p: dvax.generators.Dense(p["A"]), P=lambda p: dvax.operators.Diagonal(p["P"]),
        K=lambda t, p: dvax.sets.Ball(p["c"] * jnp.sin(t), p["r"]),
        f=lambda t, x, u, p: p["l"] - u + 0.1 * x**2, h=lambda t, x, u, p: p["b"] * x - 0.5 * u + 2.0,
    )  # fmt: skip
    args = {
        "A": jnp.array([[-1.0, 1.0], [-1.0, -0.5]]), "P": jnp.array([1.0, 1.6]), "r": jnp.array(0.8),
        "c": jnp.array([0.3, -0.2]), "l": jnp.array([1.0, 0.4]), "b": jnp.array(1.2),
    }  # fmt: skip
    rng = np.random.default_rng(5)
    dargs = jax.tree_util.tree_map(lambda a: jnp.asarray(rng.normal(size=a.shape)), args)
    x0, dx0 = jnp.array([0.5, -0.3]), jnp.array([0.2, 1.0])
    ts = jnp.array([0.4, 1.0])

    def run(x0, args):
        sol = dvax.solve(
            problem, x0, 0.0, 1.0, args, ts, method=dvax.ETD4RK(), rtol=1e-9, atol=1e-10,
            adjoint="forward", max_steps=2**14,
        )  # fmt: skip
        return sol.xs, sol.us

    dxs, dus = jax.jvp(run, (x0, args), (dx0, dargs))[1]
    found = dvax.directional_derivative(problem, x0, 0.0, 1.0, args, dx0=dx0, dargs=dargs, ts=ts)
    assert not found.kinks
    np.testing.assert_allclose(np.asarray(found.dxs), np.asarray(dxs), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(np.asarray(found.dus), np.asarray(dus), rtol=1e-6, atol=1e-7)


@pytest.mark.thorough
def test_kinks_are_classified_as_crossing_touching_or_staying():
    """z crosses at 1, touches at 2 and stays from 3 on."""
    z = lambda t: jnp.where(t < 1.5, 1.0 - t, jnp.where(t < 3.0, -2.0 * (t - 2.0) ** 2, 0.0))  # noqa: E731
    smooth = lambda t: jnp.where((t > 2.5) & (t < 3.0), -2.0 * (3.0 - t) ** 2, z(t))  # noqa: E731
    problem = dvax.Problem(
        A=ZERO, P=ONE, K=dvax.sets.Box(0.0, 9.0), f=lambda t, x, u, args: u - x,
        h=lambda t, x, u, args: smooth(t) + 0.0 * x,
    )  # fmt: skip
    sol = dvax.solve(problem, 0.0, 0.0, 4.0, dense=True, max_steps=2**14, method=dvax.ETD2RK())
    found = dvax.sensitivity.kinks(sol)
    assert [kink.kind for kink in found] == ["crosses", "touches", "stays"]
    assert found[0].start == pytest.approx(1.0, abs=1e-6)
    assert found[1].start == pytest.approx(2.0, abs=1e-3)
    assert found[2].start == pytest.approx(3.0, abs=2e-3) and found[2].end == 4.0


@pytest.mark.slow
def test_kinks_at_a_bound_that_becomes_infinite():
    # The law u = min(max(s − x, 0), b(t)) with b = 0.3 while sin 9t > 0, else no bound.
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(0.0, jnp.where(jnp.sin(9 * t) < 0.0, jnp.inf, 0.3)),
        f=lambda t, x, u, args: u,
        h=lambda t, x, u, args: jnp.sin(3 * t) - x - u,
    )
    sol = dvax.solve(problem, 0.1, 0.0, 1.0, dense=True, max_steps=2**12)
    found = [kink.start for kink in dvax.sensitivity.kinks(sol) if kink.switch == 1]
    for jump in (np.pi / 9, 2 * np.pi / 9):
        assert min(abs(np.array(found) - jump)) < 1e-6


@pytest.mark.thorough
def test_directional_derivative_rejects_wrong_directions():
    case = c1()
    with pytest.raises(dvax.InputError, match=r"dx0.*shape"):
        dvax.directional_derivative(case.problem, -1.0, 0.0, 2.0, case.args, dx0=jnp.ones(2))
    with pytest.raises(dvax.InputError, match=r"dargs.*structure"):
        dvax.directional_derivative(case.problem, -1.0, 0.0, 2.0, case.args, dargs={"ell": 1.0})
    with pytest.raises(dvax.InputError, match=r"outside jax\.jit"):
        jax.jit(lambda x: dvax.directional_derivative(case.problem, x, 0.0, 2.0, case.args).dxs)(
            0.1
        )
    sol = dvax.solve(case.problem, -1.0, 0.0, 2.0, case.args)
    with pytest.raises(dvax.InputError, match="dense=True"):
        dvax.sensitivity.kinks(sol)


def test_kinks_of_a_dense_piecewise_linear_solution_are_refused():
    sol = dvax.solve(
        c1().problem, -1.0, 0.0, 2.0, c1().args, method=dvax.PiecewiseLinear(), dense=True
    )
    with pytest.raises(dvax.InputError, match="exponential method"):
        dvax.sensitivity.kinks(sol)


@pytest.mark.thorough
def test_directional_derivative_in_the_values_of_a_table():
    """x' = −x + load(t) − u with u = max(0, x − 1) is linear between jumps and kinks."""
    times = [0.0, 0.5, 1.2, 2.0]
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=ONE, K=dvax.sets.Box(0.0, 9.0),
        f=lambda t, x, u, load: load(t) - u, h=lambda t, x, u, load: x - 1.0,
    )  # fmt: skip
    table = lambda v: dvax.signals.Table(times, v, kind="constant")  # noqa: E731
    load, along = table([3.0, 0.5, 2.0, 2.0]), table([1.0, -0.5, 0.3, 0.0])
    dargs = jax.tree_util.tree_map(lambda leaf: None, load)
    dargs = eqx.tree_at(lambda s: s.values, dargs, along.values, is_leaf=lambda v: v is None)
    found = dvax.directional_derivative(problem, 0.2, 0.0, 2.0, load, dargs=dargs)

    def end(values):
        return dvax.solve(
            problem, 0.2, 0.0, 2.0, table(values), method=dvax.ETD4RK(), rtol=1e-9,
            adjoint="forward", max_steps=2**14,
        ).xs[-1]  # fmt: skip

    exact = jax.jvp(end, (load.values,), (along.values,))[1]
    assert float(found.dxs[-1]) == pytest.approx(float(exact), rel=1e-6)


@pytest.mark.thorough
def test_directional_derivative_with_a_fast_rotating_half_plane():
    """z leaves the corner much more slowly than the half-plane rotates."""
    e = jnp.array([0.0, 1.0])
    problem = dvax.Problem(
        A=ZERO, P=ONE, h=lambda t, x, u, a: e + 1e-4 * x,
        K=lambda t, a: dvax.sets.HalfSpace(jnp.stack([jnp.cos(a), jnp.sin(a)]), 0.0),
        f=lambda t, x, u, a: 0.5 * ((u - e) + 0.5 * (u - e)[::-1]),
    )  # fmt: skip
    dx0 = jnp.array([3.0, 3.0])
    found = dvax.directional_derivative(
        problem, jnp.zeros(2), 0.0, 1.0, jnp.array(0.0), dx0=dx0, dargs=jnp.array(1.0)
    )
    exact = quotient(problem, jnp.zeros(2), 1.0, jnp.array(0.0), dx0, jnp.array(1.0))
    np.testing.assert_allclose(np.asarray(found.dxs[-1]), exact, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(np.asarray(found.dus[-1]), [-1.0, 2.8e-4], atol=1e-4)


@pytest.mark.thorough
def test_directional_derivative_with_a_shrinking_ball():
    spin = jnp.array([[0.0, 2.0], [-2.0, 0.0]])
    problem = dvax.Problem(
        A=ZERO, P=ONE, K=lambda t, r: dvax.sets.Ball(0.0, r), h=lambda t, x, u, r: x,
        f=lambda t, x, u, r: spin @ x + (x - u),
    )  # fmt: skip
    for dx0 in (None, jnp.array([1e-7, 0.0])):
        found = dvax.directional_derivative(
            problem, jnp.array([1.0, 0.0]), 0.0, 1.0, jnp.array(1.0), dx0=dx0, dargs=jnp.array(-1.0)
        )
        np.testing.assert_allclose(np.asarray(found.dxs[-1]), [-0.7151, -1.5624], atol=1e-4)


@pytest.mark.thorough
def test_directional_derivative_with_a_product_of_boxes_and_a_tuple_state():
    space = dvax.spaces.Product(dvax.spaces.Euclidean(2), dvax.spaces.Euclidean())
    problem = dvax.Problem(
        A=ZERO, P=ONE, K=dvax.sets.Product(dvax.sets.Box(0.0, 9.0), dvax.sets.Box(0.0, 9.0)),
        f=lambda t, x, u, a: (u[0] - 2 * x[0], u[1] - 2 * x[1] + x[0][0]),
        h=lambda t, x, u, a: (x[0], x[1]), state_space=space,
    )  # fmt: skip
    found = dvax.directional_derivative(
        problem,
        (jnp.zeros(2), jnp.array(0.0)),
        0.0,
        1.0,
        dx0=(jnp.array([1.0, -1.0]), jnp.array(0.0)),
    )
    first, second = (np.asarray(part[-1]) for part in found.dxs)
    np.testing.assert_allclose(first, [np.exp(-1.0), -np.exp(-2.0)], rtol=1e-6)
    # δx₂' = −2δx₂ + max(δx₂, 0) + e^{−t}, from 0: t e^{−t}
    assert float(second) == pytest.approx(np.exp(-1.0), rel=1e-6)


@pytest.mark.thorough
def test_directional_derivative_accepts_single_precision_and_none_in_args():
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=ONE, K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, a: a[0] - 0.5 * x - u, h=lambda t, x, u, a: 1.0 - 2 * x - u,
    )  # fmt: skip
    with jax.numpy_dtype_promotion("standard"):  # times of tables are double
        short = dvax.directional_derivative(
            problem, jnp.float32(-1.0), 0.0, 2.0, (jnp.float32(3.0), None), dx0=1.0,
            dargs=(1.0, None), rtol=1e-4, atol=1e-5, tol=1e-3,
        )  # fmt: skip
    by_start, by_load = c1_derivatives()
    assert short.dxs.dtype == jnp.float32
    assert float(short.dxs[-1]) == pytest.approx(by_start + by_load, rel=1e-2)
    c = c1().constants
    bounds = dvax.ParameterBounds(
        c, T=2.0, kappa_K=0.0, C_h0=1.0, C_f0=3.0, modulus_f=1.0, modulus_h=0.0
    )
    seen = dvax.sensitivity.change(
        problem, -1.0, 0.0, 2.0, (3.0, None), bounds, dargs=(0.1, None), ts=[0.0, 1.0, 2.0]
    )
    assert seen.x.actual[-1] == pytest.approx(0.064, abs=1e-3)
    assert seen.x.certified[-1] == pytest.approx(0.3437, abs=1e-3)


@pytest.mark.slow
def test_sets_that_do_not_show_their_kinks_are_refused():
    def weakly_active(K):
        # u = proj_K((1.5, 0.5) + x): y₁ + y₂ ≤ 1 is active, and y₂ ≥ 0 as well, without a multiplier
        # for x ∈ span(−1, 1).
        return dvax.Problem(
            A=dvax.generators.Zero(), P=ONE, K=K, f=lambda t, x, u, a: 0.0 * x,
            h=lambda t, x, u, a: jnp.array([1.5, 0.5]) + x, control_space=dvax.spaces.Euclidean(2),
        )  # fmt: skip

    both = dvax.sets.Intersection(
        dvax.sets.Box(0.0, jnp.inf), dvax.sets.HalfSpace(jnp.ones(2), 1.0)
    )
    with pytest.raises(dvax.InputError, match=r"Intersection.*ConstrainedBox"):
        dvax.directional_derivative(weakly_active(both), jnp.zeros(2), 0.0, 1.0, dx0=jnp.ones(2))
    boxes = dvax.sets.Intersection(dvax.sets.Box(0.0, jnp.inf), dvax.sets.Box(-1.0, 1.5))
    found = [
        dvax.directional_derivative(
            weakly_active(K), jnp.array([-0.2, -0.5]), 0.0, 1.0, dx0=jnp.array([1.0, -1.0])
        )
        for K in (boxes, dvax.sets.Box(0.0, 1.5))
    ]
    np.testing.assert_array_equal(found[0].dus, found[1].dus)
    assert len(found[0].kinks) == len(found[1].kinks) == 1
