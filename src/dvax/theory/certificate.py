"""The a-posteriori certificate: a bound on the distance from the computed to the exact trajectory.

Let x_h solve x_h' = A x_h + p exactly (every exponential method does, with p its stage polynomial),
and let δ(s) = ‖p(s) − f̃(s, x_h(s))‖. Subtracting the mild equations,

    ‖x_h − x‖(t) ≤ M e^{ωt}‖x_h(0) − x₀‖ + M ∫₀ᵗ e^{ω(t−s)} (δ(s) + L̃‖x_h − x‖(s)) ds,

and Gronwall's lemma gives, with c = ω + M L̃,

    ‖x_h − x‖(t) ≤ M e^{ct}‖x_h(0) − x₀‖ + M ∫₀ᵗ e^{c(t−s)} δ(s) ds.

A does not enter δ, so the bound is finite for a partial differential equation. If the law is solved
only to the residual ‖w‖, δ increases by β_f‖P⁻¹‖‖w‖/γ. With a one-sided constant μ the same bound
holds with M = 1 and c = μ: d/dt‖x_h − x‖ ≤ μ‖x_h − x‖ + δ. The response follows, since
‖u_h − u‖ ≤ L‖x_h − x‖ + ‖u_h − u_{x_h}‖.
"""

import dataclasses
import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._captured import Reads, current
from .._dataset import Variable, dataset, described
from .._once import once_per_object
from .._repr import is_known, last_text, table, value_text
from .._tree import Tree
from ..errors import InputProblem, Problems, input_error
from ..evolution import Implicit, Solution, between, disturbance, gronwall
from ..evolution.defect import ROUNDINGS
from ..evolution.enclosed_projection import rounding_of
from ..evolution.interpolated_response import Place
from ..evolution.setup import Setup
from ..evolution.solve import run_again
from ..generators import AbstractGenerator, AbstractMatrixFree, Growth, Product
from ..operators import AbstractOperator, Spectrum
from ..problem import Problem
from ..sets._face import face, iterates
from .constants import Constants
from .domain import Domain
from .error_ellipsoid import Disturbances
from .status import Status, weakest


class Bound(eqx.Module):
    """Bounds on the true error at the saved times of a solution.

    - `ts`; `x` ≥ ‖x_h − x‖ and `u` ≥ ‖u_h − u‖: at each time the smaller of the next two;
    - `x_paper`, `u_paper`: with the paper's rate ω + ML̃;
    - `x_sharp`, `u_sharp`: with the one-sided constant μ or the rate of an energy norm, whichever is
      smaller; None if neither is known;
    - `why`: the reason for which the bound is infinite from some time on, or estimated, or empty;
    - `last`: the last saved state, at which a run that goes on starts;
    - `integrals`, (m, k): the Gronwall estimates of the k rates over their factors M, with which a run
      that goes on starts; None if the problem was solved again;
    - `status`: the weakest status among the quantities in the bound. "proved" means that the constants
      are proved, that M, ω and ‖P⁻¹‖ are at least those implied by the structure of A and P, and that
      the defect is enclosed over every step. "estimated" means that the defect was sampled.

    The roundoff of every step, of t and of u is included, for propagators and functions f, h and K
    that are computed with relative errors of a few ε.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> check = dvax.verify(problem, -1.0, 0.0, 2.0)
    >>> sol = dvax.solve(problem, -1.0, 0.0, 2.0, ts=[1.0, 2.0], method=dvax.ETD2RK())
    >>> bound = dvax.bound_error(problem, sol, check.constants)
    >>> bound.status, bound.x.shape, bool((bound.x_sharp <= bound.x_paper).all())
    ('proved', (2,), True)

    ```
    """

    ts: jax.Array
    x: jax.Array
    u: jax.Array
    x_paper: jax.Array
    u_paper: jax.Array
    x_sharp: jax.Array | None
    u_sharp: jax.Array | None
    status: Status = eqx.field(static=True)
    integrals: jax.Array | None = None
    why: str = eqx.field(static=True, default="")
    last: Tree | None = None

    def __repr__(self) -> str:
        about = {"x": "‖x_h − x‖", "u": "‖u_h − u‖"}
        rows = [
            (f"{name}", f"≤ {last_text(getattr(self, name))} at the last time ({text})")
            for name, text in about.items()
        ]
        infinite = np.isinf(np.asarray(self.x)) if is_known(self.x) else np.zeros(0, bool)
        if infinite.any():
            first = float(np.asarray(self.ts)[np.argmax(infinite)])
            rows.append(("", f"∞ from t = {first:.6g} on{f': {self.why}' if self.why else ''}"))
        return table(f"Bound: {self.status}", [("ts", value_text(self.ts)), *rows])

    def to_xarray(self, *, time_unit: str = "", x_unit: str = "", u_unit: str = "") -> Any:
        """Return the bounds as an `xarray.Dataset` over `time`: `error_bound_x`, `error_bound_u`, and
        those with the paper's and with the sharper rate, `error_bound_x_paper`, ….

        **Raises:** `ModuleNotFoundError` if xarray (the extra `dvax[app]`) is not installed.
        """
        variables: dict[str, Variable] = {}
        for name in ("x", "u", "x_paper", "u_paper", "x_sharp", "u_sharp"):
            values, letter = getattr(self, name), name[0]
            if values is not None:
                unit = (x_unit if letter == "x" else u_unit) or None
                about = described(f"bound on ‖{letter}_h − {letter}‖", unit, status=self.status)
                variables[f"error_bound_{name}"] = ("time",), values, about
        time = ("time",), self.ts, described("time", time_unit or None)
        return dataset("Bound.to_xarray", variables, {"time": time}, {"status": self.status})


