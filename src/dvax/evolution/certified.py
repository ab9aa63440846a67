"""Step sizes for a given bound on the error: `certified_tol` of `dvax.solve`.

If the norm of the defect is at most δ, then ‖x_h − x‖(t) ≤ M Φ_c(t) δ with c = ω + ML̃. This gives the
tolerance of the step control up to a small factor, which a run determines. The first run is always
cheap. Its bound and its number of steps predict those of the next run, and an unreachable tolerance is
refused after the first run. A bound is called certified if enclosures bound the defect over every step,
and estimated if the defect is sampled.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .._captured import Reads
from .._once import once_per_object
from .._tree import Tree
from ..errors import InputError, Problems, input_error
from ..problem import Problem
from .defect import ROUNDINGS
from .growth import between, disturbance, gronwall
from .results import RESULTS
from .setup import Setup
from .signature import Signature, flatten
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
    setup: Setup,
    constants: Any,
    tol: float,
    max_steps: int,
    throw: bool,
) -> Solution:
    """Return a solution whose error bound is at most `tol` at every saved time.

    `run(ts, atol)` solves with this absolute tolerance and rtol = 0, and raises where that fails if
    `throw`.

    **Raises:** `dvax.InputError` if `tol` is out of reach, because of roundoff or of `max_steps`.
    """
    growth = _checked_growth(constants, tol, setup)
    problem, t0, t1 = setup.problem, setup.setting["t0"], setup.setting["t1"]
    _check_domain(problem, constants, setup.args, t0, t1)
    _check_knots(setup)
    span = t1 - t0
    amplification = growth.amplification(span)
    size, largest = _sizes(setup)
    eps = float(jnp.finfo(setup.dtype).eps)
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
        if not throw and solution.result != RESULTS.successful:
            return solution  # the result says what failed, and nothing is certified
        of_defect, largest_x, speed = _assess(solution, growth)
        rate = max(size, largest, speed)
        of_steps, of_time = _roundoff(solution, growth, largest_x, rate, eps)
        if of_steps + of_time > 0.5 * tol:
            reason = f"roundoff of x in {int(solution.stats['steps'])} steps, and of t"
            least = max(2.0 * (of_steps + of_time), reachable)
            raise _out_of_reach(tol, least, growth, span, reason)
        # That of the steps is part of their defect.
        last, bound = bound, of_defect + of_time
        if bound <= tol:
            if of_region(constants):
                # The same steps with more saved times, which make the bounds between them sharper.
                denser = run(np.linspace(t0, t1, _REGION_CHECKS + 1)[1:], atol)
                exit_time = _exit_time(denser, constants, _bounds_between(denser, growth))
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
    """The growth of disturbances: pairs (M, c) in `rates`, and constants of the problem."""

    rates: list[tuple[float, float]]
    beta_f: float
    norm_P_inv: float
    gamma: float

    def amplification(self, span: float) -> float:
        """Return the smallest M Φ_c(T): a bound on the error that a defect of norm 1 causes."""
        return min(M * _convolved(rate, span) for M, rate in self.rates)


def _growth(constants: Any) -> _Growth | list[str]:
    """Return the growth pairs: (M, c) of the paper, (1, μ) one-sided, and that of an energy norm, as
    far as `constants` has them; or the names of the constants that are missing."""
    known: dict[str, Any] = {name: getattr(constants, name, None) for name in _REQUIRED_CONSTANTS}
    missing = [name for name, value in known.items() if value is None]
    if missing:
        return missing
    one_sided, energy = (getattr(constants, name, None) for name in ("one_sided", "energy"))
    rates = [(float(known["M"]), float(known["growth_rate"]))]
    rates += [] if one_sided is None else [(1.0, float(one_sided))]
    rates += [] if energy is None else [(float(energy[0]), float(energy[1]))]
    return _Growth(rates, *(float(known[name]) for name in _Growth._fields[1:]))


_growth_of_module = once_per_object(_growth)


def _sizes(setup: Setup) -> tuple[float, float]:
    """Return ‖1‖ and the size of x or of f, whichever is larger, at t0.

    The response is set to zero, because solving for it takes much longer to compile.
    """
    numbers, signature = flatten((setup.problem,), (setup.x0, setup.args), None)
    size, largest = np.asarray(_sizes_of(numbers, setup.setting["t0"], signature))
    return float(size), float(largest)


@partial(jax.jit, static_argnums=2)
def _sizes_of(numbers: list[Any], t0: Any, signature: Signature) -> jax.Array:
    (problem,), (x0, args) = signature.unflatten(numbers)
    space = problem.spaces(x0)[0]
    t = jnp.asarray(t0, _tree.dtype(x0))
    rate = problem.f(t, x0, problem.zero_control(x0), _tree.as_arrays(args))
    return jnp.stack([jnp.sqrt(space.size()), jnp.maximum(space.norm(rate), space.norm(x0))])


def _assess(solution: Solution, growth: _Growth) -> tuple[float, float, float]:
    """Return the largest error bound at the saved times, the largest norm of x, and the largest speed,
    for responses that are zero."""
    setup = solution.setup
    data = (setup.x0, solution.xs, solution.ts, _integrated(solution), setup.args)
    numbers, signature = flatten((setup.problem,), data, None)
    found = np.asarray(_assessed(numbers, growth, setup.setting["t0"], signature))
    return float(found[0]), float(found[1]), float(found[2])


@partial(jax.jit, static_argnums=3)
def _assessed(numbers: list[Any], growth: _Growth, t0: Any, signature: Signature) -> jax.Array:
    (problem,), (x0, xs, ts, integrated, args) = signature.unflatten(numbers)
    args, space = _tree.as_arrays(args), problem.spaces(x0)[0]
    A = problem.generator(args)

    def speed(t: Any, x: Tree) -> Any:
        u = problem.zero_control(x)
        return space.norm(_tree.add(A.apply(x), problem.f(t, x, u, args)))

    norm = jnp.maximum(jnp.max(jax.vmap(space.norm)(xs)), space.norm(x0))
    start = speed(jnp.asarray(t0, ts.dtype), x0)
    fastest = jnp.maximum(jnp.max(jax.vmap(speed)(ts, xs)), start)
    bound = jnp.max(_smallest_bounds(t0, ts, integrated, growth)[0])
    return jnp.stack([bound, norm.astype(bound.dtype), fastest.astype(bound.dtype)])


def _bounds_between(solution: Solution, growth: _Growth) -> jax.Array:
    """Return the error bounds on the intervals from each saved time, or t0, to the next one."""
    t0 = solution.setup.setting["t0"]
    return _smallest_bounds(t0, solution.ts, _integrated(solution), growth)[1]


def _integrated(solution: Solution) -> tuple[Any, Any]:
    """Return the integrated defects of the state and of the law, and those of the completed steps."""
    assert solution.defect is not None and solution.completed_defect is not None
    return (solution.defect, solution.law_defect), solution.completed_defect


def _roundoff(
    solution: Solution, growth: _Growth, size: float, rate: float, eps: float
) -> tuple[float, float]:
    """Return bounds on the error due to roundoff: of x, of this `size`, in all steps, and of t, with
    |x'| of the size `rate`."""
    t0, t1 = solution.setup.setting["t0"], solution.setup.setting["t1"]
    factor = min(M * np.exp(min(max(c, 0.0) * (t1 - t0), 700.0)) for M, c in growth.rates)
    of_steps = ROUNDINGS * int(solution.stats["steps"]) * size
    return float(factor) * eps * of_steps, ROUNDINGS * eps * max(abs(t0), abs(t1)) * rate


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


