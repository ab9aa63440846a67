"""How far the polynomials of a step are from a solution: a bound on the defect, rounding included.

A step has polynomials X and Y in place of x and y, plus oscillations in closed form. The bound does
not ask how they were found. In the mode of a step let F be the free entries. With z = M_FF⁻¹ w_F, the
response Y − z satisfies w_F = 0, and differs from Y by rounding errors. The defect of the state
equation is δ = x_c' − Ax_c − B(Y − z) − g, for the one of three trajectories x_c that has the smallest
bound:

- x_c = X: then δ − Bz is a polynomial. But the derivative of X has large rounding errors;
- x_c = x₀ + ∫(AX + BY + g): then δ − Bz = A(X − x_c), which is large where A is;
- x_c is the solution of the mode: then δ = 0, and X − x_c is propagated by the mode. This is small
  where Bz is large and decays fast, as a current through a small resistance.

Where a step begins, x_c jumps by X − x_c, whose sum over all steps belongs to the defect.

The response is a solution of the law, up to what its entries violate of the conditions of the mode. A
violation of y is a distance of y from K, and one of w perturbs the law.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.polynomial import chebyshev

from . import radau
from .inputs import Piece, basis
from .modes import Equations, inverse
from .system import Affine

Array = np.ndarray
Wave = tuple[complex, Array, Array]
"""λ and the parts in x and in y of an oscillation, at the start of a step."""

_EPS = float(np.finfo(float).eps)
_SUM = 32.0 * _EPS
"""Rounding error of a sum over all degrees, relative to the sum of the absolute values."""

_DERIVATIVE = np.stack(
    [
        np.pad(chebyshev.chebder(row), (0, radau.STAGES + 1))[: radau.STAGES + 1]
        for row in np.eye(radau.STAGES + 1)
    ],
    axis=1,
)
_INTEGRAL = np.stack(
    [
        np.pad(chebyshev.chebint(row, lbnd=-1), (0, radau.STAGES + 2))[: radau.STAGES + 2]
        for row in np.eye(radau.STAGES + 1)
    ],
    axis=1,
)
_SIGNS = (-1.0) ** np.arange(radau.STAGES + 2)


def _products() -> Array:
    """Return ∫ TⱼT_k dθ over [0, 1], for the Chebyshev polynomials of 2θ − 1."""
    j, k = np.ogrid[: radau.STAGES + 1, : radau.STAGES + 1]

    def mean(n: Array) -> Array:
        even = n % 2 == 0
        return np.where(even, 1.0 / (1.0 - np.where(even, n, 0.0) ** 2), 0.0)

    return 0.5 * (mean(j + k) + mean(np.abs(j - k)))


_PRODUCTS = _products()


class Norms(NamedTuple):
    """The norms of the unit vectors of x and of y, which are orthogonal."""

    x: Array
    y: Array


class Polynomials(NamedTuple):
    """The part [0, `used`] of a step of an original system: Chebyshev coefficients of x, y and (g, q)
    there, one row for each degree; its waves, its mode, and its length."""

    x: Array
    y: Array
    inputs: Array
    waves: tuple[Wave, ...]
    length: float

    @classmethod
    def of(
        cls, x: Array, ys: Array, waves: tuple[Wave, ...], used: float, length: float,
        piece: Piece, begin: float, prescribed: Array,
    ) -> "Polynomials":  # fmt: skip
        """Return the part of a step that begins at `begin` of a piece and has the `length` in all, from
        the values of x at the nodes and of y at the collocation points; y is `prescribed` where that is
        not NaN."""
        thetas = used * radau.EXTREMES
        c_x = radau.COEFFICIENTS @ radau.state_at(x, thetas)
        c_y = radau.COEFFICIENTS @ radau.multiplier_at(ys, thetas)
        is_free = np.isnan(prescribed)
        c_y = np.where(is_free, c_y, 0.0)
        c_y[0] = np.where(is_free, c_y[0], prescribed)
        waves = tuple((rate, v, np.where(is_free, w, 0.0)) for rate, v, w in waves)
        inputs = piece.local(begin, used * length, chop=False)
        inputs = np.pad(inputs, ((0, radau.STAGES + 1 - len(inputs)), (0, 0)))
        return cls(c_x, c_y, inputs, waves, used * length)

    def size(self) -> Array:
        """Return a bound on |x|, which also bounds what an evaluation sums."""
        return np.abs(self.x).sum(axis=0) + sum(2.0 * np.abs(v) for _, v, _ in self.waves)

    def boxes(self, thetas: Array) -> Array:
        """Return bounds (low, high) on (x, y) between consecutive ones of these θ of the part, whose
        ends are 0 and 1: a row for each interval."""
        both = np.hstack([self.x, self.y])
        rows = [np.zeros((0, 2, both.shape[1]))]
        for first in range(0, len(thetas) - 1, _CHUNK):
            low, high = thetas[first : first + _CHUNK + 1][:-1], thetas[first + 1 :][:_CHUNK]
            at = low[:, None] + (high - low)[:, None] * radau.EXTREMES
            values = chebyshev.chebvander(2.0 * at - 1.0, radau.STAGES) @ both
            c = np.einsum("jk,ikl->jil", radau.COEFFICIENTS, values)
            middle, half = c[0], np.abs(c[1:]).sum(axis=0) + 2.0 * _SUM * np.abs(both).sum(axis=0)
            for rate, of_x, of_y in self.waves:
                v, length = 2.0 * np.concatenate([of_x, of_y]), (high - low)[:, None] * self.length
                at_middle = np.exp(rate * self.length * 0.5 * (low + high))[:, None] * v
                reach = np.minimum(0.5 * abs(rate) * length, 1.0) * np.abs(v)
                is_short = 0.5 * abs(rate) * length < 1.0
                middle = middle + np.where(is_short, at_middle.real, 0.0)
                half = half + reach * (1.0 + _SUM)
            rows.append(np.stack([middle - half, middle + half], axis=1))
        return np.concatenate(rows)


_CHUNK = 256
"""Number of intervals whose boxes are computed at once."""


class StepDefect(NamedTuple):
    """Bounds on ∫‖δ‖ and on the integrated perturbation of the law over a step, and on the distance of
    a computed x in it from x_c."""

    state: float
    law: float
    of_row: float


@np.errstate(over="ignore", invalid="ignore")  # a defect may be infinite
def step_defect(
    system: Affine, equations: Equations, norms: Norms, part: Polynomials, start: Array, end: Array,
    input_error: Array,
) -> StepDefect:  # fmt: skip
    """Return the defect of a step of the original `system` from x = `start` to x = `end`. The mode is
    that of the `equations`; `input_error` bounds the errors of the polynomials of (g, q)."""
    sizes = system.sizes
    n, m = system.B.shape
    unit = (n + m + 8.0) * _EPS
    of_g, of_q = input_error[:n], input_error[n:]
    g, q = part.inputs[:, :n], part.inputs[:, n:]
    terms = _sum(part.x) @ sizes.A.T + _sum(part.y) @ sizes.B.T + _sum(g)
    rate = part.x @ system.A.T + part.y @ system.B.T + g
    of_oscillations, jumps = np.zeros(n), np.zeros(n)
    first, last = start, end
    for rate_of, v, w in part.waves:
        size = abs(rate_of) * np.abs(v) + sizes.A @ np.abs(v) + sizes.B @ np.abs(w)
        of_oscillations += 2.0 * (np.abs(rate_of * v - system.A @ v - system.B @ w) + unit * size)
        first = first - 2.0 * np.real(v)
        last = last - 2.0 * np.real(np.exp(rate_of * part.length) * v)
        jumps += (16.0 + abs(rate_of) * part.length) * _EPS * np.abs(v)
    law = _Law.of(system, equations, part, q, of_q, unit)
    beside, no_distance = of_oscillations + of_g, np.zeros(n)
    of_polynomial = _of_polynomial(norms, part, rate, unit * terms, first, last)
    of_integral, apart = _of_integral(system, norms, part, rate, unit * terms, first, last)
    charged = []
    for total, distance in ((of_polynomial.total, no_distance), (of_integral, apart)):
        z, columns = law.correction(np.abs(system.C) @ distance)
        of_z = np.abs(columns).sum(axis=1)
        charged.append((total + part.length * norm(norms.x, beside + of_z), distance, z))
    if min(charged, key=lambda found: found[0])[0] > 4.0 * of_polynomial.jumps:
        _, columns = law.correction(np.zeros(m))
        columns = np.hstack([columns, np.diag(of_polynomial.largest + beside)])
        propagated = _propagated(system, law, norms, part.length, columns, unit)
        total = propagated.of_columns + propagated.largest * of_polynomial.jumps
        distance = total / norms.x
        charged.append((total, distance, law.correction(np.abs(system.C) @ distance)[0]))
    row = sum((abs(r) * part.length * np.abs(v) for r, v, _ in part.waves), part.size())
    of_start, of_row = norm(norms.x, jumps), norm(norms.x, _SUM * row)
    found = []
    for state, distance, z in sorted(charged, key=lambda one: one[0]):
        of_state, of_law = law.violations(norms, distance, z)
        at_row = of_row + norm(norms.x, distance)
        found.append(StepDefect(state + of_start + of_state, of_law, at_row))
        if of_law == 0.0:
            break
    gain = _gain(system, norms) if len(found) > 1 else 0.0
    return min(found, key=lambda one: one.state + gain * one.law)


def _gain(system: Affine, norms: Norms) -> float:
    """Return by how much a perturbation of the law changes x', at most, up to rounding."""
    M = norms.y[:, None] * system.M / norms.y
    least = float(np.linalg.eigvalsh(0.5 * (M + M.T))[0])
    return float(np.linalg.norm(norms.x[:, None] * system.B / norms.y, 2)) / max(least, 1e-300)


