"""Steps chosen for a bound on the error: `certified_tol` of `dvax.solve`.

With a defect of the norm δ all along, ‖x_h − x‖(t) ≤ M Φ_c(t) δ, c = ω + ML̃. So the tolerance of the
step control follows from the one that is asked for, up to a factor of a few that a run shows. The first
run is cheap, whatever is asked for. Its bound and its number of steps predict those of the next one, so
that a tolerance out of reach is refused after it. A bound is called certified where the defect is
enclosed over every step, and estimated where it is sampled.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..problem import Problem
from .growth import between, disturbance, gronwall
from .results import RESULTS
from .solution import Solution

_COARSE = 100.0
"""How much coarser the first run is."""

_CHEAP = 1e-5
"""Of the size of state and rate: the finest tolerance of the first run."""

_AIM = 0.7
"""The share of the tolerance that a run aims at, so that it need not be made again."""

_RUNS = 8
_LOOKS = 256
"""Times up to each of which it is looked whether a run stays in the region of its constants."""

_ROUNDINGS = 256.0
"""A rate f̃ is taken to be known to so many roundings of its size, and no defect to be smaller."""

_NEEDED = ("M", "growth_rate", "beta_f", "norm_P_inv", "gamma")


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
    """The solution whose bound is at most `tol` at every saved time;
    `run(ts, atol)` solves with this absolute tolerance and no relative one.

    **Raises:** `dvax.InputError` where rounding alone leaves a bound above `tol`.
    """
    _check(constants, tol, x0)
    _check_domain(constants, args, t0, t1)
    known, span = _growth(constants), t1 - t0
    grown = known.grown(span)
    size, largest = (float(v) for v in _sizes(problem, jnp.asarray(t0), x0, args))
    eps = float(jnp.finfo(jnp.result_type(*jtu.tree_leaves(x0))).eps)
    reachable = _ROUNDINGS * eps * largest * grown
    if not tol >= reachable:
        raise _hopeless(tol, reachable, known, span, "the roundoff of f alone grows to that")
    # The step control holds the root mean square of the defect below atol/span.
    atol = tol / grown * span / size
    scale = 1.0 + largest / size
    coarse = max(_COARSE * atol, _CHEAP * scale)
    atol = coarse if coarse < 0.1 * scale else max(atol, min(coarse, 0.1 * scale))
    before, bound, steps = np.inf, np.inf, 0
    for _ in range(_RUNS):
        solution = run(ts, atol)
        if solution.result != RESULTS.successful:
            return solution  # throw=False: the result says what failed, and nothing is certified
        bounds = _bounds(solution, known, t0)
        rounding = _rounding(solution, known, max(size, largest), t0, t1)
        if rounding > 0.5 * tol:
            many = f"roundoff of x in {int(solution.stats['steps'])} steps, and of t"
            raise _hopeless(tol, max(2.0 * rounding, reachable), known, span, many)
        last, bound = bound, float(np.max(np.asarray(bounds))) + rounding
        if bound <= tol:
            if of_region(constants):
                # The same steps, saved more often: the bounds in between are the sharper for it.
                looks = run(np.linspace(t0, t1, _LOOKS + 1)[1:], atol)
                left = _leaves(looks, constants, _all_along(looks, known, t0))
                if left is not None:
                    raise _outside(left)
            return _with_bound(solution, bound)
        taken = int(solution.stats["steps"])
        # Where other rules than the tolerance chose the steps, an equal bound says nothing. Elsewhere
        # it falls like a power of their number, by half the order at the very least.
        expected = last * (steps / taken) ** (0.5 * _order(solution))
        if np.isfinite(last) and bound > expected and taken > 1.5 * steps:
            why = f"{taken} steps gave {bound:.3g}, and {steps} gave {last:.3g}: roundoff"
            raise _hopeless(tol, min(bound, last), known, span, why)
        before, steps = atol, taken
        atol = min(0.5 * atol, _AIM * atol * tol / bound) if np.isfinite(bound) else 0.1 * atol
        _predict(solution, before / atol, tol, bound, max_steps, known, span)
    raise _hopeless(tol, bound, known, span, "every finer run fell short of its prediction")


def _predict(
    solution: Solution,
    finer: float,
    tol: float,
    bound: float,
    max_steps: int,
    known: "_Growth",
    span: float,
) -> None:
    """Refuse a run with a `finer` tolerance that would take more than `max_steps`: a defect of order p
    takes finer^{1/p} times the steps."""
    order = _order(solution)
    steps = int(solution.stats["steps"]) + int(solution.stats["rejected"])
    needed = steps * finer ** (1.0 / order)
    if needed > max_steps:
        least = bound * (steps / max_steps) ** order
        name = type(solution.setup.method).__name__
        why = f"it would take about {needed:.2g} steps of {name}, and max_steps is {max_steps}"
        raise _hopeless(tol, least, known, span, why)


def _order(solution: Solution) -> int:
    """p, where the defect is O(h^p)."""
    return getattr(solution.setup.method, "degree", 1) + 1


class _Growth(NamedTuple):
    """What a disturbance grows by, as numbers: properties of `Constants` cost a run of C1 to read."""

    rates: list[tuple[float, float]]
    beta_f: float
    norm_P_inv: float
    gamma: float

    def grown(self, span: float) -> float:
        """M Φ_c(T): what a defect of 1 may grow to."""
        return min(M * _convolved(rate, span) for M, rate in self.rates)


def _growth(constants: Any) -> _Growth:
    """(M, c) of the paper, (1, μ) one-sided, and that of an energy norm, as far as they are known."""
    one_sided, energy = (getattr(constants, name, None) for name in ("one_sided", "energy"))
    rates = [(float(constants.M), float(constants.growth_rate))]
    rates += [] if one_sided is None else [(1.0, float(one_sided))]
    rates += [] if energy is None else [(float(energy[0]), float(energy[1]))]
    return _Growth(rates, *(float(getattr(constants, name)) for name in _Growth._fields[1:]))


@eqx.filter_jit
def _sizes(problem: Problem, t0: jax.Array, x0: Tree, args: Any) -> tuple[jax.Array, jax.Array]:
    """‖1‖, and how large states and rates are, roughly: the response is left out, since to solve for
    it takes much longer to compile."""
    space = problem.spaces(x0)[0]
    rate = problem.f(t0, x0, problem.zero_control(x0), args)
    return jnp.sqrt(space.size()), jnp.maximum(space.norm(rate), space.norm(x0))


def _bounds(solution: Solution, known: _Growth, t0: float) -> Any:
    """The bound at every saved time."""
    assert solution.defect is not None and solution.completed_defect is not None
    integrated = (solution.defect, solution.law_defect), solution.completed_defect
    return _least(t0, solution.ts, integrated, known)[0]


def _rounding(solution: Solution, known: _Growth, rate: float, t0: float, t1: float) -> float:
    """What rounding may add to the error: of x, twice a step; of t, at which data is evaluated and x is
    known, x' being of the size `rate`."""
    space = solution.setup.problem.spaces(solution.setup.x0)[0]
    sizes = jax.vmap(space.norm)(solution.xs)
    size = float(np.maximum(np.max(np.asarray(sizes)), space.norm(solution.setup.x0)))
    eps = float(jnp.finfo(solution.setup.dtype).eps)
    steps = int(solution.stats["steps"])
    grows = min(M * np.exp(min(max(c, 0.0) * (t1 - t0), 700.0)) for M, c in known.rates)
    return float(grows) * eps * (2.0 * steps * size + 4.0 * max(abs(t0), abs(t1)) * rate)


