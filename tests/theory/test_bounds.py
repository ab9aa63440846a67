"""The certified bound is above the true error at every saved time, and pairs of trajectories obey
the estimates of the paper."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tests.closed_forms import ALL
from tests.once import once
from tests.selection import mostly_thorough

import dvax
from dvax.theory.certificate import continue_bound

RUNS = {
    "adaptive ETD2RK": dict(rtol=1e-5, atol=1e-5, method=dvax.ETD2RK()),
    "fixed ETD2RK": dict(dt=1 / 128),
    "fixed ETD1": dict(dt=1 / 128, method=dvax.ETD1()),
}


OFTEN = {
    ("C1", "adaptive ETD2RK"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "run"), mostly_thorough(itertools.product(ALL, RUNS), OFTEN))
def test_bound_error_is_above_the_true_error_at_every_saved_time(name, run):
    case = ALL[name]()
    ts = np.linspace(0.0, case.t1, 17)[1:]
    sol = dvax.solve(
        case.problem, jnp.asarray(case.x0), 0.0, case.t1, args=case.args, ts=ts, **RUNS[run]
    )
    bound = dvax.bound_error(case.problem, sol, case.constants)
    norm = lambda v: np.sqrt(np.sum(np.square(v)))  # noqa: E731
    exact = [case.exact(t) for t in ts]
    x_error = np.array([norm(np.asarray(x) - e[0]) for x, e in zip(sol.xs, exact, strict=True)])
    u_error = np.array([norm(np.asarray(u) - e[1]) for u, e in zip(sol.us, exact, strict=True)])
    assert np.all(np.asarray(bound.x) >= x_error)
    assert np.all(np.asarray(bound.u) >= u_error)
    # Where the error is rounding the ratio says nothing.
    visible = x_error > 1e-12
    ratio = np.asarray(bound.x)[visible] / x_error[visible]
    print(f"{name} {run}: bound / error at t1 {ratio[-1]:.1f}, least {ratio.min():.2f}")
    # A bound of no size would pass as well: it stays within the reach of the constants.
    assert np.all(np.asarray(bound.x) < 10.0)
    if bound.x_sharp is not None:
        assert np.all(np.asarray(bound.x_sharp) >= x_error)
        assert np.all(np.asarray(bound.x_sharp) <= np.asarray(bound.x_paper) * (1 + 1e-12))


METHODS = {m.__name__: m() for m in (dvax.DormandPrince, dvax.ExpRosenbrock, dvax.ETD4RK)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method"),
    mostly_thorough(
        itertools.product(("C1", "C2", "C3", "C4"), METHODS),
        {("C1", "ExpRosenbrock"), ("C3", "DormandPrince")},
    ),
)
def test_bound_error_covers_roundoff(name, method):
    """At tolerances near 1e-13 the error is mostly roundoff; ExpRosenbrock has nearly no other here."""
    case = ALL[name]()
    region = {"x": (0.0, 7.0)} if name == "C4" else {}
    x0, ts = jnp.asarray(case.x0), np.linspace(0.0, case.t1, 17)[1:]
    constants = dvax.verify(case.problem, x0, 0.0, case.t1, case.args, **region).constants
    sol = dvax.solve(
        case.problem, x0, 0.0, case.t1, case.args, ts,
        rtol=1e-13, atol=1e-13, method=METHODS[method], constants=constants,
    )  # fmt: skip
    bound = dvax.bound_error(case.problem, sol, constants)
    error = [np.linalg.norm(x - case.exact(t)[0]) for t, x in zip(ts, sol.xs, strict=True)]
    assert np.all(np.asarray(bound.x) >= error)


def test_bound_error_is_larger_for_a_less_accurate_solution():
    case = ALL["C1"]()
    at = lambda tol: float(  # noqa: E731
        dvax.bound_error(
            case.problem,
            dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, rtol=tol, atol=tol),
            case.constants,
        ).x[-1]
    )
    coarse, fine = at(1e-3), at(1e-5)
    assert fine < 0.1 * coarse


def test_bound_error_propagates_an_initial_error():
    case = ALL["C1"]()
    sol = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, rtol=1e-6, method=dvax.ETD2RK())
    without = dvax.bound_error(case.problem, sol, case.constants)
    given = dvax.bound_error(case.problem, sol, case.constants, initial_error=0.01)
    # M e^{(ω + ML̃)T} · 0.01 with ω + ML̃ = ½.
    assert float(given.x_paper[-1] - without.x_paper[-1]) == pytest.approx(0.01 * np.e, rel=1e-9)


def test_bound_error_rejects_an_invalid_initial_error():
    case = ALL["C1"]()
    sol = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, rtol=1e-3, method=dvax.ETD2RK())
    for wrong in (-1e-3, np.nan, np.inf, [0.0, 1.0], "0"):
        with pytest.raises(dvax.InputError, match="initial_error"):
            dvax.bound_error(case.problem, sol, case.constants, initial_error=wrong)


def _pieces(c):
    """The bounds of C1 as a whole, and of the same steps in two pieces."""
    case = ALL["C1"]()
    run = lambda x, t0, ts: dvax.solve(  # noqa: E731
        case.problem, x, t0, ts[-1], args=case.args, ts=np.asarray(ts), dt=0.125, measure=True
    )
    whole = dvax.bound_error(
        case.problem, run(-1.0, 0.0, [0.5, 1.0, 1.5, 2.0]), c, initial_error=0.01
    )
    first = run(-1.0, 0.0, [0.5, 1.0])
    before = dvax.bound_error(case.problem, first, c, initial_error=0.01)
    second = run(first.xs[-1], 1.0, [1.5, 2.0])
    after = dvax.bound_error(case.problem, second, c, initial_error=before)
    names = ("x", "u", "x_paper", "u_paper", "x_sharp", "u_sharp")
    joined = {n: np.concatenate([getattr(before, n), getattr(after, n)]) for n in names}
    return {n: np.asarray(getattr(whole, n)) for n in names}, joined


@pytest.mark.thorough
def test_bound_error_of_a_run_in_pieces_equals_that_of_the_whole():
    whole, pieces = _pieces(ALL["C1"]().constants)
    for name in whole:
        np.testing.assert_allclose(pieces[name], whole[name], rtol=1e-10, err_msg=name)


@pytest.mark.thorough
def test_bound_of_pieces_with_one_semigroup_equals_that_of_the_whole():
    """M > 1 multiplies the integral over all pieces once."""
    case = ALL["C1"]()
    c = replaced(case.constants, M=2.0)
    run = lambda x, t0, ts: dvax.solve(  # noqa: E731
        case.problem, x, t0, ts[-1], args=case.args, ts=np.asarray(ts), dt=0.125, measure=True
    )
    whole = dvax.bound_error(case.problem, run(-1.0, 0.0, [0.5, 1.0, 1.5, 2.0]), c)
    x, joined = -1.0, []
    for begin in (0.0, 1.0):
        part = run(x, begin, [begin + 0.5, begin + 1.0])
        if joined:
            joined.append(continue_bound(case.problem, part, c, joined[-1]))
        else:
            joined.append(dvax.bound_error(case.problem, part, c))
        x = part.xs[-1]
    for name in ("x", "u", "x_paper", "x_sharp"):
        found = np.concatenate([getattr(bound, name) for bound in joined])
        np.testing.assert_allclose(found, getattr(whole, name), rtol=1e-10, err_msg=name)


@pytest.mark.thorough
def test_bound_error_of_pieces_includes_the_overshoot_of_each():
    """With M > 1 the bound of pieces is larger, since they need not share one semigroup."""
    # Nothing says that the pieces have one semigroup in common.
    whole, pieces = _pieces(replaced(ALL["C1"]().constants, M=2.0))
    assert np.all(pieces["x_paper"] >= whole["x_paper"] * (1 - 1e-12))
    assert pieces["x_paper"][-1] > 1.5 * whole["x_paper"][-1]


@pytest.mark.slow
def test_bound_error_continues_only_from_the_last_bounded_time():
    case = ALL["C1"]()
    run = lambda x, t0, t1, ts: dvax.solve(  # noqa: E731
        case.problem, x, t0, t1, args=case.args, ts=ts, dt=0.125, measure=True
    )
    first = run(-1.0, 0.0, 1.0, [0.0, 0.5])
    before = dvax.bound_error(case.problem, first, case.constants)
    second = run(first.stats["x"], 1.0, 2.0, [2.0])
    with pytest.raises(dvax.InputError, match=r"up to t = 0\.5 for a run from t0 = 1"):
        dvax.bound_error(case.problem, second, case.constants, initial_error=before)


@pytest.mark.slow
def test_bound_error_continues_only_with_the_state_of_the_bound():
    case = ALL["C1"]()
    run = lambda x, t0, t1: dvax.solve(  # noqa: E731
        case.problem, x, t0, t1, args=case.args, ts=[t1], dt=0.125, measure=True
    )
    first = run(-1.0, 0.0, 1.0)
    before = dvax.bound_error(case.problem, first, case.constants)
    other = run(first.xs[-1] + 1e-3, 1.0, 2.0)
    for constants in (case.constants, None):
        with pytest.raises(dvax.InputError, match="with the state that it is about"):
            dvax.bound_error(case.problem, other, constants, initial_error=before)


def replaced(constants, **more):
    names = ("gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f", "M", "omega", "m_P",
             "norm_P_inv", "one_sided")  # fmt: skip
    given = {name: getattr(constants, name) for name in names} | {"status": "proved"}
    return dvax.Constants(**(given | more))


def test_bound_error_with_constants_below_the_proved_ones_is_declared():
    case = ALL["C1"]()
    sol = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, rtol=1e-4, method=dvax.ETD2RK())
    status = lambda c: dvax.bound_error(case.problem, sol, c).status  # noqa: E731
    assert status(case.constants) == "declared"
    assert status(replaced(case.constants)) == "proved"
    for smaller in (dict(omega=-1.5), dict(norm_P_inv=0.5, m_P=0.5)):
        assert status(replaced(case.constants, **smaller)) == "declared"


@pytest.mark.thorough
def test_bound_error_of_the_response_ignores_the_constants_given_to_solve():
    # A nonmonotone weight: the law is solved by iteration, so that its error is more than rounding.
    case = ALL["C4"]()
    told = replaced(case.constants, gamma=10 * case.constants.gamma, L_F=10 * case.constants.L_F)
    bounds = []
    for constants in (None, case.constants, told):
        sol = dvax.solve(
            case.problem, jnp.asarray(case.x0), 0.0, case.t1, args=case.args, dt=0.25,
            constants=constants, measure=True,
        )  # fmt: skip
        bound = dvax.bound_error(case.problem, sol, case.constants)
        bounds.append(np.asarray(bound.u - case.constants.L * bound.x))
        c1 = (sol.law_residual / case.constants.gamma + sol.law_step) * case.constants.norm_P_inv
        np.testing.assert_allclose(bounds[-1], c1, rtol=1e-6, atol=1e-14)


def _contact(alpha, load):
    return dvax.models.Contact(
        alpha=alpha, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0, kappa0=0.5, g=1.0,
        ell=dvax.signals.Function(lambda t: load(t, jnp)),
    )  # fmt: skip


def _reference(alpha, load, ts, breaks=()):
    """The same point by an explicit Runge–Kutta method of order 8 with very short steps."""

    def rate(t, x):
        u = np.clip(0.5 * (1.0 - 2.0 * x), 0.0, 0.5)
        return -alpha * x + load(t, np) - 0.5 * x - u

    out, x, start = [], np.array([-1.0]), 0.0
    for stop in [*breaks, ts[-1]]:
        before = stop - 1e-13
        inner = np.minimum(ts[(ts > start) & (ts <= stop)], before)
        run = solve_ivp(
            rate, (start, before), x, "DOP853", inner, rtol=1e-11, atol=1e-12, max_step=0.01
        )
        out.append(run.y[0])
        x, start = run.y[:, -1], stop
    return np.concatenate(out)


@pytest.mark.slow
def test_bound_error_does_not_grow_with_the_number_of_saved_times():
    """A step is counted once, for any number of saved times in it."""
    case = ALL["C1"]()
    end = {}
    for count in (1, 2000):
        ts = np.linspace(0.0, 2.0, count + 1)[1:]
        sol = dvax.solve(
            case.problem, -1.0, 0.0, 2.0, args=case.args, ts=ts, dt=1 / 16, measure=True
        )
        bound = dvax.bound_error(case.problem, sol, case.constants)
        end[count] = np.array([float(bound.x_paper[-1]), float(bound.x_sharp[-1])])
    assert np.all(end[2000] <= end[1])
    # In one piece everything is charged e^{c₊T}: with 2000 times the decay is seen as well.
    assert end[2000][1] < 0.9 * end[1][1]


@pytest.mark.slow
@pytest.mark.parametrize("dt", mostly_thorough([0.1, 0.05], [0.1]))
def test_bound_error_covers_saved_times_between_steps_of_a_stiff_contact(dt):
    # Trajectories approach fast here, so a bound must not let an impulse decay before it acted.
    load = lambda t, np: 300.0 * np.sin(20.0 * t)  # noqa: E731
    model, ts = _contact(50.0, load), np.linspace(0.0, 2.0, 2001)[1:]
    sol = dvax.solve(model.problem, -1.0, 0.0, 2.0, ts=ts, dt=dt, measure=True, max_steps=64)
    bound = dvax.bound_error(model.problem, sol, model.constants)
    error = np.abs(np.asarray(sol.xs) - _reference(50.0, load, ts))
    assert bound.status == "proved" and error.max() > 0.1
    assert np.all(np.asarray(bound.x) >= error - 1e-8)
    assert np.all(np.asarray(bound.x_sharp) >= error - 1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough(["ETD1", "ETD2RK"], ["ETD1"]))
def test_bound_error_covers_an_unannounced_jump_at_the_end_of_a_step(name):
    # What floor does is not read off the code as a time (t < 1 would be).
    load = lambda t, np: 3.0 * (1.0 - np.minimum(np.floor(t), 1.0))  # noqa: E731
    model, ts = _contact(1.0, load), np.linspace(0.0, 2.0, 41)[1:]
    sol = dvax.solve(
        model.problem, -1.0, 0.0, 2.0, ts=ts, dt=0.125, method=getattr(dvax, name)(), measure=True
    )
    bound = dvax.bound_error(model.problem, sol, model.constants)
    error = np.abs(np.asarray(sol.xs) - _reference(1.0, load, ts, breaks=[1.0]))
    assert bound.status == "proved" and error.max() > 0.05
    assert np.all(np.asarray(bound.x_sharp) >= error - 1e-8)


def test_bound_error_rejects_a_solution_of_another_problem():
    one, four = ALL["C1"](), ALL["C4"]()
    sol = dvax.solve(one.problem, -1.0, 0.0, 2.0, args=one.args, rtol=1e-3, method=dvax.ETD2RK())
    with pytest.raises(dvax.InputError, match="another problem"):
        dvax.bound_error(four.problem, sol, four.constants)


TS = np.linspace(0.0, 3.0, 13)


@jax.jit
def _pair(p, x0s):
    """Two trajectories of a contact problem on four points, and its constants."""
    model = dvax.models.Contact(
        **{k: v for k, v in p.items() if k not in ("g", "ell", "weights")},
        g=dvax.signals.Function(lambda t: p["g"] * jnp.cos(t)),
        ell=dvax.signals.Constant(p["ell"]),
        weights=p["weights"],
    )
    sols = [dvax.solve(model.problem, x, 0.0, 3.0, ts=TS, dt=1 / 64) for x in x0s]
    c = model.constants
    norm = jax.vmap(model.problem.spaces(x0s[0])[0].norm)
    return (
        norm(sols[0].xs - sols[1].xs), norm(sols[0].us - sols[1].us),
        c.L, c.growth_rate, c.sharp_decay_rate, c.hadamard(3.0), c.decay_rate,
    )  # fmt: skip


def test_pairs_of_contact_trajectories_satisfy_the_estimates():
    rng = np.random.default_rng(6)
    decaying, sharpest = 0, 0.0
    for _ in range(60):
        positive = lambda: float(10.0 ** rng.uniform(-1, 0.7))  # noqa: E731
        p = {name: positive() for name in ("alpha", "beta", "b_x", "b_u", "d_x", "d_u", "kappa0")}
        p |= {"g": rng.normal(size=4) * 3, "ell": rng.normal(size=4) * 3}
        p["weights"] = rng.uniform(0.1, 2.0, 4)
        x0s = tuple(rng.normal(size=(2, 4)) * positive())
        dx, du, L, rate, sharp, hadamard, decay = map(np.asarray, _pair(p, x0s))
        slack = 1e-3 * dx[0]  # the error of the fixed steps themselves
        # thm:continuous_dependence, eq:vi_sensitivity, cor:hadamard_wellposed, and one-sided.
        assert np.all(dx <= dx[0] * np.exp(rate * TS) + slack)
        assert np.all(du <= L * dx + 1e-9)
        assert max(dx.max() + du.max(), 0) <= hadamard * dx[0] + slack
        assert np.all(dx <= dx[0] * np.exp(-sharp * TS) + slack)
        sharpest = max(sharpest, np.max(dx[1:] / (dx[0] * np.exp(-sharp * TS[1:]))))
        decaying += decay > 0
        if decay > 0:
            assert dx[-1] < dx[0]
    print(f"{decaying} of 60 decay certainly; the one-sided bound is reached to {sharpest:.3f}")
    assert decaying > 3 and sharpest > 0.3


@pytest.mark.slow
def test_bound_error_with_constants_of_a_region_is_finite_inside_it():
    case = ALL["C1"]()
    ts = np.linspace(0.0, 2.0, 21)[1:]
    run = lambda t1, ts: dvax.solve(  # noqa: E731
        case.problem, -1.0, 0.0, t1, args=case.args, ts=ts, rtol=1e-5, atol=1e-8,
        method=dvax.ETD2RK(),
    )  # fmt: skip
    check = lambda **more: dvax.verify(  # noqa: E731
        case.problem, jnp.asarray(-1.0), 0.0, 2.0, case.args, **more
    )
    sol = run(2.0, ts)
    free = dvax.bound_error(case.problem, sol, check().constants)
    assert free.status == "proved" and np.all(np.isfinite(free.x))
    # x passes 1 at about t = 0.9 and stays above.
    leaves = int(np.argmax(np.asarray(sol.xs) > 1.0 - 1e-4))
    within = dvax.bound_error(case.problem, sol, check(x=(-2.0, 1.0)).constants)
    assert within.status == "proved"
    for v, w in (
        (within.x, free.x),
        (within.x_paper, free.x_paper),
        (within.u_sharp, free.u_sharp),
    ):
        np.testing.assert_allclose(np.asarray(v)[:leaves], np.asarray(w)[:leaves], rtol=1e-9)
        assert np.all(np.isinf(np.asarray(v)[leaves:]))
    # C1 does not depend on t, so that its constants hold after the interval of `check` too.
    longer = run(3.0, np.array([3.0]))
    assert dvax.bound_error(case.problem, longer, check().constants).status == "proved"


@once
def excursion() -> dvax.Problem:
    """x is near 0 but for a pulse at t = ½, which lifts it to 1.5; u = x/2 up to 1."""
    return dvax.Problem(
        A=dvax.generators.Scalar(-4.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: 0.1 * x**2 + 32.0 * jnp.exp(-(((t - 0.5) / 0.03) ** 2)) - 0.1 * u,
        h=lambda t, x, u, args: x - u,
    )


REGIONS = [
    ({"x": (-0.5, 2.0)}, True),
    ({"x": (-0.5, 1.2)}, False),
    ({"x": (-0.5, 2.0), "u": (-0.1, 1.1)}, True),
    ({"x": (-0.5, 2.0), "u": (-0.1, 0.5)}, False),
]
BETWEEN = [(name, *case) for name in ("steps of ETD2RK", "windows of Picard") for case in REGIONS]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "region", "good"), mostly_thorough(BETWEEN, [BETWEEN[0], BETWEEN[3]])
)
def test_bound_error_detects_leaving_the_region_between_saved_times(name, region, good):
    method = dvax.ETD2RK() if name == "steps of ETD2RK" else dvax.Picard()
    """The saved states are within 0.1 of 0, whatever has been in between."""
    problem = excursion()
    check = dvax.verify(problem, 0.0, 0.0, 3.0, **region)
    assert check.constants is not None and check.status == "proved"
    ts = [0.2, 2.5, 3.0]
    sol = dvax.solve(problem, 0.0, 0.0, 3.0, ts=ts, rtol=1e-5, atol=1e-8, method=method)
    assert np.abs(np.asarray(sol.xs)).max() < 0.1
    bound = dvax.bound_error(problem, sol, check.constants)
    assert bound.status == "proved"
    np.testing.assert_array_equal(np.isfinite(np.asarray(bound.x)), [True, good, good])
    # Kept by the solve itself it is the same.
    kept = dvax.solve(
        problem, 0.0, 0.0, 3.0, ts=ts, rtol=1e-5, atol=1e-8, method=method,
        constants=check.constants,
    )  # fmt: skip
    assert kept.bounds is not None
    again = dvax.bound_error(problem, kept, check.constants)
    np.testing.assert_allclose(again.x, bound.x, rtol=1e-6)
    low, high = kept.bounds.x
    assert 1.3 < float(high[1]) < 1.7 and float(low[1]) > -0.1 and float(high[0]) < 0.1
    # They are those since the saved time before, or since t0.
    assert isinstance(method, dvax.Picard) or float(high[2]) < 0.1
    fine = dvax.solve(problem, 0.0, 0.0, 3.0, ts=np.linspace(0.0, 3.0, 301), rtol=1e-9)
    for k, (a, b) in enumerate(zip([0.0, *ts[:-1]], ts)):
        part = np.asarray(fine.xs)[(np.asarray(fine.ts) >= a) & (np.asarray(fine.ts) <= b)]
        assert float(low[k]) - 1e-4 <= part.min() and part.max() <= float(high[k]) + 1e-4


@pytest.mark.thorough
@pytest.mark.parametrize("bound", [1.2, 2.0])
def test_certified_tol_fails_if_the_trajectory_leaves_the_region(bound):
    problem = excursion()
    constants = dvax.verify(problem, 0.0, 0.0, 3.0, x=(-0.5, bound)).constants
    run = lambda: dvax.solve(problem, 0.0, 0.0, 3.0, constants=constants, certified_tol=1e-3)  # noqa: E731
    if bound < 1.5:
        with pytest.raises(dvax.InputError, match=r"region that the trajectory leaves by t = 0\.5"):
            run()
    else:
        assert float(run().stats["certified_bound"]) <= 1e-3


@pytest.mark.slow
def test_bound_error_rejects_a_method_without_a_defect():
    case = ALL["C1"]()
    sol = dvax.solve(
        case.problem, -1.0, 0.0, 2.0, args=case.args, rtol=1e-3, method=dvax.Implicit()
    )
    with pytest.raises(dvax.InputError, match=r"dvax\.Implicit.*exponential method"):
        dvax.bound_error(case.problem, sol, case.constants)