class _OfPolynomial(NamedTuple):
    """The defect of X: ∫‖δ‖ and jumps in `total`, the largest entries of |δ|, and the `jumps` alone."""

    total: float
    largest: Array
    jumps: float


def _of_polynomial(
    norms: Norms, part: Polynomials, rate: Array, rounding: Array, first: Array, last: Array
) -> _OfPolynomial:
    """Return the defect of X itself, with the jumps at its ends."""
    c, scale = part.x, 2.0 / part.length
    residual = scale * (_DERIVATIVE @ c) - rate
    rounding = rounding + _SUM * scale * (_DERIVATIVE @ np.abs(c)).sum(axis=0)
    squares = np.einsum("ki,kj,ji->i", residual, _PRODUCTS, residual)
    mean = np.sqrt(np.maximum(norms.x**2 @ np.maximum(squares, 0.0), 0.0)) * (1.0 + 1e-12)
    jumps = 0.0
    for row, value in ((c * _SIGNS[:-1, None], first), (c, last)):
        at_end, error = _running(row)
        jumps += norm(norms.x, np.abs(at_end - value) + error + _EPS * np.abs(value))
    total = part.length * (mean + norm(norms.x, rounding)) + jumps
    return _OfPolynomial(float(total), _sum(residual) + rounding, jumps)


