"""`dvax.ensemble`: each member is what `dvax.solve` makes of it alone."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import c1, c1_solution
from tests.selection import mostly_thorough

import dvax
from dvax import generators, operators, sets, spaces
from dvax.ensembles import Moments
from dvax.ensembles.ensemble import check_own
from dvax.ensembles.members import _compiled
from dvax.ensembles.workers import in_order

COUNT = 150


def loaded(args_of=lambda args: args):
    return dvax.Problem(
        A=generators.Scalar(-1.0), P=operators.Scaling(1.0), K=sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: args_of(args)["load"] - 0.5 * x - u,
        h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip


def pair():
    """Two states and a coupled law on a simplex, with a matrix among the parameters."""
    return dvax.Problem(
        A=generators.Zero(), P=operators.Scaling(1.0), K=sets.Simplex(1.0),
        f=lambda t, x, u, args: (args[0] @ u - x[0], 0.3 * x[0].sum() - args[1] * x[1]),
        h=lambda t, x, u, args: x[0] - u * jnp.arange(1.0, 4.0) + jnp.sin(3 * t),
        control_space=spaces.Euclidean(3),
    )  # fmt: skip


RNG = np.random.default_rng(5)
LOADS = RNG.uniform(2.0, 4.0, COUNT)
STARTS = RNG.uniform(-1.0, 0.5, COUNT)


def test_ensembles_of_about_as_many_members_run_one_program():
    programs = []
    for count in (150, 129, 200, 256):
        loads = np.linspace(2.0, 4.0, count)
        found = dvax.ensemble(loaded(), np.zeros(count), 0.0, 2.0, {"load": loads})
        programs.append(_compiled._cache_size())
        for k in (0, count - 1):
            alone = dvax.solve(loaded(), 0.0, 0.0, 2.0, {"load": loads[k]})
            assert abs(found.values[k] - alone.xs[-1]) <= 1e-12
    assert len(set(programs)) == 1


@pytest.fixture(scope="module")
def states():
    """Members with an x0, a load and an end of their own, at rows of times of their own."""
    ends = RNG.uniform(0.1, 2.0, COUNT)
    times = ends[:, None] * np.array([0.0, 0.5, 1.0])
    found = dvax.ensemble(loaded(), STARTS, 0.0, ends, {"load": LOADS}, times, rtol=1e-8)
    return ends, times, found


def test_members_are_single_solves(states):
    ends, times, found = states
    assert len(found) == COUNT and found.values.shape == (COUNT, 3) and not found.failed.any()
    for k in (0, 1, 77, COUNT - 1):
        alone = dvax.solve(
            loaded(), STARTS[k], 0.0, ends[k], {"load": LOADS[k]}, times[k], rtol=1e-8
        )
        np.testing.assert_allclose(found.values[k], alone.xs, atol=1e-12)
        np.testing.assert_allclose(found.member(k).xs, alone.xs, atol=1e-12)
        assert int(found.steps[k]) == int(alone.stats["steps"])
        assert float(found.ts[k]) == ends[k]
    assert found.method == alone.stats["method"]


@pytest.mark.slow
def test_members_of_a_closed_form():
    case = c1()
    ends = np.linspace(0.2, 2.0, 40)
    found = dvax.ensemble(
        case.problem, case.x0, 0.0, ends, case.args, axes=(None, None), rtol=1e-9, atol=1e-12
    )
    exact = [c1_solution(t)[0] for t in ends]
    np.testing.assert_allclose(found.values, exact, atol=3e-9)


@pytest.mark.thorough
def test_trees_of_states_and_arguments_with_some_axes_shared():
    x0 = (jnp.array([0.2, 0.3, 0.5]), jnp.asarray(1.0))
    matrices, rates = RNG.normal(size=(12, 3, 3)), np.array([0.5])
    observe = lambda sol: {"x": sol.xs[1], "u": sol.us}  # noqa: E731
    found = dvax.ensemble(
        pair(), x0, 0.0, 1.0, (matrices, rates[0]), [0.5, 1.0], axes=(None, (0, None)),
        observe=observe,
    )  # fmt: skip
    assert found.values["x"].shape == (12, 2) and found.values["u"].shape == (12, 2, 3)
    for k in (0, 7):
        alone = dvax.solve(pair(), x0, 0.0, 1.0, (matrices[k], 0.5), [0.5, 1.0])
        np.testing.assert_allclose(found.values["x"][k], alone.xs[1], atol=1e-9)
        np.testing.assert_allclose(found.values["u"][k], alone.us, atol=1e-9)


OPTIONS = {
    "dt": {"dt": 0.01},
    "ETD4RK": {"method": dvax.ETD4RK()},
    "Implicit": {"method": dvax.Implicit()},
    "Picard": {"method": dvax.Picard()},
    "numbers": {"dt0": 0.01, "dt_max": 0.2, "horizon": 4.0},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(OPTIONS, ["dt", "numbers"]))
def test_options_are_those_of_solve(name):
    options = OPTIONS[name]
    found = dvax.ensemble(loaded(), STARTS[:5], 0.0, 1.0, {"load": LOADS[:5]}, rtol=1e-5, **options)
    alone = dvax.solve(loaded(), STARTS[3], 0.0, 1.0, {"load": LOADS[3]}, rtol=1e-5, **options)
    np.testing.assert_allclose(found.values[3], alone.xs[0], atol=1e-11)


@pytest.mark.thorough
def test_events_are_observed_in_each_member():
    rise = dvax.Event(lambda t, x, u, args: x - 1.0, direction=1, terminal=True)
    found = dvax.ensemble(
        loaded(), STARTS, 0.0, 4.0, {"load": LOADS}, events=[rise], max_events=2,
        observe=lambda sol: sol.events.ts[0],
    )  # fmt: skip
    alone = dvax.solve(loaded(), STARTS[9], 0.0, 4.0, {"load": LOADS[9]}, events=[rise])
    np.testing.assert_allclose(found.values[9], alone.events.ts[0], atol=1e-9)


@pytest.mark.slow
def test_first_member_with_an_empty_set_fails_alone():
    """u = min(1/2, a), and x' = −x + u from 0."""
    problem = dvax.Problem(
        A=generators.Scalar(-1.0), P=operators.Scaling(1.0), K=lambda t, a: sets.Box(0.0, a),
        f=lambda t, x, u, args: u, h=lambda t, x, u, args: 0.5 - 0.0 * x,
    )  # fmt: skip
    a = np.array([-1.0, 1.0, 0.25])
    with pytest.warns(UserWarning, match="1 of 3 members failed, the first of them number 0"):
        found = dvax.ensemble(problem, 0.0, 0.0, 1.0, a, axes=(None, 0))
    assert found.failed.tolist() == [True, False, False]
    exact = np.array([0.5, 0.25]) * -np.expm1(-1.0)
    np.testing.assert_allclose(found.values[1:], exact, rtol=1e-6)
    assert "K is refused at t = 0" in found.failures()[0]
    assert "lower = 0, upper = -1" in found.failures()[0]
    with pytest.raises(dvax.InputError, match="lower = 0, upper = -1"):
        found.member(0)


