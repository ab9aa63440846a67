"""The a-posteriori certificate: how far the computed trajectory is from the true one.

Let x_h solve x_h' = A x_h + p exactly (every exponential method does, with p its stage polynomial),
and let δ(s) = ‖p(s) − f̃(s, x_h(s))‖. Subtracting the mild equations,

    ‖x_h − x‖(t) ≤ M e^{ωt}‖x_h(0) − x₀‖ + M ∫₀ᵗ e^{ω(t−s)} (δ(s) + L̃‖x_h − x‖(s)) ds,

and Gronwall's lemma gives, with c = ω + M L̃,

    ‖x_h − x‖(t) ≤ M e^{ct}‖x_h(0) − x₀‖ + M ∫₀ᵗ e^{c(t−s)} δ(s) ds.

A never enters δ, so the bound is finite for a partial differential equation. Where f̃ is only
evaluated through a law solved to ‖w‖, δ gains β_f‖P⁻¹‖‖w‖/γ. With a one-sided constant μ the same
holds with M = 1 and c = μ: d/dt‖x_h − x‖ ≤ μ‖x_h − x‖ + δ. The response follows, since
‖u_h − u‖ ≤ L‖x_h − x‖ + ‖u_h − u_{x_h}‖.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from ..errors import InputError, InputProblem
from ..evolution import Implicit, Solution, between, disturbance, gronwall, solve
from ..evolution.control import MAX_GROWTH
from ..generators import AbstractGenerator, AbstractMatrixFree, Product
from ..problem import Problem
from .constants import Constants
from .status import Status, weakest


class Bound(eqx.Module):
    """Bounds on the true error at the saved times of a solution.

    - `ts`; `x` ≥ ‖x_h − x‖ and `u` ≥ ‖u_h − u‖: the better one, at each time, of the next two;
    - `x_paper`, `u_paper`: with the paper's rate ω + ML̃;
    - `x_sharp`, `u_sharp`: with the one-sided constant μ, or the rate of an energy norm where that
      gives less; None where neither is known;
    - `status`: the weakest of what the bound rests on. "proved" says that the constants are proved,
      that M, ω and ‖P⁻¹‖ are no smaller than what the structure of A and P gives, and that the
      defect is enclosed over every step; the moduli of f and h are those that the constants state.
      "estimated" says that the defect was sampled.

    Bounds hold up to floating-point rounding in the solve itself.
    """

    ts: jax.Array
    x: jax.Array
    u: jax.Array
    x_paper: jax.Array
    u_paper: jax.Array
    x_sharp: jax.Array | None
    u_sharp: jax.Array | None
    status: Status = eqx.field(static=True)


def bound_error(
    problem: Problem, sol: Solution, constants: Constants, *, initial_error: Any = 0.0
) -> Bound:
    """Bound the error of a computed trajectory at its saved times.

    **Arguments:** `problem` and `sol`, the solution of it; `constants`, its moduli; `initial_error`,
    a bound on ‖x_h(t0) − x(t0)‖, or the `Bound` of the run that this one continues from its last
    saved state. (With M > 1 every piece multiplies by M anew.)

    Where the solve did not measure its defect (fixed steps), or where it went (constants of a region,
    that the solve was not given), it is run again, and the distance of the two runs is added.

    Constants that `dvax.verify` found for a region of x or u are good while the trajectory stays in
    it: where what encloses it over the steps up to a saved time, with its bound, is not inside, the
    bounds are infinite from there on. (Between two saved times the bound is taken from the one before
    and all that disturbs the equation on the way, so many saved times make it the sharper.) For other
    times or `args` than those verified nobody proved them: then the status is "declared". With a region
    of u the bounds are those of the one solution whose response stays in it; a law that is monotone
    there alone may have others.

    **Raises:** `dvax.InputError` where `sol` is not a solution of `problem`, or `initial_error` is
    not a number ≥ 0.

    ```python
    >>> import dvax
    >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
    ...                             kappa0=0.5, g=1.0, ell=3.0)
    >>> sol = dvax.solve(model.problem, -1.0, 0.0, 2.0, rtol=1e-6)
    >>> bound = dvax.bound_error(model.problem, sol, model.constants)
    >>> bool(bound.x[-1] >= abs(sol.xs[-1] - 1.8360919559905713)), bound.status
    (True, 'proved')

    ```
    """
    _check(problem, sol, constants, initial_error)
    space = problem.spaces(sol.setup.x0)[0]
    measured, apart = sol, jnp.zeros_like(sol.ts)
    domain = constants.domain
    regional = domain is not None and not domain.free
    if sol.defect is None or (regional and sol.extent is None):
        measured = _again(problem, sol, constants)
        apart = jax.vmap(lambda a, b: space.norm(_tree.sub(a, b)))(measured.xs, sol.xs)
    assert measured.defect is not None and measured.law_defect is not None
    assert measured.completed_defect is not None

    integrated_defect = (measured.defect, measured.law_defect), measured.completed_defect
    law = sol.law_residual, sol.law_step
    start = _starts(initial_error, sol.ts.dtype)
    begin = sol.setup.setting["t0"]
    t0 = jnp.asarray(begin, sol.ts.dtype)
    x, u, x_sharp, u_sharp = _bounds(constants, t0, sol.ts, integrated_defect, apart, law, start)
    best_x = x if x_sharp is None else jnp.minimum(x, x_sharp)
    best_u = u if u_sharp is None else jnp.minimum(u, u_sharp)
    where: Status = "proved"
    inside = jnp.ones(sol.ts.shape, bool)
    if domain is not None:
        covered = domain.covers(begin, sol.setup.setting["t1"]) and domain.is_of(sol.setup.args)
        where = "proved" if covered else "declared"
        if regional:
            assert measured.extent is not None
            passed = _on_the_way(constants, t0, sol.ts, integrated_defect, start)
            law_error = constants.norm_P_inv * (law[0] / constants.gamma + law[1])
            of_u = constants.L * passed + law_error
            spaces = problem.spaces(sol.setup.x0)
            inside = domain.keeps(*measured.extent, passed, of_u, spaces)
    status = weakest(
        constants.status_of(*(name for name, _ in constants.statuses)),
        "proved" if measured.enclosed else "estimated",
        _status_of_structure(problem, sol, constants),
        where,
    )
    kept = lambda v: jnp.where(inside, v, jnp.inf)  # noqa: E731
    sharp = [None if v is None else kept(v) for v in (x_sharp, u_sharp)]
    return Bound(sol.ts, kept(best_x), kept(best_u), kept(x), kept(u), sharp[0], sharp[1], status)


@jax.jit
def _bounds(
    c: Constants, t0: Any, ts: Any, integrated_defect: tuple, apart: Any, law: tuple, start: tuple
) -> tuple:
    """x, u, x_sharp and u_sharp of `Bound`."""
    acted, completed_defect = (disturbance(c, *parts) for parts in integrated_defect)
    law_error = c.norm_P_inv * (law[0] / c.gamma + law[1])
    x, *each = (
        gronwall(t0, ts, acted, completed_defect, rate, M, initial) + apart
        for M, rate, initial in _rates(c, start)
    )
    u = c.L * x + law_error
    if not each:
        return x, u, None, None
    sharp = jnp.min(jnp.stack(each), axis=0)
    return x, u, sharp, c.L * sharp + law_error


def _rates(c: Constants, start: tuple) -> list[tuple[Any, Any, Any]]:
    """(M, c) in which errors grow, and what they start with: the paper's first, then the sharp ones."""
    rates = [(c.M, c.growth_rate, start[0])]
    rates += [] if c.one_sided is None else [(1.0, c.one_sided, start[1])]
    return rates + ([] if c.energy is None else [(*c.energy, start[1])])


