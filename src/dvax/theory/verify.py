"""`dvax.verify`: the status of every assumption of the paper, and the constants of a problem."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree, _user_code
from .._captured import Reads, current
from .._tree import Tree
from ..errors import InputError, InputProblem, input_error
from ..evolution.nonfinite import nonfinite_data
from ..problem import Problem
from ..programs.slope import Slope, SlopeEnclosure, TooLarge, interval, is_slope
from ..programs.structure import independent_of_first
from .assumptions import Assumption, assumptions
from .certificate import is_declared
from .constants import Constants
from .domain import Domain
from .energy import EnergyNorm, energy_norm
from .moduli import sharp_rate
from .modulus_status import ModulusStatuses, modulus_statuses
from .region import Region, as_intervals
from .set_motion import SetMotion, does_not_move, set_motion
from .status import Status, weakest
from .system import System

_SEARCH_RADIUS = 10.0
"""Radius of a search in an unbounded region, in units of 1 + |x0|."""


class Verification(NamedTuple):
    """The assumptions and constants of a problem with their statuses.

    - `assumptions`: the `Assumption`s; `check["ass:…"]` returns the one with this label;
    - `constants`: `dvax.Constants` with the status of each, or None if a modulus is missing or γ is not
      positive;
    - `route`: "variational inequality" or "projection", the route of the paper that gives the larger γ;
    - `no_energy`: why `energy=True` has found no norm in which trajectories contract, or empty.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> check = dvax.verify(problem, -1.0, 0.0, 2.0)
    >>> check.status, check.route, float(check.constants.gamma)
    ('proved', 'variational inequality', 2.0)
    >>> check["ass:f_lipschitz"].status
    'proved'

    ```
    """

    assumptions: tuple[Assumption, ...]
    constants: Constants | None
    route: str
    no_energy: str = ""

    def __repr__(self) -> str:
        parts = [f"Verification: {self.status}, route: {self.route}", self.table()]
        parts += [f"energy=True has found no norm: {self.no_energy}"] if self.no_energy else []
        return "\n".join([*parts, repr(self.constants)] if self.constants is not None else parts)

    def __getitem__(self, label: Any) -> Any:
        if not isinstance(label, str):
            return tuple(self)[label]
        for assumption in self.assumptions:
            if assumption.label == label:
                return assumption
        raise KeyError(label)

    @property
    def status(self) -> Status:
        """The weakest status among the assumptions that the theory needs."""
        statuses: list[Status] = [a.status for a in self.assumptions if a.is_required]
        return weakest(*statuses)

    def table(self) -> str:
        """Return the assumptions as lines of text."""
        width = max(len(a.label) for a in self.assumptions)
        return "\n".join(
            f"{a.label:<{width}}  {a.status:<9}  {a.statement}: {a.why}" for a in self.assumptions
        )


def verify(
    problem: Problem,
    x0: Tree = None,
    t0: float = 0.0,
    t1: float = 1.0,
    args: Any = None,
    *,
    x: Any = None,
    u: Any = None,
    declared: Mapping[str, float] | Constants | None = None,
    energy: bool = False,
) -> Verification:
    """Check every assumption of the paper for a problem on [t0, t1], and compute its constants.

    Each assumption is

    - *proved* from the structure of A, P and K and the code of f and h. Constant derivatives are
      bounded
      by their singular values and eigenvalues in the norms of the spaces, other derivatives by
      interval arithmetic over the region, laws F = aG by their factors, and affine data too large
      for a matrix by Lanczos' method (which fails with a probability of at most 10⁻¹²);
    - *declared*, if `declared` gives a modulus that is not proved, and no search contradicts it;
    - *estimated* from points of the region otherwise: a bound from the wrong side;
    - *refuted*, with the counterexample.

    **Arguments:** `x0`: a state (only its shape matters; omit it for a scalar problem); `x`, `u`:
    the region for the statements as (low, high), numbers or elements. By default x is unbounded,
    and Pu lies in a box around K(t), if one is known. Constants of a region hold for trajectories
    that stay in it. A bound of u that follows from K restricts nothing, so that responses may be at
    it. (If the region of u excludes a part of P⁻¹K(t), the law may have other solutions there.)
    `declared`: moduli by name, or `dvax.Constants`. `energy`: search for a norm in which trajectories
    contract, for affine data of up to 40 unknowns (needs `dvax[energy]`); `no_energy` of the result
    says why there is none.

    If f, h and K do not depend on t, the constants hold at all times, whatever t0 and t1 are.

    The problem is not solved, and an assumption that fails is not an error: the result reports it.

    **Returns:** a `Verification`. **Raises:** `dvax.InputError` if the data do not fit together, or a
    region is invalid.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> check = dvax.verify(problem)
    >>> check.status, float(check.constants.gamma), float(check.constants.L)
    ('proved', 2.0, 1.0)
    >>> round(float(check.constants.sharp_decay_rate), 12)     # the paper's own is −0.5
    0.5

    ```
    """
    problem = current(problem)
    t0, t1 = time_span(t0, t1, "dvax.verify(t0, t1)")
    _user_code.check_args(args, "dvax.verify")
    x0 = state_for(problem, x0, t0, args, "dvax.verify(x0)")
    nonfinite_data(problem, args, "dvax.verify").raise_any()
    problem.check(jnp.asarray(t0), x0, args)
    system = System(problem, x0, args)
    knots = np.asarray(problem.knots(t0, t1, x0, args), float)
    K = set_motion(system, t0, t1, knots)
    states = as_intervals(x, x0, "dvax.verify(x)")
    given_u = as_intervals(u, system.u0, "dvax.verify(u)")
    possible = response_box(system, K)
    responses = intersect(given_u, possible)
    time = interval(t0, t1)
    region = Region(time, states, responses)
    box = None
    if K.empty_at is None:  # else a search would project onto an empty set
        box = Region(time, search_box(states, x0), search_box(responses, system.u0))
    moduli = modulus_statuses(system, region, box, _declared(declared))
    statuses = tuple(assumptions(system, region, K, knots, moduli))
    # P⁻¹K(t) contains every response, so the domain needs only the bounds that exclude a part of it:
    # a response at a limit of K would be on the boundary of any other region.
    limits_u = None if u is None else without_limits(given_u, possible)
    if knots.size == 0 and _is_autonomous(system, t0):
        time = interval(-np.inf, np.inf)
    domain = domain_of(time, None if x is None else states, limits_u, args, problem)
    found = _energy(system, region, moduli) if energy else ""
    if isinstance(found, str):
        constants = constants_of(system, region, moduli, domain)
        return Verification(statuses, constants, _route(system, moduli), found)
    constants = constants_of(system, region, moduli, domain, (found.M, found.rate))
    return Verification(statuses, constants, _route(system, moduli))


def _is_autonomous(system: System, t: float) -> bool:
    """Return whether the code of f, h and K proves that none of them depends on t."""
    problem, args = system.problem, system.args

    def data(t: Any, x: Any, u: Any) -> Any:
        return problem.f(t, x, u, args), problem.h(t, x, u, args)

    return does_not_move(problem, t, args) and independent_of_first(
        data, jnp.asarray(t), system.x0, system.u0
    )


def _route(system: System, moduli: ModulusStatuses) -> str:
    """Return which of the paper's two sufficient conditions gives the larger γ."""
    gamma_by_smallness = float(system.spectrum.m_P) - moduli.by_name["beta_h"].value * float(
        system.spectrum.norm_P_inv
    )
    return (
        "projection"
        if moduli.by_name["gamma"].value <= gamma_by_smallness
        else "variational inequality"
    )