def bound_by_constants(
    problem: Problem, sol: Solution, constants: Constants, initial_error: Any = 0.0
) -> Bound:
    """Return the bound of `dvax.bound_error` with these constants."""
    problem = current(problem)
    _check(problem, sol, constants, initial_error)
    return _bound_error(
        problem, sol, constants, _initial_errors(initial_error, constants, sol.ts.dtype)
    )


def continue_bound(problem: Problem, sol: Solution, constants: Constants, before: Bound) -> Bound:
    """Bound the error of a solution that goes on from the last state of another one of the same
    problem, whose bound is `before`.

    Both are one trajectory with one semigroup, so that the integral of each rate goes on,
    ∫₀ᵗ = e^{c(t−τ)} ∫₀^τ + ∫_τ^t, and M multiplies their sum once. `bound_error` does not assume that
    the pieces have one semigroup.
    """
    problem = current(problem)
    # A solution that was read from a file does not know its x0.
    before = dataclasses.replace(before, last=None)
    _check(problem, sol, constants, before)
    if before.integrals is None:
        return bound_by_constants(problem, sol, constants, before)
    return _bound_error(problem, sol, constants, tuple(before.integrals[-1]))


def disturbances(problem: Problem, sol: Solution, c: Constants) -> tuple[Disturbances, np.ndarray]:
    """Return, for each saved time of a solution whose defect is known, what disturbs x, late errors
    being its motion within a few roundings of t; and the distance of u from the solution of the law."""
    args, t0 = _tree.as_arrays(sol.setup.args), jnp.asarray(sol.setup.setting["t0"], sol.ts.dtype)
    of_x, of_u = _roundoff(
        current(problem), args, t0, sol.setup.x0, sol.ts, sol.xs, sol.us, c.norm_P_inv
    )
    law = sol.law_residual, sol.law_step, of_u
    total, completed = (
        np.asarray(disturbance(c, *(np.asarray(v, float) for v in parts)))
        for parts in _defects(sol, c)
    )
    of_law = _law_error(c, *(np.asarray(v, float) for v in law))
    return Disturbances(total, completed, np.asarray(of_x, float)), np.asarray(of_law)