def _check_knots(setup: Setup) -> None:
    """Raise if steps do not end at all knots of the data."""
    near = knot_near_end(setup)
    if np.isfinite(near):
        raise input_error(
            "dvax.solve(certified_tol)",
            f"data that may jump at t = {near:.17g}, some roundings of t from an end of the run",
            "no step ends there, so that the jump is in no bound",
            "Let the run start or end there, or measure time from a later origin",
        )


def knot_near_end(setup: Setup) -> float:
    """Return the first knot of the data so close to an end of the run that no step ends there; infinity
    without one."""
    times = setup.setting["t0"], setup.setting["t1"]
    numbers, signature = flatten((setup.problem,), (times, setup.x0, setup.args), None)
    return float(np.asarray(_knot_near_end(numbers, signature)))


@partial(jax.jit, static_argnums=1)
def _knot_near_end(numbers: list[Any], signature: Signature) -> jax.Array:
    (problem,), (times, x0, args) = signature.unflatten(numbers)
    t0, t1 = (jnp.asarray(t, _tree.dtype(x0)) for t in times)
    return problem.data_knots(t0, x0, _tree.as_arrays(args)).near_end(t0, t1)


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
            "constants of another problem or another args, or of other values that f, h or K reads "
            "from around it",
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
        "dvax.verify gives a one-sided rate where possible. dvax.bound_error(problem, sol), without "
        "constants, proves a bound along the trajectory, which is often much smaller",
    )


def _checked_growth(constants: Any, tol: Any, setup: Setup) -> _Growth:
    """Return the growth of disturbances.

    **Raises:** `dvax.InputError` if a constant is missing, or a value traced, or `tol` not positive.
    """
    if not _tree.is_concrete(tol, setup.x0, setup.setting, constants):
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
    is_module = isinstance(constants, eqx.Module)
    growth = _growth_of_module(constants) if is_module else _growth(constants)
    if not isinstance(growth, _Growth):
        raise input_error(
            "dvax.solve(constants)",
            "None" if constants is None else f"no {', '.join(growth)}",
            "a bound on the error rests on the constants of the problem",
            "Give dvax.Constants, or constants=dvax.verify(problem, x0).constants",
        )
    return growth
