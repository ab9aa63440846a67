"""`certified_tol`: the true error is below it, and unattainable values are rejected."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.closed_forms import ALL, c7
from tests.selection import mostly_thorough

import dvax

METHODS = {"ETD1": dvax.ETD1(), "ETD2RK": dvax.ETD2RK(), "ETD4RK": dvax.ETD4RK()}
TOLERANCES = {"ETD1": [1e-2, 1e-3], "ETD2RK": [1e-3, 1e-5, 1e-7], "ETD4RK": [1e-3, 1e-7]}
CASES = [
    (name, method, tol)
    for name in [*ALL, "C7"]
    for method, tols in TOLERANCES.items()
    for tol in tols
]  # fmt: skip
OFTEN = {
    ("C4", "ETD4RK", 1e-3),
}  # fmt: skip


def system(name):
    case = c7(24) if name == "C7" else ALL[name]()
    region = {"x": (0.0, 7.0)} if name == "C4" else {}
    x0 = jnp.asarray(case.x0)
    check = dvax.verify(case.problem, x0, 0.0, case.t1, case.args, **region)
    return case, x0, check.constants


def errors(case, x0, sol):
    space, control = case.problem.spaces(x0)
    exact = [case.exact(float(t)) for t in sol.ts]
    of_x = [float(space.norm(x - e[0])) for x, e in zip(sol.xs, exact, strict=True)]
    of_u = [float(control.norm(u - e[1])) for u, e in zip(sol.us, exact, strict=True)]
    return np.array(of_x), np.array(of_u)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method", "tol"), mostly_thorough(CASES, OFTEN))
def test_certified_tol_is_above_the_true_error(name, method, tol):
    case, x0, constants = system(name)
    ts = np.linspace(0.0, case.t1, 21)[1:]
    sol = dvax.solve(
        case.problem, x0, 0.0, case.t1, case.args, ts, method=METHODS[method], constants=constants,
        certified_tol=tol,
    )  # fmt: skip
    bound = dvax.bound_error(case.problem, sol, constants)
    of_x, of_u = errors(case, x0, sol)
    assert np.all(of_x <= np.asarray(bound.x) + 1e-12) and np.all(
        of_u <= np.asarray(bound.u) + 1e-12
    )
    assert float(bound.x.max()) <= tol
    # Only what is enclosed is called certified.
    key = "certified_bound" if bound.status == "proved" else "estimated_bound"
    assert {"certified_bound", "estimated_bound"} & set(sol.stats) == {key}
    # It exceeds that of `bound_error` by the roundoff of x and t alone: some ulps a step (sizes are 1).
    assert sol.stats[key] <= tol
    roundoff = sol.stats[key] - float(bound.x.max())
    assert -1e-9 * tol <= roundoff <= 20 * 2.0**-52 * (int(sol.stats["steps"]) + 10) + 1e-9 * tol
    if of_x.max() > 1e-11:
        # Not far below either: the last run aims at seven tenths.
        assert float(bound.x.max()) >= 0.05 * tol
        print(f"{name} {method} {tol:g}: bound / error {float(bound.x.max()) / of_x.max():.1f}")


def test_certified_tol_below_rounding_is_rejected_before_the_run():
    case, x0, constants = system("C1")
    with pytest.raises(dvax.InputError, match=r"c = -0\.5.*in reach here is about [\d.e-]+"):
        dvax.solve(case.problem, x0, 0.0, 2.0, case.args, constants=constants, certified_tol=1e-15)
    with pytest.raises(dvax.InputError, match=r"M Φ_c\(T\) = [\d.]+e\+"):
        # Paper's constants alone, over a long time: e^{c·200} of anything is hopeless.
        paper = ALL["C1"]().constants
        given = {n: getattr(paper, n) for n in ("gamma", "L_F", "alpha_h", "beta_h", "alpha_f",
                 "beta_f", "M", "omega", "m_P", "norm_P_inv")}  # fmt: skip
        alone = dvax.Constants(**given)
        dvax.solve(case.problem, x0, 0.0, 200.0, case.args, constants=alone, certified_tol=1e-3)


def test_certified_tol_rejects_conflicting_arguments():
    case, x0, constants = system("C1")
    run = lambda **more: dvax.solve(case.problem, x0, 0.0, 2.0, case.args, **more)  # noqa: E731
    with pytest.raises(dvax.InputError, match=r"constants.*rests on the constants"):
        run(certified_tol=1e-3)
    for wrong in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(dvax.InputError, match="positive number"):
            run(certified_tol=wrong, constants=constants)
    with pytest.raises(dvax.InputError, match=r"dt.*cannot be chosen"):
        run(certified_tol=1e-3, constants=constants, dt=0.1)
    with pytest.raises(dvax.InputError, match="no defect"):
        run(certified_tol=1e-3, constants=constants, method=dvax.Implicit())
    with pytest.raises(dvax.InputError, match=r"traced.*outside jax\.jit"):
        jax.jit(
            lambda x: (
                dvax.solve(
                    case.problem, x, 0.0, 2.0, case.args, constants=constants, certified_tol=1e-3
                ).xs
            )
        )(x0)


@pytest.mark.slow
def test_certified_tol_reports_a_failed_run_as_failed():
    case, x0, constants = system("C1")
    sol = dvax.solve(
        case.problem, x0, 0.0, 2.0, case.args, constants=constants, certified_tol=1e-5, max_steps=3,
        throw=False,
    )  # fmt: skip
    assert sol.result != dvax.RESULTS.successful and "certified_bound" not in sol.stats