def encloses_by(sol: Solution, c: Constants, otherwise: bool = False) -> bool:
    """Return whether enclosures of the response, which rest on the moduli that the problem was solved
    with, hold by these constants; `otherwise` if the moduli are traced.

    The larger γ, and the smaller L_F and ‖P⁻¹‖, the sharper they are."""
    if sol.plan is None or not sol.plan.interpolated:
        return True
    used = sol.setup.moduli
    pairs = (
        (used["gamma"], c.gamma), (c.L_F, used["L_F"]), (c.norm_P_inv, used["norm_P_inv"]),
    )  # fmt: skip
    if not _tree.is_concrete(pairs):
        return otherwise
    return all(float(sharp) <= float(proved) for sharp, proved in pairs)


def _defects(sol: Solution, c: Constants) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Return the integrated defects of state and law at the saved times, and at the start of the step
    that contains each of them."""
    assert sol.defect is not None and sol.law_defect is not None
    assert sol.completed_defect is not None
    if sol.plan is None or not sol.plan.interpolated:
        return (sol.defect, sol.law_defect), sol.completed_defect
    # The defect of the law is ρ(γ), and ρ(γ)/γ bounds an error for the γ with which it was found.
    ratio = c.gamma / sol.setup.moduli["gamma"]
    (total, law), (before, law_before) = (sol.defect, sol.law_defect), sol.completed_defect
    return (total, ratio * law), (before, ratio * law_before)


def _bound_error(problem: Problem, sol: Solution, constants: Constants, initial: tuple) -> Bound:
    """Return the bound for these initial errors, one for each rate."""
    space = problem.spaces(sol.setup.x0)[0]
    measured, distance = sol, jnp.zeros_like(sol.ts)
    domain = constants.domain
    regional = domain is not None and not domain.is_unbounded
    if (
        sol.defect is None
        or (regional and sol.bounds is None)
        or not encloses_by(sol, constants, otherwise=True)
    ):
        measured = _solve_again(sol, constants)
        distance = jax.vmap(lambda a, b: space.norm(_tree.sub(a, b)))(measured.xs, sol.xs)
    args, t0 = _tree.as_arrays(sol.setup.args), jnp.asarray(sol.setup.setting["t0"], sol.ts.dtype)
    of_x, of_u = _roundoff(
        problem, args, t0, sol.setup.x0, sol.ts, sol.xs, sol.us, constants.norm_P_inv
    )
    distance = _tree.prepare(operator.add, distance, of_x)
    defects = _defects(measured, constants)
    law = sol.law_residual, sol.law_step, of_u
    estimates, integrals = _estimates(constants, t0, sol.ts, defects, initial)
    x, u, x_sharp, u_sharp = _bounds(constants, estimates, distance, law)
    best_x = x if x_sharp is None else _tree.prepare(_smaller, x, x_sharp)
    best_u = u if u_sharp is None else _tree.prepare(_smaller, u, u_sharp)
    domain_status: Status = "proved"
    inside, why = None, ""
    if domain is not None:
        setting = sol.setup.setting
        covered = domain.covers(setting["t0"], setting["t1"]) and domain.has_args(
            sol.setup.args, Reads(problem)
        )
        domain_status = "proved" if covered else "declared"
        if regional:
            assert measured.bounds is not None
            largest_x = _bound_since_previous_time(constants, t0, sol.ts, defects, initial)
            largest_u = constants.L * largest_x + _law_error(constants, *law)
            spaces = problem.spaces(sol.setup.x0)
            ranges_x, ranges_u = measured.bounds
            values = ranges_x, ranges_u, largest_x, largest_u, spaces
            inside = domain.contains(*values)
            rates = [rate for _, rate, _ in _rates(constants, initial)]
            why = _exit(domain, sol.ts, inside, values, rates)
    status = weakest(
        constants.status_of(*(name for name, _ in constants.statuses)),
        "proved" if measured.enclosed and encloses_by(measured, constants) else "estimated",
        _status_of_structure(problem, sol, constants),
        domain_status,
    )

    def valid(v: jax.Array | None) -> Any:
        if v is None or inside is None:
            return v
        return _tree.prepare(_where_inside, inside, v)

    return Bound(
        sol.ts, valid(best_x), valid(best_u), valid(x), valid(u), valid(x_sharp), valid(u_sharp),
        status, valid(integrals) if measured is sol else None, why or _overflow(best_x),
        last_state(sol),
    )  # fmt: skip


def last_state(sol: Solution) -> Tree | None:
    """Return the state at the last saved time, None without saved times."""
    return jtu.tree_map(lambda leaf: leaf[-1], sol.xs) if len(sol.ts) else None


def _exit(domain: Domain, ts: jax.Array, inside: jax.Array, values: tuple, rates: list[Any]) -> str:
    """Return where the region may be left, and how fast errors may grow, as text; empty if it is not
    left, or under tracing."""
    if not _tree.is_concrete(inside, values, rates) or bool(jnp.all(inside)):
        return ""
    k = int(np.argmin(np.asarray(inside)))
    before = f" after t = {float(ts[k - 1]):.6g}" if k else ""
    where = domain.exit_at(k, *values)
    rate = min(map(float, rates))
    growth = f". Errors may grow by the factor e^({rate:.3g} t)" if rate > 0 else ""
    return (
        f"the region of the constants may be left{before}; up to t = {float(ts[k]):.6g}, {where}"
        f"{growth}"
    )


def _smaller(a: Any, b: Any) -> Any:
    return (np if isinstance(a, np.ndarray) else jnp).minimum(a, b)


def _where_inside(inside: Any, bound: Any) -> Any:
    """Return the rows of a bound, infinite where the region of the constants may be left."""
    return (np if isinstance(inside, np.ndarray) else jnp).where(inside, bound.T, np.inf).T


def _overflow(x: jax.Array) -> str:
    if not _tree.is_concrete(x) or _tree.has_only_finite(x):
        return ""
    return "the bound on the growth of errors is larger than any number"


@eqx.filter_jit
def _roundoff(
    problem: Problem, args: Any, t0: Any, x0: Any, ts: Any, xs: Any, us: Any, norm_P_inv: Any
) -> tuple[jax.Array, jax.Array]:
    """Return, for each saved time, how far x moves within a few roundings of t, and the roundoff of u.

    The roundoff of the steps is part of their defect.
    """
    generator, (state, control) = problem.generator(args), problem.spaces(x0)
    operator = problem.operator(args)

    def sizes(t: Any, x: Any, u: Any) -> tuple[Any, Any, Any]:
        rate = _tree.add(generator.apply(x), problem.f(t, x, u, args))
        K = problem.set_at(t, args)
        projected = jnp.zeros_like(control.norm(u))
        if iterates(K):
            # Rows that are nearly parallel move y by many times their own roundoff.
            y = operator.apply(u)
            projected = rounding_of(K, control, Place(y, y, face(K, y, control)))
        return state.norm(rate), control.norm(u), projected

    speed, size, projected = jax.vmap(sizes)(ts, xs, us)
    largest = jnp.maximum(jnp.abs(t0), jnp.abs(ts))
    unit = ROUNDINGS * jnp.finfo(ts.dtype).eps
    return unit * largest * speed, unit * size + norm_P_inv * projected


@jax.jit
def _estimates(c: Constants, t0: Any, ts: Any, defects: tuple, initial: tuple) -> tuple:
    """Return the Gronwall estimate of each rate, and all of them over their factors M."""
    total, completed = (disturbance(c, *parts) for parts in defects)
    rates = _rates(c, initial)
    found = [gronwall(t0, ts, total, completed, rate, M, error) for M, rate, error in rates]
    parts = [x / jnp.asarray(M, x.dtype) for x, (M, *_) in zip(found, rates, strict=True)]
    return found, jnp.stack(parts, axis=1)


@jax.jit
def _bounds(c: Constants, estimates: list, distance: Any, law: tuple) -> tuple:
    """Return x, u, x_sharp and u_sharp of `Bound`."""
    law_error = _law_error(c, *law)
    x, *others = (estimate + distance for estimate in estimates)
    u = c.L * x + law_error
    if not others:
        return x, u, None, None
    sharp = jnp.min(jnp.stack(others), axis=0)
    return x, u, sharp, c.L * sharp + law_error


def _law_error(c: Constants, residual: Any, step: Any, roundoff: Any) -> Any:
    """Return a bound on the distance of the computed u from the solution of the law at x_h."""
    return c.norm_P_inv * (residual / c.gamma + step) + roundoff


def _rates(c: Constants, initial: tuple) -> list[tuple[Any, Any, Any]]:
    """Return (M, rate, initial error) of every Gronwall estimate: the paper's, then the sharp ones."""
    rates = [(c.M, c.growth_rate)]
    rates += [] if c.one_sided is None else [(1.0, c.one_sided)]
    rates += [] if c.energy is None else [c.energy]
    return [(*rate, error) for rate, error in zip(rates, initial, strict=True)]