def _of_integral(
    system: Affine, norms: Norms, part: Polynomials, rate: Array, rounding: Array, first: Array,
    last: Array,
) -> tuple[float, Array]:  # fmt: skip
    """Return the defect of x₀ + ∫(AX + BY + g), with its jump at the end, and its distance from X."""
    half = 0.5 * part.length
    own = half * (_INTEGRAL @ rate)
    own_size = half * (np.abs(_INTEGRAL) @ np.abs(rate))
    apart = np.pad(part.x, ((0, 1), (0, 0))) - own
    apart[0] -= first
    distance = np.abs(apart).sum(axis=0) + _SUM * own_size.sum(axis=0)
    distance += 2.0 * _EPS * (np.abs(part.x).sum(axis=0) + np.abs(first))
    at_end, error = _running(own)
    jump = np.abs((first + at_end) - last) + error + _SUM * own_size.sum(axis=0)
    jump += _EPS * (np.abs(first) + np.abs(last))
    total = part.length * norm(norms.x, np.abs(system.A) @ distance + rounding)
    return float(total + norm(norms.x, jump)), distance


def law_rounding(system: Affine, x: Array, y: Array, q: Array) -> Array:
    """Return a bound on the rounding errors of My + Cx + q."""
    sizes, unit = system.sizes, (sum(system.B.shape) + 8.0) * _EPS
    return unit * (np.abs(y) @ sizes.M.T + np.abs(x) @ sizes.C.T + np.abs(q))


