"""How the projection onto a polyhedral set changes, on boxes that its argument does not leave.

Let K = {y : low ≤ R y ≤ high}, y = proj_K(z) and s = z − y ∈ N_K(y), and let both be enclosed.

- A row that is nowhere near its bounds is never active. Let S have all others.
- If the rows of S are independent, s = R_Sᵀμ determines μ. A row with μₖ ≠ 0 everywhere is always
  active, and so is an equation. Let W have these rows.

Let E_S and E_W be the orthogonal projections onto the null spaces of the rows. Take two points z. For
the differences p of y and q of s: E_W p = p, E_S q = 0 and ⟨p, q⟩ ≥ 0. With Π = E_W − E_S it follows
that ⟨Πp, Πq⟩ = ⟨p, q⟩. So there is a symmetric X with 0 ≤ X ≤ Π and X(p + q) = Πp, namely
X = Πp(Πp)ᵀ/⟨Πp, p + q⟩. Hence p = D(p + q) with D = E_S + X, which is E_W if S = W, and otherwise

    |D − ½(E_S + E_W)|ᵢⱼ ≤ ½ dᵢ dⱼ,   dᵢ² = Πᵢᵢ.
"""

from typing import NamedTuple

import numpy as np

from ..programs.slope import Values
from ..sets._conditions import Limits
from .blocks import Block

_RANK, _ZERO = 1e-6, 1e-14
"""Smallest singular value of rows of length one that count as independent, and largest one of rows that
count as dependent. In between D is not known."""

_ROUNDINGS = 64.0
"""Roundings of the entries of D, of R y and of μ."""


class Range(NamedTuple):
    """Values between two arrays."""

    low: Values
    high: Values

    def image(self, matrix: Values) -> tuple[Values, Values]:
        """Return the center and the half width of the image of each row under a matrix."""
        center, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        return center @ matrix.T, half @ np.abs(matrix).T


def derivatives_on_faces(
    R: np.ndarray, limits: Limits, y: Range, force: Range, eps: float
) -> tuple[Block, np.ndarray]:
    """Return D for each box of y, of a multiple of s and of the limits of R y, which are rows of
    bounds, and whether it is known.

    All are in coordinates in which the norm of the space is Euclidean. `eps` is the relative error of
    y and of s."""
    lengths = np.linalg.norm(R, axis=1)
    lengths[lengths == 0.0] = 1.0
    R = R / lengths[:, None]
    low, high, width = (Range(v.low / lengths, v.high / lengths) for v in limits)
    center, half = y.image(R)
    size = np.maximum(np.abs(y.low), np.abs(y.high)) @ np.abs(R).T
    bound = sum(
        np.where(np.isfinite(v), np.abs(v), 0.0) for v in (low.low, low.high, high.low, high.high)
    )
    half = half + _ROUNDINGS * eps * (size + bound)
    maybe = (center + half >= high.low) | (center - half <= low.high)
    is_equation = (width.low == 0.0) & (width.high == 0.0)
    found = [
        _derivative(R[may], equation[may], Range(*ends), eps)
        for may, equation, *ends in zip(maybe, is_equation, force.low, force.high, strict=True)
    ]
    D, radius, known = (np.stack(parts) for parts in zip(*found, strict=True))
    return Block(D, radius), known


def _derivative(
    rows: Values, is_equation: np.ndarray, force: Range, eps: float
) -> tuple[Values, Values, bool]:
    """Return D with its radius, and whether it is known, for the rows that may be active."""
    n = rows.shape[1]
    rounding = np.full((n, n), _ROUNDINGS * float(np.finfo(float).eps))
    if not len(rows):
        return np.eye(n), 0.0 * rounding, True
    certain = is_equation.copy()
    if len(rows) <= n and np.linalg.svd(rows, compute_uv=False)[-1] > _RANK:
        mu, half = force.image(np.linalg.pinv(rows.T))
        size = np.maximum(np.abs(force.low), np.abs(force.high))
        half = half + _ROUNDINGS * eps * np.linalg.norm(size) / _RANK
        certain |= np.abs(mu) > half
    inner, outer = _null_space(rows, _ZERO), _null_space(rows[certain], _RANK)
    part = np.maximum(np.diag(outer - inner), 0.0)
    if part.sum() < 0.5:  # the rank of Π
        return outer, rounding, True
    d = np.sqrt(part)
    return 0.5 * (inner + outer), 0.5 * np.outer(d, d) + rounding, False


def _null_space(rows: Values, rank: float) -> Values:
    """Return the orthogonal projection onto the null space of rows, those with singular values above
    `rank`."""
    eye = np.eye(rows.shape[1])
    if not len(rows):
        return eye
    _, sizes, V = np.linalg.svd(rows, full_matrices=False)
    V = V[sizes > rank]
    return eye - V.T @ V