@jax.jit
def _bound_since_previous_time(
    c: Constants, t0: Any, ts: Any, defects: tuple, initial: tuple
) -> jax.Array:
    """Return, for each saved time, the bound on x at all times since the previous saved time."""
    total, completed = (disturbance(c, *parts) for parts in defects)
    bounds = []
    for M, rate, error in _rates(c, initial):
        at_ts = gronwall(t0, ts, total, completed, rate, M, error)
        bounds.append(between(t0, ts, total, completed, rate, M, error, at_ts))
    return jnp.min(jnp.stack(bounds), axis=0)


def _check(problem: Problem, sol: Any, constants: Any, initial_error: Any) -> None:
    if not isinstance(constants, Constants):
        raise input_error(
            "dvax.bound_error(constants)", type(constants).__name__, "it must be a dvax.Constants",
            "Pass dvax.verify(problem, x0).constants; if that is None, its table() says what is "
            "missing. If they are omitted, they are proved along the trajectory",
        )  # fmt: skip
    check_bounded(problem, sol, initial_error)
    if isinstance(sol.setup.method, Implicit):
        raise input_error(
            "dvax.bound_error(sol)", "a solution of dvax.Implicit",
            "an implicit method keeps no polynomials of its steps, so its defect is unknown",
            "Solve with an exponential method, or omit the constants",
        )  # fmt: skip


