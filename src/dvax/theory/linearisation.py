"""How errors propagate along a trajectory: by one matrix, and a bound on what it leaves out.

Let e = x_c − x, and v = u_c − u the difference of the responses. By the mean value theorem

    e' = (A + F_x)e + F_u v + δ,

with ∂f/∂x and ∂f/∂u enclosed over a box that contains both trajectories. v follows from e. With
w = P(u_c − u), N = (I − ∂h/∂u)P⁻¹ and any ρ > 0, the law is a projection of y + ρ(h − P⁻¹y), so

    w = D[(I − ρN)w + ρ ∂h/∂x e],   0 ≤ D ≤ 1.

For a polyhedral set `faces` has bounds on D. For a box D is diagonal: Dᵢ = 1 where yᵢ is inside its
interval all the time, and Dᵢ = 0 where (h − u)ᵢ has one sign, so that yᵢ is at an end of it; elsewhere
Dᵢ is unknown. Centers of the enclosures give v = Ve + …, and so

    |e' − Ce − δ| ≤ R|e| + W|(w/‖P‖, v)|,   C = A + F_x + F_u V,

entry by entry, with W = 0 where D, ∂h/∂u and ∂f/∂u are known.
"""

from typing import NamedTuple

import numpy as np

from .. import _tree
from ..programs.slope import TooLarge, Values
from ..sets._conditions import Limits
from .blocks import Block, as_one_matrix, identity, norms
from .faces import Range, derivatives_on_faces
from .local_derivatives import Derivatives
from .system import System
from .weights import roots

MAX_UNKNOWNS = 128
"""Largest number of unknowns of x, and of u."""

_SEPARATION = 1e-12
"""Relative distance from which two numbers differ by more than rounding errors, in double precision."""


class Linearisation(NamedTuple):
    """|e' − Ce − δ| ≤ R|e| + W|g| entry by entry, with ‖g‖ ≤ √2 L‖e‖, and ‖v‖ ≤ gain·‖e‖, in
    coordinates in which norms are Euclidean; `knows_law`: D is known.

    All are stacks, with one entry for each interval of time, but L."""

    C: Values
    R: Values
    W: Values
    L: float
    gain: Values
    knows_law: Values

    def rest(self, scales: Values) -> Values:
        """Return bounds on ‖S(e' − Ce − δ)‖/‖Se‖ for the diagonal matrix S of these scales."""
        of_x = norms(scales[:, None] * self.R / scales)
        of_law = norms(scales[:, None] * self.W) * np.sqrt(2.0) * self.L / float(np.min(scales))
        return of_x + of_law


def linearisation(system: System, J: Derivatives, L: float) -> Linearisation | None:
    """Return C with its rest for derivatives on boxes that contain both trajectories, or None if x or u
    is too large or an enclosure is infinite. ‖v‖ ≤ L‖e‖ is known."""
    f_x, f_u, count = J.f_x, J.f_u, len(J.f_x.center)
    constant = [b for b in (system.A, system.P, system.P_inv) if b is not None]
    finite = all(np.isfinite(b.radius).all() for b in (f_x, f_u, J.h_x, J.h_u, *constant))
    if len(constant) < 3 or not finite:
        return None
    try:
        A, P, P_inv = (_repeated(as_one_matrix(b), count) for b in constant)
    except TooLarge:
        return None
    if max(A.center.shape[1], P.center.shape[1]) > MAX_UNKNOWNS:
        return None
    C, R = (A.plus(f_x)).center, f_x.radius
    response = _response(J, system, P, P_inv)
    if response is None:
        W, gain = np.abs(f_u.center) + f_u.radius, np.full(count, L)
        knows_law = np.zeros(count, bool)
    else:
        Q, G, T, knows_law = response
        F = f_u.center @ Q
        C, R = C + F @ G.center, R + np.abs(F) @ G.radius
        norm_P = norm(P.center[0])
        W = np.concatenate([norm_P * (np.abs(F) @ T), f_u.radius], axis=2)
        own = norms(Q @ G.center) + norms(np.abs(Q) @ G.radius)
        gain = np.minimum(L, own + norms(np.abs(Q) @ T) * norm_P * L)
    if not all(np.isfinite(v).all() for v in (C, R, W)):
        return None
    return Linearisation(C, R, W, L, gain, knows_law)


