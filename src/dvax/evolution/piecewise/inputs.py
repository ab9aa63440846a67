"""Piecewise polynomial approximation of the inputs g(t) and q(t) of an affine system.

The inputs are analytic between two knots of the data. An interval on which they are linear in t is one
piece. Other intervals are bisected until Chebyshev interpolation has converged, according to the decay
of its coefficients and to its error at check points. The spacing of the points is irregular, so that
aliasing does not turn a wave into a constant.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._tree import Tree
from ...problem import Problem
from ...programs.analytic import complex_radius
from .radau import STAGES

Array = np.ndarray

_POINTS = np.cos(np.pi * (np.arange(STAGES + 1) + 0.5) / (STAGES + 1))
_TO_COEFFICIENTS = np.linalg.inv(np.polynomial.chebyshev.chebvander(_POINTS, STAGES))
_LINE_SAMPLES = np.array([-0.93, -0.5441, 0.0713, 0.4129, 0.8537])
_CHECK_POINTS = np.array([-0.9871, -0.4127, 0.0317, 0.3719, 0.8853])
_ROUNDOFF_FACTOR = 64.0
"""Bound on the rounding error of a sample, in units of eps times the size of t and of the value."""

_SAMPLE_ROUNDOFF = 8.0
"""The same if the code of f and h is exact to a few roundings."""


class Piece(NamedTuple):
    """The polynomial approximation of (g, q) on [start, start + length].

    - `coefficients`: Chebyshev coefficients, one row per degree;
    - `noise`: the uncertainty of each entry due to rounding of t and of the values;
    - `error`: a bound on the largest error if it `is_proved`, else the largest one at the check points.
    """

    start: float
    length: float
    coefficients: Array
    noise: Array
    error: Array
    is_proved: bool = False

    def uncertainty(self) -> Array:
        """Return the error of (g, q), those of the samples and of the evaluation included."""
        of_samples = _SAMPLE_ROUNDOFF / _ROUNDOFF_FACTOR * self.noise
        return self.error + of_samples + _EVALUATION * np.abs(self.coefficients).sum(axis=0)

    def evaluate(self, positions: Array) -> Array:
        """Return (g, q), one row per relative position in [0, 1]."""
        if len(self.coefficients) == 1:
            return np.broadcast_to(self.coefficients[0], (len(positions), self.error.size))
        s = 2.0 * np.asarray(positions) - 1.0
        return np.polynomial.chebyshev.chebval(s, self.coefficients).T

    def local(self, begin: float, length: float, chop: bool = True) -> Array:
        """Return the Chebyshev coefficients of the polynomial on [begin, begin + length] of the piece.

        Coefficients below the roundoff level are dropped if `chop`: on a short interval all
        coefficients of high degree are rounding errors.
        """
        c = self.coefficients
        s, ratio = 2.0 * (begin + 0.5 * length) / self.length - 1.0, length / self.length
        if len(c) <= 2:
            return np.stack([c[0] + s * c[1], ratio * c[1]]) if len(c) == 2 else c
        values = np.polynomial.chebyshev.chebval(s + ratio * _POINTS, c).T
        new = _TO_COEFFICIENTS @ values
        if not chop:
            return new
        significant = np.abs(new) > _CHOP_TOLERANCE * np.abs(c).sum(axis=0)
        degree = int(np.flatnonzero(significant.any(axis=1)).max(initial=1))
        keep = np.where(np.arange(degree + 1)[:, None] < 2, 1.0, significant[: degree + 1])
        return keep * new[: degree + 1]


def values(coefficients: Array, basis: Array) -> Array:
    """Return the values of polynomials at the points of `basis` (one row per point)."""
    return basis[:, : len(coefficients)] @ coefficients


def basis(positions: Array) -> Array:
    """Return the Chebyshev polynomials at positions in [0, 1]: a row per point, a column per degree."""
    return np.polynomial.chebyshev.chebvander(2.0 * positions - 1.0, STAGES)


_EVALUATION = 32.0 * np.finfo(float).eps
"""Rounding error of a value, relative to the sum of the absolute values of the coefficients."""

_CHOP_TOLERANCE = 16.0 * np.finfo(float).eps


class UnresolvedInput(Exception):
    """The approximation of the inputs failed at time `t`.

    `result` names the reason in `dvax.RESULTS`: the inputs are not finite (`nonfinite`), the shortest
    piece is still inaccurate (`step_too_small`), or there are too many pieces (`max_steps`).
    """

    def __init__(self, t: float, result: str):
        super().__init__(t)
        self.t, self.result = t, result


@eqx.filter_jit
def _samples(problem: Problem, args: Any, x: Tree, u: Tree, ts: Any) -> Any:
    return jax.vmap(lambda t: _inputs(problem, args, x, u, t))(ts)


@eqx.filter_jit
def _radii(problem: Problem, args: Any, x: Tree, u: Tree, low: Any, high: Any, length: Any) -> Any:
    """Return bounds on (g, q), up to constants, in discs that contain the ellipses of pieces of this
    length; `low` and `high` are the ends of the real times that decide branches. One row per piece and
    per ρ."""

    def one(low: Any, high: Any, length: Any, rho: Any) -> Any:
        reach = 0.25 * length * (rho + 1.0 / rho)
        return complex_radius(lambda t: _inputs(problem, args, x, u, t), low, high, reach)

    rows = jax.vmap(one, in_axes=(None, None, None, 0))
    ellipses = jnp.asarray(_ELLIPSES, low.dtype)
    return jax.vmap(rows, in_axes=(0, 0, 0, None))(low, high, length, ellipses)


def _inputs(problem: Problem, args: Any, x: Tree, u: Tree, t: Any) -> jax.Array:
    f, h = problem.f(t, x, u, args), problem.h(t, x, u, args)
    return jnp.concatenate([f.ravel(), -h.ravel()])


def build_pieces(
    problem: Problem, stops: Array, x0: Any, args: Any, max_pieces: int, prove: bool = False
) -> list[Piece]:
    """Return pieces that approximate the inputs between the first and the last of `stops`; bounds on
    their errors are proved if `prove` and if the code of f and h shows that the inputs are analytic.

    **Raises:** `UnresolvedInput` where the inputs are not finite, where an interval of a few units of
    roundoff in t is still too long, or where more than `max_pieces` pieces are necessary.
    """
    dtype = jnp.result_type(x0)
    x, u = jnp.zeros_like(x0), problem.zero_control(x0)
    eps = float(jnp.finfo(dtype).eps)

    def sample(starts: Array, lengths: Array, positions: Array) -> Array:
        """Return the values at these positions in every interval: [interval, position, entry]."""
        ts = (starts[:, None] + lengths[:, None] * (0.5 + 0.5 * positions)).ravel()
        padded = _padded(ts)
        values = np.asarray(_samples(problem, args, x, u, jnp.asarray(padded, dtype)), float)
        values = values[: len(ts)].reshape(len(starts), len(positions), -1)
        bad = ~np.isfinite(values).all(axis=(1, 2))
        if bad.any():
            raise UnresolvedInput(float(starts[bad][0]), "nonfinite")
        return values

    accepted: list[Piece] = []
    starts, lengths = stops[:-1], np.diff(stops)
    values = sample(starts, lengths, _LINE_SAMPLES)
    slope = (values[:, -1] - values[:, 0]) / (_LINE_SAMPLES[-1] - _LINE_SAMPLES[0])
    middle = values[:, 0] - _LINE_SAMPLES[0] * slope
    misfit = np.abs(values - middle[:, None] - _LINE_SAMPLES[:, None] * slope[:, None]).max(axis=1)
    ends = np.abs(starts) + lengths
    noise = (
        _ROUNDOFF_FACTOR
        * eps
        * (np.abs(values).max(axis=1) + np.abs(slope) * (ends / lengths)[:, None])
    )
    lines = (misfit <= noise).all(axis=1)
    for k in np.flatnonzero(lines):
        rows = np.stack([middle[k], slope[k]])
        flat = np.all(np.abs(slope[k]) <= noise[k])
        accepted.append(
            Piece(starts[k], lengths[k], rows[:1] if flat else rows, noise[k], 0 * misfit[k])
        )
    starts, lengths = starts[~lines], lengths[~lines]
    positions = np.concatenate([_POINTS, _CHECK_POINTS])
    while len(starts):
        values = sample(starts, lengths, positions)
        nodes, extra = values[:, : STAGES + 1], values[:, STAGES + 1 :]
        c = np.einsum("ij,kjl->kil", _TO_COEFFICIENTS, nodes)
        basis = np.polynomial.chebyshev.chebvander(_CHECK_POINTS, STAGES)
        misfit = np.abs(np.einsum("ij,kjl->kil", basis, c) - extra).max(axis=1)
        slope_size = np.abs(c[:, 1:]).sum(axis=1)
        magnification = ((np.abs(starts) + lengths) / lengths)[:, None]
        noise = _ROUNDOFF_FACTOR * eps * (np.abs(c).sum(axis=1) + slope_size * magnification)
        tail = np.abs(c[:, -3:]).max(axis=1)
        converged = ((misfit <= noise) & (tail <= noise)).all(axis=1)
        error = np.maximum(misfit - noise, 0.0)
        accepted += [
            Piece(starts[k], lengths[k], c[k], noise[k], error[k])
            for k in np.flatnonzero(converged)
        ]
        starts, lengths = starts[~converged], lengths[~converged]
        short = lengths <= 1e3 * eps * (np.abs(starts) + lengths)
        if short.any():
            raise UnresolvedInput(float(starts[short][0]), "step_too_small")
        if len(accepted) + len(starts) > max_pieces:
            raise UnresolvedInput(float(stops[0]), "max_steps")
        half = 0.5 * lengths
        starts = np.stack([starts, starts + half], axis=1).ravel()
        lengths = np.repeat(half, 2)
    pieces = _close_gaps(sorted(accepted, key=lambda piece: piece.start))
    if not prove:
        return pieces
    starts, lengths = (np.array([getattr(p, name) for p in pieces]) for name in ("start", "length"))
    c = np.einsum("ij,kjl->kil", _TO_COEFFICIENTS, sample(starts, lengths, _POINTS))
    # The inputs may have other values at the knots themselves, up to a few roundings of t.
    rounding = _EDGE * eps * (np.abs(starts) + lengths)
    edge = np.minimum(rounding, _MAX_EDGE * lengths)

    def errors(edge: Any) -> Array:
        numbers = starts + edge, starts + lengths - edge, lengths
        padded = (jnp.asarray(_padded(v), dtype) for v in numbers)
        radii = np.asarray(_radii(problem, args, x, u, *padded), float)[: len(pieces)]
        return np.min(_INTERPOLATION[:, None] * radii, axis=1)

    bounds = errors(0.0)
    is_whole = np.all(np.isfinite(bounds), axis=1)
    if not is_whole.all():
        bounds = np.where(np.expand_dims(is_whole, 1), bounds, errors(edge))
    edge = np.where(is_whole, 0.0, edge)
    # Next to a knot, within some roundings of t, the inputs have values of one side or of the other.
    sizes = np.pad(np.abs(c).sum(axis=1), ((1, 1), (0, 0)))
    around = sizes[:-2] + sizes[1:-1] + sizes[2:]
    is_short = ~np.isfinite(bounds) & np.expand_dims(lengths <= 4.0 * rounding, 1)
    bounds = np.where(is_short & (len(pieces) > 1), around, bounds)
    bounds = bounds + 4.0 * np.expand_dims(edge / lengths, 1) * around
    return [_proved(*one) for one in zip(pieces, bounds, c, strict=True)]


def _proved(piece: Piece, of_interpolant: Array, c: Array) -> Piece:
    """Return a piece with a proved error, if that of the polynomial with the coefficients c that
    interpolates the inputs is finite."""
    if not np.isfinite(of_interpolant).all():
        return piece
    apart = c.copy()
    apart[: len(piece.coefficients)] -= piece.coefficients
    return piece._replace(error=of_interpolant + np.abs(apart).sum(axis=0), is_proved=True)


def _padded(values: Array) -> Array:
    """Return values whose number is a power of two, the last one repeated: few shapes are compiled."""
    return np.pad(values, (0, (1 << (len(values) - 1).bit_length()) - len(values)), mode="edge")


_ELLIPSES = np.array([2.0, 3.0, 5.0, 8.0, 13.0, 21.0, 50.0])
"""Values of ρ, the sum of the semiaxes of an ellipse in the complex plane, over half of an interval."""

_INTERPOLATION = 4.0 * _ELLIPSES**-STAGES / (_ELLIPSES - 1.0)
"""The error of interpolation in Chebyshev points, for a function of modulus ≤ 1 in each ellipse."""

_EDGE, _MAX_EDGE = 256.0, 1e-3
"""Length next to a knot that branches of the code are not decided for: roundings of t, and at most this
part of a piece, which is less than the distance of the first Chebyshev point."""


def _close_gaps(pieces: list[Piece]) -> list[Piece]:
    """Return the pieces, made continuous where neighbours differ by no more than their noise.

    The piece with less noise keeps its value, and the other one is corrected by a linear function. (A
    slope_size edge far from t = 0 has large noise, since rounding of t changes its value.)
    """
    changes = np.zeros((len(pieces), 2, len(pieces[0].noise)))
    for k in range(len(pieces) - 1):
        left, right = pieces[k], pieces[k + 1]
        gap = right.evaluate(np.zeros(1))[0] - left.evaluate(np.ones(1))[0]
        agrees = np.abs(gap) <= left.noise + right.noise
        changes[k, 1] = np.where(agrees & (left.noise > right.noise), gap, 0.0)
        changes[k + 1, 0] = np.where(agrees & (left.noise <= right.noise), -gap, 0.0)
    corrected = []
    for piece, (first, last) in zip(pieces, changes, strict=True):
        c = piece.coefficients
        if first.any() or last.any():
            c = np.concatenate([c, np.zeros((max(0, 2 - len(c)), c.shape[1]))])
            c[0] += 0.5 * (first + last)
            c[1] += 0.5 * (last - first)
        corrected.append(piece._replace(coefficients=c))
    return corrected


def is_continuous(before: Piece, after: Piece) -> bool:
    """Return whether the inputs are continuous at the common end of two pieces."""
    end, start = before.evaluate(np.ones(1))[0], after.evaluate(np.zeros(1))[0]
    size = np.abs(before.coefficients).sum(axis=0) + np.abs(after.coefficients).sum(axis=0)
    return bool(np.all(np.abs(end - start) <= 8.0 * _ROUNDOFF_FACTOR * np.finfo(float).eps * size))
