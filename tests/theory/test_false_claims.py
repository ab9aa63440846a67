"""Cases for which an earlier version wrongly reported proved or refuted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import dvax

GIVEN = dict(
    A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
    f=lambda t, x, u, args: -u, h=lambda t, x, u, args: 0.1 * x,
)  # fmt: skip


def problem(**other):
    return dvax.Problem(**{**GIVEN, **other})


def test_verify_bounds_a_reshape_with_permuted_axes():
    left, right = jnp.array([[-100.0, 0.0], [0.0, 0.0]]), jnp.array([0.0, 100.0, 0.0, 0.0])
    f = lambda t, x, u, a: left @ x + (jnp.ravel(x, order="F") * right).reshape(2, 2)  # noqa: E731
    c = dvax.verify(problem(f=f), jnp.zeros((2, 2))).constants
    J = np.asarray(jax.jacfwd(lambda x: f(0.0, x, 0.0, None))(jnp.zeros((2, 2)))).reshape(4, 4)
    assert float(c.alpha_f) == pytest.approx(np.linalg.norm(J, 2))
    assert float(c.one_sided) >= np.linalg.eigvalsh(0.5 * (J + J.T))[-1] - 1 - 1e-9


def test_verify_bounds_the_response_of_a_coupled_law_as_a_whole():
    first, second = jnp.array([1.0, 0.0]), jnp.array([0.0, 1.001])
    wave = lambda u: jnp.array([0.0, 1.0]) * jnp.sin(2 * jnp.pi * u) / (2 * jnp.pi)  # noqa: E731
    system = problem(
        A=dvax.generators.Scalar(0.0), K=dvax.sets.Ball(0.0, np.sqrt(2.0)),
        h=lambda t, x, u, a: first * x + second,
        f=lambda t, x, u, a: jnp.array([-1.0, -2.0]) * x + wave(u),
    )  # fmt: skip
    mu = float(dvax.verify(system, jnp.zeros(2)).constants.one_sided)
    x, d = jnp.array([-1.00069, 1.20141]), jnp.array([7e-5, 7e-5])
    rates = []
    for angle in np.linspace(0.0, np.pi, 40):
        d = 1e-4 * jnp.array([np.cos(angle), np.sin(angle)])
        change = system.reduced(0.0, x + d) - system.reduced(0.0, x)
        rates.append(float(change @ d / (d @ d)))
    assert max(rates) > -0.95  # above what was once called proved
    assert mu >= max(rates) - 1e-6


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("K", "h"),
    [
        (dvax.sets.Box(0.0, 0.5), lambda t, x, u, a: -5 * lax.round(u)),
        (
            dvax.sets.Box(0.0, 4.0),
            lambda t, x, u, a: (
                jnp.where(jnp.clip(jnp.floor(u).astype(int), 1, 3) // 2 == 0, 5.0, 0.0) + 0 * u
            ),
        ),
    ],
)
def test_verify_does_not_prove_a_law_with_a_jump_inside_the_set(K, h):
    check = dvax.verify(problem(K=K, h=h))
    assert check["ass:strong_pseudomono"].status != "proved"
    assert check["ass:lipschitz_smallness"].status != "proved"


def test_verify_treats_filled_entries_of_a_gather_as_constant():
    outside = jnp.array([7])
    f = lambda t, x, u, a: (  # noqa: E731
        x.at[outside].get(mode="fill", fill_value=-7.0) + 14 * jnp.maximum(x, 0.0)
    )
    c = dvax.verify(problem(A=dvax.generators.Scalar(0.0), f=f), jnp.zeros(1)).constants
    assert float(c.alpha_f) == pytest.approx(14.0)


def test_verify_accepts_user_functions_with_names_of_dvax():
    @jax.jit
    def linear_table(knots, weights, s):
        return jnp.sum(weights * jnp.maximum(s - knots, 0.0))

    knots = jnp.array([0.0, 1.0, 2.0])
    f = lambda t, x, u, a: linear_table(knots, jnp.ones(3), x)  # noqa: E731
    c = dvax.verify(problem(f=f), 0.0, x=(0.0, 2.0)).constants
    assert float(c.alpha_f) >= 2.0


@pytest.mark.slow
def test_verify_with_a_declared_spectrum_is_not_proved():
    n = 3000
    e = jnp.zeros(n).at[0].set(1.0)
    P = dvax.operators.MatrixFree(lambda v: v + 3 * e * v, m=1.0, norm=4.0)
    h = lambda t, x, u, a: 0.1 * x + 0.1 * jnp.tanh(u)  # noqa: E731
    check = dvax.verify(problem(P=P, K=dvax.sets.Box(-1.0, 1.0), h=h), jnp.zeros(n))
    assert check["ass:strong_pseudomono"].status == "declared"
    # An affine law goes by its action, P⁻¹ by conjugate gradients.
    affine = problem(
        P=dvax.operators.MatrixFree(lambda v: 2 * v, m=0.5, norm=2.5),
        h=lambda t, x, u, a: 0.1 * x + 0.1 * u,
    )
    found = dvax.verify(affine, jnp.zeros(4)).constants
    assert float(found.gamma) == pytest.approx(0.45, rel=1e-6)


@pytest.mark.thorough
def test_verify_of_a_weighted_law_with_a_declared_spectrum_is_declared():
    h = lambda t, x, u, a: u - (2.0 + jnp.sin(x[0])) * (u - 0.1 * jnp.tanh(u))  # noqa: E731
    for declared, P in enumerate(
        (dvax.operators.Scaling(2.0), dvax.operators.MatrixFree(lambda v: 2.0 * v, m=2.0, norm=2.0))
    ):
        check = dvax.verify(problem(P=P, K=dvax.sets.Box(-1.0, 1.0), h=h), jnp.zeros(3))
        row = check["ass:strong_pseudomono"]
        assert row.status == ("declared" if declared else "proved")
        assert "F = aG" in row.why


@pytest.mark.slow
def test_verify_constants_hold_for_their_args_and_times_only():
    f = lambda t, x, u, a: a["k"] * x - u + jnp.sin(t)  # noqa: E731
    system = problem(f=f, K=dvax.sets.Box(-1.0, 1.0))
    one, other = {"k": jnp.asarray(1.0)}, {"k": jnp.asarray(3.0)}
    c = dvax.verify(system, 0.0, args=one).constants
    for args, status in ((one, "proved"), ({"k": 1.0}, "proved"), (other, "declared")):
        sol = dvax.solve(system, 0.1, 0.0, 1.0, args, method=dvax.ETD2RK())
        assert dvax.bound_error(system, sol, c).status == status
    with pytest.raises(dvax.InputError, match="another args"):
        dvax.solve(system, 0.1, 0.0, 1.0, other, constants=c, certified_tol=1e-3)
    with pytest.raises(dvax.InputError, match="verified on"):
        dvax.solve(system, 0.1, 0.0, 2.0, one, constants=c, certified_tol=1e-3)


@pytest.mark.slow
def test_verify_constants_do_not_follow_an_array_that_numpy_changes():
    system = problem(f=lambda t, x, u, a: a * x - u, K=dvax.sets.Box(-1.0, 1.0))
    args = np.array(1.0)
    c = dvax.verify(system, 0.0, args=args).constants
    args[...] = 3.0
    sol = dvax.solve(system, 0.1, 0.0, 1.0, args, method=dvax.ETD2RK())
    assert dvax.bound_error(system, sol, c).status == "declared"


def test_verify_does_not_prove_an_empty_intersection():
    balls = dvax.sets.Intersection(
        dvax.sets.Ball(0.0, 1.0), dvax.sets.Ball(jnp.array([5.0, 0.0]), 1.0)
    )
    check = dvax.verify(problem(K=balls), jnp.zeros(2))
    assert check["ass:operators (iii)"].status != "proved"


@pytest.mark.slow
@pytest.mark.parametrize("knot", [0.5, 0.0])
def test_verify_detects_jumps_in_time_at_any_knot(knot):
    switch = dvax.signals.Function(
        lambda t: jnp.where(t < knot, -5.0, -3.0), knots=jnp.array([knot])
    )
    moving = problem(K=lambda t, a: dvax.sets.Box(switch(t), 10.0))
    assert dvax.verify(moving, t0=-1.0)["ass:time_regularity (i)"].status != "proved"
    below = problem(K=lambda t, a: dvax.sets.Box(-6.0, switch(t)))
    assert dvax.verify(below, t0=-1.0)["ass:time_regularity (i)"].status == "refuted"
    scaled = problem(h=lambda t, x, u, a: switch(t) * x)
    assert dvax.verify(scaled, t0=-1.0)["ass:time_regularity (ii)"].status != "proved"


@pytest.mark.parametrize(("begin", "slope"), [(1e5, 1.0), (1.7e9, 1e-3)])
def test_verify_does_not_mistake_a_slope_at_a_late_time_for_a_jump(begin, slope):
    times = begin + 3600.0 * np.arange(4)
    load = dvax.signals.Table(times, np.array([1.0, 1.0, 1.0 + slope * 3600, 1.0]))
    system = problem(
        K=lambda t, a: dvax.sets.Box(-1.0, load(t) - 0.5), h=lambda t, x, u, a: 0.1 * x + load(t)
    )
    check = dvax.verify(system, None, times[0], times[-1])
    assert check["ass:time_regularity (i)"].status == "proved"
    assert check["ass:time_regularity (ii)"].status == "proved"


@pytest.mark.thorough
def test_certified_tol_rejects_constants_of_a_region_that_the_run_leaves():
    grows = problem(
        A=dvax.generators.Scalar(0.0), K=dvax.sets.Box(-10.0, 10.0),
        f=lambda t, x, u, a: 20 * jnp.maximum(x - 0.5, 0.0) + 1.0 + jnp.sin(20 * t) - 0.0 * u,
    )  # fmt: skip
    c = dvax.verify(grows, 0.0, 0.0, 1.0, x=(-1.0, 0.5)).constants
    with pytest.raises(dvax.InputError, match="larger region"):
        dvax.solve(grows, 0.0, 0.0, 0.8, constants=c, certified_tol=1e-2)
    reacts = problem(
        A=dvax.generators.Scalar(0.0), K=dvax.sets.Box(-10.0, 10.0), h=lambda t, x, u, a: x,
        f=lambda t, x, u, a: 20 * jnp.maximum(u - 0.5, 0.0) + 1.0 + jnp.sin(20 * t),
    )  # fmt: skip
    c = dvax.verify(reacts, 0.0, 0.0, 1.0, u=(-1.0, 0.5)).constants
    with pytest.raises(dvax.InputError, match="larger region"):
        dvax.solve(reacts, 0.0, 0.0, 0.8, constants=c, certified_tol=1e-2)
    sol = dvax.solve(reacts, 0.0, 0.0, 0.8, rtol=1e-4, method=dvax.ETD2RK())
    assert np.isinf(float(dvax.bound_error(reacts, sol, c).x[-1]))


def test_parameter_bounds_in_a_region_are_declared():
    f = lambda t, x, u, a: 20 * a["k"] * jnp.maximum(x - 0.5, 0.0) + a["c"] - u * 0.0  # noqa: E731
    ends = {"k": 1.0, "c": 1.0}, {"k": 1.0, "c": 1.1}
    bounds = dvax.parameter_bounds(problem(f=f), *ends, 0.0, x=(-1.0, 0.5))
    assert bounds.status == "declared"


@pytest.mark.thorough
def test_bound_error_of_a_single_precision_run_accepts_double_constants():
    short = problem(K=dvax.sets.Box(jnp.float32(0.0), jnp.float32(1.0)))
    c = dvax.verify(short, jnp.zeros(2, jnp.float32)).constants
    sol = dvax.solve(short, jnp.ones(2, jnp.float32), 0.0, 1.0, rtol=1e-3)
    assert np.isfinite(float(dvax.bound_error(short, sol, c).x[-1]))


def test_verify_proves_a_pseudomonotone_law_with_zero_slope():
    flat = problem(K=dvax.sets.Box(1.0, 2.0), h=lambda t, x, u, a: u - (2 / u) * u)
    check = dvax.verify(flat)
    assert check.constants is not None and float(check.constants.gamma) == pytest.approx(1.0)


@pytest.mark.thorough
def test_certified_tol_checks_the_region_between_saved_times():
    """For x = sin t, which exceeds 0.6 for a while, constants up to 0.6 do not hold then."""
    k = lambda x: 12 * jnp.tanh(5 * jnp.maximum(jnp.abs(x) - 0.6, 0.0))  # noqa: E731
    system = problem(
        A=dvax.generators.Zero(), K=dvax.sets.Box(0.0, 0.5), h=lambda t, x, u, a: 0.0 * x,
        f=lambda t, x, u, a: jnp.cos(t) + k(x) * (x - jnp.sin(t)) - 0.0 * u,
    )  # fmt: skip
    c = dvax.verify(system, 0.0, 0.0, 3.0, x=(-0.6, 0.6)).constants
    with pytest.raises(dvax.InputError, match="larger region"):
        dvax.solve(system, 0.0, 0.0, 3.0, constants=c, certified_tol=1e-3)
    inside = dvax.verify(system, 0.0, 0.0, 0.6, x=(-0.6, 0.6)).constants
    sol = dvax.solve(
        system, 0.0, 0.0, 0.6, ts=[0.2, 0.2, 0.6], constants=inside, certified_tol=1e-3
    )
    assert sol.ts.tolist() == [0.2, 0.2, 0.6] and sol.xs.shape == (3,)
    assert (
        np.max(np.abs(np.asarray(sol.xs) - np.sin(sol.ts))) <= sol.stats["certified_bound"] <= 1e-3
    )


def test_parameter_bounds_measure_radii_from_the_origin():
    steep = lambda t, x, u, a: a * x + 10 * jnp.tanh(10 * x) + 0.0 * u  # noqa: E731
    system = problem(f=steep, h=lambda t, x, u, a: -u)
    with pytest.raises(dvax.InputError, match="region without 0"):
        dvax.parameter_bounds(system, 0.0, 0.01, 1.0, start_radius=1.0, x=(1.0, np.inf))
    for radius in (-1.0, np.nan, np.inf):
        with pytest.raises(dvax.InputError, match="start_radius"):
            dvax.parameter_bounds(system, 0.0, 0.01, 1.0, start_radius=radius)


@pytest.mark.thorough
def test_parameter_bounds_do_not_hold_outside_their_box():
    system = problem(
        K=dvax.sets.Box(0.0, 0.5), f=lambda t, x, u, a: a**3 - 0.5 * x - u,
        h=lambda t, x, u, a: 1.0 - 2 * x - u,
    )  # fmt: skip
    bounds = dvax.parameter_bounds(system, 0.0, 0.1, t1=2.0)
    change = dvax.sensitivity.change
    with pytest.raises(dvax.InputError, match="outside it"):
        change(system, -1.0, 0.0, 2.0, 0.05, bounds, dargs=1.0)
    with pytest.raises(dvax.InputError, match=r"times \[0, 2\]"):
        change(system, -1.0, 5.0, 7.0, 0.05, bounds, dargs=0.01)
    with pytest.raises(dvax.InputError, match=r"dargs.*structure"):
        change(system, -1.0, 0.0, 2.0, 0.05, bounds, dargs=(0.01, 0.02))
    grows = problem(f=lambda t, x, u, a: a * x - u, K=dvax.sets.Box(0.0, 0.5))
    bounds = dvax.parameter_bounds(grows, 0.0, 0.1, t1=2.0, start_radius=1.0)
    with pytest.raises(dvax.InputError, match=r"norm 3"):
        change(grows, 3.0, 0.0, 2.0, 0.05, bounds, dargs=0.01)


def friction(v):
    return -jnp.sign(v)


JUMPS = {
    "sign": (friction, 2.0),
    "heaviside": (lambda v: jnp.heaviside(v - 0.7, 0.0), 1.0),
    "with a slope": (lambda v: -100.0 * v - jnp.where(v > 1.2, 3.0, 0.0), 3.0),
    "small beside others": (lambda v: 30.0 * jnp.cos(v) + 0.5 * jnp.floor(v / 2.5), 0.5),
    "branches apart": (lambda v: jnp.where(v > 0.3, -1.0, -v), 0.7),
    "condition": (lambda v: jax.vmap(lambda w: lax.cond(w < -1, lambda: 2.0, lambda: w))(v), 3.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("where", ["f", "h"])
@pytest.mark.parametrize("name", JUMPS)
def test_verify_refutes_a_lipschitz_constant_of_a_function_that_jumps(name, where):
    """An estimate from slopes and differences would be a number without meaning."""
    fn, height = JUMPS[name]
    system = problem(**{where: lambda t, x, u, args: fn(x) - u})
    found = dvax.verify(system, jnp.array([0.3, 0.2]), 0.0, 5.0, x=(-3.0, 3.0))
    label = {"f": "ass:f_lipschitz", "h": "ass:h_lipschitz_x"}[where]
    assert found[label].status == found.status == "refuted"
    text = found[label].why.split("jumps by ")[1]
    assert float(text.split()[0]) == pytest.approx(height, rel=1e-3)
    assert "as a law" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    "fn",
    [
        lambda v: jnp.tanh(1e6 * v), lambda v: jax.scipy.special.digamma(v + 4.0),
        lambda v: jnp.sign(v) * jnp.sqrt(jnp.abs(v)), jnp.sinc, lambda v: jnp.fmod(v, 50.0),
        lambda v: (1e10 + jnp.fmod(v, 50.0)) - 1e10, lambda v: jnp.cumprod(1.0 + v),
    ],
)  # fmt: skip
def test_verify_does_not_mistake_a_steep_function_or_rounding_for_a_jump(fn):
    system = problem(f=lambda t, x, u, args: fn(x) - u)
    found = dvax.verify(system, jnp.array([0.3, 0.2]), 0.0, 5.0, x=(-3.0, 3.0))
    assert found["ass:f_lipschitz"].status in ("proved", "estimated")


@pytest.mark.slow
def test_a_law_with_a_dead_zone_times_a_sum_is_not_proved_monotone():
    """The condition on one entry was once applied to the sum too: γ = 0.55 was called proved,
    while the symmetric part of ∂F has the eigenvalue −0.085."""
    inside = lambda v: jnp.abs(v) <= 0.1  # noqa: E731
    zone = lambda v: jnp.where(inside(v), (0.1 - jnp.abs(v)) * jnp.sum(v), 0.0)  # noqa: E731
    system = problem(f=lambda t, x, u, a: 0.0 * x, h=lambda t, x, u, a: -zone(u - 0.5))
    y = jnp.array([0.599466, 0.998102, 0.987523])
    J = np.asarray(jax.jacfwd(lambda y: y + zone(y - 0.5))(y))
    least = np.linalg.eigvalsh(0.5 * (J + J.T))[0]
    assert least < -0.08
    check = dvax.verify(system, jnp.zeros(3))
    assert check["ass:strong_pseudomono"].status != "proved"
    assert check.constants is None


@pytest.mark.slow
def test_switching_times_of_each_entry_do_not_hold_for_the_others():
    rates = jnp.array([1.0, 2.0])
    fast = lambda t, x, u, a: jnp.where(t * rates > 1.0, x, jnp.sum(t * rates) * x)  # noqa: E731
    found = dvax.verify(problem(f=fast), jnp.zeros(2), 0.0, 1.0, x=(-1.0, 1.0))
    assert float(found.constants.alpha_f) >= 3.0


@pytest.mark.slow
def test_a_sum_of_exponentials_beside_a_value_of_many_operations_is_bounded():
    def deep(x):
        for _ in range(70):
            x = 0.5 * jnp.sin(x) + 0.1 * x
        return x

    system = problem(f=lambda t, x, u, a: deep(x) - jnp.log(1 + jnp.exp(x)))
    found = dvax.verify(system, jnp.zeros(2), 0.0, 1.0, x=(-1.0, 1.0))
    assert 0.731 <= float(found.constants.alpha_f) <= 0.74


def _of_three(F, **other):
    law = dict(K=dvax.sets.Box(0.0, jnp.ones(3)), h=lambda t, x, u, a: u - F(u, a) - x)
    return problem(**{**law, **other})


INDEFINITE = {
    "affine": lambda u, a: 0.02 * jnp.sum(u) - 1e-3 * u,
    "cubic": lambda u, a: 4.0 * (u - 0.5) ** 3 - 0.1 * u,
    "one direction": lambda u, a: u - 0.7 * jnp.sum(u),
}


@pytest.mark.parametrize("name", INDEFINITE)
def test_verify_refutes_a_law_whose_slope_is_negative_somewhere(name):
    """x moves F so that ⟨F(y), z − y⟩ ≥ 0 > ⟨F(z), z − y⟩ for two points along which F decreases."""
    F = INDEFINITE[name]
    found = dvax.verify(_of_three(F), jnp.ones(3), 0.0, 1.0)["ass:strong_pseudomono"]
    assert found.status == "refuted"
    x, y, z = (np.asarray(getattr(found.evidence, name)) for name in ("x", "y", "z"))
    assert (y >= 0).all() and (z >= 0).all() and (y <= 1).all() and (z <= 1).all()
    assert np.asarray(F(y, None) + x) @ (z - y) >= 0.0 > np.asarray(F(z, None) + x) @ (z - y)


def test_a_declared_modulus_of_a_law_that_decreases_is_refuted():
    given = _of_three(INDEFINITE["affine"])
    found = dvax.verify(given, jnp.ones(3), 0.0, 1.0, declared={"gamma": 0.1})
    assert found["ass:strong_pseudomono"].status == "refuted"


def test_speed_of_h_in_time_is_a_norm():
    moving = problem(h=lambda t, x, u, a: jnp.array([3.0, 4.0]) * t - u, control_space=None)
    why = dvax.verify(moving, jnp.zeros(2), 0.0, 1.0)["ass:time_regularity (ii)"].why
    assert "‖∂h/∂t‖ ≤ 5" in why


def test_verify_of_a_set_that_is_empty_somewhere_searches_nothing():
    rows = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
    empty = _of_three(
        lambda u, a: 2.0 * u + 0.1 * jnp.roll(u, 1) * jnp.sum(u),
        K=lambda t, a: dvax.sets.ConstrainedBox(
            jnp.zeros(3), jnp.ones(3), rows, jnp.array([0.0, 1.0]) + 3.0 * t, jnp.full(2, 9.0)
        ),
    )
    found = dvax.verify(empty, jnp.ones(3), 0.0, 1.0)
    assert found["ass:operators (iii)"].status == "refuted"
    assert "search" not in found["ass:strong_pseudomono"].why