@pytest.mark.slow
def test_failures_name_data_that_are_not_finite_and_sets_that_are_empty():
    problem = dvax.Problem(
        A=generators.Scalar(-1.0), P=operators.Scaling(1.0),
        K=lambda t, args: sets.ConstrainedBox(
            jnp.zeros(2), jnp.ones(2), jnp.ones((1, 2)), args["need"] * jnp.ones(1), jnp.full(1, 9.0)
        ),
        f=lambda t, x, u, args: args["push"] - u, h=lambda t, x, u, args: x - u,
    )  # fmt: skip
    x0s, need, push = np.ones((5, 2)), np.array([0.5, 1.0, 3.0, 0.1, 0.5]), np.ones((5, 2))
    x0s[0, 1], push[3, 0] = np.inf, np.nan
    with pytest.warns(
        UserWarning, match=r"3 of 5 members failed.*Its x0 is inf in component \(1,\)"
    ):
        told = dvax.ensemble(problem, x0s, 0.0, 1.0, {"need": need, "push": push}).failures()
    assert set(told) == {0, 2, 3}
    assert "K is refused at t = 0" in told[2] and "must not be empty" in told[2]
    assert told[3].endswith("Its args contain nan in component (0,) of ['push'] (1 of 2 entries).")


@pytest.mark.slow
def test_members_that_fail_leave_the_others_alone():
    """x' = a x² from x = 1 escapes at t = 1/a."""
    problem = dvax.Problem(
        A=generators.Zero(), P=operators.Scaling(1.0), K=sets.Box(-1.0, 1.0),
        f=lambda t, x, u, args: args * x**2 + 0.0 * u, h=lambda t, x, u, args: -x,
    )  # fmt: skip
    a = np.array([0.1, 2.0, 0.3, 0.5, 4.0, 0.2])
    with pytest.warns(UserWarning, match="2 of 6 members failed, the first of them number 1"):
        found = dvax.ensemble(problem, 1.0, 0.0, 1.0, a, axes=(None, 0))
    assert found.failed.tolist() == [False, True, False, False, True, False]
    good = ~found.failed
    np.testing.assert_allclose(found.values[good], 1.0 / (1.0 - a[good]), rtol=1e-5)
    assert np.isnan(found.values[found.failed]).all()
    np.testing.assert_allclose(found.ts[1], 0.5, atol=1e-3)
    np.testing.assert_allclose(found.mean, found.values[good].mean(), rtol=1e-14, atol=1e-16)
    np.testing.assert_allclose(found.std, found.values[good].std(ddof=1), rtol=1e-12)
    np.testing.assert_allclose(found.quantile(0.5), np.median(found.values[good]))
    told = found.failures()
    assert set(told) == {1, 4}
    assert (
        not found.switched.any()
        and "The step became too small" in told[1]
        and "Stopped at t = 0.5000" in told[1]
    )
    with pytest.raises(dvax.SolveError, match="finite-time escape"):
        found.member(1)


