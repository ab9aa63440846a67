"""Measured data as functions of time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate

import dvax
from dvax._jax.jaxprs import count_operations
from dvax._lookup import count_up_to
from dvax.signals import Constant, Function, Product, Table, listen

TIMES = np.array([-1.0, -0.2, 0.1, 0.9, 2.0, 2.5])
VALUES = np.array([[0.0, 1.0], [3.0, -1.0], [2.0, 2.0], [2.0, 0.0], [-4.0, 1.0], [0.5, 7.0]])
KINDS = ("constant", "linear", "cubic")
# Inside the pieces, on every knot, and next to the knots on either side.
ASKED = np.sort(
    np.concatenate(
        [np.linspace(-1, 2.5, 61), TIMES, np.nextafter(TIMES[1:], -9), np.nextafter(TIMES[:-1], 9)]
    )
)


def exact(kind, t):
    if kind == "linear":
        return scipy.interpolate.make_interp_spline(TIMES, VALUES, k=1)(t)
    if kind == "cubic":
        return scipy.interpolate.CubicSpline(TIMES, VALUES, bc_type="not-a-knot")(t)
    return VALUES[[np.max(np.flatnonzero(TIMES <= s)) for s in t]]


@pytest.mark.parametrize("kind", KINDS)
def test_a_table_joins_its_values_as_scipy_does(kind):
    table = Table(TIMES, VALUES, kind)
    found = np.asarray(jax.jit(jax.vmap(table.value))(jnp.asarray(ASKED)))
    np.testing.assert_allclose(found, exact(kind, ASKED), rtol=1e-12, atol=1e-12)


def test_a_constant_table_takes_the_new_value_at_a_jump():
    table = Table([0.0, 1.0, 2.0], [5.0, 7.0, 9.0], "constant")
    before = float(np.nextafter(1.0, 0.0))
    assert [float(table(t)) for t in (0.0, before, 1.0, 1.5, 2.0)] == [5.0, 5.0, 7.0, 7.0, 9.0]


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_extrapolated(kind):
    table = Table(TIMES, VALUES, kind)
    outside = [np.nextafter(-1.0, -2), -5.0, np.nextafter(2.5, 3), 1e9]
    found = np.asarray(jax.vmap(table.value)(jnp.asarray(outside)))
    assert np.all(np.isnan(found))
    assert np.all(np.isfinite(np.asarray(jax.vmap(table.value)(jnp.array([-1.0, 2.5])))))


def test_a_cubic_table_of_four_points_is_the_cubic_through_them():
    t = np.array([0.0, 0.4, 1.1, 3.0])
    table = Table(t, t**3 - 2 * t**2 + 1, "cubic")
    s = np.linspace(0, 3, 31)
    found = np.asarray(jax.vmap(table.value)(jnp.asarray(s)))
    np.testing.assert_allclose(found, s**3 - 2 * s**2 + 1, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 10, 63, 65, 1000, 1024, 1025, 4097])
def test_the_times_up_to_any_time_are_counted_as_numpy_does(count):
    rng = np.random.default_rng(count)
    times = np.sort(rng.uniform(0, 1, count))
    near = np.concatenate([times, np.nextafter(times, -1), np.nextafter(times, 2)])
    asked = np.concatenate([rng.uniform(-0.1, 1.1, 50), rng.choice(near, 100), near[:9], near[-9:]])
    find = jax.jit(lambda t: count_up_to(jnp.asarray(times), t))
    one_by_one = [int(find(t)) for t in asked[:60]]
    expected = np.searchsorted(times, asked, side="right")
    np.testing.assert_array_equal(one_by_one, expected[:60])
    np.testing.assert_array_equal(jax.vmap(find)(asked), expected)
    np.testing.assert_array_equal(find(asked), expected)


@pytest.mark.parametrize("count", [169, 8784])
def test_a_lookup_has_few_operations_because_a_program_contains_many(count):
    table = Table(np.arange(count), np.sin(np.arange(count)))
    program = jax.make_jaxpr(table.value)(0.5)
    assert count_operations(program) < 60


@pytest.mark.parametrize("kind", KINDS)
def test_a_table_takes_an_array_of_times(kind):
    table = Table(TIMES, VALUES, kind)
    asked = ASKED[:60].reshape(5, 12)
    found = table(asked)
    assert found.shape == (5, 12, 2)
    np.testing.assert_allclose(
        found.reshape(60, 2), exact(kind, ASKED[:60]), rtol=1e-12, atol=1e-12
    )


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_a_table_is_linear_in_its_values_and_its_gradient_says_how(kind):
    t = 0.37
    weights = jax.jacrev(lambda v: Table(TIMES, v, kind)(t))(jnp.asarray(VALUES[:, 0]))
    np.testing.assert_allclose(
        float(jnp.dot(weights, jnp.asarray(VALUES[:, 1]))), exact(kind, [t])[0, 1], atol=1e-12
    )
    # The unit values one by one give the same weights.
    unit = np.eye(len(TIMES))
    by_hand = {
        "constant": lambda e: e[2],
        "linear": lambda e: np.interp(t, TIMES, e),
        "cubic": lambda e: scipy.interpolate.CubicSpline(TIMES, e)(t),
    }[kind]
    np.testing.assert_allclose(np.asarray(weights), [by_hand(e) for e in unit], atol=1e-12)


def test_a_product_of_a_profile_and_a_record_is_a_separable_field():
    profile, record = np.array([1.0, -2.0, 4.0]), Table(TIMES, VALUES[:, 0])
    field = Product(Constant(profile), record)
    expected = profile * np.interp(0.3, TIMES, VALUES[:, 0])
    np.testing.assert_allclose(np.asarray(field(0.3)), expected)
    np.testing.assert_allclose(np.asarray(Product(record, 2.0)(0.3)), 2 * expected[0])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Table([0.0, 2.0, 1.0], [1.0, 2.0, 3.0]), ["times[1]", "increase"]),
        (lambda: Table([0.0, 1.0, 1.0], [1.0, 2.0, 3.0]), ["times[1]", "increase"]),
        (lambda: Table([0.0, np.nan], [1.0, 2.0]), ["times[1]", "finite"]),
        (lambda: Table([0.0, np.inf], [1.0, 2.0]), ["times[1]", "finite"]),
        (lambda: Table([0.0, 1.0], [1.0, np.nan]), ["values[1] = nan", "first of 1", "finite"]),
        (
            lambda: Table([0.0, 1.0], [[1.0, 2.0], [np.inf, np.nan]]),
            ["values[1, 0] = inf", "first of 2"],
        ),
        (lambda: Table([0.0, 1.0], [1.0, np.inf]), ["values", "finite"]),
        (lambda: Table([0.0, 1.0], [1.0, 2.0, 3.0]), ["(2,)", "(3,)"]),
        (lambda: Table([0.0], [1.0]), ["at least 2"]),
        (lambda: Table([0.0, 1.0, 2.0], [1.0, 2.0, 3.0], "cubic"), ["at least 4"]),
        (lambda: Table([[0.0, 1.0]], [[1.0, 2.0]]), ["vector"]),
        (
            lambda: Table(np.array(["2020-01-01", "2020-01-02"], "M8[D]"), [1.0, 2.0]),
            ["since a date"],
        ),
        (lambda: Constant(float("nan")), ["finite"]),
    ],
)
def test_bad_data_is_refused_with_its_place(make, words):
    with pytest.raises(dvax.InputError) as caught:
        make()
    for word in words:
        assert word in str(caught.value)


def test_a_listener_hears_every_table_at_its_own_time_and_no_other():
    a, b = Table([0.0, 1.0], [0.0, 1.0]), Table([0.5, 3.0, 4.0], [0.0, 1.0, 2.0])
    kinked = Function(lambda t: jnp.abs(t - 0.25), knots=[0.25])

    def use(t):
        with listen(t) as reports:
            Product(a, b)(t)
            kinked(t)
            Constant(2.0)(t)
            b(t - 1.0)
        return reports

    found = []
    jax.eval_shape(lambda t: (found.append(use(t)), t)[1], jnp.zeros(()))
    reports = found[0]
    assert sorted(float(k) for knots in reports.knots for k in knots) == [0, 0.25, 0.5, 1, 3, 4]
    assert [name for _, _, name in reports.spans if name == "Table"] == ["Table", "Table"]
    assert len(reports.unresolved) == 1 and "Table" in reports.unresolved[0]
    # Outside the block no signal is recorded.
    a(0.5)
    assert len(reports.knots) == 3


@pytest.mark.slow
def test_lists_in_args_are_tables():
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0),
        K=lambda t, args: dvax.sets.Box(0.0, dvax.signals.Table([0.0, 1.0], args["limit"])(t)),
        f=lambda t, x, u, args: dvax.signals.Table(args["times"], [1.0, 2.0])(t) - u,
        h=lambda t, x, u, args: x,
    )  # fmt: skip
    lists = {"limit": [1.0, 2], "times": [0.0, 1.0]}
    arrays = {"limit": jnp.array([1.0, 2.0]), "times": np.array([0.0, 1.0])}
    ends = [dvax.solve(problem, 0.5, 0.0, 1.0, args).xs[-1] for args in (lists, arrays)]
    np.testing.assert_allclose(*ends, rtol=1e-9)