class _Law(NamedTuple):
    """The law of a step in its mode: w with its rounding `error`, its waves and a mask of the free
    entries."""

    system: Affine
    equations: Equations
    part: Polynomials
    w: Array
    waves: list[tuple[complex, Array]]
    error: Array
    free: Array

    @classmethod
    def of(
        cls,
        system: Affine,
        equations: Equations,
        part: Polynomials,
        q: Array,
        of_q: Array,
        unit: float,
    ) -> "_Law":
        """Return the law, with errors `of_q` of q."""
        sizes = system.sizes
        w = part.y @ system.M.T + part.x @ system.C.T + q
        error = law_rounding(system, *(_sum(v) for v in (part.x, part.y, q))) + of_q
        waves = []
        for rate, of_x, of_y in part.waves:
            error = error + 2.0 * unit * (sizes.M @ np.abs(of_y) + sizes.C @ np.abs(of_x))
            waves.append((rate, system.M @ of_y + system.C @ of_x))
        return cls(system, equations, part, w, waves, error, np.array(equations.mode) == 0)

    def correction(self, more: Array) -> tuple[Array, Array]:
        """Return a bound on |z|, with `more` errors of w, and columns of which Bz is a combination with
        coefficients from [−1, 1]."""
        z, columns, free = np.zeros(len(self.free)), np.zeros((len(self.system.A), 0)), self.free
        if free.any():
            residual = sum((2.0 * np.abs(v) for _, v in self.waves), _sum(self.w))
            residual = (residual + self.error + more)[free]
            M, size = (v[np.ix_(free, free)] for v in (self.system.M, self.system.sizes.M))
            approximate, B = inverse(M), self.system.B[:, free]
            rest = _rest(M, size, approximate, residual)
            z[free] = np.abs(approximate) @ residual + rest
            columns = np.hstack([(B @ approximate) * residual, rest * B])
        return z, columns

    def violations(self, norms: Norms, apart: Array, z: Array) -> tuple[float, float]:
        """Return what distances of y from K add to the defect of the state, and the integrated
        perturbation of the law. `apart`: a bound on |X − x_c|."""
        system, part = self.system, self.part
        of_w = self.error + np.abs(system.C) @ apart + np.abs(system.M) @ z
        outside, perturbed = np.zeros(len(z)), np.zeros(len(z))
        waves_y = [(rate, v) for rate, _, v in part.waves]
        for c in self.equations.conditions:
            i = c.i
            member, waves = (self.w, self.waves) if c.of_w else (part.y, waves_y)
            row = c.sign * member[:, i]
            row[0] -= c.sign * c.bound
            slack = (of_w if c.of_w else z)[i] + _SUM * (np.abs(row).sum() + abs(c.bound))
            moving = [
                radau.Wave(rate * part.length, c.sign * v[i]) for rate, v in waves if v[i] != 0.0
            ]
            (perturbed if c.of_w else outside)[i] += part.length * _violation(row, moving, slack)
        columns = lambda weights, matrix: np.sqrt((weights**2) @ matrix**2)  # noqa: E731
        state = columns(norms.x, system.B) @ outside
        law = norms.y @ perturbed + columns(norms.y, system.M) @ outside
        return float(state), float(law)


class _Propagation(NamedTuple):
    """Bounds on the sum of ∫‖e^{Cs}b‖ for columns b, over the length of a step, and on the largest
    ‖e^{Cs}‖, for the matrix C of its mode."""

    of_columns: float
    largest: float


