"""Modes: which constraints of y are active, and what the equations prescribe in each.

A mode has a number for each pair (yᵢ, wᵢ): −1 where yᵢ is at its lower bound, 1 at the upper one, and 0
where it is free, so that wᵢ = 0. Of each pair a mode prescribes one member; what has a sign to keep is
the other one.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from . import radau
from .inputs import Piece
from .rings import Ring, derivatives, rings
from .system import LARGEST, Affine

Array = np.ndarray
Mode = tuple[int, ...]

ROUNDINGS = 32.0 * np.finfo(float).eps
"""What rounding may do to a sum, relative to the sum of the sizes of its terms."""


class Condition(NamedTuple):
    """sign · (member − bound) ≥ 0 of pair i; where it fails the pair goes on in the state `to`."""

    i: int
    of_w: bool
    sign: float
    bound: float
    to: int


class Factors(NamedTuple):
    """Scales of rows and columns, LU factors of the scaled equations of a step, and the sizes of what
    x, p and d at the collocation points have of x at the start."""

    rows: Array
    columns: Array
    factors: tuple[Array, Array]
    from_start: tuple[Array, Array, Array]


class Solved(NamedTuple):
    """x at the nodes and p at the collocation points; by how much rounding may change them and d; and
    by how much what x may be off by at the start."""

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

    `prescribed_p` and `prescribed_d` hold the prescribed values (0 elsewhere), `unknown` says where p
    is unknown; `scales` are the time scales of the mode, 1/|λ| in effect, from the shortest to the
    longest.
    """

    def __init__(self, system: Affine, mode: Mode, weights: Array):
        self.system, self.mode, self.weights = system, mode, weights
        state = np.array(mode)
        free = state == 0
        self.unknown = free != system.swapped
        u = self.unknown
        y = np.where(state < 0, system.low, np.where(state > 0, system.up, 0.0))
        value = np.where(free, 0.0, y)
        self.prescribed_p = np.where(u, 0.0, value)
        self.prescribed_d = np.where(u, value, 0.0)
        self.conditions = [c for i, s in enumerate(mode) for c in _conditions(system, i, s)]
        M = system.M[np.ix_(u, u)]
        self.inverse = inverse(M)
        of_x = self.inverse @ system.C[u]
        self.eliminated = eliminated = system.A - system.B[:, u] @ of_x
        # Products before sizes: a large change of p may leave d as it is.
        self._p_of_x, self._d_of_x = np.abs(of_x), np.abs(system.C - system.M[:, u] @ of_x)
        self._p_of_law = np.abs(self.inverse)
        self._d_of_law = np.abs(system.M[:, u] @ self.inverse)
        spectrum = np.linalg.eigvals(eliminated) if np.isfinite(eliminated).all() else np.zeros(1)
        real, imag = np.real(spectrum), np.imag(spectrum)
        speeds = np.abs(real) / 8.0 + np.abs(imag) / 4.0
        fastest = max(float(speeds.max()), 1e-300)
        self.scales = np.unique(1.0 / speeds[speeds > 1e-20 * fastest])
        self.shortest = 1e-2 / fastest
        whole = np.block([[system.A, system.B[:, u]], [system.C[u], M]])
        # Others are damped within a period or two, and not worth the trouble.
        light = spectrum[(imag > 4.0 * np.abs(real)) & (imag > 0)]
        self.rings = rings(whole, len(system.A), light)
        self._reach: dict[float, Array] = {}
        self._factors: dict[float, Factors] = {}

    def solve(self, h: float, x0: Array, inputs: Array, sizes: Array, off: Array) -> Solved:
        """A step of length h from x0, which is `off` by so much, for `inputs` (g, q) at the collocation
        points, which are sums of terms of these `sizes`."""
        system, u, s = self.system, self.unknown, radau.STAGES
        n, k = len(x0), int(self.unknown.sum())
        rows, columns, factors, from_start = self._factorised(h)
        g, q = inputs[:, :n], inputs[:, n:]
        A, B, C, M = system.A, system.B[:, u], system.C[u], system.M[np.ix_(u, u)]
        # For x − x0, so that the rounding of a short step is that of a small change.
        right = np.zeros((s, n + k))
        right[:, :n] = h * (g + system.B @ self.prescribed_p + A @ x0)
        right[:, n:] = (self.prescribed_d - q - system.M @ self.prescribed_p)[:, u] - C @ x0
        found = np.zeros((s, n + k))
        # Refined until the errors of each equation are the rounding of its own terms.
        last = np.inf
        for _ in range(_REFINED):
            X, Q = found[:, :n], found[:, n:]
            of_x = right[:, :n] - radau.D[1:, 1:] @ X + h * (X @ A.T + Q @ B.T)
            residual = np.hstack([of_x, right[:, n:] - X @ C.T - Q @ M.T])
            change = scipy.linalg.lu_solve(factors, (residual * rows).ravel(), check_finite=False)
            change = change.reshape(s, n + k) * columns
            found = found + change
            size = np.abs(found).max(axis=0)
            size[:n] += np.abs(x0)
            now = float(np.max(np.abs(change).max(axis=0) / np.where(size > 0.0, size, 1.0)))
            if not (_ACCURATE < now < 0.5 * last):
                break
            last = now
        p = np.tile(self.prescribed_p, (s, 1))
        p[:, u] = found[:, n:]
        x = np.vstack([x0, x0 + found[:, :n]])
        # The rounding of the residual, with a few patterns of signs, as it is at different points.
        X, P = np.abs(x[1:]), np.abs(p)
        terms = np.empty((s, n + k))
        terms[:, :n] = np.abs(radau.D[1:, 1:]) @ np.abs(found[:, :n])
        terms[:, :n] += h * (X @ np.abs(system.A.T) + P @ np.abs(system.B.T) + sizes[:n])
        of_law = X @ np.abs(system.C.T) + P @ np.abs(system.M.T) + sizes[n:]
        terms[:, n:] = (of_law + np.abs(self.prescribed_d))[:, u]
        patterns = _SIGNS[: terms.size] * (_ROW * terms * rows).ravel()[:, None]
        noise = scipy.linalg.lu_solve(factors, patterns, check_finite=False)
        noise = noise.reshape(s, n + k, -1) * columns[:, None]
        noise_x, noise_p, noise_d = (v.max(axis=-1) for v in self._sizes(noise))
        carried_x, carried_p, carried_d = (v @ off for v in from_start)
        return Solved(
            x, p, np.vstack([0.0 * x0, noise_x + _ROW * X]), noise_p, noise_d,
            np.vstack([off, carried_x]), carried_p, carried_d,
        )  # fmt: skip

    def _sizes(self, found: Array) -> tuple[Array, Array, Array]:
        """|x|, |p| and |d| at the collocation points from solutions of the equations of a step, stacked
        along the last axis."""
        system, u = self.system, self.unknown
        x, free = found[:, : len(system.A)], found[:, len(system.A) :]
        p = np.zeros((len(x), len(u), x.shape[-1]))
        p[:, u] = free
        d = system.C @ x + system.M[:, u] @ free
        d[:, u] = 0.0
        return np.abs(x), np.abs(p), np.abs(d)

    def reach(self, h: float, B: Array) -> Array:
        """Sizes of the entries of (1/h − A)⁻¹B, A that of the states alone: what disturbances of x' by
        the columns of B do to x within h."""
        if h not in self._reach:
            if len(self._reach) >= _KEPT:
                self._reach.clear()
            unit = np.eye(len(self.eliminated))
            self._reach[h] = np.abs(inverse(unit / h - self.eliminated) @ B)
        return self._reach[h]

    def ringing(
        self, x: Array, piece: Piece, begin: float, h: float
    ) -> tuple[list[tuple[complex, Array, Array, Array]], Array]:
        """(λ, x, y, w) of the oscillations that a step is too long to follow, and what is left of x."""
        active = [ring for ring in self.rings if ring.rate.imag * h > _FOLLOWED]
        found, x0 = [], x
        if active:
            forcing = derivatives(
                self.forcing(piece.coefficients), begin / piece.length, piece.length
            )
        for ring in active:
            a = ring.amplitude(x, forcing)
            y, w = self.responses(ring)
            found.append((ring.rate, a * ring.x, a * y, a * w))
            x0 = x0 - 2.0 * found[-1][1].real
        return found, x0

    def residuals(
        self, x: Array, p: Array, given: Array, h: float, B: Array
    ) -> tuple[Array, Array]:
        """Of the equations of x' and of those that prescribe d, at θ = 0, less what is rounding."""
        system, n = self.system, x.shape[1]
        p0 = radau.START @ p
        rate = radau.D[0] @ x / h
        terms = np.abs(system.A) @ np.abs(x[0]) + np.abs(system.B) @ np.abs(p0) + np.abs(given[:n])
        slope = np.abs(radau.D[0]) @ np.abs(x) / h
        off = np.abs(rate - system.A @ x[0] - system.B @ p0 - given[:n])
        rounding = _ROUNDING * (terms + slope)
        law = np.abs(system.M @ p0 + system.C @ x[0] + given[n:] - self.prescribed_d)
        sizes = np.abs(p).max(axis=0)
        noise = _ROUNDING * (
            np.abs(system.M) @ sizes + np.abs(system.C) @ np.abs(x).max(axis=0) + np.abs(given[n:])
        )
        law = np.where(self.unknown, np.maximum(law - noise, 0.0), 0.0)
        # Where y is prescribed it is taken to be so exactly, and the state's equation is off instead.
        of_y = np.where(system.swapped, law, 0.0)
        state = np.maximum(off - rounding, 0.0) + np.abs(B) @ of_y
        return state, law - of_y

    def start_residual(self, of_x: Array, of_p: Array) -> Array:
        """What errors of x and p make of the equations of x'."""
        return np.abs(self.system.A) @ of_x + np.abs(self.system.B) @ of_p

    def responses(self, ring: Ring) -> tuple[Array, Array]:
        """(y, w) of an oscillation of amplitude 1."""
        p = np.zeros(len(self.unknown), complex)
        p[self.unknown] = ring.p
        d = self.system.C @ ring.x + self.system.M @ p
        d[self.unknown] = 0.0
        return self.members(p, d)

    def forcing(self, coefficients: Array) -> Array:
        """The Chebyshev coefficients of (g, r) from those of (g, q)."""
        n = len(self.system.A)
        q = coefficients[:, n:][:, self.unknown]
        found = np.hstack([coefficients[:, :n], q])
        found[0, :n] += self.system.B @ self.prescribed_p
        found[0, n:] += (self.system.M @ self.prescribed_p - self.prescribed_d)[self.unknown]
        return found

    def dependent(self, x: Array, p: Array, q: Array) -> Array:
        """d from x, p and q, rows of times."""
        d = p @ self.system.M.T + x @ self.system.C.T + q
        d[:, self.unknown] = self.prescribed_d[self.unknown]
        return d

    def noise(
        self, x: Array, p: Array, q: Array, off: Array, rounding: float = ROUNDINGS
    ) -> tuple[Array, Array]:
        """What is undetermined of p and of d at one t, for values of these sizes, by rounding and by
        what x is `off` by."""
        system, u = self.system, self.unknown
        terms = rounding * (np.abs(system.C) @ x + np.abs(system.M) @ p + q)
        of_p = np.zeros(len(u))
        of_p[u] = rounding * p[u] + self._p_of_law @ terms[u] + self._p_of_x @ off
        return of_p, terms + self._d_of_law @ terms[u] + self._d_of_x @ off

    def members(self, p: Array, d: Array) -> tuple[Array, Array]:
        """(y, w) from (p, d)."""
        swapped = self.system.swapped
        return np.where(swapped, d, p), np.where(swapped, p, d)

    def multiplier(self, x: Array, q: Array) -> Array:
        """p from x and q, by the law alone."""
        p, u = self.prescribed_p.copy(), self.unknown
        free = self.prescribed_d - q - self.system.C @ x - self.system.M @ p
        p[u] = self.inverse @ free[u]
        return p

    def at(self, x: Array, q: Array, sizes: Array, off: Array) -> tuple[Array, ...]:
        """(y, w) at one x and q, and their noise, where q is a sum of terms of these `sizes`."""
        p = self.multiplier(x, q)
        d = self.dependent(x[None], p[None], q[None])[0]
        y, w = self.members(p, d)
        return y, w, *self.members(*self.noise(np.abs(x), np.abs(p), sizes, off))

    def _factorised(self, h: float) -> Factors:
        """Those of a step of this length.

        States are measured by their energy, since pivots that compare volts with amperes would spoil
        the smaller ones, and each p and its row by their largest entries."""
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
        # Rows that are stiff have large entries, and are not to be the pivots for that.
        large = 1.0 / np.abs(K).max(axis=1)
        if len(self._factors) >= _KEPT:
            self._factors.clear()
        factors = scipy.linalg.lu_factor(large[:, None] * K, check_finite=False)
        rows = rows * large.reshape(s, n + k)
        start = np.zeros((s, n + k, n))
        start[:, states, states] = radau.D[1:, :1] * rows[:, :n]
        start = scipy.linalg.lu_solve(factors, start.reshape(len(K), n), check_finite=False)
        start = start.reshape(s, n + k, n) * columns[:, None]
        found = Factors(rows, columns, factors, self._sizes(start))
        self._factors[h] = found
        return found


