"""`dvax.verify`: every assumption of the paper, with what is known about it and how."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree, _user_code
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..evolution.nonfinite import refuse_nonfinite_data
from ..problem import Problem
from ..programs.slope import Slope, SlopeEnclosure, TooLarge, interval, is_slope
from .assumption import Assumption
from .certificate import is_declared
from .constants import Constants
from .domain import Domain
from .energy import energy_norm
from .known import Knowledge, knowledge
from .moduli import sharp_rate
from .motion import Motion, motion
from .region import Region, between
from .rows import rows
from .status import Status, weakest
from .system import System

_REACH = 10.0
"""A search looks as far as ten times 1 + |x0| where a region has no bounds."""


class Verification(NamedTuple):
    """What is known about a problem.

    - `assumptions`: one line each, found by its label with `check["ass:…"]`;
    - `constants`: `dvax.Constants` with the status of each, or None where a modulus is missing or γ is
      not positive;
    - `route`: "variational inequality" or "projection", which of the paper's two routes gives the
      better γ.
    """

    assumptions: tuple[Assumption, ...]
    constants: Constants | None
    route: str

    def __getitem__(self, label: Any) -> Any:
        if not isinstance(label, str):
            return tuple(self)[label]
        for row in self.assumptions:
            if row.label == label:
                return row
        raise KeyError(label)

    @property
    def status(self) -> Status:
        """The weakest status among the assumptions that the theory needs."""
        words: list[Status] = [row.status for row in self.assumptions if row.needed]
        return weakest(*words)

    def table(self) -> str:
        """The assumptions as lines of text."""
        width = max(len(row.label) for row in self.assumptions)
        return "\n".join(
            f"{row.label:<{width}}  {row.status:<9}  {row.statement}: {row.why}"
            for row in self.assumptions
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

    - *proved* from the structure of A, P and K and the code of f and h: derivatives that do not change
      by their singular values and eigenvalues in the norms of the spaces, others by interval
      arithmetic over the region, laws F = aG by their factors, affine data too large for a matrix by
      Lanczos' method (which fails with a probability of at most 10⁻¹²);
    - *declared*, where `declared` gives a modulus that is not proved, and no search contradicts it;
    - *estimated* from points of the region where nothing better is known: a bound from the wrong side;
    - *refuted*, with the counterexample.

    **Arguments:** `x0`: a state (its shape is what matters; 0 for a scalar problem); `x`, `u`: the
    region as (low, high), numbers or elements, where the statements are to hold: everywhere by
    default, with Pu in a box around K(t) where one is known. Constants that hold in a region only are
    good for trajectories that stay in it (and where that of u leaves out a part of P⁻¹K(t), the law may
    have other solutions there). `declared`: moduli by name, or `dvax.Constants`. `energy`:
    look for a norm in which trajectories approach, for affine data of up to 40 unknowns (needs
    `dvax[energy]`).

    Nothing is solved and nothing is refused: what is wrong is said in the answer.

    **Returns:** a `Verification`. **Raises:** `dvax.InputError` where the data do not fit together, or
    a region is not one.

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
    t0, t1 = span(t0, t1, "dvax.verify(t0, t1)")
    _user_code.check_args(args, "dvax.verify")
    x0 = state_like(problem, x0, t0, args, "dvax.verify(x0)")
    refuse_nonfinite_data(problem, args, "dvax.verify")
    problem.check(jnp.asarray(t0), x0, args)
    system = System(problem, x0, args)
    knots = np.asarray(problem.knots(t0, t1, x0, args), float)
    K = motion(system, t0, t1, knots)
    states = between(x, x0, "dvax.verify(x)")
    asked = between(u, system.u0, "dvax.verify(u)")
    responses = met(asked, around_responses(system, K))
    time = interval(t0, t1)
    region = Region(time, states, responses)
    box = Region(time, bounded(states, x0), bounded(responses, system.u0))
    known = knowledge(system, region, box, _declared(declared))
    assumptions = tuple(rows(system, region, K, knots, known))
    # u is around K(t) whatever it does: what it must be watched for is what was asked for.
    domain = domain_of(time, None if x is None else states, None if u is None else asked, args)
    constants = constants_of(system, region, known, domain, energy)
    return Verification(assumptions, constants, _route(system, known))


def _route(system: System, known: Knowledge) -> str:
    """Which of the paper's two sufficient conditions gives the larger γ."""
    small = float(system.spectrum.m_P) - known.of["beta_h"].value * float(
        system.spectrum.norm_P_inv
    )
    return "projection" if known.of["gamma"].value <= small else "variational inequality"


