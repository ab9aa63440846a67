"""The assumptions of the paper, each with its status for a problem."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..problem import Problem
from ..programs.slope import Slope, SlopeEnclosure, TooLarge, interval, is_slope
from .certificate import is_declared
from .modulus_status import ModulusStatuses
from .projection_speed import slopes
from .region import Region
from .set_motion import SetMotion, bounded_in_time, jumps, times
from .status import Status, weakest
from .system import System
from .weights import roots

_LARGEST_MAGNITUDE = 1e100
"""Bound on |x| and |u| that stands for every ball 𝔹_R(0) in floating-point arithmetic."""

_SAMPLES = 33


class Assumption(NamedTuple):
    """An assumption with its label in the paper.

    - `status`: "proved", "declared", "estimated" or "refuted";
    - `why`: the reason for the status, with numbers;
    - `is_required`: whether the theory needs it; one of two alternative sufficient conditions is not
      required;
    - `evidence`: the counterexample, if there is one.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> check = dvax.verify(problem, -1.0, 0.0, 2.0)
    >>> assumption = check["ass:strong_pseudomono"]
    >>> assumption.status, assumption.is_required
    ('proved', True)
    >>> assumption.why.split(" (")[0]
    'γ = 2'

    ```
    """

    label: str
    statement: str
    status: Status
    why: str
    is_required: bool = True
    evidence: Any = None

    @property
    def holds_between_jumps(self) -> bool:
        """Whether it fails at jumps alone, on both sides of which the theory holds."""
        return self.why.endswith(_ON_EACH_SIDE)


def assumptions(
    system: System, region: Region, K: SetMotion, knots: np.ndarray, moduli: ModulusStatuses
) -> list[Assumption]:
    """Return the status of every assumption, in the order of the paper."""
    span = float(region.t.low), float(region.t.high)
    finite = _finite_region(region)
    return [
        _generator(system),
        _operator(system),
        _sets(K),
        _integrable(system, finite, span, knots, moduli),
        _law(moduli),
        _feedback(moduli),
        _moving_set(system, K, span, knots),
        _moving_feedback(system, finite, span, knots),
        _smallness(system, moduli),
        _rate(moduli),
    ]


def _generator(system: System) -> Assumption:
    A = system.problem.generator(system.args)
    declared = is_declared(A)
    M, omega = float(system.growth.M), float(system.growth.omega)
    source = "from its declared numerical range" if declared else f"from {type(A).__name__}"
    return Assumption(
        "ass:operators (i)", "A generates a C₀-semigroup", "declared" if declared else "proved",
        f"‖e^{{At}}‖ ≤ {M:.6g} e^{{{omega:.6g} t}}, {source}",
    )  # fmt: skip


def _operator(system: System) -> Assumption:
    low, high = float(system.spectrum.m), float(system.spectrum.norm)
    return Assumption(
        "ass:operators (ii)", "P is bounded, self-adjoint and coercive",
        "declared" if system.spectrum.declared else "proved",
        f"its spectrum lies in [{low:.6g}, {high:.6g}]",
    )  # fmt: skip


def _sets(K: SetMotion) -> Assumption:
    label, statement = "ass:operators (iii)", "K(t) is nonempty, closed and convex"
    if K.empty_at is not None:
        why = f"K(t) is empty at t = {K.empty_at:.17g}"
        return Assumption(label, statement, "refuted", why, evidence=K.empty_at)
    if K.is_nonempty:
        return Assumption(label, statement, "proved", "from the data of the set at every t")
    return Assumption(label, statement, "estimated", "tested at a sample of times only")


@eqx.filter_jit
def _is_finite(problem: Problem, x: Tree, u: Tree, args: Any, times: jax.Array) -> jax.Array:
    """Return at which times f is finite. One program for all parameters: JAX would compile one for each
    operation of f."""
    return jax.vmap(lambda t: _tree.all_finite(problem.f(t, x, u, args)))(times)


def _integrable(
    system: System,
    finite_region: Region,
    span: tuple[float, float],
    knots: np.ndarray,
    moduli: ModulusStatuses,
) -> Assumption:
    label, statement = "ass:operators (iv)", "f and h are Carathéodory, f(·, 0, 0) is integrable"
    zero = _tree.zeros_like(system.x0)

    def f_at_zero(t: Any) -> Tree:
        return system.problem.f(t, zero, system.u0, system.args)

    samples = np.linspace(*span, _SAMPLES)
    args = _tree.as_arrays(system.args)
    finite = np.asarray(_is_finite(system.problem, zero, system.u0, args, jnp.asarray(samples)))
    if not finite.all():
        t = samples[np.argmin(finite)]
        why = f"f(t, 0, 0) = {_tree.short(f_at_zero(jnp.asarray(t)))} at t = {t:.17g}"
        return Assumption(label, statement, "refuted", why, evidence=float(t))
    bounded = bounded_in_time(f_at_zero, *span, knots)
    blocks = system.at(finite_region)[:4]
    smooth = all(b is not None and np.isfinite(b.radius).all() for b in blocks)
    names = ("alpha_f", "beta_f", "alpha_h", "beta_h")
    lipschitz = all(moduli.by_name[name].status == "proved" for name in names)
    if bounded and (smooth or lipschitz):
        return Assumption(label, statement, "proved", "by their code: bounded in t and continuous")
    why = f"f(t, 0, 0) is finite at {_SAMPLES} times; no proof from the code"
    return Assumption(label, statement, "estimated", why)


def _law(moduli: ModulusStatuses) -> Assumption:
    label = "ass:strong_pseudomono"
    statement = "F_{t,x} is strongly pseudomonotone on K(t) and Lipschitz"
    gamma, L_F = moduli.by_name["gamma"], moduli.by_name["L_F"]
    if gamma.status == "refuted":
        why = f"with no γ > 0: {gamma.reason}"
        return Assumption(label, statement, "refuted", why, evidence=moduli.counterexample)
    why = f"γ = {gamma.value:.6g} ({gamma.reason}); L_F = {L_F.value:.6g} ({L_F.reason})"
    return Assumption(label, statement, weakest(gamma.status, L_F.status), why)


def _feedback(moduli: ModulusStatuses) -> Assumption:
    value = moduli.by_name["alpha_h"]
    why = f"α_h = {value.value:.6g} ({value.reason})"
    return Assumption("ass:h_lipschitz_x", "h is Lipschitz in x", value.status, why)


def _rate(moduli: ModulusStatuses) -> Assumption:
    a, b = moduli.by_name["alpha_f"], moduli.by_name["beta_f"]
    why = f"α_f = {a.value:.6g} ({a.reason}); β_f = {b.value:.6g} ({b.reason})"
    statement = "f is Lipschitz in x and u"
    return Assumption("ass:f_lipschitz", statement, weakest(a.status, b.status), why)


def _smallness(system: System, moduli: ModulusStatuses) -> Assumption:
    beta = moduli.by_name["beta_h"]
    m_P, norm = float(system.spectrum.m_P), float(system.spectrum.norm_P_inv)
    q = (norm - m_P + 2.0 * beta.value * norm) / (norm + m_P)
    why = f"q_ρ ≤ {q:.6g} at ρ = {2.0 / (m_P + norm):.6g}, β_h = {beta.value:.6g} ({beta.reason})"
    status: Status = weakest(beta.status, "declared" if system.spectrum.declared else "proved")
    if not q < 1 and beta.status == "proved":
        # β_h is the modulus itself if ∂h/∂u is constant, and otherwise an upper bound.
        sharp = moduli.exact_in_u and system.spectrum.exact and not system.spectrum.declared
        status = "refuted" if sharp else "estimated"
        why += "; it fails for every ρ" if sharp else "; not proved"
        why += ", but another proof of γ > 0 suffices"
    statement = "q_ρ < 1 for some ρ (the projection route)"
    return Assumption("ass:lipschitz_smallness", statement, status, why, is_required=False)


def _moving_set(
    system: System, K: SetMotion, span: tuple[float, float], knots: np.ndarray
) -> Assumption:
    label, statement = "ass:time_regularity (i)", "proj_{K(t)} is continuous in t"
    if K.empty_at is not None:
        why = f"K(t) is empty at t = {K.empty_at:.17g}"
        return Assumption(label, statement, "refuted", why, evidence=K.empty_at)
    z = jtu.tree_map(jnp.ones_like, system.u0)

    def project(t: Any) -> Tree:
        return system.problem.set_at(t, system.args).project(z, system.control)

    # A speed of 0 excludes jumps: the pieces of time beside one have no finite speed.
    jump = jumps(project, knots, span) if K.speed > 0.0 else None
    if jump is not None:
        why = f"proj_{{K(t)}}(1) jumps by {jump[1]:.6g} at t = {jump[0]:.17g}; {_ON_EACH_SIDE}"
        return Assumption(label, statement, "refuted", why, evidence=jump[0])
    if np.isfinite(K.speed):
        return Assumption(label, statement, "proved", f"ω_K(r) = {K.speed:.6g} r")
    return Assumption(label, statement, "estimated", "no proof from the code of K")


def _moving_feedback(
    system: System, finite_region: Region, span: tuple[float, float], knots: np.ndarray
) -> Assumption:
    label, statement = "ass:time_regularity (ii)", "h is continuous in t"

    def h(t: Any, x: Tree, u: Tree) -> Tree:
        return system.problem.h(t, x, u, system.args)

    jump = jumps(lambda t: h(t, system.x0, system.u0), knots, span)
    if jump is not None:
        why = f"h jumps by {jump[1]:.6g} at t = {jump[0]:.17g}; {_ON_EACH_SIDE}"
        return Assumption(label, statement, "refuted", why, evidence=jump[0])
    try:
        enclosure = SlopeEnclosure(h, (jnp.zeros(()), system.x0, system.u0), (0,))
        weights, speed = roots(system.control, system.u0), 0.0
        for piece in times(*span, knots):
            out = slopes(enclosure(piece, finite_region.x, finite_region.u).out)
            fastest = [_fastest(x, root) for x, root in zip(out, weights, strict=True)]
            # `max` would drop NaN.
            speed = float(np.maximum(speed, _length(np.array(fastest))))
        if np.isfinite(speed):
            speed_text = f", ‖∂h/∂t‖ ≤ {speed:.6g}" if speed < 1e50 else ""
            return Assumption(
                label, statement, "proved", f"by its code, Lipschitz in t{speed_text}"
            )
    except TooLarge:
        pass
    return Assumption(label, statement, "estimated", "no proof from the code of h")


def _fastest(x: Slope, root: np.ndarray) -> float:
    """Return a bound on the norm of the derivative in t, with the square root of the weights."""
    entries = np.zeros(root.size)
    for part in x.parts.values():
        entries += (np.abs(part.center) + part.radius).ravel()
    return _length(root * entries)


def _length(entries: np.ndarray) -> float:
    """Return the Euclidean norm without overflow of the squares."""
    largest = float(np.max(entries, initial=0.0))
    if not 0.0 < largest < np.inf:
        return largest
    return largest * float(np.linalg.norm(entries / largest))


_ON_EACH_SIDE = "the theory holds on both sides of it"


def _finite_region(region: Region) -> Region:
    """Return the region, limited to |x|, |u| ≤ 10¹⁰⁰."""

    def limit(v: Slope) -> Slope:
        return interval(
            np.maximum(v.low, -_LARGEST_MAGNITUDE), np.minimum(v.high, _LARGEST_MAGNITUDE)
        )

    x, u = (jtu.tree_map(limit, v, is_leaf=is_slope) for v in (region.x, region.u))
    return Region(region.t, x, u)