@np.errstate(over="ignore", invalid="ignore")
def _propagated(
    system: Affine, law: _Law, norms: Norms, length: float, columns: Array, unit: float
) -> _Propagation:
    """On [s, 2s] the norm of e^{Cs}b is at most that at s, times the growth of the symmetric part."""
    free, scale = law.free, norms.x
    approximate = inverse(system.M[np.ix_(free, free)])
    similar = lambda matrix: scale[:, None] * matrix / scale  # noqa: E731
    C = similar(system.A - system.B[:, free] @ approximate @ system.C[free])
    rounding = unit * similar(
        system.sizes.A + system.sizes.B[:, free] @ np.abs(approximate) @ system.sizes.C[free]
    )
    if not np.isfinite(C).all():
        return _Propagation(np.inf, np.inf)
    size = float(np.linalg.norm(C)) * length
    halvings = max(0, int(np.ceil(np.log2(max(size, 1e-300)))) + 2)
    growth = max(float(np.linalg.eigvalsh(0.5 * (C + C.T))[-1]), 0.0)
    b = scale[:, None] * columns
    s = length * 0.5**halvings
    first = sum(np.linalg.norm(b, axis=0)) * s * np.exp(growth * s)
    factor, of_columns, largest = scipy.linalg.expm(C * s), float(first), float(np.exp(growth * s))
    error = float(np.linalg.norm(rounding)) + len(C) * 32.0 * _EPS * float(np.linalg.norm(C))
    for _ in range(halvings):
        more = np.exp(growth * s)
        at = np.linalg.norm(factor @ b, axis=0) + s * error * largest**2 * np.linalg.norm(b, axis=0)
        of_columns += float(at.sum()) * s * more
        here = float(np.linalg.norm(factor, 2)) + s * error * largest**2
        largest = max(largest, here * more)
        factor, s = factor @ factor, 2.0 * s
    return _Propagation(of_columns, largest)


def _rest(M: Array, size: Array, approximate: Array, residual: Array) -> float:
    """Return a bound on the entries of (M⁻¹ − N)r for an approximate inverse N and all |r| ≤
    `residual`. The terms of M have this `size` in all."""
    with np.errstate(invalid="ignore", over="ignore"):
        left = np.abs(np.eye(len(M)) - approximate @ M)
        left += (len(M) + 8.0) * _EPS * (np.abs(approximate) @ size)
        share = float(left.sum(axis=1).max())
        largest = float((np.abs(approximate) @ residual).max())
        return share / (1.0 - share) * largest if share < 0.5 else np.inf


def _violation(row: Array, waves: list[radau.Wave], slack: float) -> float:
    """Return a bound on the mean of max(slack − f, 0) over [0, 1] for the function f with these
    Chebyshev coefficients and waves."""
    swing = sum(2.0 * abs(wave.amplitude) for wave in waves)
    if row[0] - np.abs(row[1:]).sum() - swing >= slack:
        return 0.0
    on_grid = _ON_GRID @ row
    if radau.lowest(on_grid) - swing >= slack:
        return 0.0
    f = radau.Sum(on_grid, waves)
    a, b = np.zeros(1), np.ones(1)
    for _ in range(_MAX_DIVISIONS):
        # Only the intervals that are not proved to exceed the slack are divided.
        ends = a[:, None] + (b - a)[:, None] * _PARTS
        a, b = ends[:, :-1].ravel(), ends[:, 1:].ravel()
        low, _ = f.bounds(a, b)
        keep = low < slack
        a, b, violation = a[keep], b[keep], slack - low[keep]
        if not 0 < len(a) <= _MAX_INTERVALS:
            break
    return float((b - a) @ violation)


_ON_GRID = basis(radau.GRID)
_MAX_DIVISIONS, _MAX_INTERVALS, _PARTS = 12, 32, np.linspace(0.0, 1.0, 17)


def _running(c: Array) -> tuple[Array, Array]:
    """Return the sums of the rows, the smallest first, and bounds on their rounding errors."""
    partial = np.cumsum(c[::-1], axis=0)
    return partial[-1], _EPS * np.abs(partial).sum(axis=0)


def _sum(c: Array) -> Array:
    return np.abs(c).sum(axis=0)


def norm(weights: Array, v: Array) -> float:
    """Return the norm of v = Σ vᵢeᵢ, where the unit vectors eᵢ have the norms `weights`."""
    return float(np.sqrt(np.sum((weights * v) ** 2)))