def constants_of(
    system: System, region: Region, moduli: ModulusStatuses, domain: Domain,
    energy: tuple[float, float] | None = None,
) -> Constants | None:  # fmt: skip
    """Return the constants, or None unless every modulus is finite and γ > 0."""
    if not _give_constants(moduli):
        return None
    values: dict[str, Any] = {name: entry.value for name, entry in moduli.by_name.items()}
    statuses: dict[str, Status] = {name: entry.status for name, entry in moduli.by_name.items()}
    declared = is_declared(system.problem.generator(system.args))
    A_status: Status = "declared" if declared else "proved"
    P_status: Status = "declared" if system.spectrum.declared else "proved"
    statuses |= {"M": A_status, "omega": A_status, "m_P": P_status, "norm_P_inv": P_status}
    mu = _one_sided_rate(system, region, moduli)
    if mu is not None:
        statuses["one_sided"] = weakest(A_status, P_status)
    if energy is not None:
        statuses["energy"] = "proved"
    return Constants(
        **values, M=system.growth.M, omega=system.growth.omega, m_P=system.spectrum.m_P,
        norm_P_inv=system.spectrum.norm_P_inv, one_sided=mu, status=statuses,
        domain=domain, energy=energy,
    )  # fmt: skip


def _give_constants(moduli: ModulusStatuses) -> bool:
    values = {name: entry.value for name, entry in moduli.by_name.items()}
    finite = all(np.isfinite(value) for value in values.values())
    return moduli.counterexample is None and values["gamma"] > 0 and finite