@jax.jit
def _on_the_way(
    c: Constants, t0: Any, ts: Any, integrated_defect: tuple, start: tuple
) -> jax.Array:
    """The bound on x at all times since the saved time before."""
    acted, completed_defect = (disturbance(c, *parts) for parts in integrated_defect)
    each = []
    for M, rate, initial in _rates(c, start):
        at = gronwall(t0, ts, acted, completed_defect, rate, M, initial)
        each.append(between(t0, ts, acted, completed_defect, rate, M, initial, at))
    return jnp.min(jnp.stack(each), axis=0)


def _check(problem: Problem, sol: Any, constants: Any, initial_error: Any) -> None:
    wrong: list[InputProblem] = [
        InputProblem(
            f"dvax.bound_error({name})", type(given).__name__, f"it is a {kind}", f"Take {source}"
        )
        for name, given, known, kind, source in (
            ("sol", sol, isinstance(sol, Solution), "dvax.Solution", "what dvax.solve returned"),
            ("constants", constants, isinstance(constants, Constants), "dvax.Constants",
             "dvax.verify(problem, x0).constants"),
        )
        if not known
    ]  # fmt: skip
    if wrong:
        raise InputError(*wrong)
    if sol.setup.problem is not problem and sol.setup.problem != problem:
        wrong.append(
            InputProblem(
                "dvax.bound_error(problem, sol)",
                "a solution of another problem",
                "the certificate evaluates the defect of this problem",
                "Pass the problem that was solved",
            )
        )
    if isinstance(sol.setup.method, Implicit):
        wrong.append(
            InputProblem(
                "dvax.bound_error(sol)",
                "a solution of dvax.Implicit",
                "an implicit method keeps no polynomials of its steps, so that its defect is not known",
                "Solve with an exponential method",
            )
        )
    if not isinstance(initial_error, Bound) and _tree.is_concrete(initial_error):
        number = np.asarray(initial_error)
        real = number.ndim == 0 and np.issubdtype(number.dtype, np.number)
        if not (real and np.isfinite(number) and number >= 0):
            wrong.append(
                InputProblem(
                    "dvax.bound_error(initial_error)",
                    _tree.short(initial_error),
                    "it must be one number ≥ 0: a bound on ‖x_h(t0) − x(t0)‖",
                    "Pass 0 where the initial state is exact, or the Bound of the run before",
                )
            )
    if isinstance(initial_error, Bound):
        wrong += _breaks_off(initial_error, sol.setup.setting["t0"])
    if wrong:
        raise InputError(*wrong)