def _all_along(solution: Solution, known: _Growth, t0: float) -> Any:
    """The bound at all times since the saved time before."""
    assert solution.defect is not None and solution.completed_defect is not None
    integrated = (solution.defect, solution.law_defect), solution.completed_defect
    return _least(t0, solution.ts, integrated, known)[1]


@jax.jit
def _least(t0: Any, ts: Any, integrated: tuple, known: _Growth) -> tuple[jax.Array, jax.Array]:
    """At the saved times, and at all times before each of them since the last."""
    acted, completed = (disturbance(known, *parts) for parts in integrated)
    at, on_the_way = [], []
    for M, rate in known.rates:
        at.append(gronwall(t0, ts, acted, completed, rate, M, 0.0))
        on_the_way.append(between(t0, ts, acted, completed, rate, M, 0.0, at[-1]))
    return jnp.min(jnp.stack(at), axis=0), jnp.min(jnp.stack(on_the_way), axis=0)


def of_region(constants: Any) -> bool:
    """Whether x or u must stay somewhere for these to hold."""
    domain = getattr(constants, "domain", None)
    return domain is not None and not domain.free


def _leaves(solution: Solution, constants: Any, error_bounds: Any) -> float | None:
    """The first saved time by which x or u, with its bound, has been where the constants do not
    hold."""
    domain, bounds = constants.domain, solution.bounds
    assert bounds is not None
    law_error = solution.law_residual / constants.gamma + solution.law_step
    of_u = constants.L * error_bounds + constants.norm_P_inv * law_error
    spaces = solution.setup.problem.spaces(solution.setup.x0)
    inside = np.asarray(domain.keeps(*bounds, error_bounds, of_u, spaces))
    return None if inside.all() else float(solution.ts[int(np.argmin(inside))])