def _repeated(a: Block, count: int) -> Block:
    """Return a stack of one matrix as one of `count` matrices."""
    return a if len(a.center) == count else Block(*(np.repeat(v, count, axis=0) for v in a))


def _response(
    J: Derivatives, system: System, P: Block, P_inv: Block
) -> tuple[Values, Block, Values, Values] | None:
    """Return Q, G and T with |v − QGe| ≤ |Q|T|w| for an enclosed G, and whether D is known; None if K
    is not a box."""
    derivative = _derivative_of_projection(J, system, P.center[0])
    if derivative is None:
        return None
    D, is_known = derivative
    eye = identity(P)
    N = eye.plus(J.h_u, -1.0) @ P_inv
    sizes = np.linalg.svd(N.center, compute_uv=False)
    rho = (2.0 / (sizes[:, 0] + sizes[:, -1]))[:, None, None]
    G = (D @ J.h_x).times(rho)
    product = D @ eye.plus(N.times(rho), -1.0)
    try:
        inverse = np.linalg.inv(eye.center - product.center)
    except np.linalg.LinAlgError:
        return None
    # The inverse is rounded.
    rest = np.abs(eye.center - inverse @ (eye.center - product.center))
    T = product.radius + np.abs(eye.center - product.center) @ rest
    return P_inv.center @ inverse, G, T, is_known


def _derivative_of_projection(
    J: Derivatives, system: System, P: Values
) -> tuple[Block, Values] | None:
    """Return D for each box, and whether it is known; None if K has no rule."""
    root = np.concatenate(roots(system.control, system.u0))
    separation = max(_SEPARATION, 64.0 * float(np.finfo(_tree.dtype(system.u0)).eps))
    if system.rows is None and J.limits:
        low, high = _entries_on_box(J, (J.limits[0], J.limits[1]), root, separation, P)
        center, radius = 0.5 * (low + high), 0.5 * (high - low)
        eye = np.eye(len(root))
        return Block(center[:, :, None] * eye, radius[:, :, None] * eye), (low == high).all(axis=1)
    if system.rows is None:
        return None
    u, h = (Range(root * v.low, root * v.high) for v in (J.u, J.h))
    center, half = u.image(P)
    y, force = Range(center - half, center + half), Range(h.low - u.high, h.high - u.low)
    limits = Limits(*J.limits)
    return derivatives_on_faces(system.rows / root, limits, y, force, separation)


def _entries_on_box(
    J: Derivatives, ends: tuple[Range, Range], root: Values, separation: float, P: Values
) -> tuple[Values, Values]:
    """Return bounds on the entries of D for a box, with a row for each box of u and h."""
    (u_low, u_high), (h_low, h_high) = ((root * v.low, root * v.high) for v in (J.u, J.h))
    low, high = ends
    # u is P⁻¹y with rounding errors, which must not look like a distance of y from its bounds.
    size = np.maximum(np.abs(u_low), np.abs(u_high))
    half = (0.5 * (u_high - u_low) + separation * size) @ np.abs(P).T
    middle = (0.5 * (u_low + u_high)) @ P.T
    is_inside = (middle - half > root * low.high) & (middle + half < root * high.low)
    apart = separation * (size + np.maximum(np.abs(h_low), np.abs(h_high)))
    is_at_end = (h_low - u_high > apart) | (h_high - u_low < -apart)
    return np.where(is_inside & ~is_at_end, 1.0, 0.0), np.where(is_at_end, 0.0, 1.0)


def norm(matrix: Values) -> float:
    """Return ‖matrix‖₂."""
    return float(norms(matrix[None])[0])
