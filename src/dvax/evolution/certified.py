"""Step sizes for a given bound on the error: `certified_tol` of `dvax.solve`.

If the norm of the defect is at most δ, then ‖x_h − x‖(t) ≤ M Φ_c(t) δ with c = ω + ML̃. This gives the
tolerance of the step control up to a small factor, which a run determines. The first run is always
cheap. Its bound and its number of steps predict those of the next run, and an unreachable tolerance is
refused after the first run. A bound is called certified if enclosures bound the defect over every step,
and estimated if the defect is sampled.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._captured import Reads
from .._tree import Tree
from ..errors import InputError, Problems, input_error
from ..problem import Problem
from ..spaces import AbstractSpace
from .defect import ROUNDINGS
from .growth import between, disturbance, gronwall
from .results import RESULTS
from .solution import Solution

_FIRST_RUN_FACTOR = 100.0
"""Ratio of the tolerance of the first run to the predicted one."""

_FIRST_RUN_TOLERANCE = 1e-5
"""Smallest tolerance of the first run, relative to the size of state and rate."""

_TARGET_SHARE = 0.7
"""The share of the tolerance that later runs aim at, so that they rarely miss it."""

_MAX_RUNS = 8
_REGION_CHECKS = 256
"""Number of times at which to check that a run stays in the region of its constants."""

_RATE_ROUNDOFF = 256.0
"""Assumed rounding error of f̃, in units of eps times its size: no defect is smaller."""

_REQUIRED_CONSTANTS = ("M", "growth_rate", "beta_f", "norm_P_inv", "gamma")


def certified(
    run: Callable[[Any, float], Solution],
    ts: Any,
    problem: Problem,
    x0: Tree,
    args: Any,
    t0: float,
    t1: float,
    constants: Any,
    tol: float,
    max_steps: int,
) -> Solution:
    """Return a solution whose error bound is at most `tol` at every saved time.

    `run(ts, atol)` solves with this absolute tolerance and rtol = 0.

    **Raises:** `dvax.InputError` if `tol` is out of reach, because of roundoff or of `max_steps`.
    """
    _check(constants, tol, x0)
    _check_domain(problem, constants, args, t0, t1)
    growth, span = _growth(constants), t1 - t0
    amplification = growth.amplification(span)
    size, largest = (float(v) for v in _sizes(problem, jnp.asarray(t0), x0, _tree.as_arrays(args)))
    eps = float(jnp.finfo(jnp.result_type(*jtu.tree_leaves(x0))).eps)
    reachable = _RATE_ROUNDOFF * eps * largest * amplification
    if not tol >= reachable:
        raise _out_of_reach(tol, reachable, growth, span, "the roundoff of f alone grows to that")
    # The step control holds the root mean square of the defect below atol/span.
    atol = tol / amplification * span / size
    scale = 1.0 + largest / size
    coarse = max(_FIRST_RUN_FACTOR * atol, _FIRST_RUN_TOLERANCE * scale)
    atol = coarse if coarse < 0.1 * scale else max(atol, min(coarse, 0.1 * scale))
    before, bound, steps = np.inf, np.inf, 0
    for _ in range(_MAX_RUNS):
        solution = run(ts, atol)
        if solution.result != RESULTS.successful:
            return solution  # throw=False: the result says what failed, and nothing is certified
        bounds, _ = _bounds(solution, growth, t0)
        of_steps, of_time = _roundoff(solution, growth, max(size, largest), t0, t1)
        if of_steps + of_time > 0.5 * tol:
            reason = f"roundoff of x in {int(solution.stats['steps'])} steps, and of t"
            least = max(2.0 * (of_steps + of_time), reachable)
            raise _out_of_reach(tol, least, growth, span, reason)
        # That of the steps is part of their defect.
        last, bound = bound, float(np.max(np.asarray(bounds))) + of_time
        if bound <= tol:
            if of_region(constants):
                # The same steps with more saved times, which make the bounds between them sharper.
                denser = run(np.linspace(t0, t1, _REGION_CHECKS + 1)[1:], atol)
                exit_time = _exit_time(denser, constants, _bounds(denser, growth, t0)[1])
                if exit_time is not None:
                    raise _outside(exit_time)
            return _with_bound(solution, bound)
        new_steps = int(solution.stats["steps"])
        # The bound should decrease at least with half the order in the number of steps. If it does not
        # although there are many more steps, roundoff dominates. (With about the same number of steps,
        # the tolerance did not determine them, and the comparison is meaningless.)
        expected = last * (steps / new_steps) ** (0.5 * _order(solution))
        if np.isfinite(last) and bound > expected and new_steps > 1.5 * steps:
            why = f"{new_steps} steps gave {bound:.3g}, and {steps} gave {last:.3g}: roundoff"
            raise _out_of_reach(tol, min(bound, last), growth, span, why)
        before, steps = atol, new_steps
        atol = (
            min(0.5 * atol, _TARGET_SHARE * atol * tol / bound)
            if np.isfinite(bound)
            else 0.1 * atol
        )
        _predict(solution, before / atol, tol, bound, max_steps, growth, span)
    raise _out_of_reach(tol, bound, growth, span, "every finer run missed its predicted bound")


def _predict(
    solution: Solution,
    finer: float,
    tol: float,
    bound: float,
    max_steps: int,
    growth: "_Growth",
    span: float,
) -> None:
    """Raise if a run whose tolerance is smaller by the factor `finer` needs more than `max_steps`.

    With a defect of order p the number of steps grows by finer^{1/p}.
    """
    order = _order(solution)
    steps = int(solution.stats["steps"]) + int(solution.stats["rejected"])
    needed = steps * finer ** (1.0 / order)
    if needed > max_steps:
        least = bound * (steps / max_steps) ** order
        name = type(solution.setup.method).__name__
        why = f"it would take about {needed:.2g} steps of {name}, and max_steps is {max_steps}"
        raise _out_of_reach(tol, least, growth, span, why)


def _order(solution: Solution) -> int:
    """Return the order p of the defect O(h^p)."""
    return getattr(solution.setup.method, "degree", 1) + 1


class _Growth(NamedTuple):
    """The growth of disturbances: pairs (M, c) in `rates`, and constants of the problem.

    They are copied once, because each read of some properties of `Constants` computes a bound.
    """

    rates: list[tuple[float, float]]
    beta_f: float
    norm_P_inv: float
    gamma: float

    def amplification(self, span: float) -> float:
        """Return the smallest M Φ_c(T): a bound on the error that a defect of norm 1 causes."""
        return min(M * _convolved(rate, span) for M, rate in self.rates)


def _growth(constants: Any) -> _Growth:
    """Return the growth pairs: (M, c) of the paper, (1, μ) one-sided, and that of an energy norm, as
    far as `constants` has them."""
    one_sided, energy = (getattr(constants, name, None) for name in ("one_sided", "energy"))
    rates = [(float(constants.M), float(constants.growth_rate))]
    rates += [] if one_sided is None else [(1.0, float(one_sided))]
    rates += [] if energy is None else [(float(energy[0]), float(energy[1]))]
    return _Growth(rates, *(float(getattr(constants, name)) for name in _Growth._fields[1:]))


@eqx.filter_jit
def _sizes(problem: Problem, t0: jax.Array, x0: Tree, args: Any) -> tuple[jax.Array, jax.Array]:
    """Return ‖1‖ and the size of x or of f, whichever is larger.

    The response is set to zero, because solving for it takes much longer to compile.
    """
    space = problem.spaces(x0)[0]
    rate = problem.f(t0, x0, problem.zero_control(x0), args)
    return jnp.sqrt(space.size()), jnp.maximum(space.norm(rate), space.norm(x0))


def _bounds(solution: Solution, growth: _Growth, t0: float) -> tuple[jax.Array, jax.Array]:
    """Return the bounds at every saved time, and on the interval from the last one to it."""
    assert solution.defect is not None and solution.completed_defect is not None
    integrated = (solution.defect, solution.law_defect), solution.completed_defect
    return _smallest_bounds(t0, solution.ts, integrated, growth)


def _roundoff(
    solution: Solution, growth: _Growth, rate: float, t0: float, t1: float
) -> tuple[float, float]:
    """Return bounds on the error due to roundoff: of x in all steps, and of t, with |x'| of the size
    `rate`."""
    space = solution.setup.problem.spaces(solution.setup.x0)[0]
    size = float(_largest_norm(space, solution.setup.x0, solution.xs))
    eps = float(jnp.finfo(solution.setup.dtype).eps)
    steps = int(solution.stats["steps"])
    factor = min(M * np.exp(min(max(c, 0.0) * (t1 - t0), 700.0)) for M, c in growth.rates)
    of_steps = ROUNDINGS * steps * size
    return float(factor) * eps * of_steps, ROUNDINGS * eps * max(abs(t0), abs(t1)) * rate


@eqx.filter_jit
def _largest_norm(space: AbstractSpace, x0: Tree, xs: Tree) -> jax.Array:
    return jnp.maximum(jnp.max(jax.vmap(space.norm)(xs)), space.norm(x0))


@jax.jit
def _smallest_bounds(
    t0: Any, ts: Any, integrated: tuple, growth: _Growth
) -> tuple[jax.Array, jax.Array]:
    """Return the smallest bounds over all growth pairs: at the saved times, and between them."""
    total, completed = (disturbance(growth, *parts) for parts in integrated)
    at_ts, between_ts = [], []
    for M, rate in growth.rates:
        at_ts.append(gronwall(t0, ts, total, completed, rate, M, 0.0))
        between_ts.append(between(t0, ts, total, completed, rate, M, 0.0, at_ts[-1]))
    return jnp.min(jnp.stack(at_ts), axis=0), jnp.min(jnp.stack(between_ts), axis=0)


def of_region(constants: Any) -> bool:
    """Return whether the constants hold in a bounded region of x or u only."""
    domain = getattr(constants, "domain", None)
    return domain is not None and not domain.is_unbounded


def _exit_time(solution: Solution, constants: Any, error_bounds: Any) -> float | None:
    """Return the first saved time by which x or u may have left the region of the constants, or None.

    The bounds on x_h and u_h are enlarged by their error bounds.
    """
    domain, bounds = constants.domain, solution.bounds
    assert bounds is not None
    law_error = solution.law_residual / constants.gamma + solution.law_step
    of_u = constants.L * error_bounds + constants.norm_P_inv * law_error
    spaces = solution.setup.problem.spaces(solution.setup.x0)
    inside = np.asarray(domain.contains(*bounds, error_bounds, of_u, spaces))
    return None if inside.all() else float(solution.ts[int(np.argmin(inside))])


def _outside(t: float) -> InputError:
    return input_error(
        "dvax.solve(constants)",
        f"constants of a region that the trajectory leaves by t = {t:.6g}",
        "outside it nothing bounds the error",
        "Verify the problem in a larger region: dvax.verify(problem, x0, x=(low, high))",
    )


def _check_domain(problem: Problem, constants: Any, args: Any, t0: float, t1: float) -> None:
    """Raise if the constants were verified for other times, other `args`, or other values that the
    functions read."""
    domain = getattr(constants, "domain", None)
    wrong = Problems()
    if domain is not None and not domain.covers(t0, t1):
        wrong.add(
            "dvax.solve(constants)",
            f"constants verified on [{domain.t0:.17g}, {domain.t1:.17g}]",
            f"they must cover the run, which goes from {t0:.17g} to {t1:.17g}",
            f"Verify for these: dvax.verify(problem, x0, {t0:g}, {t1:g}, args)",
        )
    if domain is not None and not domain.has_args(args, Reads(problem)):
        wrong.add(
            "dvax.solve(constants)",
            "constants of another args, or of other values that f, h or K reads from around it",
            "f and h may be steeper at these parameters than at those",
            "Verify for these: dvax.verify(problem, x0, t0, t1, args)",
        )
    wrong.raise_any()


def _with_bound(solution: Solution, bound: float) -> Solution:
    solution.stats["certified_bound" if solution.enclosed else "estimated_bound"] = bound
    return solution


def _convolved(a: float, T: float) -> float:
    """Return Φ_a(T) = ∫₀ᵀ e^{as} ds."""
    return T if a == 0.0 else float(np.expm1(min(a * T, 700.0)) / a)


def _amount(value: float, before: str) -> str:
    # `_convolved` limits its exponent, and such numbers say no more.
    return f"{before}{value:.3g}" if value < 1e100 else "more than 1e100"


def _out_of_reach(
    tol: float, reachable: float, growth: _Growth, span: float, why: str
) -> InputError:
    M, rate = min(growth.rates, key=lambda pair: pair[0] * _convolved(pair[1], span))
    return input_error(
        "dvax.solve(certified_tol)",
        f"{tol:g}",
        f"errors may grow like M e^{{ct}} with M = {M:g} and c = {rate:g}, a defect by "
        f"{_amount(M * _convolved(rate, span), 'M Φ_c(T) = ')} over T = {span:g}, and the least "
        f"bound in reach here is {_amount(reachable, 'about ')} ({why})",
        "Choose a larger certified_tol, solve for a shorter time, or find sharper constants: "
        "dvax.verify gives a one-sided rate where possible",
    )


def _check(constants: Any, tol: Any, x0: Tree) -> None:
    missing = [name for name in _REQUIRED_CONSTANTS if getattr(constants, name, None) is None]
    if constants is None or missing:
        raise input_error(
            "dvax.solve(constants)",
            "None" if constants is None else f"no {', '.join(missing)}",
            "a bound on the error rests on the constants of the problem",
            "Give dvax.Constants, or constants=dvax.verify(problem, x0).constants",
        )
    if not _tree.is_concrete(tol, x0, constants):
        raise input_error(
            "dvax.solve(certified_tol)",
            "a traced value",
            "the tolerance of a run depends on the results of earlier runs",
            "Call dvax.solve outside jax.jit first, and pass the atol of that solution inside",
        )
    if not (_tree.is_number(tol) and np.isfinite(tol) and tol > 0):
        raise input_error(
            "dvax.solve(certified_tol)", str(tol), "it must be a positive number",
            "Give the largest error of x, in the norm of the state space, that is allowed",
        )  # fmt: skip
