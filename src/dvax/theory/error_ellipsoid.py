"""How far an error can get: an ellipsoid that contains it, mapped along a linearisation.

The propagation of errors by e' = Ce + rest + δ is exact for the rest and δ zero. A ball is added for δ,
and the rest is bounded with scaled entries, in which C is balanced: positions and speeds of an
oscillator differ in size, and so do their errors.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..programs.slope import Values
from .blocks import eigenvalues, norms
from .linearisation import Linearisation

_ROUNDING = 1e-14
"""Relative rounding errors of a product of matrices and of an exponential, for each of their rows."""

_PARTS = 2**14
"""Number of parts of a span in which ‖e^{Cs}‖ is bounded, times the size of C, at most."""

_SMALL_GROWTH = 0.05
"""Logarithm of a factor of growth that is not worth a closer look."""

_DEGREE = 14
"""Degree of the Taylor polynomial of an exponential, for matrices of norm ≤ 1/2."""

_COUPLING = 1e-3
"""Relative size of the entries that are added to C for its scales, so that none is without limit."""


_INFINITE = np.errstate(over="ignore", invalid="ignore")
"""Bounds may be infinite, or NaN where infinity was multiplied by 0, which stand for no bound."""


class ErrorEllipsoid(NamedTuple):
    """Errors e = Bz with ‖z‖ ≤ 1."""

    B: Values

    @classmethod
    def ball(cls, radius: float, n: int) -> "ErrorEllipsoid":
        return cls(np.diag(np.full(n, radius)))

    @property
    def norm(self) -> float:
        """The largest ‖e‖."""
        return _norm(self.B) * (1.0 + _ROUNDING * len(self.B))

    @_INFINITE
    def plus(self, radius: float, semiaxes: Values = 0.0) -> "ErrorEllipsoid":
        """Return an ellipsoid that contains all sums of an error, of one of norm ≤ `radius`, and of one
        {Mz: ‖z‖ ≤ 1} with M the diagonal matrix of these `semiaxes`.

        With Mᵢ the matrices of the parts and sᵢ = √tr MᵢMᵢᵀ, Σsᵢ ΣMᵢMᵢᵀ/sᵢ contains their sums, and
        has the smallest trace of such ellipsoids, with the root Σsᵢ: a sum of many sets is too large by
        √n at most.
        """
        n = len(self.B)
        rounding = _ROUNDING * n * (radius + float(np.linalg.norm(self.B)))
        parts = [self.B, (radius + rounding) * np.eye(n), semiaxes * np.eye(n)]
        sizes = [float(np.linalg.norm(part)) for part in parts]
        if not np.isfinite(sizes).all():
            return ErrorEllipsoid.ball(np.inf, n)
        whole = sum(sizes)
        scaled = [np.sqrt(whole / s) * M for s, M in zip(sizes, parts, strict=True) if s > 0.0]
        if len(scaled) < 2:
            return ErrorEllipsoid(scaled[0]) if scaled else self
        return ErrorEllipsoid(np.asarray(np.linalg.qr(np.hstack(scaled).T, mode="r")).T)


class Disturbances(NamedTuple):
    """What disturbs x_c at given times, in ascending order: ∫‖δ‖ up to the end of the step of the
    method that contains each time, and up to the start of that step (or twice the first); and the
    norm of `late` errors at the time, which are not propagated."""

    integral: Values
    completed: Values
    late: Values


class Propagated(NamedTuple):
    """Bounds of ‖e‖ at given times, and the `largest` up to the last one; an ellipsoid that contains e
    there; the shares of e that are due to the rest of the linearisation, one for each of its intervals;
    and the scales of its norm."""

    bounds: Values
    largest: float
    ellipsoid: ErrorEllipsoid
    shares: Values
    scales: Values

    @property
    def share(self) -> float:
        """The share of e that is due to the rest on all intervals."""
        return float(self.shares.sum())

    def within(self, radius: float) -> ErrorEllipsoid:
        """Return the ellipsoid, or the ball of errors up to `radius` if that is smaller in the scaled
        norm. In another norm a ball may be smaller that soon becomes larger."""
        scaled = ErrorEllipsoid(self.scales[:, None] * self.ellipsoid.B)
        is_smaller = radius * float(self.scales.max()) < scaled.norm
        return ErrorEllipsoid.ball(radius, len(self.scales)) if is_smaller else self.ellipsoid


@_INFINITE
def propagate(
    linear: Linearisation, start: ErrorEllipsoid, times: Values, ends: Sequence[int],
    disturbed: Disturbances,
) -> Propagated:  # fmt: skip
    """Return what an error in the ellipsoid `start` at time 0 becomes at these times, which ascend.

    `ends`: the numbers of the times at which the intervals of the linearisation end, the last one
    included. On each of them let ‖e^{Cs}‖ ≤ m and, in the scaled norm ‖S·‖, ≤ m_S. Gronwall's lemma
    gives ‖Se‖ ≤ m_S(‖Se₀‖ + ‖S‖∫‖δ‖)e^{m_S rest t} =: s, and the variation of constants that
    e(t) − e^{Ct}e₀ is a sum of two parts, of norm ≤ m∫‖δ‖, or of scaled norm ≤ m_S‖S‖∫‖δ‖, and of
    scaled norm ≤ m_S rest t s.
    """
    n, count = len(start.B), len(times)
    firsts = [0, *(k + 1 for k in ends[:-1])]
    number = np.repeat(np.arange(len(ends)), np.diff([0, *(k + 1 for k in ends)]))
    begins = np.array([0.0, *times[list(ends[:-1])]])
    lengths = times[list(ends)] - begins
    scales = _scales(linear)
    least, most = float(scales.min()), float(scales.max())
    scaled = scales[:, None] * linear.C / scales
    # Exponentials of large matrices are less exact.
    rounding = _ROUNDING * n * max(1.0, float(np.max(norms(linear.C) * lengths)))
    rest = linear.rest(scales) + _ROUNDING * n * norms(scaled)
    m, m_scaled = (_largest_exponentials(v, lengths) for v in (linear.C, scaled))
    shares = m_scaled * rest * lengths
    different, at, place = np.unique(times, return_index=True, return_inverse=True)
    elapsed = different - begins[number[at]]
    maps = _exponentials(linear.C[number[at]] * elapsed[:, None, None])
    bounds, largest = np.zeros(count), 0.0
    ellipsoid, done = start, 0.0
    for j, (first, end) in enumerate(zip(firsts, ends, strict=True)):
        rows = slice(first, end + 1)
        until = elapsed[place[rows]]
        size = float(np.linalg.norm(ellipsoid.B))
        added = np.maximum(disturbed.integral[rows] - done, 0.0) + rounding * size
        begin = ErrorEllipsoid(scales[:, None] * ellipsoid.B).norm
        top = m_scaled[j] * (begin + most * added[-1]) * np.exp(shares[j])
        of_rest = m_scaled[j] * rest[j] * until * top
        of_balls = m[j] * added
        if 4.0 * m_scaled[j] < m[j]:  # a ball of the scaled norm is longer in some directions
            of_rest, of_balls = of_rest + m_scaled[j] * most * added, np.zeros(len(added))
        mapped = {k: ErrorEllipsoid(maps[k] @ ellipsoid.B) for k in set(place[rows])}
        own = np.array([mapped[k].norm for k in place[rows]])
        bounds[rows] = own + of_rest / least + of_balls
        largest = float(np.maximum(largest, top / least))  # NaN included
        ellipsoid = mapped[place[end]].plus(float(of_balls[-1]), of_rest[-1] / scales)
        done = float(disturbed.completed[end])
    late = disturbed.late
    return Propagated(
        bounds + late, largest + float(late.max()), ellipsoid.plus(float(late[-1])),
        shares, scales,
    )  # fmt: skip


def _scales(linear: Linearisation) -> Values:
    """Return scales with which the entries of C and R on both sides of the diagonal are of one size."""
    import scipy.linalg  # a slow import that only this function needs

    sizes = np.mean(np.abs(linear.C) + linear.R, axis=0)
    off = sizes - np.diag(np.diag(sizes))
    largest = float(off.max(initial=0.0))
    if largest == 0.0:
        return np.ones(len(off))
    _, (factors, _) = scipy.linalg.matrix_balance(
        off + _COUPLING * largest * (1.0 - np.eye(len(off))), permute=False, separate=True
    )
    return float(np.max(factors)) / factors


def _largest_exponentials(C: Values, lengths: Values) -> Values:
    """Return a bound on ‖e^{Cs}‖ for 0 ≤ s ≤ length, for each matrix of a stack: the largest one on a
    grid, between whose points it grows at most at the rate of the symmetric part of C."""
    rates = np.maximum(eigenvalues(0.5 * (C + C.swapaxes(1, 2)))[:, -1], 0.0)
    return np.array(
        [
            _on_grid(*one) if one[1] * one[2] > _SMALL_GROWTH else np.exp(one[1] * one[2])
            for one in zip(C, rates, lengths, strict=True)
        ]
    )


def _exponentials(M: Values) -> Values:
    """Return e^M for each matrix of a stack.

    All at once by matrix products: `scipy.linalg.expm` solves a system of equations for each of them,
    and threads make that slow for small ones on a busy machine. The remainder of the Taylor polynomial
    is below the unit roundoff."""
    size = float(np.max(np.abs(M).sum(axis=2), initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(2.0 * size)))) if 0.0 < size < np.inf else 0
    M = M / 2.0**squarings
    found = eye = np.broadcast_to(np.eye(M.shape[1]), M.shape)
    for k in range(_DEGREE, 0, -1):
        found = eye + (M @ found) / k
    for _ in range(squarings):
        found = found @ found
    return found


def _norm(matrix: Values) -> float:
    """Return ‖matrix‖₂."""
    if not np.isfinite(matrix).all():
        return np.inf
    return float(np.linalg.svd(matrix, compute_uv=False)[0])


def _on_grid(C: Values, rate: float, length: float) -> float:
    parts = int(np.clip(np.ceil(20.0 * rate * length), 1, max(16, _PARTS // len(C) ** 2)))
    factor = _exponentials(C[None] * (length / parts))[0]
    powers = [np.eye(len(C))]
    for _ in range(parts - 1):
        powers.append(factor @ powers[-1])
    with np.errstate(over="ignore"):
        return float(np.max(norms(np.stack(powers))) * np.exp(rate * length / parts))