def constants_of(
    system: System, region: Region, known: Knowledge, domain: Domain, energy: bool = False
) -> Constants | None:
    """The constants, where every modulus is a number and γ > 0."""
    values: dict[str, Any] = {name: entry.value for name, entry in known.of.items()}
    if known.pair is not None or not values["gamma"] > 0:
        return None
    if not all(np.isfinite(value) for value in values.values()):
        return None
    statuses: dict[str, Status] = {name: entry.status for name, entry in known.of.items()}
    by_hand = is_declared(system.problem.generator(system.args))
    of_A: Status = "declared" if by_hand else "proved"
    of_P: Status = "declared" if system.spectrum.declared else "proved"
    statuses |= {"M": of_A, "omega": of_A, "m_P": of_P, "norm_P_inv": of_P}
    mu = _sharp(system, region, known)
    if mu is not None:
        statuses["one_sided"] = weakest(of_A, of_P)
    contraction = _energy(system, region) if energy else None
    if contraction is not None:
        statuses["energy"] = "proved"
    return Constants(
        **values, M=system.growth.M, omega=system.growth.omega, m_P=system.spectrum.m_P,
        norm_P_inv=system.spectrum.norm_P_inv, one_sided=mu, status=statuses,
        domain=domain, energy=contraction,
    )  # fmt: skip


def _energy(system: System, region: Region) -> tuple[float, float] | None:
    t0, t1 = float(region.t.low), float(region.t.high)
    found = energy_norm(system, system.at(region), _pointwise(system, t0), t1 - t0)
    return None if found is None else (found.M, found.rate)


def domain_of(time: Slope, x: Tree | None, u: Tree | None, args: Any) -> Domain:
    """Where the constants hold: between the bounds of x and u that were asked for."""
    end = lambda tree, i: jtu.tree_map(lambda v: v[i], tree, is_leaf=is_slope)  # noqa: E731
    both = lambda tree: None if tree is None else (end(tree, 0), end(tree, 1))  # noqa: E731
    return Domain(float(time.low), float(time.high), both(x), both(u), args)


def _sharp(system: System, region: Region, known: Knowledge) -> float | None:
    """The one-sided rate, of the law without its weight where it has one; None where not known."""
    gamma, alpha_h = known.of["gamma"].value, known.of["alpha_h"].value
    proved = known.of["gamma"].status == known.of["alpha_h"].status == "proved"
    if known.divided is not None:
        system, found = known.divided.system, known.divided.moduli
        gamma, alpha_h, proved = found.gamma.value, found.alpha_h.value, True
    if not proved or not np.isfinite(alpha_h):
        return None
    mu = sharp_rate(system, region, gamma, alpha_h, _pointwise(system, float(region.t.low)))
    return mu if np.isfinite(mu) else None


def _pointwise(system: System, t: float) -> bool:
    """Whether the law is one of every point by itself: K a box, and P diagonal."""
    block = system.P_inv
    if block is None or not (len(block.center) > 1 or block.center.shape == (1, 1, 1)):
        return False
    return system.problem.set_at(jnp.asarray(t), system.args).intervals(system.u0) is not None


def around_responses(system: System, K: Motion) -> Tree:
    """A box around P⁻¹K(t)."""
    y = jtu.tree_map(interval, K.low, K.high)
    P = system.problem.operator(system.args)
    try:
        return SlopeEnclosure(P.inverse, (system.u0,), ())(y).out
    except TooLarge:
        return between(None, system.u0, "dvax.verify(u)")


