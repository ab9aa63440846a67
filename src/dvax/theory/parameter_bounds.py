"""`dvax.parameter_bounds`: the constants of Section 6 for a box of parameters, read off f and h."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..problem import Problem
from ..programs.slope import Slope, SlopeEnclosure, TooLarge, interval, is_slope
from ..sets import Ball
from ..spaces import AbstractSpace
from ..vi import independent
from .blocks import block
from .constants import Constants
from .formulas import convolved
from .known import knowledge
from .motion import motion, slopes, times
from .parameters import ParameterBounds, ParameterSet
from .region import Region, between
from .status import Status
from .system import System
from .verify import around_responses, bounded, constants_of, domain_of, met, span, state_like
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
    """The bounds of Section 6 for all parameters η between `low` and `high`.

    **Arguments:** `low`, `high`: two `args` of f and h, trees of numbers and arrays of one shape; D is
    the box between them, and distances of parameters are Euclidean over all their entries. A, P and K
    must not depend on η (the paper's setting). `x0`, `t0`, `t1`, `x`, `u` as in `dvax.verify`;
    `start_radius`: R_Λ ≥ ‖ζ‖ of the initial states meant, needed where the moduli of f and h in η
    grow with x or u: they are then taken over the a-priori ball (lem:parametrized_apriori).

    **Returns:** `dvax.ParameterBounds`, "proved" where everything is read off the code.

    **Raises:** `dvax.InputError` where the two trees do not fit, A, P or K depends on η, or a constant
    is not known: then it says which.

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
    _check(problem, low, high, start_radius)
    middle = jtu.tree_map(lambda a, b: 0.5 * (a + b), low, high)
    t0, t1 = span(t0, t1, "dvax.parameter_bounds(t0, t1)")
    x0 = state_like(problem, x0, t0, middle, "dvax.parameter_bounds(x0)")
    problem.check(jnp.asarray(t0), x0, middle)
    _fixed(problem, t0, middle)
    system = System(problem, x0, middle, varied=True)
    knots = np.asarray(problem.knots(t0, t1, x0, middle), float)
    K = motion(system, t0, t1, knots)
    states = between(x, x0, "dvax.parameter_bounds(x)")
    asked = between(u, system.u0, "dvax.parameter_bounds(u)")
    responses = met(asked, around_responses(system, K))
    states = _from_the_origin("x", x, states)
    responses = _from_the_origin("u", u, responses)
    eta = jtu.tree_map(lambda a, b: interval(np.asarray(a), np.asarray(b)), low, high)
    region = Region(interval(t0, t1), states, responses, eta)
    box = Region(region.t, bounded(states, x0), bounded(responses, system.u0), eta)
    known = knowledge(system, region, box, {})
    domain = domain_of(
        region.t, None if x is None else states, None if u is None else asked, middle
    )
    constants = constants_of(system, region, known, domain)
    if constants is None:
        raise _unknown("γ, L_F, α_h, β_h, α_f, β_f", known.of["gamma"].how)

    # Over the region, or where that leaves no bound over the ball of the a-priori estimate.
    span_of: dict[str, Any] = dict(T=t1 - t0, kappa_K=_kappa(system, t0, t1, knots))
    sizes: dict[str, Any] = dict(
        C_f0=_size(system, "f", region, knots), C_h0=_size(system, "h", region, knots)
    )
    of = lambda region: {  # noqa: E731
        f"modulus_{name}": _by_parameter(system, name, region, knots) for name in ("f", "h")
    }
    moduli, used = of(region), False
    if not all(np.isfinite(v) for v in moduli.values()) and start_radius is not None:
        used = True
        without = ParameterBounds(constants, **span_of, **sizes, modulus_f=0.0, modulus_h=0.0)
        R = without.radius(start_radius)
        near = region._replace(
            x=_ball(
                region.x,
                system.state,
                min(R, _reach(system, region, constants, knots, start_radius)),
            ),
            u=_ball(region.u, system.control, R),
        )
        moduli = of(near)
    for name, value in {**span_of, **sizes, **moduli}.items():
        if not np.isfinite(value):
            raise _unknown(name, "the code of f, h or K does not bound it over this region")
    # In a region it is for the caller to say that trajectories stay in it.
    status: Status = "proved" if x is None and u is None else "declared"
    meant = ParameterSet(low, high, t0, t1, start_radius if used else None)
    return ParameterBounds(constants, status=status, **span_of, **sizes, **moduli, domain=meant)


def _from_the_origin(name: str, asked: Any, tree: Tree) -> Tree:
    """The region with 0 in it: the estimates of Section 6 go out from f(t, 0, 0) and h(t, 0, 0), so
    that moduli have to hold on the way from there."""

    def one(v: Slope) -> Slope:
        if asked is not None and not ((v.low <= 0) & (v.high >= 0)).all():
            raise InputError(
                InputProblem(
                    f"dvax.parameter_bounds({name})", "a region without 0",
                    "radii are counted from f(t, 0, 0) and h(t, 0, 0), on the way from where moduli "
                    "of the region need not hold",
                    "Widen it to one that contains 0",
                )
            )  # fmt: skip
        return interval(np.minimum(v.low, 0.0), np.maximum(v.high, 0.0))

    return jtu.tree_map(one, tree, is_leaf=is_slope)


def _reach(
    system: System, region: Region, c: Constants, knots: np.ndarray, start_radius: float
) -> float:
    """A bound on ‖x(t)‖ from u ∈ P⁻¹K(t) alone, where K is bounded: with C = sup ‖f(t, 0, u, η)‖,
    ‖x(t)‖ ≤ M e^{at}‖ζ‖ + M C Φ_a(t), a = ω + M α_f (Gronwall). The a-priori estimate of the paper
    bounds u by x, and grows with L."""
    C = _size(system, "f", region, knots, region.u)
    M, a, T = float(c.M), float(c.omega + c.M * c.alpha_f), float(region.t.high - region.t.low)
    return M * start_radius * float(np.exp(max(a, 0.0) * T)) + M * C * float(convolved(a, T))


def _size(
    system: System, name: str, region: Region, knots: np.ndarray, responses: Tree = None
) -> float:
    """sup ‖f(t, 0, 0, η)‖, or of f(t, 0, u, η)."""
    nil = lambda leaf: interval(np.zeros(leaf.shape), np.zeros(leaf.shape))  # noqa: E731
    zero, still = jtu.tree_map(nil, system.x0), jtu.tree_map(nil, system.u0)
    still = still if responses is None else responses
    enclosure = SlopeEnclosure(getattr(system, name), system.likes, ())
    space, like = (system.state, system.x0) if name == "f" else (system.control, system.u0)
    worst = 0.0
    for piece in times(float(region.t.low), float(region.t.high), knots):
        out = enclosure(piece, zero, still, region.eta).out
        worst = max(worst, _norm(out, space, like))
    return worst


def _by_parameter(system: System, name: str, region: Region, knots: np.ndarray) -> float:
    """sup ‖∂f/∂η‖ over the region."""
    space, like = (system.state, system.x0) if name == "f" else (system.control, system.u0)
    ones = [np.ones(leaf.size) for leaf in jtu.tree_leaves(system.eta)]
    enclosure = SlopeEnclosure(getattr(system, name), system.likes, (3,))
    worst = 0.0
    try:
        for piece in times(float(region.t.low), float(region.t.high), knots):
            out = enclosure(piece, region.x, region.u, region.eta).out
            worst = max(worst, block(out, 0, roots(space, like), ones).norm())
    except TooLarge:
        return np.inf
    return worst


def _kappa(system: System, t0: float, t1: float, knots: np.ndarray) -> float:
    """sup_t ‖proj_{K(t)} 0‖."""
    like, space = system.u0, system.control
    at = lambda t: system.problem.set_at(t, system.args)  # noqa: E731
    time, pieces = (jnp.zeros(()),), times(t0, t1, knots)
    if isinstance(at(jnp.asarray(t0)), Ball) and not isinstance(like, tuple):
        # Its projection divides by a distance that may vanish, but how far off it is does not.
        def off(t: Any) -> jax.Array:
            ball = at(t)
            assert isinstance(ball, Ball)
            center = jnp.broadcast_to(ball.center, like.shape)
            return jnp.maximum(space.norm(center) - ball.radius, 0.0)

        enclosure = SlopeEnclosure(off, time, ())
        return max(float(enclosure(piece).out.high) for piece in pieces)
    enclosure = SlopeEnclosure(lambda t: at(t).project(like, space), time, ())
    return max(_norm(enclosure(piece).out, space, like) for piece in pieces)


def _norm(out: Tree, space: AbstractSpace, like: Tree) -> float:
    """The largest norm of an element within these intervals."""
    total = 0.0
    for x, root in zip(slopes(out), roots(space, like), strict=True):
        largest = np.maximum(np.abs(x.low), np.abs(x.high)).ravel()
        total += float(np.sum((root * largest) ** 2))
    return float(np.sqrt(total))


def _ball(tree: Tree, space: AbstractSpace, R: Any) -> Tree:
    """The intervals met with a box around 𝔹_R(0)."""
    each = iter(roots(space, space.zeros()))

    def met(v: Slope) -> Slope:
        reach = float(R) / next(each).reshape(v.low.shape)
        return interval(np.maximum(v.low, -reach), np.minimum(v.high, reach))

    return jtu.tree_map(met, tree, is_leaf=is_slope)


def _check(problem: Problem, low: Tree, high: Tree, start_radius: Any) -> None:
    if start_radius is not None and not (np.ndim(start_radius) == 0 and 0 <= start_radius < np.inf):
        raise InputError(
            InputProblem(
                "dvax.parameter_bounds(start_radius)", _tree.short(start_radius),
                "it must be one number ≥ 0: a bound on ‖ζ‖", "Give the largest norm that is meant",
            )
        )  # fmt: skip
    same = _tree.same_shape(low, high)
    ordered = same and all(
        bool(np.all(np.asarray(a) <= np.asarray(b)))
        for a, b in zip(jtu.tree_leaves(low), jtu.tree_leaves(high), strict=True)
    )
    if not ordered:
        raise InputError(
            InputProblem(
                "dvax.parameter_bounds(low, high)",
                f"{_tree.short(low)} and {_tree.short(high)}",
                "they are the ends of a box of parameters: trees of one shape with low ≤ high",
                "Give the least and the largest value of every parameter",
            )
        )


def _fixed(problem: Problem, t0: float, eta: Tree) -> None:
    """Raise an `InputError` where A, P or K depends on η."""
    arrays = lambda module: jtu.tree_leaves(module)  # noqa: E731
    for name, made in (
        ("A", lambda v: arrays(problem.generator(v))),
        ("P", lambda v: arrays(problem.operator(v))),
        ("K", lambda v: arrays(problem.set_at(jnp.asarray(t0), v))),
    ):
        if not independent(
            lambda v, made=made: [a for a in made(v) if isinstance(a, jax.Array)], eta
        ):
            raise InputError(
                InputProblem(
                    f"dvax.Problem({name})",
                    "a callable that uses args",
                    "Section 6 of the paper keeps A, P and K fixed and lets f and h alone vary",
                    "Keep it out of args here; the derivative of a solution has no such limit",
                )
            )


def _unknown(what: str, why: str) -> InputError:
    return InputError(
        InputProblem(
            "dvax.parameter_bounds",
            what,
            f"no bound is known for all of these parameters: {why}",
            "Give a region in x or u, a start_radius, or make dvax.ParameterBounds by hand",
        )
    )
