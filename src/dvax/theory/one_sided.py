"""A one-sided Lipschitz constant of the coupled system, which bounds the separation of trajectories.

For two solutions let d = Δx, v = Δu. Both satisfy the law, and a normal cone is monotone:

    ⟨Δ(h − u), PΔu⟩ ≥ 0,   that is   ⟨H_x d − (I − H_u)v, Pv⟩ ≥ 0,

with H_x, H_u averages of ∂h/∂x, ∂h/∂u over the segment between the two. So for every τ ≥ 0

    d/dt ½‖d‖² = ⟨(A + F_x)d + F_u v, d⟩
               ≤ ⟨(A + F_x)d + F_u v, d⟩ + τ⟨H_x d − (I − H_u)v, Pv⟩ ≤ μ(τ)‖d‖².

With G = A + F_x, N = P(I − H_u) + (I − H_u)ᵀP (positive definite where F is strongly monotone) and
B = F_u + τH_xᵀP, completing the square in v gives

    μ(τ) = ½ λ_max(G + Gᵀ + B N⁻¹ Bᵀ/τ),

which is convex in τ. It keeps the sign of every feedback, whereas L̃ = α_f + β_f L adds absolute
values. It needs only Lipschitz bounds of h and the convexity of K. For the contact law it is
−(α + d_x − d_u b_x/(1 + b_u)), which is sharp. If the derivatives are enclosed within radii, those of
F_x are added to G, and those of H_u subtracted from N, as diagonal matrices with a quadratic form that
is no smaller; the other terms are bounded with ‖v‖ ≤ L‖d‖ and added to μ.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from ..programs.slope import TooLarge, Values
from .blocks import Block, as_one_matrix, diagonal, dominating, eigenvalues
from .system import Jacobians, System

_ITERATIONS = 60
_ROUNDING = 1e-14


def one_sided(system: System, J: Jacobians, gamma: float, alpha_h: float, pointwise: bool) -> float:
    """Return the minimum of μ(τ), or ∞ if the derivatives are unknown or F is not strongly monotone.

    If the law is `pointwise` (K and P act pointwise), every point has its own τ. If A has no matrix but
    M = 1, the bound ⟨Ad, d⟩ ≤ ω‖d‖² replaces it.
    """
    if J.f_x is None or J.f_u is None or J.h_x is None or J.h_u is None or system.P is None:
        return np.inf
    try:
        return _minimise_mu(system, J.f_x, J.f_u, J.h_x, J.h_u, system.P, gamma, alpha_h, pointwise)
    except TooLarge:
        return np.inf


def _minimise_mu(
    system: System, f_x: Block, f_u: Block, h_x: Block, h_u: Block, P: Block, gamma: float,
    alpha_h: float, pointwise: bool,
) -> float:  # fmt: skip
    shift, A = 0.0, system.A
    if A is not None:
        f_x = _with_equal_counts(f_x, A)[0].plus(_with_equal_counts(A, f_x)[0])
    elif float(system.growth.M) == 1.0:
        shift = float(system.growth.omega)
    else:
        return np.inf
    f_x, f_u, h_x, h_u, P = _with_equal_counts(f_x, f_u, h_x, h_u, P)
    if not all(np.isfinite(b.radius).all() for b in (f_x, f_u, h_x, h_u)):
        return np.inf
    G = _raised(_twice(f_x.center), _twice(f_x.radius))
    N = _twice(P.center @ (np.eye(h_u.center.shape[1]) - h_u.center))
    cross = h_x.center.swapaxes(1, 2) @ P.center
    # The other radii add at most ⟨R_u v, d⟩ + τ⟨S_x d + S_u v, Pv⟩, with ‖v‖ ≤ L‖d‖.
    norm_P = float(system.spectrum.norm)
    L = alpha_h * float(system.spectrum.norm_P_inv) / gamma if gamma > 0 else np.inf
    radii = [b.radius_norms() for b in (f_u, h_x, h_u)]
    if not pointwise:
        # ‖v‖ ≤ L‖d‖ holds for all points together, not for each point.
        radii = [np.broadcast_to(np.max(r), len(G)) for r in radii]

    def rest(tau: Values, of_law: Values) -> Values:
        of_u, of_x, _ = radii
        if not (of_u.any() or of_x.any() or of_law.any()):
            return np.zeros(len(G))
        return of_u * L + tau * norm_P * L * (of_x + of_law * L)

    def minimum(N: Values, of_law: Values) -> float:
        return _minimum_over_tau(G, N, f_u.center, cross, partial(rest, of_law=of_law), pointwise)

    least = minimum(N, radii[2])
    if radii[2].any():
        lowered = -_raised(-N, _twice(np.abs(P.center) @ h_u.radius))
        least = min(least, minimum(lowered, np.zeros(len(G))))
    return least + shift


def _twice(stack: Values) -> Values:
    """Return the sum of every matrix and its transpose."""
    return stack + stack.swapaxes(1, 2)


def _raised(center: Values, radius: Values) -> Values:
    """Return matrices with a quadratic form no smaller than that of any in `center` ± `radius`, which
    are symmetric: of the diagonals that can be added, each matrix gets that of least eigenvalue."""
    if not radius.any():
        return center
    raised = np.stack([center + diagonal(e) for e in dominating(radius)])
    best = np.argmin([eigenvalues(v)[:, -1] for v in raised], axis=0)
    return raised[best, np.arange(len(center))]


def _minimum_over_tau(
    G: Values, N: Values, feedback: Values, cross: Values, rest: Callable[[Values], Values],
    pointwise: bool,
) -> float:  # fmt: skip
    """Return the minimum of μ(τ) + `rest`(τ), or ∞ if N is not positive definite."""
    if not (eigenvalues(N)[:, 0] > 0).all():
        return np.inf
    inverse = np.linalg.inv(N)

    def mu(log_tau: Values) -> Values:
        """Return μ for every matrix, with its own τ or a common one."""
        tau = np.exp(log_tau)
        factor = tau[:, None, None]
        B = feedback + factor * cross
        S = G + B @ inverse @ B.swapaxes(1, 2) / factor
        S = 0.5 * (S + S.swapaxes(1, 2))
        values = 0.5 * eigenvalues(S)[:, -1] + _ROUNDING * np.abs(S).max(axis=(1, 2))
        return values + rest(tau)

    # No τ gives less than ½ λ_max(G). If feedback and coupling are opposite, B = 0 for one τ, which
    # reaches that value: two eigenvalue problems in the place of a search.
    squares, products = (np.sum(v * cross, axis=(1, 2)) for v in (cross, feedback))
    if not pointwise:
        squares, products = (np.sum(v, keepdims=True) for v in (squares, products))
    if np.all(squares > 0) and np.all(products < 0):
        opposite = mu(np.log(-products / squares))
        least = 0.5 * eigenvalues(G)[:, -1]
        if np.max(opposite) <= np.max(least) + 10 * _ROUNDING * np.abs(G).max():
            return float(np.max(opposite))
    if pointwise:
        return float(np.max(_minimum(mu, len(G))))
    return float(_minimum(lambda log_tau: np.max(mu(log_tau), keepdims=True), 1)[0])


def _with_equal_counts(*blocks: Block) -> list[Block]:
    """Return the blocks as stacks with the same number of matrices."""
    if len({len(b.center) for b in blocks}) == 1:
        return list(blocks)
    return [as_one_matrix(b) for b in blocks]


def _minimum(fn: Callable[[Values], Values], count: int) -> Values:
    """Return the minima of `count` unimodal functions by golden-section search.

    Every function value is a valid bound, so stopping early only costs sharpness.
    """
    low, high = np.full(count, -30.0), np.full(count, 30.0)
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)
    a, b = high - ratio * (high - low), low + ratio * (high - low)
    at_a, at_b = fn(a), fn(b)
    best = np.minimum(at_a, at_b)
    for _ in range(_ITERATIONS):
        left = at_a < at_b
        low, high = np.where(left, low, a), np.where(left, b, high)
        kept, at_kept = np.where(left, a, b), np.where(left, at_a, at_b)
        new = np.where(left, high - ratio * (high - low), low + ratio * (high - low))
        at_new = fn(new)
        a, at_a = np.where(left, new, kept), np.where(left, at_new, at_kept)
        b, at_b = np.where(left, kept, new), np.where(left, at_kept, at_new)
        best = np.minimum(best, at_new)
    return best
