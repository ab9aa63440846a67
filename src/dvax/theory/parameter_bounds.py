"""`dvax.parameter_bounds`: the constants of Section 6 for a box of parameters, from f and h."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._captured import current
from .._tree import Tree
from ..errors import InputError, input_error
from ..problem import Problem
from ..programs.slope import Slope, SlopeEnclosure, TooLarge, interval, is_slope
from ..sets import AbstractSet, Ball
from ..spaces import AbstractSpace
from ..vi import independent
from .blocks import block
from .constants import Constants
from .formulas import growth_integral
from .modulus_status import modulus_statuses
from .parameters import ParameterBounds, ParameterSet
from .projection_speed import slopes
from .region import Region, as_intervals
from .set_motion import set_motion, times
from .status import Status
from .system import System
from .verify import (
    constants_of,
    domain_of,
    intersect,
    response_box,
    search_box,
    state_for,
    time_span,
)
from .weights import roots


def parameter_bounds(
    problem: Problem,
    low: Tree,
    high: Tree,
    x0: Tree = None,
    t0: float = 0.0,
    t1: float = 1.0,
    *,
    x: Any = None,
    u: Any = None,
    start_radius: float | None = None,
) -> ParameterBounds:
    """Return the bounds of Section 6 for all parameters η between `low` and `high`.

    **Arguments:** `low`, `high`: two `args` of f and h, trees of numbers and arrays of one shape; D
    is the box between them, and distances of parameters are Euclidean over all entries. A, P and K
    must not depend on η (the paper's setting). `x0`, `t0`, `t1`, `x`, `u` as in `dvax.verify`;
    `start_radius`: R_Λ ≥ ‖ζ‖ for all initial states ζ, required if the moduli of f and h in η grow
    with x or u: these are then bounded over the a-priori ball (lem:parametrized_apriori).

    **Returns:** `dvax.ParameterBounds`, "proved" if all constants follow from the code.

    **Raises:** `dvax.InputError` if the two trees do not match, A, P or K depends on η, or a constant
    is unknown; the error names it.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, ell: ell - 0.5 * x - u,
    ...     h=lambda t, x, u, ell: 1.0 - 2.0 * x - u,
    ... )
    >>> bounds = dvax.parameter_bounds(problem, 2.9, 3.1, t1=2.0)
    >>> bounds.status, float(bounds.C_f0), float(bounds.modulus_f)
    ('proved', 3.1, 1.0)
    >>> round(float(bounds.sharp_state(0.0, 0.1)), 6)
    0.126424

    ```
    """
    low, high = _tree.as_floats(low, "low"), _tree.as_floats(high, "high")
    problem = current(problem)
    _check(problem, low, high, start_radius)
    middle = jtu.tree_map(lambda a, b: 0.5 * (a + b), low, high)
    t0, t1 = time_span(t0, t1, "dvax.parameter_bounds(t0, t1)")
    x0 = state_for(problem, x0, t0, middle, "dvax.parameter_bounds(x0)")
    problem.check(jnp.asarray(t0), x0, middle)
    _require_fixed_operators(problem, t0, middle)
    system = System(problem, x0, middle, varied=True)
    knots = np.asarray(problem.knots(t0, t1, x0, middle), float)
    K = set_motion(system, t0, t1, knots)
    states = as_intervals(x, x0, "dvax.parameter_bounds(x)")
    given_u = as_intervals(u, system.u0, "dvax.parameter_bounds(u)")
    responses = intersect(given_u, response_box(system, K))
    states = _including_origin("x", x, states)
    responses = _including_origin("u", u, responses)
    eta = jtu.tree_map(lambda a, b: interval(np.asarray(a), np.asarray(b)), low, high)
    region = Region(interval(t0, t1), states, responses, eta)
    box = Region(region.t, search_box(states, x0), search_box(responses, system.u0), eta)
    moduli = modulus_statuses(system, region, box, {})
    domain = domain_of(
        region.t, None if x is None else states, None if u is None else given_u, middle, problem
    )
    constants = constants_of(system, region, moduli, domain)
    if constants is None:
        raise _unknown("γ, L_F, α_h, β_h, α_f, β_f", moduli.by_name["gamma"].reason)

    values: dict[str, Any] = dict(
        T=t1 - t0,
        kappa_K=_kappa(system, t0, t1, knots),
        C_f0=_largest_at_zero(system, "f", region, knots),
        C_h0=_largest_at_zero(system, "h", region, knots),
    )
    eta_moduli: dict[str, Any] = _moduli_in_parameter(system, region, knots)
    # If the moduli in η are unbounded over the region, they are taken over the a-priori ball.
    needs_ball = start_radius is not None and not np.isfinite(list(eta_moduli.values())).all()
    if start_radius is not None and needs_ball:
        R = ParameterBounds(constants, **values, modulus_f=0.0, modulus_h=0.0).radius(start_radius)
        R_x = min(R, _state_bound(system, region, constants, knots, start_radius))
        ball = region._replace(
            x=_within_ball(region.x, system.state, R_x),
            u=_within_ball(region.u, system.control, R),
        )
        eta_moduli = _moduli_in_parameter(system, ball, knots)
    for name, value in {**values, **eta_moduli}.items():
        if not np.isfinite(value):
            raise _unknown(name, "the code of f, h or K does not bound it over this region")
    # In a region, it is an assumption of the caller that trajectories stay in it.
    status: Status = "proved" if x is None and u is None else "declared"
    domain_of_bounds = ParameterSet(low, high, t0, t1, start_radius if needs_ball else None)
    return ParameterBounds(
        constants, **values, **eta_moduli, status=status, domain=domain_of_bounds
    )


def _including_origin(name: str, bounds: Any, tree: Tree) -> Tree:
    """Return the region, extended to contain 0.

    The estimates of Section 6 start from f(t, 0, 0) and h(t, 0, 0), so the moduli must hold between 0
    and every point of the region.
    """

    def one(v: Slope) -> Slope:
        if bounds is not None and not ((v.low <= 0) & (v.high >= 0)).all():
            raise input_error(
                f"dvax.parameter_bounds({name})", "a region without 0",
                "the bounds start from f(t, 0, 0) and h(t, 0, 0), so the moduli must hold at 0",
                "Widen it so that it contains 0",
            )  # fmt: skip
        return interval(np.minimum(v.low, 0.0), np.maximum(v.high, 0.0))

    return jtu.tree_map(one, tree, is_leaf=is_slope)


def _state_bound(
    system: System, region: Region, c: Constants, knots: np.ndarray, start_radius: float
) -> float:
    """Return a bound on ‖x(t)‖ that follows from u ∈ P⁻¹K(t) alone, for bounded K.

    With C = sup ‖f(t, 0, u, η)‖ and a = ω + M α_f, ‖x(t)‖ ≤ M e^{at}‖ζ‖ + M C Φ_a(t) (Gronwall). The
    paper's a-priori estimate bounds u by x instead, and grows with L.
    """
    C = _largest_at_zero(system, "f", region, knots, region.u)
    M, a, T = float(c.M), float(c.omega + c.M * c.alpha_f), float(region.t.high - region.t.low)
    return M * start_radius * float(np.exp(max(a, 0.0) * T)) + M * C * float(growth_integral(a, T))


def _largest_at_zero(
    system: System, name: str, region: Region, knots: np.ndarray, responses: Tree = None
) -> float:
    """Return sup ‖f(t, 0, 0, η)‖, or sup ‖f(t, 0, u, η)‖ for u in `responses`."""

    def zeros_like(leaf: Any) -> Slope:
        return interval(np.zeros(leaf.shape), np.zeros(leaf.shape))

    x, u = jtu.tree_map(zeros_like, system.x0), jtu.tree_map(zeros_like, system.u0)
    u = u if responses is None else responses
    enclosure = SlopeEnclosure(getattr(system, name), system.likes, ())
    space, like = (system.state, system.x0) if name == "f" else (system.control, system.u0)
    largest = 0.0
    for piece in times(float(region.t.low), float(region.t.high), knots):
        out = enclosure(piece, x, u, region.eta).out
        largest = max(largest, _largest_norm(out, space, like))
    return largest


def _moduli_in_parameter(system: System, region: Region, knots: np.ndarray) -> dict[str, float]:
    return {
        f"modulus_{name}": _modulus_in_parameter(system, name, region, knots) for name in ("f", "h")
    }


def _modulus_in_parameter(system: System, name: str, region: Region, knots: np.ndarray) -> float:
    """Return sup ‖∂f/∂η‖ over the region."""
    space, like = (system.state, system.x0) if name == "f" else (system.control, system.u0)
    ones = [np.ones(leaf.size) for leaf in jtu.tree_leaves(system.eta)]
    enclosure = SlopeEnclosure(getattr(system, name), system.likes, (3,))
    largest = 0.0
    try:
        for piece in times(float(region.t.low), float(region.t.high), knots):
            out = enclosure(piece, region.x, region.u, region.eta).out
            largest = max(largest, block(out, 0, roots(space, like), ones).norm())
    except TooLarge:
        return np.inf
    return largest


def _kappa(system: System, t0: float, t1: float, knots: np.ndarray) -> float:
    """Return sup_t ‖proj_{K(t)} 0‖."""
    like, space = system.u0, system.control

    def set_at(t: Any) -> AbstractSet:
        return system.problem.set_at(t, system.args)

    time, pieces = (jnp.zeros(()),), times(t0, t1, knots)
    if isinstance(set_at(jnp.asarray(t0)), Ball) and not isinstance(like, tuple):
        # The projection divides by a distance that may be 0, but ‖proj 0‖ has a form without division.
        def distance(t: Any) -> jax.Array:
            ball = set_at(t)
            assert isinstance(ball, Ball)
            center = jnp.broadcast_to(ball.center, like.shape)
            return jnp.maximum(space.norm(center) - ball.radius, 0.0)

        enclosure = SlopeEnclosure(distance, time, ())
        return max(float(enclosure(piece).out.high) for piece in pieces)
    enclosure = SlopeEnclosure(lambda t: set_at(t).project(like, space), time, ())
    return max(_largest_norm(enclosure(piece).out, space, like) for piece in pieces)


def _largest_norm(out: Tree, space: AbstractSpace, like: Tree) -> float:
    """Return the largest norm of an element within these intervals."""
    total = 0.0
    for x, root in zip(slopes(out), roots(space, like), strict=True):
        largest = np.maximum(np.abs(x.low), np.abs(x.high)).ravel()
        total += float(np.sum((root * largest) ** 2))
    return float(np.sqrt(total))


def _within_ball(tree: Tree, space: AbstractSpace, R: Any) -> Tree:
    """Return the intersection of the intervals with a box around 𝔹_R(0)."""
    leaf_roots = iter(roots(space, space.zeros()))

    def one(v: Slope) -> Slope:
        radius = float(R) / next(leaf_roots).reshape(v.low.shape)
        return interval(np.maximum(v.low, -radius), np.minimum(v.high, radius))

    return jtu.tree_map(one, tree, is_leaf=is_slope)


def _check(problem: Problem, low: Tree, high: Tree, start_radius: Any) -> None:
    if start_radius is not None and not (np.ndim(start_radius) == 0 and 0 <= start_radius < np.inf):
        raise input_error(
            "dvax.parameter_bounds(start_radius)", _tree.short(start_radius),
            "it must be one number ≥ 0: a bound on ‖ζ‖", "Pass the largest norm of a state",
        )  # fmt: skip
    same = _tree.same_shape(low, high)
    ordered = same and all(
        bool(np.all(np.asarray(a) <= np.asarray(b)))
        for a, b in zip(jtu.tree_leaves(low), jtu.tree_leaves(high), strict=True)
    )
    if not ordered:
        raise input_error(
            "dvax.parameter_bounds(low, high)",
            f"{_tree.short(low)} and {_tree.short(high)}",
            "they must be the ends of a box of parameters: trees of one shape with low ≤ high",
            "Pass the smallest and the largest value of every parameter",
        )


def _require_fixed_operators(problem: Problem, t0: float, eta: Tree) -> None:
    """Raise an `InputError` if A, P or K depends on η."""

    def arrays(build: Callable[[Tree], Any], v: Tree) -> list[jax.Array]:
        return [leaf for leaf in jtu.tree_leaves(build(v)) if isinstance(leaf, jax.Array)]

    for name, build in (
        ("A", problem.generator),
        ("P", problem.operator),
        ("K", partial(problem.set_at, jnp.asarray(t0))),
    ):
        if not independent(partial(arrays, build), eta):
            raise input_error(
                f"dvax.Problem({name})",
                "a callable that uses args",
                "Section 6 of the paper keeps A, P and K fixed and lets f and h alone vary",
                "Keep it out of args here; derivatives of solutions have no such restriction",
            )


def _unknown(what: str, why: str) -> InputError:
    return input_error(
        "dvax.parameter_bounds",
        what,
        f"no bound is known for all of these parameters: {why}",
        "Pass a region in x or u, or a start_radius, or construct dvax.ParameterBounds",
    )