def _energy(system: System, region: Region, moduli: ModulusStatuses) -> EnergyNorm | str:
    """Return the norm, or why there is none."""
    if not _give_constants(moduli):
        return "the problem has no constants, since a modulus is missing or γ is not positive"
    t0, t1 = float(region.t.low), float(region.t.high)
    return energy_norm(system, system.at(region), _pointwise(system, t0), t1 - t0)


def domain_of(time: Slope, x: Tree | None, u: Tree | None, args: Any, problem: Problem) -> Domain:
    """Return the domain of constants of a problem for these times, bounds of x and u, and args."""

    def bounds(tree: Tree | None) -> tuple[Tree, Tree] | None:
        if tree is None:
            return None
        low = jtu.tree_map(lambda v: v.low, tree, is_leaf=is_slope)
        return low, jtu.tree_map(lambda v: v.high, tree, is_leaf=is_slope)

    return Domain(float(time.low), float(time.high), bounds(x), bounds(u), args, Reads(problem))


def _one_sided_rate(system: System, region: Region, moduli: ModulusStatuses) -> float | None:
    """Return the one-sided rate μ, with the law G for a law F = aG, or None if it is unknown."""
    gamma, alpha_h = moduli.by_name["gamma"].value, moduli.by_name["alpha_h"].value
    proved = moduli.by_name["gamma"].status == moduli.by_name["alpha_h"].status == "proved"
    if moduli.unweighted is not None:
        system, proved_moduli = moduli.unweighted.system, moduli.unweighted.moduli
        gamma, alpha_h, proved = proved_moduli.gamma.value, proved_moduli.alpha_h.value, True
    if not proved or not np.isfinite(alpha_h):
        return None
    mu = sharp_rate(system, region, gamma, alpha_h, _pointwise(system, float(region.t.low)))
    return mu if np.isfinite(mu) else None


def _pointwise(system: System, t: float) -> bool:
    """Return whether the law acts pointwise: K is a box, and P is diagonal."""
    block = system.P_inv
    if block is None or not (len(block.center) > 1 or block.center.shape == (1, 1, 1)):
        return False
    return system.problem.set_at(jnp.asarray(t), system.args).intervals(system.u0) is not None


def response_box(system: System, K: SetMotion) -> Tree:
    """Return a box around P⁻¹K(t)."""
    y = jtu.tree_map(interval, K.low, K.high)
    P = system.problem.operator(system.args)
    try:
        return SlopeEnclosure(P.inverse, (system.u0,), ())(y).out
    except TooLarge:
        return as_intervals(None, system.u0, "dvax.verify(u)")


def intersect(region: Tree, possible: Tree) -> Tree:
    """Return the intersection of a region of u with the box around all responses.

    **Raises:** `dvax.InputError` if it is empty.
    """

    def one(a: Slope, b: Slope) -> Slope:
        low, high = np.maximum(a.low, b.low), np.minimum(a.high, b.high)
        if not (low <= high).all():
            k = np.unravel_index(np.argmax(low - high), low.shape)
            raise input_error(
                "dvax.verify(u)",
                f"[{a.low[k]:.6g}, {a.high[k]:.6g}] in entry {tuple(map(int, k))}",
                f"responses lie in P⁻¹K(t), within [{b.low[k]:.6g}, {b.high[k]:.6g}] there, so "
                "the region contains none of them",
                "Omit u, or widen it",
            )
        return interval(low, high)

    return jtu.tree_map(one, region, possible, is_leaf=is_slope)


