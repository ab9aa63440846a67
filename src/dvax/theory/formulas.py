"""Formulas of the paper that belong to no class, with their labels.

All of them take NumPy or JAX numbers and return upper bounds, or the quantity itself after "=".
"""

from typing import Any

import numpy as np

from .. import _tree

__all__ = [
    "bielecki_equivalence",
    "continuity_coefficients",
    "frozen_difference",
    "growth_integral",
    "quadratic_root",
    "response_in_time",
    "response_in_time_sqrt",
]


def growth_integral(a: Any, T: Any) -> Any:
    """Return Φ_a(T) = ∫₀ᵀ e^{a(T−s)} ds = (e^{aT} − 1)/a, or T for a = 0 (Section 2.2)."""
    lib = _tree.array_module(a, T)
    z = lib.asarray(a * T)
    small = lib.abs(z) < 1e-300
    with np.errstate(over="ignore"):  # infinite is the answer then
        return T * lib.where(small, 1.0, lib.expm1(z) / lib.where(small, 1.0, z))


def bielecki_equivalence(lam: Any, T: Any) -> tuple[Any, Any]:
    """Return (e^{−λT}, 1), the constants of e^{−λT}‖v‖_C ≤ ‖v‖_λ ≤ ‖v‖_C (lem:bielecki_equiv)."""
    lib = _tree.array_module(lam, T)
    return lib.exp(-lam * T), lib.ones_like(lib.asarray(lam * T))


def frozen_difference(gap: Any, gamma: Any) -> Any:
    """Return the bound gap/γ on the distance of two solutions.

    For the solutions of VI(K, F₁) and VI(K, F₂), ‖y₁ − y₂‖ ≤ ‖F₁(y₂) − F₂(y₂)‖/γ with the γ of F₁
    (eq:vi_sensitivity). With gap = ‖F(ỹ)‖ it bounds the distance of a ỹ ∈ K from the solution of
    VI(K, F) (eq:ym_local_bound_by_F).
    """
    return gap / gamma


def continuity_coefficients(
    norm_F: Any, step_K: Any, step_y: Any, step_F: Any, L_F: Any
) -> tuple[Any, Any]:
    """Return (a, b) with γs² ≤ a + bs for s = ‖ŷ − ỹ‖ (eq:continuity_split).

    y and ŷ are the solutions at t and t̂, and ỹ = proj_{K(t̂)} y. `norm_F` = ‖F_{t,x}(y)‖, step_K =
    ‖proj_{K(t)}ŷ − ŷ‖, step_y = ‖ỹ − y‖, and step_F is the change of F at ỹ.
    """
    return norm_F * (step_K + step_y) + 2.0 * L_F * step_y**2, L_F * step_y + step_F


def quadratic_root(a: Any, b: Any, gamma: Any) -> Any:
    """Return the bound √(2a/γ + b²/γ²) on s that follows from γs² ≤ a + bs (lem:techni)."""
    lib = _tree.array_module(a, b, gamma)
    return lib.sqrt(2.0 * a / gamma + (b / gamma) ** 2)


def response_in_time_sqrt(
    norm_F: Any,
    speed_K: Any,
    speed_h: Any,
    alpha_h: Any,
    gap_x: Any,
    gap_t: Any,
    gamma: Any,
    L_F: Any,
) -> Any:
    """Return the paper's bound on ‖y₁ − y₂‖ between (t₁, x₁) and (t₂, x₂), of order √|t₁ − t₂|
    (proof of lem:continuity_u).

    `norm_F` = ‖F_{t₁,x₁}(y₁)‖; `speed_K` and `speed_h` are the Lipschitz constants of proj_K and h
    in t.
    """
    step = speed_K * gap_t
    a, b = continuity_coefficients(norm_F, step, step, alpha_h * gap_x + speed_h * gap_t, L_F)
    return quadratic_root(a, b, gamma) + step


def response_in_time(
    speed_K: Any, speed_h: Any, alpha_h: Any, gap_x: Any, gap_t: Any, gamma: Any, L_F: Any
) -> Any:
    """Return a bound on ‖y₁ − y₂‖ between (t₁, x₁) and (t₂, x₂) of order |t₁ − t₂|, sharper than the
    paper's.

    Let z = y₁ − F₁(y₁), so that y₁ = proj_{K(t₁)} z. As a candidate for VI(K(t₂), F₁), y₁ has the
    natural residual ‖proj_{K(t₁)}z − proj_{K(t₂)}z‖ ≤ ω_K, hence (by the residual bound of
    Kim–Vuong–Khanh for points outside K, which requires F Lipschitz everywhere) its distance from that
    problem's solution is at most (1 + (1 + L_F)/γ)ω_K. The distance of that solution from y₂ is at most
    ‖F₁ − F₂‖/γ by eq:vi_sensitivity:

        ‖y₁ − y₂‖ ≤ (1 + (1 + L_F)/γ) ω_K|t₁ − t₂| + (ω_h|t₁ − t₂| + α_h‖x₁ − x₂‖)/γ.
    """
    return (1.0 + (1.0 + L_F) / gamma) * speed_K * gap_t + (
        speed_h * gap_t + alpha_h * gap_x
    ) / gamma
