"""The certified bound is above the true error at every saved time, and pairs of trajectories obey
the estimates of the paper."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import ALL

import dvax

RUNS = {
    "adaptive ETD2RK": dict(rtol=1e-5, atol=1e-5),
    "fixed ETD2RK": dict(dt=1 / 128),
    "fixed ETD1": dict(dt=1 / 128, method=dvax.ETD1()),
}


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize("name", ALL)
def test_the_bound_is_above_the_true_error_at_every_saved_time(name, run):
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
    rounding = 1e-12
    assert np.all(np.asarray(bound.x) >= x_error - rounding)
    assert np.all(np.asarray(bound.u) >= u_error - rounding)
    # Where the error is rounding, and the bound 0, the ratio says nothing.
    visible = x_error > rounding
    ratio = np.asarray(bound.x)[visible] / x_error[visible]
    print(f"{name} {run}: bound / error at t1 {ratio[-1]:.1f}, least {ratio.min():.2f}")
    # A bound of no size would pass as well: it stays within the reach of the constants.
    assert np.all(np.asarray(bound.x) < 10.0)
    if bound.x_sharp is not None:
        assert np.all(np.asarray(bound.x_sharp) >= x_error - rounding)
        assert np.all(np.asarray(bound.x_sharp) <= np.asarray(bound.x) * (1 + 1e-12))


def test_a_worse_solution_has_a_larger_bound():
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


def test_an_error_in_the_initial_state_is_propagated():
    case = ALL["C1"]()
    sol = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, rtol=1e-6)
    without = dvax.bound_error(case.problem, sol, case.constants)
    given = dvax.bound_error(case.problem, sol, case.constants, initial_error=0.01)
    # M e^{(ω + ML̃)T} · 0.01 with ω + ML̃ = ½.
    assert float(given.x[-1] - without.x[-1]) == pytest.approx(0.01 * np.e, rel=1e-9)


def test_the_bound_says_what_it_rests_on():
    case = ALL["C1"]()
    sol = dvax.solve(case.problem, -1.0, 0.0, 2.0, args=case.args, rtol=1e-4)
    assert dvax.bound_error(case.problem, sol, case.constants).status in ("declared", "estimated")


def test_a_solution_of_another_problem_is_refused():
    one, four = ALL["C1"](), ALL["C4"]()
    sol = dvax.solve(one.problem, -1.0, 0.0, 2.0, args=one.args, rtol=1e-3)
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


def test_no_pair_of_trajectories_of_a_contact_problem_breaks_the_estimates():
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