def without_limits(region: Tree, possible: Tree) -> Tree | None:
    """Return a region of u without the bounds that the box around all responses implies.

    None stands for a region without bounds.
    """

    def one(a: Slope, b: Slope) -> Slope:
        low, high = (
            np.where(a.low <= b.low, -np.inf, a.low),
            np.where(a.high >= b.high, np.inf, a.high),
        )
        return interval(low, high)

    left = jtu.tree_map(one, region, possible, is_leaf=is_slope)
    entries = jtu.tree_leaves(left, is_leaf=is_slope)
    unbounded = all(bool(np.isinf(v.low).all() and np.isinf(v.high).all()) for v in entries)
    return None if unbounded else left


def search_box(tree: Tree, middle: Tree) -> Tree:
    """Return the bounded box for a search in the region `tree`."""

    def one(v: Slope, m: Any) -> Slope:
        m = np.asarray(m, float)
        radius = _SEARCH_RADIUS * (1.0 + np.max(np.abs(m), initial=0.0))
        low = np.where(np.isfinite(v.low), v.low, np.minimum(m, v.high) - radius)
        high = np.where(np.isfinite(v.high), v.high, np.maximum(m, low) + radius)
        return interval(low, high)

    return jtu.tree_map(one, tree, middle, is_leaf=is_slope)


def time_span(t0: Any, t1: Any, name: str) -> tuple[float, float]:
    """Return t0 and t1 as floats after checking that t0 < t1."""
    try:
        begin, end = float(t0), float(t1)
    except (TypeError, ValueError):
        raise input_error(
            name, f"{t0!r}, {t1!r}"[:120], "they must be two real numbers with values",
            "Give the times of the run",
        ) from None  # fmt: skip
    if not (np.isfinite([begin, end]).all() and begin < end):
        raise input_error(
            name, f"[{begin:.17g}, {end:.17g}]",
            "it must be an interval of time with t0 < t1", "Give the times of the run",
        )  # fmt: skip
    return begin, end


def state_for(problem: Problem, x0: Tree, t0: float, args: Any, name: str) -> Tree:
    """Return a state of this problem: the one given, or zero if its shape is known."""
    if not isinstance(problem, Problem):
        raise input_error(
            name.split("(")[0] + "(problem)", type(problem).__name__, "it must be a dvax.Problem",
            "Build one from A, P, K, f and h, or pass model.problem",
        )  # fmt: skip
    if x0 is not None:
        state = _tree.as_float(x0, "x0")
        _tree.require(
            lambda: all(np.isfinite(leaf).all() for leaf in jtu.tree_leaves(state)),
            name, state, "every entry must be finite", "Correct the entry",
        )  # fmt: skip
        return state
    if problem.state_space is not None:
        return problem.state_space.zeros()
    zero = jnp.zeros(())
    try:
        problem.check(jnp.asarray(t0), zero, args)
    except InputError as error:
        raise InputError(
            InputProblem(
                name,
                "None",
                "the problem names no state space, and does not take a single number as its state",
                "Pass any state as x0",
            ),
            error.problems[0],
        ) from error
    return zero


def _declared(declared: Mapping[str, float] | Constants | None) -> dict[str, float]:
    """Return the declared moduli by name, after checking names and values."""
    if declared is None:
        return {}
    names = ("gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f")
    if isinstance(declared, Constants):
        return {name: float(getattr(declared, name)) for name in names}
    invalid = [name for name in declared if name not in names]
    if not isinstance(declared, Mapping):
        invalid = [type(declared).__name__]
    if invalid:
        raise input_error(
            "dvax.verify(declared)",
            f"{invalid[0]!r}",
            f"it must map names among {', '.join(names)} to numbers",
            "Correct the name; the others follow from A and P",
        )
    values: dict[str, float] = {}
    for name, value in declared.items():
        try:
            values[name] = float(value)
        except (TypeError, ValueError):
            values[name] = np.nan
        is_possible = values[name] > 0 if name in ("gamma", "L_F") else values[name] >= 0
        if not (np.isfinite(values[name]) and is_possible):
            raise input_error(
                f"dvax.verify(declared[{name!r}])", repr(value)[:120],
                "a modulus must be a finite number, gamma and L_F positive, the others ≥ 0",
                "Correct it, or omit it",
            )  # fmt: skip
    return values
