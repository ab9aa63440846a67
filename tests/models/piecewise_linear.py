"""An oracle for piecewise linear systems, which proceeds from one switching to the next.

In each regime x' = Mz for z = (x, load, its slope, 1), so that z moves by a matrix exponential; where
an expression cᵀz of the regime falls below zero, another regime begins. scipy finds the moment.
"""

import itertools
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize

Array = np.ndarray


class Regime(NamedTuple):
    """x' = `rate` z, until one of the `exits` (c, name) has cᵀz < 0: then `name` begins."""

    rate: Array
    exits: list[tuple[Array, str]]


class Run(NamedTuple):
    """The states at the times, and when the regime changed."""

    states: Array
    switchings: Array


def follow(
    regimes: dict[str, Regime], first: str, x0: Array, times: Array, load: Array, step: float
) -> Run:
    """From x0 at times[0] through all `times`, between which the load is a line. Signs are looked at
    every `step`, or more often; two switchings within one are not seen, and refused where they show."""
    n = len(x0)
    rates, parts = {}, int(np.ceil(np.max(np.diff(times)) / step))
    for name, regime in regimes.items():
        M = np.zeros((n + 3, n + 3))
        M[:n] = regime.rate
        M[n, n + 1] = 1.0
        rates[name] = M
    flows: dict[tuple[str, float], Array] = {}

    def flow(name: str, h: float) -> Array:
        # Lengths repeat, but for rounding and for what is left behind a switching.
        key = name, round(h, 15)
        if key not in flows:
            flows[key] = scipy.linalg.expm(rates[name] * h)
        return flows[key]

    x, name, states, switchings = np.array(x0, float), first, [np.array(x0, float)], []
    for k, (t0, t1) in enumerate(itertools.pairwise(times)):
        z = np.concatenate([x, [load[k], (load[k + 1] - load[k]) / (t1 - t0), 1.0]])
        t, h = t0, (t1 - t0) / parts
        while t1 - t > 1e-15 * max(abs(t1), h):
            ahead = min(h, t1 - t)
            new = flow(name, ahead) @ z
            out = [(c, to) for c, to in regimes[name].exits if c @ new < 0.0]
            if not out:
                t, z = t + ahead, new
                continue
            moments = [_moment(rates[name], z, c, ahead) for c, _ in out]
            s = min(moments)
            z = scipy.linalg.expm(rates[name] * s) @ z
            t, name = t + s, out[int(np.argmin(moments))][1]
            switchings.append(t)
        x = z[:n]
        states.append(x)
    return Run(np.array(states), np.array(switchings))


def _moment(M: Array, z: Array, c: Array, h: float) -> float:
    """Return the time in [0, h] at which cᵀz becomes negative."""

    def value(s: float) -> float:
        return float(c @ (scipy.linalg.expm(M * s) @ z))

    # Behind a switching the new expression is zero, or rounding, and rises.
    begin = 0.0 if value(0.0) > 0.0 else 1e-6 * h
    assert value(begin) >= 0.0, "two switchings within one step: make it shorter"
    return float(scipy.optimize.brentq(value, begin, h, xtol=1e-15, rtol=1e-14))
