"""How errors propagate along a trajectory: by one matrix, and a bound on what it leaves out.

Let e = x_c − x, and v = u_c − u the difference of the responses. By the mean value theorem

    e' = (A + F_x)e + F_u v + δ,

with ∂f/∂x and ∂f/∂u enclosed over a box that contains both trajectories. For K a box, v follows from e.
With w = P(u_c − u), N = (I − ∂h/∂u)P⁻¹ and any ρ > 0, the law is a projection of y + ρ(h − P⁻¹y), so

    w = D[(I − ρN)w + ρ ∂h/∂x e],   D diagonal, 0 ≤ D ≤ 1:

Dᵢ = 1 where yᵢ is inside its interval all the time, and Dᵢ = 0 where (h − u)ᵢ has one sign, so that yᵢ
is at an end of it; elsewhere Dᵢ is unknown. Centers of the enclosures give v = Ve + …, and so

    |e' − Ce − δ| ≤ R|e| + W|(w/‖P‖, v)|,   C = A + F_x + F_u V,

entry by entry, with W = 0 where D, ∂h/∂u and ∂f/∂u are known.
"""

from typing import NamedTuple

import numpy as np

from .._tree import Tree
from ..programs.slope import TooLarge, Values
from .blocks import Block, as_one_matrix, norms
from .projection_speed import slopes
from .region import Region
from .system import System
from .weights import roots

MAX_UNKNOWNS = 128
"""Largest number of unknowns of x, and of u."""

_SEPARATION = 1e-12
"""Relative distance from which two numbers differ by more than rounding errors."""


class Linearisation(NamedTuple):
    """|e' − Ce − δ| ≤ R|e| + W|g| entry by entry, with ‖g‖ ≤ √2 L‖e‖, and ‖v‖ ≤ gain·‖e‖, in
    coordinates in which norms are Euclidean; `knows_law`: every entry of D is known."""

    C: Values
    R: Values
    W: Values
    L: float
    gain: float
    knows_law: bool

    def rest(self, scales: Values) -> float:
        """Return a bound on ‖S(e' − Ce − δ)‖/‖Se‖ for the diagonal matrix S of these scales."""
        of_x = norm(scales[:, None] * self.R / scales)
        of_law = norm(scales[:, None] * self.W) * np.sqrt(2.0) * self.L / float(np.min(scales))
        return of_x + of_law


def linearisation(system: System, region: Region, L: float) -> Linearisation | None:
    """Return C with its rest over a region that contains both trajectories, or None if x or u is too
    large or an enclosure is infinite. ‖v‖ ≤ L‖e‖ is known."""
    J = system.at(region)
    blocks = system.A, J.f_x, J.f_u, J.h_x, J.h_u, system.P, system.P_inv
    known = [b for b in blocks if b is not None]
    if len(known) < len(blocks) or not all(np.isfinite(b.radius).all() for b in known):
        return None
    try:
        A, f_x, f_u, h_x, h_u, P, P_inv = map(as_one_matrix, known)
    except TooLarge:
        return None
    if max(A.center.shape[1], P.center.shape[1]) > MAX_UNKNOWNS:
        return None
    C, R = (A.plus(f_x)).center[0], f_x.radius[0]
    response = _response(system, region, J.h, P, P_inv, h_x, h_u)
    if response is None:
        W, gain, knows_law = np.abs(f_u.center[0]) + f_u.radius[0], L, False
    else:
        Q, G, T, knows_law = response
        F = f_u.center[0] @ Q
        C, R = C + F @ G.center[0], R + np.abs(F) @ G.radius[0]
        norm_P = norm(P.center[0])
        W = np.hstack([norm_P * (np.abs(F) @ T), f_u.radius[0]])
        own = norm(Q @ G.center[0]) + norm(np.abs(Q) @ G.radius[0])
        gain = min(L, own + norm(np.abs(Q) @ T) * norm_P * L)
    if not all(np.isfinite(v).all() for v in (C, R, W)):
        return None
    return Linearisation(C, R, W, L, float(gain), knows_law)


def _response(
    system: System, region: Region, h: Tree, P: Block, P_inv: Block, h_x: Block, h_u: Block
) -> tuple[Values, Block, Values, bool] | None:
    """Return Q, G and T with |v − QGe| ≤ |Q|T|w| for an enclosed G, and whether D is known; None if K
    is not a box."""
    D = _derivative_of_projection(system, region, h, P)
    if D is None:
        return None
    low, high = D
    eye = Block(np.eye(len(low))[None], np.zeros((1, len(low), len(low))))
    N = eye.plus(h_u, -1.0) @ P_inv
    sizes = np.linalg.svd(N.center[0], compute_uv=False)
    rho = 2.0 / (sizes[0] + sizes[-1])
    diagonal = Block(np.diag(0.5 * (low + high))[None], np.diag(0.5 * (high - low))[None])
    G = (diagonal @ h_x).times(rho)
    product = diagonal @ eye.plus(N.times(rho), -1.0)
    try:
        inverse = np.linalg.inv(eye.center[0] - product.center[0])
    except np.linalg.LinAlgError:
        return None
    return P_inv.center[0] @ inverse, G, product.radius[0], bool((low == high).all())


def _derivative_of_projection(
    system: System, region: Region, h: Tree, P: Block
) -> tuple[Values, Values] | None:
    """Return bounds on the entries of D, or None if K is not a box."""
    root = np.concatenate(roots(system.control, system.u0))
    u_low, u_high = (root * v for v in _ends(region.u))
    h_low, h_high = (root * v for v in _ends(h))
    bounds = system.interval_bounds(region.t)
    if bounds is None:
        return None
    low, high = bounds
    # u is P⁻¹y with rounding errors, which must not look like a distance of y from its bounds.
    size, matrix = np.maximum(np.abs(u_low), np.abs(u_high)), np.abs(P.center[0])
    half = matrix @ (0.5 * (u_high - u_low) + _SEPARATION * size)
    middle = P.center[0] @ (0.5 * (u_low + u_high))
    is_inside = (middle - half > root * low.high) & (middle + half < root * high.low)
    apart = _SEPARATION * (size + np.maximum(np.abs(h_low), np.abs(h_high)))
    is_at_end = (h_low - u_high > apart) | (h_high - u_low < -apart)
    zeros, ones = np.zeros(len(root)), np.ones(len(root))
    return np.where(is_inside & ~is_at_end, ones, zeros), np.where(is_at_end, zeros, ones)


def norm(matrix: Values) -> float:
    """Return ‖matrix‖₂."""
    return float(norms(matrix[None])[0])


def _ends(tree: Tree) -> tuple[Values, Values]:
    """Return the bounds of a tree of intervals as two vectors."""
    leaves = slopes(tree)
    low, high = (
        np.concatenate([getattr(v, end).ravel() for v in leaves]) for end in ("low", "high")
    )
    return low, high
