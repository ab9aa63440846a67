"""How far an error can get: an ellipsoid that contains it, mapped along a linearisation.

The propagation of errors by e' = Ce + rest + δ is exact for the rest and δ zero. A ball is added for δ,
and the rest is bounded with scaled entries, in which C is balanced: positions and speeds of an
oscillator differ in size, and so do their errors.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from ..programs.slope import Values
from .blocks import norms
from .linearisation import Linearisation, norm

_ROUNDING = 1e-14
"""Relative rounding errors of a product of matrices and of an exponential, for each of their rows."""

_PARTS = 2**14
"""Number of parts of a span in which ‖e^{Cs}‖ is bounded, times the size of C, at most."""

_COUPLING = 1e-3
"""Relative size of the entries that are added to C for its scales, so that none is without limit."""


class ErrorEllipsoid(NamedTuple):
    """Errors e = Bz with ‖z‖ ≤ 1."""

    B: Values

    @classmethod
    def ball(cls, radius: float, n: int) -> "ErrorEllipsoid":
        return cls(np.diag(np.full(n, radius)))

    @property
    def norm(self) -> float:
        """The largest ‖e‖."""
        return norm(self.B) * (1.0 + _ROUNDING * len(self.B))

    def plus(self, other: Values) -> "ErrorEllipsoid":
        """Return an ellipsoid that contains all sums of an error and one of {Mz: ‖z‖ ≤ 1}, M = `other`.

        Of the ellipsoids (1 + 1/p)BBᵀ + (1 + p)MMᵀ it has the smallest trace, with the root
        √tr BBᵀ + √tr MMᵀ: a sum of many sets is too large by √n at most.
        """
        n = len(self.B)
        own, added = (float(np.linalg.norm(v)) for v in (self.B, other))
        if not (np.isfinite(own) and np.isfinite(added)):
            return ErrorEllipsoid.ball(np.inf, n)
        if own == 0.0 or added == 0.0:
            return self if added == 0.0 else ErrorEllipsoid(other)
        parts = np.sqrt(1.0 + added / own) * self.B, np.sqrt(1.0 + own / added) * other
        return ErrorEllipsoid(np.asarray(np.linalg.qr(np.hstack(parts).T, mode="r")).T)

    def plus_ball(self, radius: float) -> "ErrorEllipsoid":
        """Return an ellipsoid that contains all sums of an error and one of norm ≤ `radius`."""
        n = len(self.B)
        rounding = _ROUNDING * n * (radius + float(np.linalg.norm(self.B)))
        return self.plus((radius + rounding) * np.eye(n))


class Propagated(NamedTuple):
    """Bounds of ‖e‖ at given times, and the `largest` up to the last one; an ellipsoid that contains e
    there; the share of e that is due to the rest of the linearisation; and the scales of its norm."""

    bounds: Values
    largest: float
    ellipsoid: ErrorEllipsoid
    share: float
    scales: Values

    def within(self, radius: float) -> ErrorEllipsoid:
        """Return the ellipsoid, or the ball of errors up to `radius` if that is smaller in the scaled
        norm. In another norm a ball may be smaller that soon becomes larger."""
        scaled = ErrorEllipsoid(self.scales[:, None] * self.ellipsoid.B)
        is_smaller = radius * float(self.scales.max()) < scaled.norm
        return ErrorEllipsoid.ball(radius, len(self.scales)) if is_smaller else self.ellipsoid


def propagate(
    linear: Linearisation, start: ErrorEllipsoid, times: Values, integral: Values, late: Values
) -> Propagated:
    """Return what an error in the ellipsoid `start` becomes in these times, in ascending order, with
    disturbances ∫‖δ‖ ≤ `integral` up to each of them and other errors ≤ `late` at them.

    Let ‖e^{Cs}‖ ≤ m and, in the scaled norm ‖S·‖, ≤ m_S. Gronwall's lemma gives
    ‖Se‖ ≤ m_S(‖Se₀‖ + ‖S‖∫‖δ‖)e^{m_S rest t} =: s, and the variation of constants that e(t) − e^{Ct}e₀
    is a sum of two parts, of norm ≤ m∫‖δ‖, or of scaled norm ≤ m_S‖S‖∫‖δ‖, and of scaled norm
    ≤ m_S rest t s.
    """
    C, n, end = linear.C, len(start.B), float(times[-1])
    scales = _scales(C, linear.R)
    least, most = float(scales.min()), float(scales.max())
    scaled = scales[:, None] * C / scales
    rest = linear.rest(scales) + _ROUNDING * n * norm(scaled)
    m, m_scaled = (_largest_exponential(v, end) for v in (C, scaled))
    share = m_scaled * rest * end
    disturbed = integral + _ROUNDING * n * np.linalg.norm(start.B)
    begin = ErrorEllipsoid(scales[:, None] * start.B).norm
    with np.errstate(over="ignore", invalid="ignore"):
        largest = m_scaled * (begin + most * disturbed[-1]) * np.exp(share)
        of_rest = m_scaled * rest * times * largest
        of_balls = m * disturbed
    if 4.0 * m_scaled < m:  # a ball of the scaled norm is longer in some directions
        of_rest, of_balls = of_rest + m_scaled * most * disturbed, np.zeros(len(times))
    different, place = np.unique(times, return_inverse=True)
    mapped = [ErrorEllipsoid(scipy.linalg.expm(C * t) @ start.B) for t in different]
    own, of_balls = np.array([one.norm for one in mapped])[place], of_balls + late
    ellipsoid = mapped[-1].plus(np.diag(of_rest[-1] / scales)).plus_ball(float(of_balls[-1]))
    bounds = own + of_rest / least + of_balls
    return Propagated(bounds, float(largest / least) + float(late.max()), ellipsoid, share, scales)


def _scales(C: Values, R: Values) -> Values:
    """Return scales with which the entries of C and R on both sides of the diagonal are of one size."""
    sizes = np.abs(C) + R
    off = sizes - np.diag(np.diag(sizes))
    largest = float(off.max(initial=0.0))
    if largest == 0.0:
        return np.ones(len(C))
    _, (factors, _) = scipy.linalg.matrix_balance(
        off + _COUPLING * largest * (1.0 - np.eye(len(C))), permute=False, separate=True
    )
    return float(np.max(factors)) / factors


def _largest_exponential(C: Values, end: float) -> float:
    """Return a bound on ‖e^{Cs}‖ for 0 ≤ s ≤ end: the largest one on a grid, between whose points it
    grows at most at the rate of the symmetric part of C."""
    rate = max(float(np.linalg.eigvalsh(0.5 * (C + C.T))[-1]), 0.0)
    parts = int(np.clip(np.ceil(20.0 * rate * end), 1, max(16, _PARTS // len(C) ** 2)))
    powers = [np.eye(len(C))]
    if parts > 1:
        factor = scipy.linalg.expm(C * (end / parts))
        for _ in range(parts - 1):
            powers.append(factor @ powers[-1])
    largest = np.max(norms(np.stack(powers)))
    with np.errstate(over="ignore"):
        return float(largest * np.exp(rate * end / parts))