def _breaks_off(before: Bound, t0: Any) -> list[InputProblem]:
    """What is wrong with going on from `before` at t0."""
    if before.ts.shape[0] > 0:
        end = before.ts[-1]
        if not _tree.is_concrete(end, t0) or float(end) == float(np.asarray(t0, end.dtype)):
            return []
        given = f"a Bound up to t = {float(end):.17g} for a run from t0 = {float(t0):.17g}"
    else:
        given = "a Bound without a saved time"
    return [
        InputProblem(
            "dvax.bound_error(initial_error)",
            given,
            "a bound is known at saved times only, so a run goes on from the last of them",
            "Save t1 as well: let it be the last of ts=",
        )
    ]


def _starts(initial_error: Any, dtype: Any) -> tuple[Any, Any]:
    """What the paper's and the sharp bound start with."""
    if isinstance(initial_error, Bound):
        paper, sharp = initial_error.x_paper, initial_error.x_sharp
        return paper[-1], (paper if sharp is None else sharp)[-1]
    error = jnp.asarray(initial_error, dtype)
    return error, error


def _status_of_structure(problem: Problem, sol: Solution, c: Constants) -> Status:
    """Whether M, ω, m_P and ‖P⁻¹‖ are covered by what A and P themselves prove; smaller ones may
    hold as well, but then it is the caller who says so."""
    x0, args = sol.setup.x0, sol.setup.args
    state, control = problem.spaces(x0)
    growth = problem.generator(args).growth(state)
    spectrum = problem.operator(args).spectrum(control)
    covered = (
        (c.M, growth.M),
        (c.omega, growth.omega),
        (c.norm_P_inv, spectrum.norm_P_inv),
        (spectrum.m_P, c.m_P),
    )
    if is_declared(problem.generator(args)) or spectrum.declared or not _tree.is_concrete(covered):
        return "declared"
    slack = 1e-9  # what rounding may do to an eigenvalue
    held = [float(a) >= float(b) - slack * abs(float(b)) for a, b in covered]
    return "proved" if all(held) else "declared"


def is_declared(A: AbstractGenerator) -> bool:
    """Whether the growth bound rests on a numerical range that somebody gave."""
    if isinstance(A, Product):
        return any(map(is_declared, A.parts))
    return isinstance(A, AbstractMatrixFree) and not A.numerical_range().proved


def _again(problem: Problem, sol: Solution, constants: Constants) -> Solution:
    """The same steps, with all that a certificate needs."""
    was = sol.setup
    asked = was.setting
    adaptive = isinstance(asked["dt"], float) and math.isnan(asked["dt"])
    # A first step that nobody gave is chosen again, with the growth that it allows.
    given = asked["dt0_growth"] <= MAX_GROWTH
    longest = None if asked["dt_max"] == math.inf else asked["dt_max"]
    again = solve(
        problem, was.x0, asked["t0"], asked["t1"], was.args, sol.ts, None if adaptive else asked["dt"],
        rtol=asked["rtol"], atol=asked["atol"], dt0=asked["dt0"] if given else None,
        dt_max=longest, horizon=asked["horizon"],
        method=was.method, vi_solver=was.vi_solver, constants=constants, measure=True, throw=False,
    )  # fmt: skip
    if again.ts.shape == sol.ts.shape:
        return again
    raise InputError(
        InputProblem(
            "dvax.bound_error(sol)",
            f"{sol.ts.shape[0]} saved times, of which another run reaches {again.ts.shape[0]}",
            "what the certificate needs was not kept, and so it solves once more",
            "Solve with constants= and measure=True, so that it is kept",
        )
    )