_ROW = 4.0 * np.finfo(float).eps
"""Rounding of a row of a refined solution, relative to the sum of the sizes of its terms."""

_SIGNS = np.random.default_rng(0).choice([-1.0, 1.0], (2 * LARGEST * radau.STAGES, 4))

_ROUNDING = 256.0 * np.finfo(float).eps
_FOLLOWED = 4.0
"""Radians of an oscillation in a step, up to which its polynomials follow it."""

_REFINED, _ACCURATE = 6, 1e-14
_KEPT = 64
"""Factorisations that a mode keeps: steps between the knots of a record have few lengths."""


def inverse(M: Array) -> Array:
    try:
        return np.linalg.inv(M)
    except np.linalg.LinAlgError:
        # No mode of a law with γ > 0: the equations of a step will say so.
        return np.full_like(M, np.nan)


def _conditions(system: Affine, i: int, state: int) -> list[Condition]:
    low, up = system.low[i], system.up[i]
    if state:
        # Between equal bounds w may have any sign.
        return [] if low == up else [Condition(i, True, -float(state), 0.0, 0)]
    found = [Condition(i, False, 1.0, low, -1), Condition(i, False, -1.0, up, 1)]
    return [c for c in found if np.isfinite(c.bound)]


def first_mode(system: Affine) -> Mode:
    """Every yᵢ at a bound where it has one."""
    return tuple(
        -1 if np.isfinite(low) else 1 if np.isfinite(up) else 0
        for low, up in zip(system.low, system.up, strict=True)
    )


def changed(mode: Mode, condition: Condition) -> Mode:
    """The mode after a condition has failed."""
    return (*mode[: condition.i], condition.to, *mode[condition.i + 1 :])
