"""The assumptions of the paper, each with what is known about it."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..programs.slope import SlopeEnclosure, TooLarge, interval, is_slope
from .assumption import Assumption
from .certificate import is_declared
from .known import Knowledge
from .motion import Motion, bounded_in_time, jumps, slopes, times
from .region import Region
from .status import Status, weakest
from .system import System

_LARGEST = 1e100
"""What holds for |x|, |u| up to here holds on every ball 𝔹_R(0) that floating point can see."""

_SAMPLES = 33


def rows(
    system: System, region: Region, K: Motion, knots: np.ndarray, known: Knowledge
) -> list[Assumption]:
    """One for each assumption, in the order of the paper."""
    span = float(region.t.low), float(region.t.high)
    everywhere = _huge(region)
    return [
        _generator(system),
        _operator(system),
        _sets(K),
        _integrable(system, everywhere, span, knots, known),
        _law(known),
        _feedback(known),
        _moving_set(system, K, span, knots),
        _moving_feedback(system, everywhere, span, knots),
        _smallness(system, known),
        _rate(known),
    ]


def _generator(system: System) -> Assumption:
    A = system.problem.generator(system.args)
    by_hand = is_declared(A)
    M, omega = float(system.growth.M), float(system.growth.omega)
    how = "as its numerical range is declared" if by_hand else f"from {type(A).__name__}"
    return Assumption(
        "ass:operators (i)", "A generates a C₀-semigroup", "declared" if by_hand else "proved",
        f"‖e^{{At}}‖ ≤ {M:.6g} e^{{{omega:.6g} t}}, {how}",
    )  # fmt: skip


def _operator(system: System) -> Assumption:
    low, high = float(system.spectrum.m), float(system.spectrum.norm)
    return Assumption(
        "ass:operators (ii)", "P is bounded, self-adjoint and coercive",
        "declared" if system.spectrum.declared else "proved",
        f"its spectrum lies in [{low:.6g}, {high:.6g}]",
    )  # fmt: skip


def _sets(K: Motion) -> Assumption:
    label, statement = "ass:operators (iii)", "K(t) is nonempty, closed and convex"
    if K.empty_at is not None:
        why = f"K(t) is empty at t = {K.empty_at:.17g}"
        return Assumption(label, statement, "refuted", why, evidence=K.empty_at)
    if K.standing:
        return Assumption(label, statement, "proved", "from the data of the set at every t")
    return Assumption(label, statement, "estimated", "looked at some times only")


def _integrable(
    system: System,
    everywhere: Region,
    span: tuple[float, float],
    knots: np.ndarray,
    known: Knowledge,
) -> Assumption:
    label, statement = "ass:operators (iv)", "f and h are Carathéodory, f(·, 0, 0) is integrable"
    zero = jtu.tree_map(jnp.zeros_like, system.x0)
    at_zero = lambda t: system.problem.f(t, zero, system.u0, system.args)  # noqa: E731
    samples = np.linspace(*span, _SAMPLES)
    finite = jax.vmap(lambda t: _tree.all_finite(at_zero(t)))(jnp.asarray(samples))
    if not finite.all():
        t = samples[np.argmin(finite)]
        why = f"f(t, 0, 0) = {_tree.short(at_zero(jnp.asarray(t)))} at t = {t:.17g}"
        return Assumption(label, statement, "refuted", why, evidence=float(t))
    bounded = bounded_in_time(at_zero, *span, knots)
    blocks = system.at(everywhere)[:4]
    smooth = all(b is not None and np.isfinite(b.radius).all() for b in blocks)
    names = ("alpha_f", "beta_f", "alpha_h", "beta_h")
    lipschitz = all(known.of[name].status == "proved" for name in names)
    if bounded and (smooth or lipschitz):
        return Assumption(label, statement, "proved", "their code is bounded in t and continuous")
    why = f"f(t, 0, 0) is finite at {_SAMPLES} times; no proof from the code"
    return Assumption(label, statement, "estimated", why)


def _law(known: Knowledge) -> Assumption:
    label = "ass:strong_pseudomono"
    statement = "F_{t,x} is strongly pseudomonotone on K(t) and Lipschitz"
    gamma, L_F = known.of["gamma"], known.of["L_F"]
    if gamma.status == "refuted":
        why = f"with no γ > 0: {gamma.how}"
        return Assumption(label, statement, "refuted", why, evidence=known.pair)
    why = f"γ = {gamma.value:.6g} ({gamma.how}); L_F = {L_F.value:.6g} ({L_F.how})"
    return Assumption(label, statement, weakest(gamma.status, L_F.status), why)


def _feedback(known: Knowledge) -> Assumption:
    value = known.of["alpha_h"]
    why = f"α_h = {value.value:.6g} ({value.how})"
    return Assumption("ass:h_lipschitz_x", "h is Lipschitz in x", value.status, why)


def _rate(known: Knowledge) -> Assumption:
    a, b = known.of["alpha_f"], known.of["beta_f"]
    why = f"α_f = {a.value:.6g} ({a.how}); β_f = {b.value:.6g} ({b.how})"
    statement = "f is Lipschitz in x and u"
    return Assumption("ass:f_lipschitz", statement, weakest(a.status, b.status), why)


def _smallness(system: System, known: Knowledge) -> Assumption:
    beta = known.of["beta_h"]
    m_P, norm = float(system.spectrum.m_P), float(system.spectrum.norm_P_inv)
    q = (norm - m_P + 2.0 * beta.value * norm) / (norm + m_P)
    why = f"q_ρ ≤ {q:.6g} at ρ = {2.0 / (m_P + norm):.6g}, β_h = {beta.value:.6g} ({beta.how})"
    status: Status = weakest(beta.status, "declared" if system.spectrum.declared else "proved")
    if not q < 1 and beta.status == "proved":
        # β_h is the modulus itself where ∂h/∂u does not change, and else only a bound of it.
        sharp = known.exact_in_u and system.spectrum.exact and not system.spectrum.declared
        status = "refuted" if sharp else "estimated"
        why += "; it fails for every ρ" if sharp else "; it is not shown"
        why += ", which does not matter where γ is known in another way"
    statement = "q_ρ < 1 for some ρ (the projection route)"
    return Assumption("ass:lipschitz_smallness", statement, status, why, needed=False)


def _moving_set(
    system: System, K: Motion, span: tuple[float, float], knots: np.ndarray
) -> Assumption:
    label, statement = "ass:time_regularity (i)", "proj_{K(t)} moves continuously in t"
    if K.empty_at is not None:
        why = f"K(t) is empty at t = {K.empty_at:.17g}"
        return Assumption(label, statement, "refuted", why, evidence=K.empty_at)
    z = jtu.tree_map(jnp.ones_like, system.u0)

    def project(t: Any) -> Tree:
        return system.problem.set_at(t, system.args).project(z, system.control)

    jump = jumps(project, knots, span)
    if jump is not None:
        why = f"proj_{{K(t)}}(1) jumps by {jump[1]:.6g} at t = {jump[0]:.17g}; {_ON_EACH_SIDE}"
        return Assumption(label, statement, "refuted", why, evidence=jump[0])
    if np.isfinite(K.speed):
        return Assumption(label, statement, "proved", f"ω_K(r) = {K.speed:.6g} r")
    return Assumption(label, statement, "estimated", "no proof from the code of K")


def _moving_feedback(
    system: System, everywhere: Region, span: tuple[float, float], knots: np.ndarray
) -> Assumption:
    label, statement = "ass:time_regularity (ii)", "h moves continuously in t"
    h = lambda t, x, u: system.problem.h(t, x, u, system.args)  # noqa: E731
    jump = jumps(lambda t: h(t, system.x0, system.u0), knots, span)
    if jump is not None:
        why = f"h jumps by {jump[1]:.6g} at t = {jump[0]:.17g}; {_ON_EACH_SIDE}"
        return Assumption(label, statement, "refuted", why, evidence=jump[0])
    try:
        enclosure = SlopeEnclosure(h, (jnp.zeros(()), system.x0, system.u0), (0,))
        speed = 0.0
        for piece in times(*span, knots):
            for x in slopes(enclosure(piece, everywhere.x, everywhere.u).out):
                for part in x.parts.values():
                    fastest = np.abs(part.center) + part.radius
                    speed = max(speed, float(np.max(fastest, initial=0.0)))
        if np.isfinite(speed):
            shown = f", |∂h/∂t| ≤ {speed:.6g}" if speed < 1e50 else ""
            return Assumption(label, statement, "proved", f"its code is Lipschitz in t{shown}")
    except TooLarge:
        pass
    return Assumption(label, statement, "estimated", "no proof from the code of h")


_ON_EACH_SIDE = "the theory holds on each side of it"


def _huge(region: Region) -> Region:
    """The region, cut to what floating point can see."""
    cut = lambda v: interval(np.maximum(v.low, -_LARGEST), np.minimum(v.high, _LARGEST))  # noqa: E731
    x, u = (jtu.tree_map(cut, v, is_leaf=is_slope) for v in (region.x, region.u))
    return Region(region.t, x, u)