def met(asked: Tree, possible: Tree) -> Tree:
    """Where the region that was asked for meets the one that responses lie in."""

    def met(a: Slope, b: Slope) -> Slope:
        low, high = np.maximum(a.low, b.low), np.minimum(a.high, b.high)
        if not (low <= high).all():
            k = np.unravel_index(np.argmax(low - high), low.shape)
            raise InputError(
                InputProblem(
                    "dvax.verify(u)",
                    f"[{a.low[k]:.6g}, {a.high[k]:.6g}] in entry {tuple(map(int, k))}",
                    f"responses lie in P⁻¹K(t), within [{b.low[k]:.6g}, {b.high[k]:.6g}] there, so "
                    "that nothing would be said of any of them",
                    "Leave u out, or widen it",
                )
            )
        return interval(low, high)

    return jtu.tree_map(met, asked, possible, is_leaf=is_slope)


def bounded(tree: Tree, middle: Tree) -> Tree:
    """The bounded box that a search stays in."""

    def one(v: Slope, m: Any) -> Slope:
        m = np.asarray(m, float)
        reach = _REACH * (1.0 + np.max(np.abs(m), initial=0.0))
        low = np.where(np.isfinite(v.low), v.low, np.minimum(m, v.high) - reach)
        high = np.where(np.isfinite(v.high), v.high, np.maximum(m, low) + reach)
        return interval(low, high)

    return jtu.tree_map(one, tree, middle, is_leaf=is_slope)


def span(t0: Any, t1: Any, name: str) -> tuple[float, float]:
    """Two times that make an interval."""
    try:
        begin, end = float(t0), float(t1)
    except (TypeError, ValueError):
        raise InputError(
            InputProblem(
                name, f"{t0!r}, {t1!r}"[:120], "they must be two real numbers with values",
                "Give the times of the run",
            )
        ) from None  # fmt: skip
    if not (np.isfinite([begin, end]).all() and begin < end):
        raise InputError(
            InputProblem(
                name, f"[{begin:.17g}, {end:.17g}]",
                "it must be an interval of time with t0 < t1", "Give the times of the run",
            )
        )  # fmt: skip
    return begin, end


def state_like(problem: Problem, x0: Tree, t0: float, args: Any, name: str) -> Tree:
    """A state of this problem: the one given, or zero where its shape is known."""
    if not isinstance(problem, Problem):
        raise InputError(
            InputProblem(
                name.split("(")[0] + "(problem)", type(problem).__name__, "it must be a dvax.Problem",
                "Build one from A, P, K, f and h, or pass model.problem",
            )
        )  # fmt: skip
    if x0 is not None:
        state = _tree.as_float(x0, "x0")
        _tree.require(
            lambda: all(np.isfinite(leaf).all() for leaf in jtu.tree_leaves(state)),
            name, state, "every entry must be finite", "Correct the state there",
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
                "the problem does not fit a scalar state, and names no state space, so that the shape "
                "of its states is not known",
                "Give any state: dvax.verify(problem, x0)",
            ),
            *error.problems,
        ) from error
    return zero


def _declared(given: Mapping[str, float] | Constants | None) -> dict[str, float]:
    if given is None:
        return {}
    names = ("gamma", "L_F", "alpha_h", "beta_h", "alpha_f", "beta_f")
    if isinstance(given, Constants):
        return {name: float(getattr(given, name)) for name in names}
    wrong = [name for name in given if name not in names]
    if not isinstance(given, Mapping):
        wrong = [type(given).__name__]
    if wrong:
        raise InputError(
            InputProblem(
                "dvax.verify(declared)",
                f"{wrong[0]!r}",
                f"it must map names among {', '.join(names)} to numbers",
                "Correct the name; the others follow from A and P",
            )
        )
    values: dict[str, float] = {}
    for name, value in given.items():
        try:
            values[name] = float(value)
        except (TypeError, ValueError):
            values[name] = np.nan
        if not np.isfinite(values[name]):
            raise InputError(
                InputProblem(
                    f"dvax.verify(declared[{name!r}])", repr(value)[:120],
                    "a modulus is a finite number", "Correct it, or leave it out",
                )
            )  # fmt: skip
    return values
