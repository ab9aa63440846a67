"""Formulas of the paper that belong to no object, each found by its label.

All of them take NumPy or JAX numbers and give upper bounds (or the quantity itself, where it says =).
"""

from typing import Any

from .. import _tree

__all__ = [
    "bielecki_equivalence",
    "continuity_coefficients",
    "convolved",
    "frozen_difference",
    "quadratic_root",
    "response_in_time",
    "response_in_time_sqrt",
    "within_residual",
]


def convolved(a: Any, T: Any) -> Any:
    """Φ_a(T) = ∫₀ᵀ e^{a(T−s)} ds = (e^{aT} − 1)/a, and T for a = 0 (Section 2.2)."""
    lib = _tree.library(a, T)
    z = lib.asarray(a * T)
    small = lib.abs(z) < 1e-300
    return T * lib.where(small, 1.0, lib.expm1(z) / lib.where(small, 1.0, z))


def bielecki_equivalence(lam: Any, T: Any) -> tuple[Any, Any]:
    """(e^{−λT}, 1) with e^{−λT}‖v‖_C ≤ ‖v‖_λ ≤ ‖v‖_C (lem:bielecki_equiv)."""
    lib = _tree.library(lam, T)
    return lib.exp(-lam * T), lib.ones_like(lib.asarray(lam * T))


def frozen_difference(gap: Any, gamma: Any) -> Any:
    """‖y₁ − y₂‖ ≤ ‖F₁(y₂) − F₂(y₂)‖/γ for the solutions of VI(K, F₁) and VI(K, F₂), with the norm
    `gap` and the γ of F₁ (eq:vi_sensitivity); and with gap = ‖F(ỹ)‖ the distance of a ỹ ∈ K from the
    solution of VI(K, F) (eq:ym_local_bound_by_F)."""
    return gap / gamma


def continuity_coefficients(
    push: Any, step_K: Any, step_y: Any, step_F: Any, L_F: Any
) -> tuple[Any, Any]:
    """(a, b) with γs² ≤ a + bs for s = ‖ŷ − ỹ‖ (eq:continuity_split), from

    push = ‖F_{t,x}(y)‖, step_K = ‖proj_{K(t)}ŷ − ŷ‖, step_y = ‖ỹ − y‖ and step_F the change of F at ỹ;
    y and ŷ are the solutions at t and t̂, and ỹ = proj_{K(t̂)} y.
    """
    return push * (step_K + step_y) + 2.0 * L_F * step_y**2, L_F * step_y + step_F


def quadratic_root(a: Any, b: Any, gamma: Any) -> Any:
    """s² ≤ 2a/γ + b²/γ² where γs² ≤ a + bs (lem:techni): the bound on s."""
    lib = _tree.library(a, b, gamma)
    return lib.sqrt(2.0 * a / gamma + (b / gamma) ** 2)


def response_in_time_sqrt(
    push: Any,
    speed_K: Any,
    speed_h: Any,
    alpha_h: Any,
    gap_x: Any,
    gap_t: Any,
    gamma: Any,
    L_F: Any,
) -> Any:
    """‖y₁ − y₂‖ between (t₁, x₁) and (t₂, x₂), as the paper's proof of lem:continuity_u has it: of the
    order of √|t₁ − t₂|.

    `push` = ‖F_{t₁,x₁}(y₁)‖; K and h move with `speed_K` and `speed_h`.
    """
    step = speed_K * gap_t
    a, b = continuity_coefficients(push, step, step, alpha_h * gap_x + speed_h * gap_t, L_F)
    return quadratic_root(a, b, gamma) + step


def response_in_time(
    speed_K: Any, speed_h: Any, alpha_h: Any, gap_x: Any, gap_t: Any, gamma: Any, L_F: Any
) -> Any:
    """‖y₁ − y₂‖ between (t₁, x₁) and (t₂, x₂), of the order of |t₁ − t₂|: sharper than the paper.

    Let z = y₁ − F₁(y₁), so that y₁ = proj_{K(t₁)} z. As a candidate for VI(K(t₂), F₁), y₁ has the
    natural residual ‖proj_{K(t₁)}z − proj_{K(t₂)}z‖ ≤ ω_K, hence (with the residual bound of
    Kim–Vuong–Khanh for points outside K, which takes F Lipschitz everywhere) it lies within
    (1 + (1 + L_F)/γ)ω_K of that problem's solution; and that lies within ‖F₁ − F₂‖/γ of y₂ by
    eq:vi_sensitivity:

        ‖y₁ − y₂‖ ≤ (1 + (1 + L_F)/γ) ω_K|t₁ − t₂| + (ω_h|t₁ − t₂| + α_h‖x₁ − x₂‖)/γ.
    """
    return (1.0 + (1.0 + L_F) / gamma) * speed_K * gap_t + (
        speed_h * gap_t + alpha_h * gap_x
    ) / gamma


def within_residual(residual: Any, gamma: Any, L_F: Any, tau: Any = 1.0) -> Any:
    """‖y − y*‖ ≤ (1 + L_F/γ + 1/(τγ)) ‖y − proj_K(y − τF(y))‖ (Kim–Vuong–Khanh, Theorem 4.2, quoted
    after thm:global_existence, for τ = 1), for y in K, or outside where F is Lipschitz everywhere."""
    return (1.0 + L_F / gamma + 1.0 / (tau * gamma)) * residual