@pytest.mark.thorough
def test_members_that_are_stiff_get_another_method():
    problem = dvax.Problem(
        A=generators.Zero(), P=operators.Scaling(1.0), K=sets.Box(-0.5, 0.5),
        f=lambda t, x, u, args: jnp.stack([x[1], args * (1 - x[0] ** 2) * x[1] - x[0] + u]),
        h=lambda t, x, u, args: -x[0],
        control_space=spaces.Euclidean(()),
    )  # fmt: skip
    found = dvax.ensemble(
        problem, jnp.array([2.0, 0.0]), 0.0, 60.0, np.array([1.0, 2.0, 300.0]), axes=(None, 0)
    )
    assert found.switched.tolist() == [False, False, True] and not found.failed.any()
    assert "; 1 member by ExpRosenbrock: stability limited the steps" in found.method
    alone = dvax.solve(problem, jnp.array([2.0, 0.0]), 0.0, 60.0, 300.0)
    np.testing.assert_allclose(found.values[2], alone.xs[0], rtol=1e-9)


@pytest.mark.parametrize("cut", [(1000,), (1, 999), (400, 0, 3, 597)])
def test_moments_of_pieces_are_those_of_all(cut):
    rows = {"a": 1e6 + RNG.normal(size=(1000, 3)), "b": RNG.normal(size=1000)}
    valid = RNG.uniform(size=1000) > 0.2
    rows["a"][~valid] = np.nan
    found, begin = None, 0
    for count in cut:
        piece = slice(begin, begin + count)
        part = Moments.of({k: v[piece] for k, v in rows.items()}, valid[piece])
        found, begin = part if found is None else found.merge(part), begin + count
    for name, row in rows.items():
        np.testing.assert_allclose(found.mean[name], row[valid].mean(0), rtol=1e-14, atol=1e-16)
        deviation = found.standard_deviation()[name]
        np.testing.assert_allclose(deviation, row[valid].std(0, ddof=1), rtol=1e-10)


def test_moments_of_one_row_have_no_deviation():
    one = Moments.of(np.array([2.0]), np.array([True]))
    assert one.mean == 2.0 and np.isnan(one.standard_deviation())
    none = Moments.of(np.array([np.nan]), np.array([False]))
    assert none.count == 0 and one.merge(none).mean == none.merge(one).mean == 2.0