def check_bounded(problem: Problem, sol: Any, initial_error: Any) -> None:
    """Raise an `InputError` if the solution is not of this problem, or its initial error is invalid."""
    problems = Problems()
    if not isinstance(sol, Solution):
        raise input_error(
            "dvax.bound_error(sol)", type(sol).__name__, "it must be a dvax.Solution",
            "Pass the result of dvax.solve",
        )  # fmt: skip
    solved = current(sol.setup.problem)
    if solved is not problem and solved != problem:
        problems.add(
            "dvax.bound_error(problem, sol)",
            "a solution of another problem, or of this one with other values of what f, h or K reads "
            "from around it (a global, a closure, an attribute)",
            "the certificate evaluates the defect of this problem",
            "Pass the problem that was solved, and values that change in args",
        )
    if any(event.reset is not None for event in sol.setup.events):
        problems.add(
            "dvax.bound_error(sol)",
            "a solution of events with a reset",
            "the computed and the exact trajectory are reset at different times, and in between "
            "their distance is that of the reset, which no constant of the problem bounds",
            "Bound the run up to its first event: terminal=True. What follows has no bound",
        )
    if not isinstance(initial_error, Bound) and _tree.is_concrete(initial_error):
        number = np.asarray(initial_error)
        real = number.ndim == 0 and np.issubdtype(number.dtype, np.number)
        if not (real and np.isfinite(number) and number >= 0):
            problems.add(
                "dvax.bound_error(initial_error)",
                _tree.short(initial_error),
                "it must be one number ≥ 0: a bound on ‖x_h(t0) − x(t0)‖",
                "Pass 0 if the initial state is exact, or the Bound of the previous run",
            )
    if isinstance(initial_error, Bound):
        problems += _continuation_problems(initial_error, sol.setup)
    problems.raise_any()


