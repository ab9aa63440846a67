"""Modes (sets of active constraints of y) and the linear equations of each mode.

A mode has a number for each pair (yᵢ, wᵢ): −1 if yᵢ is at its lower bound, 1 if it is at the upper one,
and 0 if yᵢ is free, so that wᵢ = 0. A mode prescribes one member of each pair; the other member must
satisfy inequalities.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from . import radau
from .inputs import Piece
from .oscillations import Oscillation, derivatives, find_oscillations
from .system import LARGEST, Affine

Array = np.ndarray
Mode = tuple[int, ...]

SUM_ROUNDOFF = 32.0 * np.finfo(float).eps
"""Bound on the rounding error of a sum, relative to the sum of the absolute values of its terms."""


class Condition(NamedTuple):
    """The condition sign · (member − bound) ≥ 0 on pair i.

    The member is w if `of_w`, else y. If the condition fails, the pair switches to the number
    `next_state`.
    """

    i: int
    of_w: bool
    sign: float
    bound: float
    to: int


class Factorisation(NamedTuple):
    """The factorised equations of a step of one length.

    `rows` and `columns` are scaling factors, `factors` the LU factors of the scaled matrix.
    `from_start` holds the absolute values of dx/dx₀, dp/dx₀ and dd/dx₀ at the collocation points.
    """

    rows: Array
    columns: Array
    factors: tuple[Array, Array]
    from_start: tuple[Array, Array, Array]


class StepSolution(NamedTuple):
    """The solution of a step: x at the nodes and p at the collocation points.

    `noise_…` bounds the rounding errors of x, p and d. `carried_…` bounds the errors that the error of
    x at the start causes in them.
    """

    x: Array
    p: Array
    noise_x: Array
    noise_p: Array
    noise_d: Array
    carried_x: Array
    carried_p: Array
    carried_d: Array


class Equations:
    """The equations of one mode.

    - `unknown`: a mask of the unknown entries of p;
    - `prescribed_p`, `prescribed_d`: the prescribed values, 0 elsewhere; `prescribed_y`: those of y,
      NaN elsewhere;
    - `conditions`: the inequalities that must hold in this mode;
    - `scales`: the time scales of the mode, about 1/|λ|, in increasing order.
    """

    def __init__(self, system: Affine, mode: Mode, weights: Array):
        self.system, self.mode, self.weights = system, mode, weights
        state = np.array(mode)
        free = state == 0
        self.unknown = free != system.swapped
        u = self.unknown
        y = np.where(state < 0, system.low, np.where(state > 0, system.up, 0.0))
        self.prescribed_y = np.where(free, np.nan, y)
        value = np.where(free, 0.0, y)
        self.prescribed_p = np.where(u, 0.0, value)
        self.prescribed_d = np.where(u, value, 0.0)
        self.conditions = [c for i, s in enumerate(mode) for c in _conditions(system, i, s)]
        M = system.M[np.ix_(u, u)]
        self.inverse = inverse(M)
        of_x = self.inverse @ system.C[u]
        self.eliminated = eliminated = system.A - system.B[:, u] @ of_x
        # Take absolute values after the products: terms of opposite sign may cancel in d.
        self._p_of_x, self._d_of_x = np.abs(of_x), np.abs(system.C - system.M[:, u] @ of_x)
        self._p_of_law = np.abs(self.inverse)
        self._d_of_law = np.abs(system.M[:, u] @ self.inverse)
        spectrum = np.linalg.eigvals(eliminated) if np.isfinite(eliminated).all() else np.zeros(1)
        real, imag = np.real(spectrum), np.imag(spectrum)
        speeds = np.abs(real) / 8.0 + np.abs(imag) / 4.0
        fastest = max(float(speeds.max()), 1e-300)
        self.scales = np.unique(1.0 / speeds[speeds > 1e-20 * fastest])
        self.shortest = 1e-2 / fastest
        pencil = np.block([[system.A, system.B[:, u]], [system.C[u], M]])
        # Other oscillations decay within one or two periods, so steps resolve them.
        light = spectrum[(imag > 4.0 * np.abs(real)) & (imag > 0)]
        self.oscillations = find_oscillations(pencil, len(system.A), light)
        self._reach: dict[float, Array] = {}
        self._factors: dict[float, Factorisation] = {}

    def solve(
        self, h: float, x0: Array, inputs: Array, sizes: Array, x_error: Array
    ) -> StepSolution:
        """Return the solution of a step of length h from x0.

        `inputs` holds (g, q) at the collocation points and `sizes` the sums of the absolute values of
        their terms, which determine their rounding errors. `x_error` bounds the error of x0.
        """
        system, u, s = self.system, self.unknown, radau.STAGES
        n, k = len(x0), int(self.unknown.sum())
        rows, columns, factors, from_start = self._factorised(h)
        g, q = inputs[:, :n], inputs[:, n:]
        A, B, C, M = system.A, system.B[:, u], system.C[u], system.M[np.ix_(u, u)]
        # Solve for x − x0, so that rounding errors of a short step are relative to a small change.
        right = np.zeros((s, n + k))
        right[:, :n] = h * (g + system.B @ self.prescribed_p + A @ x0)
        right[:, n:] = (self.prescribed_d - q - system.M @ self.prescribed_p)[:, u] - C @ x0
        solution = np.zeros((s, n + k))
        # Iterative refinement reduces the error of each equation to the rounding errors of its own
        # terms.
        last = np.inf
        for _ in range(_MAX_REFINEMENTS):
            X, Q = solution[:, :n], solution[:, n:]
            of_x = right[:, :n] - radau.D[1:, 1:] @ X + h * (X @ A.T + Q @ B.T)
            residual = np.hstack([of_x, right[:, n:] - X @ C.T - Q @ M.T])
            change = scipy.linalg.lu_solve(factors, (residual * rows).ravel(), check_finite=False)
            change = change.reshape(s, n + k) * columns
            solution = solution + change
            size = np.abs(solution).max(axis=0)
            size[:n] += np.abs(x0)
            now = float(np.max(np.abs(change).max(axis=0) / np.where(size > 0.0, size, 1.0)))
            if not (_REFINEMENT_TOLERANCE < now < 0.5 * last):
                break
            last = now
        p = np.tile(self.prescribed_p, (s, 1))
        p[:, u] = solution[:, n:]
        x = np.vstack([x0, x0 + solution[:, :n]])
        # Propagate rounding errors of the residual with a few random patterns of signs.
        X, P = np.abs(x[1:]), np.abs(p)
        terms = np.empty((s, n + k))
        terms[:, :n] = np.abs(radau.D[1:, 1:]) @ np.abs(solution[:, :n])
        terms[:, :n] += h * (X @ np.abs(system.A.T) + P @ np.abs(system.B.T) + sizes[:n])
        law_residual = X @ np.abs(system.C.T) + P @ np.abs(system.M.T) + sizes[n:]
        terms[:, n:] = (law_residual + np.abs(self.prescribed_d))[:, u]
        patterns = _SIGN_PATTERNS[: terms.size] * (_ROW_ROUNDOFF * terms * rows).ravel()[:, None]
        noise = scipy.linalg.lu_solve(factors, patterns, check_finite=False)
        noise = noise.reshape(s, n + k, -1) * columns[:, None]
        noise_x, noise_p, noise_d = (v.max(axis=-1) for v in self._sizes(noise))
        carried_x, carried_p, carried_d = (v @ x_error for v in from_start)
        return StepSolution(
            x, p, np.vstack([0.0 * x0, noise_x + _ROW_ROUNDOFF * X]), noise_p, noise_d,
            np.vstack([x_error, carried_x]), carried_p, carried_d,
        )  # fmt: skip

    def _sizes(self, solution: Array) -> tuple[Array, Array, Array]:
        """Return |x|, |p| and |d| at the collocation points from solutions of the equations of a step,
        which are stacked along the last axis."""
        system, u = self.system, self.unknown
        x, free = solution[:, : len(system.A)], solution[:, len(system.A) :]
        p = np.zeros((len(x), len(u), x.shape[-1]))
        p[:, u] = free
        d = system.C @ x + system.M[:, u] @ free
        d[:, u] = 0.0
        return np.abs(x), np.abs(p), np.abs(d)

    def disturbance_gain(self, h: float, B: Array) -> Array:
        """Return |(1/h − A)⁻¹B| entrywise, with p eliminated from A.

        This estimates the change of x within h that disturbances of x' along the columns of B cause.
        """
        if h not in self._reach:
            if len(self._reach) >= _CACHE_SIZE:
                self._reach.clear()
            unit = np.eye(len(self.eliminated))
            self._reach[h] = np.abs(inverse(unit / h - self.eliminated) @ B)
        return self._reach[h]

    def split_oscillations(
        self, x: Array, piece: Piece, begin: float, h: float
    ) -> tuple[list[tuple[complex, Array, Array, Array]], Array]:
        """Return (λ, x, y, w) of the oscillations that a step of length h is too long to resolve, and x
        without them."""
        active = [
            oscillation
            for oscillation in self.oscillations
            if oscillation.rate.imag * h > _MAX_PHASE_PER_STEP
        ]
        parts, x0 = [], x
        if active:
            forcing = derivatives(
                self.forcing(piece.coefficients), begin / piece.length, piece.length
            )
        for oscillation in active:
            a = oscillation.amplitude(x, forcing)
            y, w = self.response(oscillation)
            parts.append((oscillation.rate, a * oscillation.x, a * y, a * w))
            x0 = x0 - 2.0 * parts[-1][1].real
        return parts, x0

    def start_residual(self, x: Array, p: Array, given: Array, h: float, B: Array) -> Array:
        """Return the residual of the state equation at θ = 0, reduced by bounds on its rounding errors.
        `given` holds (g, q) at θ = 0."""
        system, n = self.system, x.shape[1]
        p0 = radau.POINTS_TO_START @ p
        rate = radau.D[0] @ x / h
        terms = np.abs(system.A) @ np.abs(x[0]) + np.abs(system.B) @ np.abs(p0) + np.abs(given[:n])
        slope = np.abs(radau.D[0]) @ np.abs(x) / h
        error = np.abs(rate - system.A @ x[0] - system.B @ p0 - given[:n])
        rounding = _RESIDUAL_ROUNDOFF * (terms + slope)
        law = np.abs(system.M @ p0 + system.C @ x[0] + given[n:] - self.prescribed_d)
        sizes = np.abs(p).max(axis=0)
        noise = _RESIDUAL_ROUNDOFF * (
            np.abs(system.M) @ sizes + np.abs(system.C) @ np.abs(x).max(axis=0) + np.abs(given[n:])
        )
        # Where y is prescribed, use its exact value and count the difference in the state equation.
        is_counted = self.unknown & system.swapped
        of_y = np.where(is_counted, np.maximum(law - noise, 0.0), 0.0)
        return np.maximum(error - rounding, 0.0) + np.abs(B) @ of_y

    def start_error(self, of_x: Array, of_p: Array) -> Array:
        """Return a bound on that residual which errors of x and p cause."""
        return np.abs(self.system.A) @ of_x + np.abs(self.system.B) @ of_p

    def response(self, oscillation: Oscillation) -> tuple[Array, Array]:
        """Return (y, w) of an oscillation of amplitude 1."""
        p = np.zeros(len(self.unknown), complex)
        p[self.unknown] = oscillation.p
        d = self.system.C @ oscillation.x + self.system.M @ p
        d[self.unknown] = 0.0
        return self.members(p, d)

    def forcing(self, coefficients: Array) -> Array:
        """Return the Chebyshev coefficients of (g, r) from those of (g, q)."""
        n = len(self.system.A)
        q = coefficients[:, n:][:, self.unknown]
        forcing = np.hstack([coefficients[:, :n], q])
        forcing[0, :n] += self.system.B @ self.prescribed_p
        forcing[0, n:] += (self.system.M @ self.prescribed_p - self.prescribed_d)[self.unknown]
        return forcing

    def dependent(self, x: Array, p: Array, q: Array) -> Array:
        """Return d from x, p and q, one row per time."""
        d = p @ self.system.M.T + x @ self.system.C.T + q
        d[:, self.unknown] = self.prescribed_d[self.unknown]
        return d

    def law_errors(
        self, x: Array, p: Array, q: Array, x_error: Array, rounding: float = SUM_ROUNDOFF
    ) -> tuple[Array, Array]:
        """Return bounds on the errors of p and d at one t, due to rounding and to the error of x.

        `x`, `p` and `q` are absolute values, and `x_error` bounds the error of x.
        """
        system, u = self.system, self.unknown
        terms = rounding * (np.abs(system.C) @ x + np.abs(system.M) @ p + q)
        of_p = np.zeros(len(u))
        of_p[u] = rounding * p[u] + self._p_of_law @ terms[u] + self._p_of_x @ x_error
        return of_p, terms + self._d_of_law @ terms[u] + self._d_of_x @ x_error

    def members(self, p: Array, d: Array) -> tuple[Array, Array]:
        """Return (y, w) from (p, d)."""
        swapped = self.system.swapped
        return np.where(swapped, d, p), np.where(swapped, p, d)

    def multiplier(self, x: Array, q: Array) -> Array:
        """Return p from x and q by the law."""
        p, u = self.prescribed_p.copy(), self.unknown
        free = self.prescribed_d - q - self.system.C @ x - self.system.M @ p
        p[u] = self.inverse @ free[u]
        return p

    def law_at(self, x: Array, q: Array, sizes: Array, x_error: Array) -> tuple[Array, ...]:
        """Return (y, w) at one x and q, and bounds on their errors.

        `sizes` is the sum of the absolute values of the terms of q, and `x_error` bounds the error of
        x.
        """
        p = self.multiplier(x, q)
        d = self.dependent(x[None], p[None], q[None])[0]
        y, w = self.members(p, d)
        return y, w, *self.members(*self.law_errors(np.abs(x), np.abs(p), sizes, x_error))

    def _factorised(self, h: float) -> Factorisation:
        """Return the factorisation for steps of length h.

        States are scaled by the norm of the state space: pivots chosen among different units (volts and
        amperes) would make the smaller ones inaccurate. Each p and its row are scaled by their largest
        entries.
        """
        if h in self._factors:
            return self._factors[h]
        system, u, s = self.system, self.unknown, radau.STAGES
        n, k = len(system.A), int(self.unknown.sum())
        block = np.block(
            [[-h * system.A, -h * system.B[:, u]], [system.C[u], system.M[np.ix_(u, u)]]]
        )
        rows = np.concatenate([self.weights, np.ones(k)])
        columns = np.concatenate([1.0 / self.weights, np.ones(k)])
        for _ in range(2 if k else 0):
            scaled = np.abs(rows[:, None] * block * columns)
            columns[n:] /= np.maximum(scaled.max(axis=0)[n:], 1e-300)
            scaled = np.abs(rows[:, None] * block * columns)
            rows[n:] /= np.maximum(scaled.max(axis=1)[n:], 1e-300)
        block = rows[:, None] * block * columns
        K = np.zeros((s, n + k, s, n + k))
        states, each = np.arange(n), np.arange(s)
        K[:, states, :, states] = radau.D[1:, 1:]
        K[each, :, each, :] += block
        K = K.reshape(s * (n + k), -1)
        # Equilibrate the rows, so that stiff rows are not chosen as pivots for their size.
        large = 1.0 / np.abs(K).max(axis=1)
        if len(self._factors) >= _CACHE_SIZE:
            self._factors.clear()
        factors = scipy.linalg.lu_factor(large[:, None] * K, check_finite=False)
        rows = rows * large.reshape(s, n + k)
        start = np.zeros((s, n + k, n))
        start[:, states, states] = radau.D[1:, :1] * rows[:, :n]
        start = scipy.linalg.lu_solve(factors, start.reshape(len(K), n), check_finite=False)
        start = start.reshape(s, n + k, n) * columns[:, None]
        factorisation = Factorisation(rows, columns, factors, self._sizes(start))
        self._factors[h] = factorisation
        return factorisation


_ROW_ROUNDOFF = 4.0 * np.finfo(float).eps
"""Rounding error of a row after refinement, relative to the sum of the absolute values of its terms."""

_SIGN_PATTERNS = np.random.default_rng(0).choice([-1.0, 1.0], (2 * LARGEST * radau.STAGES, 4))

_RESIDUAL_ROUNDOFF = 256.0 * np.finfo(float).eps
_MAX_PHASE_PER_STEP = 4.0
"""Largest phase, in radians, of an oscillation in a step whose polynomials resolve it."""

_MAX_REFINEMENTS, _REFINEMENT_TOLERANCE = 6, 1e-14
_CACHE_SIZE = 64
"""Largest number of factorisations that a mode caches: steps between data knots have few lengths."""


def inverse(M: Array) -> Array:
    """Return M⁻¹, or NaN if M is singular."""
    try:
        return np.linalg.inv(M)
    except np.linalg.LinAlgError:
        # The step then fails with NaN. With γ > 0 no mode is singular.
        return np.full_like(M, np.nan)


def _conditions(system: Affine, i: int, state: int) -> list[Condition]:
    low, up = system.low[i], system.up[i]
    if state:
        # If both bounds are equal, w may have any sign.
        return [] if low == up else [Condition(i, True, -float(state), 0.0, 0)]
    conditions = [Condition(i, False, 1.0, low, -1), Condition(i, False, -1.0, up, 1)]
    return [c for c in conditions if np.isfinite(c.bound)]


def initial_mode(system: Affine) -> Mode:
    """Return the mode in which every yᵢ is at its lower bound, else at its upper one, else free."""
    return tuple(
        -1 if np.isfinite(low) else 1 if np.isfinite(up) else 0
        for low, up in zip(system.low, system.up, strict=True)
    )


def mode_after(mode: Mode, condition: Condition) -> Mode:
    """Return the mode that follows when a condition fails."""
    return (*mode[: condition.i], condition.to, *mode[condition.i + 1 :])
