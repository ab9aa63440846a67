"""Shear frames with bilinear columns under an earthquake, solved from yielding to unloading.

The storeys i = 1..n have the drift e, the velocity v of the floor above, and the elastic part s of the
drift. With the stiffness k, the hardening ratio a, the mass m, the damping c m and the yield drift y,

    e_i' = v_i − v_(i−1),    m_i v_i' = Q_(i+1) − Q_i − c m_i v_i − m_i a_g,    Q = a k e + (1 − a) k s,

and s_i' = e_i' until |s_i| reaches y_i. From there on s_i = ±y_i in an elastoplastic column, until
e_i' changes its sign. In a viscoplastic one s_i' = e_i' − (s_i ∓ y_i)/τ, until |s_i| is below y_i
again. In each mode (a sign or 0 for each storey) z = (e, v, s, a_g, its slope, 1) obeys z' = Zz. This
is Steel01 of OpenSees. `switching.follow` solves it in long double; nothing is shared with dvax.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .switching import Mode, follow

Array = np.ndarray


class Frame(NamedTuple):
    """A frame of n storeys from the ground up: vectors of n entries; `hardening` is a, `damping` c."""

    mass: Array
    stiffness: Array
    yield_drift: Array
    damping: float
    hardening: float = 0.0

    @property
    def couplings(self) -> Array:
        """D, with e' = Dv."""
        return np.eye(len(self.mass)) - np.eye(len(self.mass), k=-1)


def oscillator(
    period: float, damping_ratio: float, yield_drift: float, hardening: float = 0.0
) -> Frame:
    """Return a frame of one storey and unit mass."""
    w = 2.0 * np.pi / period
    return Frame(
        np.ones(1), np.array([w * w]), np.array([yield_drift]), 2.0 * damping_ratio * w, hardening
    )


def exact(
    frame: Frame, ground: Array, step: float, ts: Array, tau: float | None = None
) -> tuple[Array, int]:
    """Return (e, v, s) at the times ts, and the number of changes of the mode.

    `ground` has the acceleration every `step` s, linear in between. Without τ the columns are
    elastoplastic.
    """
    modes = {
        signs: _mode(frame, signs, tau)
        for signs in itertools.product((0, 1, -1), repeat=len(frame.mass))
    }
    slopes = np.append(np.diff(ground) / step, 0.0)
    pieces = [
        (k * step, np.array([a, slope, 1.0], np.longdouble))
        for k, (a, slope) in enumerate(zip(ground, slopes, strict=True))
    ]
    return follow(modes, np.zeros(3 * len(frame.mass)), pieces, ts, fewest=10, first=1e-6)


def _mode(frame: Frame, signs: tuple[int, ...], tau: float | None) -> Mode:
    n, a, D = len(frame.mass), frame.hardening, np.asarray(frame.couplings, np.longdouble)
    m, k, y = (
        np.asarray(v, np.longdouble) for v in (frame.mass, frame.stiffness, frame.yield_drift)
    )
    e, v, s = slice(0, n), slice(n, 2 * n), slice(2 * n, 3 * n)
    load, slope, one = 3 * n, 3 * n + 1, 3 * n + 2
    Z = np.zeros((3 * n + 3, 3 * n + 3), np.longdouble)
    Z[e, v] = Z[s, v] = D
    Z[v, e] = -a * D.T * k / m[:, None]
    Z[v, s] = -(1.0 - a) * D.T * k / m[:, None]
    Z[v, v] = -frame.damping * np.eye(n)
    Z[v, load] = -1.0
    Z[load, slope] = 1.0
    conditions, ties = [], []
    for i, sign in enumerate(signs):
        limit = np.zeros(3 * n + 3, np.longdouble)
        limit[2 * n + i], limit[one] = sign or 1.0, -y[i]
        if sign == 0:
            below = limit.copy()
            below[2 * n + i] = -1.0
            conditions += [-limit, -below]
        elif tau is None:
            Z[2 * n + i] = 0.0
            conditions.append(sign * Z[i])
            ties.append(limit)
        else:
            Z[2 * n + i] -= sign * limit / np.longdouble(tau)
            conditions.append(limit)
    separable = tau is not None and tau < 0.02 / float(np.sqrt((k / m).max()))
    fast = tuple(2 * n + i for i, sign in enumerate(signs) if sign) if separable else ()
    return Mode(Z, np.array(conditions), np.array(ties) if ties else None, fast)


def peaks(frame: Frame, states: Array, ground: Callable[[Array], Array], ts: Array) -> Array:
    """Return max |e_i| over all times, from states at evenly spaced ts: between two of them e_i is the
    parabola through e_i with the slope e_i' and the curvature e_i''."""
    n, a = len(frame.mass), frame.hardening
    e, v, s = states[:, :n], states[:, n : 2 * n], states[:, 2 * n :]
    shear = (a * e + (1.0 - a) * s) * frame.stiffness
    acceleration = -shear @ frame.couplings / frame.mass - frame.damping * v - ground(ts)[:, None]
    speed, curvature = v @ frame.couplings.T, acceleration @ frame.couplings.T
    near = np.abs(speed) < np.abs(curvature) * (ts[1] - ts[0])
    tops = np.where(near, e - speed**2 / np.where(near, 2.0 * curvature, 1.0), e)
    return np.abs(tops).max(axis=0)