def _continuation_problems(previous: Bound, setup: Setup) -> list[InputProblem]:
    """Return the problems of continuing with a run from the bound `previous`."""
    t0, x0 = setup.setting["t0"], setup.x0
    if previous.ts.shape[0] > 0:
        end, last = previous.ts[-1], previous.last
        if not _tree.is_concrete(end, t0, last, x0):
            return []
        if float(end) == float(np.asarray(t0, end.dtype)):
            if last is None or all(
                np.array_equal(a, b)
                for a, b in zip(jtu.tree_leaves(last), jtu.tree_leaves(x0), strict=True)
            ):
                return []
            return [
                InputProblem(
                    "dvax.bound_error(initial_error)",
                    f"a Bound of the state {_tree.short(last)} for a run from {_tree.short(x0)}",
                    "a bound goes on with the state that it is about",
                    "Start from sol.xs[-1], or give the error of the new x0 as a number",
                )
            ]
        value_text = f"a Bound up to t = {float(end):.17g} for a run from t0 = {float(t0):.17g}"
    else:
        value_text = "a Bound without a saved time"
    return [
        InputProblem(
            "dvax.bound_error(initial_error)",
            value_text,
            "a bound exists at saved times only, so a run can continue only from the last of them",
            "Save t1 as well: make it the last entry of ts=",
        )
    ]


def _initial_errors(initial_error: Any, c: Constants, dtype: Any) -> tuple[Any, ...]:
    """Return the initial error of every rate."""
    count = 1 + (c.one_sided is not None) + (c.energy is not None)
    if not isinstance(initial_error, Bound):
        return (jnp.asarray(initial_error, dtype),) * count
    paper, sharp = initial_error.x_paper, initial_error.x_sharp
    return paper[-1], *((paper if sharp is None else sharp)[-1],) * (count - 1)


def _status_of_structure(problem: Problem, sol: Solution, c: Constants) -> Status:
    """Return "proved" if M, ω, m_P and ‖P⁻¹‖ are at least as pessimistic as the values proved from A
    and P. Sharper values may hold as well, but then they are declared."""
    growth, spectrum, declared = _structure(problem, sol.setup.x0, sol.setup.args)
    pairs = (
        (c.M, growth.M),
        (c.omega, growth.omega),
        (c.norm_P_inv, spectrum.norm_P_inv),
        (spectrum.m_P, c.m_P),
    )
    if declared or spectrum.declared or not _tree.is_concrete(pairs):
        return "declared"
    rtol = 1e-9  # rounding error of an eigenvalue
    covered = [float(a) >= float(b) - rtol * abs(float(b)) for a, b in pairs]
    return "proved" if all(covered) else "declared"


def _structure(problem: Problem, x0: Any, args: Any) -> tuple[Growth, Spectrum, bool]:
    """Return the growth of A, the spectrum of P, and whether the numerical range of A is declared.

    They are kept where A and P do not depend on args: pieces of a run are bounded one by one."""
    given = isinstance(problem.A, AbstractGenerator) and isinstance(problem.P, AbstractOperator)
    key = str(jtu.tree_map(jnp.shape, x0)), str(_tree.dtype(x0))
    if given and key in _structures(problem):
        return _structures(problem)[key]
    state, control = problem.spaces(x0)
    A, P = problem.generator(args), problem.operator(args)
    found = A.growth(state), P.spectrum(control), is_declared(A)
    if given and _tree.is_concrete(found):
        _structures(problem)[key] = found
    return found


@once_per_object
def _structures(problem: Problem) -> dict[Any, tuple[Growth, Spectrum, bool]]:
    """Return a table of the structures of a problem, one for each shape of the state."""
    return {}


def is_declared(A: AbstractGenerator) -> bool:
    """Return whether the growth bound uses a declared numerical range."""
    if isinstance(A, Product):
        return any(map(is_declared, A.parts))
    return isinstance(A, AbstractMatrixFree) and not A.numerical_range().proved


def _solve_again(sol: Solution, constants: Constants) -> Solution:
    """Solve again with the same steps, and record all that a certificate needs."""
    again = run_again(sol, sol.ts, constants=constants)
    if again.ts.shape == sol.ts.shape:
        return again
    raise input_error(
        "dvax.bound_error(sol)",
        f"{sol.ts.shape[0]} saved times, of which another run reaches {again.ts.shape[0]}",
        "the defect was not recorded, so the certificate solves the problem again",
        "Solve with constants= and measure=True, which records the defect",
    )