def test_folds_without_keeping_values(states):
    ends, times, kept = states
    folds = {
        "largest": dvax.Fold(-jnp.inf, lambda carry, x: jnp.maximum(carry, jnp.max(x))),
        "last": dvax.Fold(jnp.zeros(3), lambda carry, x: x),
    }
    found = dvax.ensemble(
        loaded(), STARTS, 0.0, ends, {"load": LOADS}, times, rtol=1e-8, keep=False, folds=folds
    )
    assert found.values is None
    assert float(found.folded["largest"]) == kept.values.max()
    assert found.folded["last"].tolist() == kept.values[-1].tolist()
    np.testing.assert_array_equal(found.mean, kept.mean)
    with pytest.raises(dvax.InputError, match="keep=False"):
        found.quantile(0.5)


@pytest.mark.thorough
def test_results_do_not_depend_on_the_threads(states):
    ends, times, threaded = states
    one = dvax.ensemble(
        loaded(),
        STARTS,
        0.0,
        ends,
        {"load": LOADS},
        times,
        rtol=1e-8,
        devices=jax.devices()[:1] * 1,
    )
    many = dvax.ensemble(
        loaded(),
        STARTS,
        0.0,
        ends,
        {"load": LOADS},
        times,
        rtol=1e-8,
        devices=jax.devices()[:1] * 5,
    )
    for found in (one, many):
        assert found.values.tobytes() == threaded.values.tobytes()
        assert np.asarray(found.mean).tobytes() == np.asarray(threaded.mean).tobytes()


@pytest.mark.thorough
def test_lanes_advance_together(states):
    ends, times, alone = states
    found = dvax.ensemble(loaded(), STARTS, 0.0, ends, {"load": LOADS}, times, rtol=1e-8, lanes=32)
    np.testing.assert_allclose(found.values, alone.values, atol=1e-12)


def test_pieces_come_back_in_order_and_errors_are_raised():
    assert next(iter(in_order(range(20), lambda piece, device: (piece, device), "abc"))) == (0, "a")
    found = list(in_order(range(20), lambda piece, device: piece**2, "abc"))
    assert found == [k**2 for k in range(20)]

    def fails(piece, device):
        return 1 // (7 - piece)

    with pytest.raises(ZeroDivisionError):
        list(in_order(range(20), fails, "abc"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "mode", mostly_thorough(["grad", "jit of grad", "closure", "jacfwd"], ["jacfwd"])
)
def test_derivatives_of_a_mean(mode):
    def mean(s, adjoint="reverse"):
        closes = mode == "closure"
        problem = loaded((lambda args: {"load": s * args["load"]}) if closes else lambda args: args)
        loads = {"load": (1.0 if closes else s) * jnp.asarray(LOADS[:8])}
        found = dvax.ensemble(
            problem, jnp.asarray(STARTS[:8]), 0.0, 2.0, loads, adjoint=adjoint, rtol=1e-10
        )
        return found.mean

    if mode == "jacfwd":
        slope = jax.jacfwd(lambda s: mean(s, "forward"))(1.0)
    else:
        slope = (jax.jit if mode == "jit of grad" else lambda g: g)(jax.grad(mean))(1.0)
    e = 1e-4
    near = {k: {"load": (1 + k * e) * LOADS[:8]} for k in (-1, 1)}
    ends = [
        dvax.ensemble(loaded(), STARTS[:8], 0.0, 2.0, near[k], rtol=1e-11, atol=1e-13).mean
        for k in (-1, 1)
    ]
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / (2 * e), rtol=1e-6)


@pytest.mark.thorough
def test_derivatives_of_a_failed_member_are_nan_and_others_are_right():
    problem = dvax.Problem(
        A=generators.Zero(), P=operators.Scaling(1.0), K=sets.Box(-1.0, 1.0),
        f=lambda t, x, u, args: args * x**2 + 0.0 * u, h=lambda t, x, u, args: -x,
    )  # fmt: skip

    def run(s):
        return dvax.ensemble(
            problem, 1.0, 0.0, 1.0, s * jnp.array([0.1, 2.0, 0.3]), axes=(None, 0), max_steps=500
        )

    # The mean is that of the members that succeed: x(1) = 1/(1 − a), of derivative a/(1 − a)² in s.
    exact = [a / (1.0 - a) ** 2 for a in (0.1, 0.3)]
    np.testing.assert_allclose(jax.grad(lambda s: run(s).mean)(1.0), np.mean(exact), rtol=1e-4)
    rows = jax.jacrev(lambda s: run(s).values)(1.0)
    assert np.isnan(rows[1])
    np.testing.assert_allclose(rows[::2], exact, rtol=1e-4)
    assert np.isnan(jax.grad(lambda s: jnp.mean(run(s).values))(1.0))
    inside = jax.jit(lambda s: run(s))(1.0)
    assert inside.failed.tolist() == [False, True, False]
    with pytest.raises(dvax.InputError, match="no values"):
        jax.jit(lambda s: run(s).member(0).xs)(1.0)