def _outside(t: float) -> InputError:
    return InputError(
        InputProblem(
            "dvax.solve(constants)",
            f"constants of a region that the trajectory leaves by t = {t:.6g}",
            "outside it nothing bounds the error",
            "Verify the problem in a larger region: dvax.verify(problem, x0, x=(low, high))",
        )
    )


def _check_domain(constants: Any, args: Any, t0: float, t1: float) -> None:
    """A run is certified only by constants that hold for it."""
    domain = getattr(constants, "domain", None)
    wrong: list[InputProblem] = []
    if domain is not None and not domain.covers(t0, t1):
        wrong.append(
            InputProblem(
                "dvax.solve(constants)",
                f"constants verified on [{domain.t0:.17g}, {domain.t1:.17g}]",
                f"the run goes from {t0:.17g} to {t1:.17g}, and nobody proved them for other times",
                f"Verify for these: dvax.verify(problem, x0, {t0:g}, {t1:g}, args)",
            )
        )
    if domain is not None and not domain.is_of(args):
        wrong.append(
            InputProblem(
                "dvax.solve(constants)",
                "constants of another args",
                "f and h may be steeper at these parameters than at those",
                "Verify for these: dvax.verify(problem, x0, t0, t1, args)",
            )
        )
    if wrong:
        raise InputError(*wrong)


def _with_bound(solution: Solution, bound: float) -> Solution:
    solution.stats["certified_bound" if solution.enclosed else "estimated_bound"] = bound
    return solution


def _convolved(a: float, T: float) -> float:
    """Φ_a(T)."""
    return T if a == 0.0 else float(np.expm1(min(a * T, 700.0)) / a)


def _hopeless(tol: float, reachable: float, known: _Growth, span: float, why: str) -> InputError:
    M, rate = min(known.rates, key=lambda pair: pair[0] * _convolved(pair[1], span))
    return InputError(
        InputProblem(
            "dvax.solve(certified_tol)",
            f"{tol:g}",
            f"errors may grow like M e^{{ct}} with M = {M:g} and c = {rate:g}, a defect by "
            f"M Φ_c(T) = {M * _convolved(rate, span):.3g} over T = {span:g}, and the least "
            f"bound in reach here is about {reachable:.3g} ({why})",
            "Ask for more than that, solve for a shorter time, or find sharper constants: "
            "dvax.verify gives a one-sided rate where it can",
        )
    )


def _check(constants: Any, tol: Any, x0: Tree) -> None:
    missing = [name for name in _NEEDED if getattr(constants, name, None) is None]
    if constants is None or missing:
        raise InputError(
            InputProblem(
                "dvax.solve(constants)",
                "None" if constants is None else f"no {', '.join(missing)}",
                "a bound on the error rests on the constants of the problem",
                "Give dvax.Constants, or constants=dvax.verify(problem, x0).constants",
            )
        )
    if not _tree.is_concrete(tol, x0, constants):
        raise InputError(
            InputProblem(
                "dvax.solve(certified_tol)",
                "a traced value",
                "steps are chosen by what earlier runs showed, which a compiled program cannot do",
                "Call it outside jax.jit, and pass the atol of the solution found to solve inside",
            )
        )
    if not (_tree.is_number(tol) and np.isfinite(tol) and tol > 0):
        raise InputError(
            InputProblem(
                "dvax.solve(certified_tol)", str(tol), "it must be a positive number",
                "Give the largest error of x, in the norm of the state space, that is allowed",
            )
        )  # fmt: skip
