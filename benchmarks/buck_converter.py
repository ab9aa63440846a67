"""The buck converter of the Siconos tutorials with its feedback: data, equations, exact solution.

x = (output V, inductor A, two voltages of the compensator, output V of the amplifier). A comparator
drives the gates of a PMOS and an NMOS transistor, whose characteristics are piecewise linear; their
diodes are ideal, so that the voltage v between them lies between −0.8 V and 3.8 V:

    x' = A x + e₁ v/L + b(t),     V_G = clip(15(r(t) − x₄) + 1.5, 0, 3),
    0 ∈ F(v) + N_[−0.8, 3.8](v),  F(v) = i_L + G(v − 1.5) − I_P(V_G, v) + I_N(V_G, v),
    I_P = φ(1 − V_G) − φ(v − V_G − 2),   I_N = φ(V_G − 2) − φ(V_G − v − 2),   φ(s) = Σ kᵢ (s − sᵢ)₊.

The tutorial has G = 0: with both transistors off F does not depend on v, and the law has no modulus.
The values are those of `examples/electronics/BuckConverter/BuckConverter.cpp`. `problem` states the
system for dvax with a response for each kink, and `exact` solves it with `switching.follow`.
"""

import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np

import dvax

from .switching import Mode, follow

Array = np.ndarray

_C, _L, _LOAD = 22e-6, 10e-6, 10.0
_R11, _R12, _R21, _C11, _C21 = 15.58e3, 227.8e3, 5.613e6, 20e-12, 1.9e-12
_GAIN, _LAG = 1e4, 1.0 / (2.0 * 3.14159 * 30e6)
_PERIOD, _RISE, _TOP, _FALL = 1.6667e-6, 1.655e-6, 1e-9, 10e-9
_SETTLING, _SET_POINT = 100e-6, 1.8
LOWEST, HIGHEST, HALFWAY = -0.8, 3.8, 1.5

_WIDTH = 1.0 / (2.0 * (1.0 + np.sqrt(2.0)))
KINKS = np.array([0.0, (1.0 + np.sqrt(2.0)) * _WIDTH])
SLOPES = 5.0 * np.array([2.0 * _WIDTH, 4.0 * np.sqrt(2.0) * _WIDTH])


def state_matrix() -> Array:
    """Return A."""
    alpha, beta = 1 / _R11 + 1 / _R12 + 1 / _R21, 1 / _R11 + 1 / _R12
    lag1, lag2 = _R11 * _C11, _R21 * _C21
    a1, a2 = 1.0 / (alpha * _R11), 1.0 / (alpha * _R21)
    return np.array([
        [-(1 / (_LOAD * _C) + beta * a2 / _C), 1 / _C, a2 / (_R11 * _C), -beta * a2 / _C,
         beta * a2 / _C],
        [-1 / _L, 0.0, 0.0, 0.0, 0.0],
        [(1 - beta / alpha) / lag1, 0.0, (a1 - 1) / lag1, a2 / lag1, -a2 / lag1],
        [-beta / alpha / lag2, 0.0, a1 / lag2, (a2 - 1) / lag2, (1 - a2) / lag2],
        [-beta / alpha * _GAIN / _LAG, 0.0, a1 * _GAIN / _LAG, a2 * _GAIN / _LAG,
         -(a2 * _GAIN + 1) / _LAG],
    ])  # fmt: skip


def ramp(end: float) -> tuple[Array, Array]:
    """Return the corners of the sawtooth r: times, which reach beyond `end`, and volts."""
    count = int(np.ceil(end / _PERIOD)) + 1
    corners = np.array([0.0, _RISE, _RISE + _TOP, _RISE + _TOP + _FALL])
    times = (_PERIOD * np.arange(count)[:, None] + corners).ravel()
    return times, np.tile([0.0, 2.25, 2.25, 0.0], count)


_SET_POINTS = (
    np.array([0.0, _SETTLING, 2 * _SETTLING, 3 * _SETTLING]),
    np.array([0.0, _SET_POINT, _SET_POINT, 0.0]),
)