@pytest.mark.slow
def test_progress_counts_the_members(capfd):
    dvax.ensemble(loaded(), STARTS[:70], 0.0, 1.0, {"load": LOADS[:70]}, progress=True)
    assert "dvax.ensemble: 70 of 70 members, 0 s left" in capfd.readouterr().err


SHAPE = {"load": LOADS[:3]}


@pytest.mark.parametrize(("arguments", "options", "words"), [
    ((STARTS[:4], 0.0, 1.0, SHAPE), {}, r"x0s has 4, args\['load'\] has 3"),
    ((1.0, 0.0, 1.0, {"load": 2.0}), {}, "no array with a member axis"),
    ((STARTS[:3], 0.0, np.array([1.0, 1.0, 0.0]), SHAPE), {}, "member 2: got 0, 0"),
    ((STARTS[:3], 0.0, 1.0, SHAPE, [0.5, 2.0]), {}, r"vector of increasing times in \[0.0, 1.0\]"),
    ((STARTS[:3], 0.0, 1.0, SHAPE, [[0.5], [1.0], [2.0]]), {}, r"ts\) of member 2"),
    ((STARTS[:3], 0.0, 1.0, SHAPE), {"axes": (0, 1)}, r"ensemble\(axes\)"),
    ((STARTS[:3], 0.0, 1.0, SHAPE), {"axes": (0, {"lode": 0})}, r"ensemble\(axes\)"),
    ((STARTS[:3], 0.0, 1.0, SHAPE), {"axes": (0, 0, 0)}, "it must be a pair"),
    ((STARTS[:3], 0.0, 1.0, SHAPE), {"method": dvax.PiecewiseLinear()}, "runs in Python"),
    ((STARTS[:3], 0.0, 1.0, SHAPE), {"rtol": -1.0}, "≥ 0 and finite"),
    ((STARTS[:0], 0.0, 1.0, {"load": LOADS[:0]}), {}, "at least one"),
])  # fmt: skip
def test_arguments_that_break_a_rule(arguments, options, words):
    with pytest.raises(dvax.InputError, match=words):
        dvax.ensemble(loaded(), *arguments, **options)


def test_arguments_of_a_wrong_type_are_all_named():
    with pytest.raises(dvax.InputError) as caught:
        check_own(None, observe=3, folds={"a": 1}, keep="yes", lanes=0)
    assert [problem.place for problem in caught.value.problems] == [
        f"dvax.ensemble({name})" for name in ("observe", "folds", "keep", "lanes")
    ]


ON_DEVICES = """
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import dvax
problem = dvax.Problem(
    A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    f=lambda t, x, u, args: args - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
)
loads = np.linspace(2.0, 4.0, 100)
assert len(jax.devices()) == 4
every = dvax.ensemble(problem, -1.0, 0.0, 2.0, loads)
one = dvax.ensemble(problem, -1.0, 0.0, 2.0, loads, devices=jax.devices()[2:3])
assert every.values.tobytes() == one.values.tobytes()
"""


@pytest.mark.thorough
def test_members_are_the_same_on_all_devices():
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    subprocess.run([sys.executable, "-c", ON_DEVICES], env=os.environ | flags, check=True)


@pytest.mark.slow
def test_an_ensemble_without_success_has_no_mean():
    with pytest.warns(UserWarning, match="3 of 3 members failed"):
        found = dvax.ensemble(
            loaded(), STARTS[:3], 0.0, 1.0, {"load": LOADS[:3]}, max_steps=2, rtol=1e-9
        )
    assert (
        np.isnan(found.mean) and np.isnan(found.std) and np.isnan(found.quantile([0.1, 0.9])).all()
    )
    assert "largest number of steps" in found.failures()[0]


