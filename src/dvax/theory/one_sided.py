"""How fast two trajectories can separate, signs and law included: a one-sided Lipschitz constant.

For two solutions let d = Δx, v = Δu. The law is solved by both, and a normal cone is monotone:

    ⟨Δ(h − u), PΔu⟩ ≥ 0,   that is   ⟨H_x d − (I − H_u)v, Pv⟩ ≥ 0,

with H_x, H_u averages of ∂h/∂x, ∂h/∂u over the segment between the two. So for every τ ≥ 0

    d/dt ½‖d‖² = ⟨(A + F_x)d + F_u v, d⟩
               ≤ ⟨(A + F_x)d + F_u v, d⟩ + τ⟨H_x d − (I − H_u)v, Pv⟩ ≤ μ(τ)‖d‖².

With G = A + F_x, N = P(I − H_u) + (I − H_u)ᵀP (positive definite where F is strongly monotone) and
B = F_u + τH_xᵀP, completing the square in v gives

    μ(τ) = ½ λ_max(G + Gᵀ + B N⁻¹ Bᵀ/τ),

convex in τ. This sees the sign of every feedback, where L̃ = α_f + β_f L adds absolute values; it needs
no convexity or smoothness of h beyond its Lipschitz bounds, and no more of K than that it is convex.
On the contact law it is −(α + d_x − d_u b_x/(1 + b_u)), which is sharp. Where the derivatives are only
enclosed, within radii r, the terms that they may add are bounded with ‖v‖ ≤ L‖d‖ and added to μ.
"""

from collections.abc import Callable

import numpy as np

from ..programs.slope import TooLarge, Values
from .blocks import Block, eigenvalues, spread_out
from .system import Jacobians, System

_ROUNDS = 60
_ROUNDING = 1e-14


def one_sided(system: System, J: Jacobians, gamma: float, alpha_h: float, pointwise: bool) -> float:
    """The least μ(τ), ∞ where the derivatives are not known or F is not strongly monotone. Where the
    law is `pointwise` (K and P point by point), every point has its own τ.

    Where A's matrix is not at hand but M = 1, ⟨Ad, d⟩ ≤ ω‖d‖² stands for it.
    """
    if J.f_x is None or J.f_u is None or J.h_x is None or J.h_u is None or system.P is None:
        return np.inf
    try:
        return _least(system, J.f_x, J.f_u, J.h_x, J.h_u, system.P, gamma, alpha_h, pointwise)
    except TooLarge:
        return np.inf


def _least(
    system: System, f_x: Block, f_u: Block, h_x: Block, h_u: Block, P: Block, gamma: float,
    alpha_h: float, pointwise: bool,
) -> float:  # fmt: skip
    added, A = 0.0, system.A
    if A is not None:
        f_x = _of_one_size(f_x, A)[0].plus(_of_one_size(A, f_x)[0])
    elif float(system.growth.M) == 1.0:
        added = float(system.growth.omega)
    else:
        return np.inf
    f_x, f_u, h_x, h_u, P = _of_one_size(f_x, f_u, h_x, h_u, P)
    if not all(np.isfinite(b.radius).all() for b in (f_x, f_u, h_x, h_u)):
        return np.inf
    G = f_x.center + f_x.center.swapaxes(1, 2)
    push = P.center @ (np.eye(h_u.center.shape[1]) - h_u.center)
    N = push + push.swapaxes(1, 2)
    across = h_x.center.swapaxes(1, 2) @ P.center
    if not (eigenvalues(N)[:, 0] > 0).all():
        return np.inf
    inverse = np.linalg.inv(N)
    # ‖v‖ ≤ L‖d‖, and what the radii may add: ⟨R_x d + R_u v, d⟩ + τ⟨S_x d + S_u v, Pv⟩.
    norm_P = float(system.spectrum.norm)
    L = alpha_h * float(system.spectrum.norm_P_inv) / gamma if gamma > 0 else np.inf
    slack = [b.slack() for b in (f_x, f_u, h_x, h_u)]
    if not pointwise:
        # What bounds ‖v‖ by ‖d‖ holds for all the points together, not for each by itself.
        slack = [np.max(s) for s in slack]
    loose = any(np.any(s) for s in slack)

    def mu(log_tau: Values) -> Values:
        """For every matrix, with its own τ or a common one."""
        tau = np.exp(log_tau)
        by = tau[:, None, None]
        B = f_u.center + by * across
        S = G + B @ inverse @ B.swapaxes(1, 2) / by
        S = 0.5 * (S + S.swapaxes(1, 2))
        each = 0.5 * eigenvalues(S)[:, -1] + _ROUNDING * np.abs(S).max(axis=(1, 2))
        if loose:
            a, b, c, e = slack
            each = each + a + b * L + tau * norm_P * L * (c + e * L)
        return each

    if pointwise:
        return float(np.max(_minimum(mu, len(G)))) + added
    return float(_minimum(lambda log_tau: np.max(mu(log_tau), keepdims=True), 1)[0]) + added


def _of_one_size(*blocks: Block) -> list[Block]:
    """All as stacks of the same length."""
    if len({len(b.center) for b in blocks}) == 1:
        return list(blocks)
    return [spread_out(b) for b in blocks]


def _minimum(fn: Callable[[Values], Values], count: int) -> Values:
    """The least values of functions that fall and then rise, by golden sections: every value of them
    is a bound, so that stopping early costs sharpness alone."""
    low, high = np.full(count, -30.0), np.full(count, 30.0)
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)
    a, b = high - ratio * (high - low), low + ratio * (high - low)
    at_a, at_b = fn(a), fn(b)
    best = np.minimum(at_a, at_b)
    for _ in range(_ROUNDS):
        left = at_a < at_b
        low, high = np.where(left, low, a), np.where(left, b, high)
        kept, at_kept = np.where(left, a, b), np.where(left, at_a, at_b)
        new = np.where(left, high - ratio * (high - low), low + ratio * (high - low))
        at_new = fn(new)
        a, at_a = np.where(left, new, kept), np.where(left, at_new, at_kept)
        b, at_b = np.where(left, kept, new), np.where(left, at_kept, at_new)
        best = np.minimum(best, at_new)
    return best