def problem(leak: float, end: float) -> dvax.Problem:
    """Return the problem of dvax with G = `leak` (S), for runs until `end` (s).

    The responses are V_G, the four pairs of (s − sᵢ)₊, and v. In the order in which they depend on each
    other F has a triangular derivative except for skew terms, so that F is strongly monotone with the
    weights P. All is affine, as `dvax.PiecewiseLinear` requires.
    """
    D, c, C, e = np.eye(10), np.zeros(10), np.zeros((10, 5)), np.zeros(10)
    D[1:5, 0], D[5:9, 0] = 1.0, -1.0
    D[3:5, 9], D[7:9, 9] = -1.0, 1.0
    D[9, 1:9], D[9, 9] = np.concatenate([-SLOPES, SLOPES, SLOPES, -SLOPES]), leak
    C[0, 4], c[0], e[0] = 15.0, -1.5, -15.0
    for first, threshold in ((1, -1.0), (3, 2.0), (5, 2.0), (7, 2.0)):
        c[first : first + 2] = threshold + KINKS
    C[9, 1], c[9] = 1.0, -HALFWAY * leak
    driving = 4.0 * SLOPES**2 / leak
    P = np.concatenate([[4.0 * driving.sum()], driving, SLOPES, driving, SLOPES, [1.0]])
    low = np.concatenate([np.zeros(9), [LOWEST]])
    high = np.concatenate([[3.0], np.full(8, np.inf), [HIGHEST]])
    sawtooth = dvax.signals.Table(*ramp(end))
    set_point = dvax.signals.Table(*_SET_POINTS)
    B = np.outer(np.eye(5)[1] / _L, np.eye(10)[9])
    into = np.eye(5)[4] * _GAIN / _LAG
    B, D, C, c, e, into = (jnp.asarray(v) for v in (B, D, C, c, e, into))
    return dvax.Problem(
        A=dvax.generators.Dense(jnp.asarray(state_matrix())),
        P=dvax.operators.Diagonal(jnp.asarray(P)),
        K=dvax.sets.Box(low * P, high * P),
        f=lambda t, x, u, args: B @ u + into * set_point(t),
        h=lambda t, x, u, args: u - (D @ u + C @ x + c + e * sawtooth(t)),
    )


def complementarity(step: float, steps: int) -> dict[str, Any]:
    """Return the system of the tutorial, x' = Ax + Bλ + b(t), 0 ≤ Cx + Dλ + e + Fr(t) ⟂ λ ≥ 0, with
    b and r at the ends of `steps` steps of `step` seconds."""
    D = np.eye(12)
    both, second = np.ones(4), np.array([0.0, 0.0, 1.0, 1.0])
    first = 1.0 - second
    D[2:6, 0], D[2:6, 1], D[6:10, 0], D[6:10, 1] = 15.0, -15.0, -15.0, 15.0
    D[2:6, 11], D[6:10, 11] = -second, second
    D[10, 10], D[10, 11], D[11, 10], D[11, 11] = 0.0, -1.0, 1.0, 0.0
    rows = np.concatenate([SLOPES, -SLOPES])
    D[11, 2:6], D[11, 6:10] = -rows, rows
    kinks = np.tile(KINKS, 2)
    e = np.concatenate([
        [-0.1, 0.1], 2.0 * both - 3.0 * first + 0.8 * second + kinks, 2.0 * both - 0.8 * second + kinks,
        [4.6, 0.0],
    ])  # fmt: skip
    C, B = np.zeros((12, 5)), np.zeros((5, 12))
    C[:2, 4], C[11, 1], B[1, 11] = 1.0, 1.0, 1.0 / _L
    times = step * np.arange(1, steps + 1)
    F = np.zeros((12, 1))
    F[:2] = -1.0
    inputs = np.zeros((5, 2))
    inputs[1, 0], inputs[4, 1] = LOWEST / _L, _GAIN / _LAG
    sawtooth = np.interp(times, *ramp(times[-1]))
    return {
        "A": state_matrix().tolist(), "B": B.tolist(), "C": C.tolist(), "D": D.tolist(),
        "e": e.tolist(), "F": F.tolist(), "inputs": inputs.tolist(), "x0": [0.0] * 5,
        "law_values": sawtooth[:, None].tolist(),
        "rate_values": np.stack([np.ones(steps), np.interp(times, *_SET_POINTS)], 1).tolist(),
    }  # fmt: skip


# z = (x, 1, r, r', set point, its slope).
_ONE, _RAMP, _SET, _ALL = 5, 6, 8, 10