@pytest.mark.thorough
@pytest.mark.parametrize("place", [0, 2])
def test_a_member_that_does_not_start_at_a_number_fails_alone(place):
    starts = np.array(STARTS[:4])
    starts[place] = np.nan
    with pytest.warns(
        UserWarning, match=f"1 of 4 members failed, the first of them number {place}"
    ):
        found = dvax.ensemble(loaded(), starts, 0.0, 1.0, {"load": LOADS[:4]})
    assert np.flatnonzero(found.failed).tolist() == [place]


@pytest.mark.slow
def test_an_ensemble_keeps_its_inputs():
    loads = np.array(LOADS[:3])
    found = dvax.ensemble(loaded(), -1.0, 0.0, 1.0, {"load": loads})
    loads[:] = 100.0
    np.testing.assert_allclose(found.member(1).xs[0], found.values[1], atol=1e-12)
    with pytest.raises(dvax.InputError, match="numbered from 0 to 2"):
        found.member(3)


@pytest.mark.slow
def test_moments_of_complex_values_and_quantiles_of_flags():
    rows = RNG.normal(size=50) + 1j * RNG.normal(size=50)
    found = Moments.of(rows[:20], np.ones(20, bool)).merge(Moments.of(rows[20:], np.ones(30, bool)))
    np.testing.assert_allclose(found.standard_deviation(), rows.std(ddof=1), rtol=1e-12)
    flags = dvax.ensemble(
        loaded(), -1.0, 0.0, 1.0, {"load": LOADS[:5]}, observe=lambda sol: sol.xs[-1] > 0.0
    )
    assert 0.0 <= flags.quantile(0.5) <= 1.0


def test_parameters_of_the_members_are_coordinates():
    loads = np.linspace(2.0, 4.0, 5)
    found = dvax.ensemble(loaded(), -1.0, 0.0, 1.0, {"load": loads}, rtol=1e-5)
    table = found.to_xarray(parameters={"load": loads, "pair": np.stack([loads, loads], axis=1)})
    assert table["load"].dims == ("member",) and table["pair"].dims == ("member", "pair_dim0")
    nearest = table.swap_dims(member="load").sel(load=3.1, method="nearest")["value"]
    assert float(nearest) == found.values[2]
    for wrong in (95, [0.5, -0.1], np.nan):
        with pytest.raises(dvax.InputError, match="quantiles are from 0 to 1"):
            found.quantile(wrong)
    for wrong in ({"load": loads[:-1]}, {"load": 1.0}, {"value": loads}):
        with pytest.raises(dvax.InputError, match="a row for each of the 5 members"):
            found.to_xarray(parameters=wrong)


@pytest.mark.slow
def test_the_mean_of_times_of_events_that_did_not_happen_is_infinite():
    problem = dvax.Problem(
        A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 3.0),
        f=lambda t, x, u, rate: rate - x + u, h=lambda t, x, u, rate: 1.0 - x,
    )  # fmt: skip
    found = dvax.ensemble(
        problem, 0.0, 0.0, 5.0, jnp.linspace(0.5, 2.0, 4), observe=lambda sol: sol.events.ts,
        events=[dvax.Event(lambda t, x, u, rate: x - 0.5)], max_events=2,
    )  # fmt: skip
    assert float(found.mean[0]) == pytest.approx(float(jnp.mean(found.values[:, 0])))
    assert float(found.mean[1]) == np.inf


def test_moments_of_infinite_rows_are_joined_without_a_warning():
    rows = np.array([[1.0, np.inf], [2.0, np.inf], [6.0, np.inf]])
    parts = [
        Moments.of(rows[part], np.ones(n, bool)) for part, n in ((slice(2), 2), (slice(2, 3), 1))
    ]
    whole = parts[0].merge(parts[1])
    np.testing.assert_allclose(whole.mean, [3.0, np.inf])
    assert float(whole.standard_deviation()[0]) == pytest.approx(np.std([1.0, 2.0, 6.0], ddof=1))