class _Law:
    """The modes of the circuit, built as they occur: which pieces of V_G, of each φ and of F hold."""

    def __init__(self, leak: float):
        self.leak, self.modes = leak, {}
        free = np.zeros((_ALL, _ALL))
        free[:5, :5] = state_matrix()
        free[4, _SET] = _GAIN / _LAG
        free[_RAMP, _RAMP + 1] = free[_SET, _SET + 1] = 1.0
        self._free = free

    def _gate(self, z: Array) -> tuple[float, int]:
        raw = 15.0 * (z[_RAMP] - z[4]) + 1.5
        return float(np.clip(raw, 0.0, 3.0)), int(raw > 0.0) + int(raw > 3.0)

    def _hinges(self, gate: Any, v: Any) -> list[Any]:
        """Arguments of (·)₊ in the order of the slopes −, +, +, −, without the kinks."""
        return [1.0 - gate, v - gate - 2.0, gate - 2.0, gate - v - 2.0]

    def _current(self, gate: float, v: float, inductor: float) -> float:
        """F(v)."""
        terms = (SLOPES @ np.maximum(s - KINKS, 0.0) for s in self._hinges(gate, v))
        a, b, c, d = terms
        return float(inductor + self.leak * (v - HALFWAY) - a + b + c - d)

    def _key(self, z: Array) -> tuple[Any, ...]:
        gate, piece = self._gate(z)
        at = lambda v: self._current(gate, v, z[1])  # noqa: E731
        if at(LOWEST) >= 0.0:
            v, place = LOWEST, -1
        elif at(HIGHEST) <= 0.0:
            v, place = HIGHEST, 1
        else:
            # F is piecewise linear: its kinks enclose the root, and between two it is exact.
            corners = np.concatenate([[LOWEST, HIGHEST], gate + 2.0 + KINKS, gate - 2.0 - KINKS])
            corners = np.unique(np.clip(corners, LOWEST, HIGHEST))
            values = np.array([at(v) for v in corners])
            k = int(np.flatnonzero(values < 0.0)[-1])
            share = -values[k] / (values[k + 1] - values[k])
            v, place = float(corners[k] + share * (corners[k + 1] - corners[k])), 0
        above = [tuple(bool(q) for q in s - KINKS > 0.0) for s in self._hinges(gate, v)]
        return piece, place, *above

    def choice(self, z: Array) -> tuple[Any, ...]:
        """Return the mode a moment later: responses are continuous, so one Euler step shows it."""
        before = self.mode(self._key(z))
        return self.add(self._key(z + 1e-16 * before.Z @ z))

    def add(self, key: tuple[Any, ...]) -> tuple[Any, ...]:
        if key not in self.modes:
            self.modes[key] = self.mode(key)
        return key

    def mode(self, key: tuple[Any, ...]) -> Mode:
        piece, place, *above = key
        unit = np.eye(_ALL)
        raw = 15.0 * (unit[_RAMP] - unit[4]) + 1.5 * unit[_ONE]
        gate = (0.0 * raw, raw, 3.0 * unit[_ONE])[piece]
        conditions = [(-raw,), (raw, 3.0 * unit[_ONE] - raw), (raw - 3.0 * unit[_ONE],)][piece]
        # Every hinge is (part without v) + (coefficient) v.
        one = unit[_ONE]
        parts = [(one - gate, 0.0), (-gate - 2.0 * one, 1.0), (gate - 2.0 * one, 0.0),
                 (gate - 2.0 * one, -1.0)]  # fmt: skip
        total, slope = unit[1] - HALFWAY * self.leak * one, self.leak
        for (part, coefficient), on, sign in zip(parts, above, (-1.0, 1.0, 1.0, -1.0)):
            for k in np.flatnonzero(on):
                total = total + sign * SLOPES[k] * (part - KINKS[k] * one)
                slope = slope + sign * SLOPES[k] * coefficient
        if place == 0:
            v = -total / slope
            limits = (v - LOWEST * one, HIGHEST * one - v)
        else:
            v = (LOWEST if place < 0 else HIGHEST) * one
            limits = (-place * (total + slope * v),)
        hinges = [
            (1.0 if on[k] else -1.0) * (part + coefficient * v - KINKS[k] * one)
            for (part, coefficient), on in zip(parts, above)
            for k in range(len(KINKS))
        ]
        Z = self._free.copy()
        Z[1] += v / _L
        # Rows of zeros and constants never change their sign.
        rows = [row for row in (*conditions, *limits, *hinges) if np.any(np.delete(row, _ONE))]
        return Mode(Z, np.array(rows))


def exact(leak: float, ts: Array) -> tuple[Array, int]:
    """Return x at `ts` from rest, and the number of switchings."""
    law, (times, volts) = _Law(leak), ramp(float(ts[-1]))
    corners = np.unique(np.concatenate([times, _SET_POINTS[0]]))
    pieces = []
    for start, stop in itertools.pairwise(corners):
        (r0, r1), (s0, s1) = (
            np.interp([start, stop], *table) for table in ((times, volts), _SET_POINTS)
        )
        length = stop - start
        pieces.append((float(start), np.array([1, r0, (r1 - r0) / length, s0, (s1 - s0) / length])))
    return follow(law.modes, np.zeros(5), pieces, ts, law.choice)
