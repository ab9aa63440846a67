"""The trajectory by SciPy with a hand-written law, without any code of dvax."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.integrate

Array = np.ndarray[Any, Any]
Rate = Callable[[float, Array], Array]
FINEST = 3e-12
"""The smallest relative accuracy that SciPy is asked for."""


class Written(NamedTuple):
    """x' = rate(t, x) on [0, span], smooth in t between the `breaks`; `period` of the data in t, where
    it has one and trajectories approach each other; whether the rate is `stiff`; the relative
    `accuracy` that SciPy is asked for."""

    rate: Rate
    x0: Array
    span: float
    breaks: list[float]
    period: float | None = None
    stiff: bool = False
    accuracy: float = FINEST


class NoReference(Exception):
    """SciPy did not finish, or two of its methods do not agree."""


def solve(written: Written, ts: Array, *, method: str | None = None, refine: int = 1) -> Array:
    """x at the increasing times ts, one row each.

    **Arguments:** `method` of `scipy.integrate.solve_ivp`; `refine`: cut each piece into so many.
    """
    stops = _cut(written.breaks, written.span, refine)
    if written.period is not None and written.span > 3 * written.period:
        return _periodic(written, ts, stops, method)
    return _pieces(written, 0.0, written.x0, stops, ts, method)


def _cut(breaks: list[float], span: float, refine: int) -> Array:
    stops = np.unique(np.concatenate([[0.0, span], [t for t in breaks if 0 < t < span]]))
    # Pieces shorter than this are below the least step of SciPy.
    stops = stops[np.append(True, np.diff(stops) > 1e-12 * span)]
    stops[-1] = span
    fine = [np.linspace(a, b, refine + 1)[1:] for a, b in itertools.pairwise(stops)]
    return np.concatenate([[0.0], *fine])


def _pieces(
    w: Written, begin: float, x: Array, stops: Array, ts: Array, method: str | None
) -> Array:
    """Solve piece by piece: no step crosses a break, and none exceeds a third of a piece."""
    method = method or ("LSODA" if w.stiff else "DOP853")
    # A step ends at every time that is asked for: dense output is less accurate than the steps.
    apart = np.min(np.abs(stops[:, None] - ts[None]), axis=0) > 1e-12 * w.span
    stops = np.union1d(stops, ts[apart & (ts > 0) & (ts < w.span)])
    rows: list[Array] = [x] * int(np.sum(ts <= begin))
    x = np.asarray(x, float)
    for a, b in itertools.pairwise(stops):
        if b <= begin:
            continue
        a = max(a, begin)
        asked = ts[(ts > a) & (ts <= b)]
        # One-sided at the ends: what jumps there is looked at from within.
        inner, outer = a + 1e-12 * (b - a), b - 1e-12 * (b - a)
        rate = lambda t, v, p=inner, q=outer: w.rate(min(max(t, p), q), v)  # noqa: E731
        out = scipy.integrate.solve_ivp(
            rate, (a, b), x, method, t_eval=np.unique(np.append(asked, b)), rtol=w.accuracy,
            atol=0.1 * w.accuracy, max_step=(b - a) / 3,
        )  # fmt: skip
        if out.status != 0 or not np.all(np.isfinite(out.y)):
            raise NoReference(f"{method} on [{a:.17g}, {b:.17g}]: {out.message}")
        rows += list(out.y.T[np.searchsorted(out.t, asked)])
        x = out.y[:, -1]
    return np.array(rows)


def _periodic(w: Written, ts: Array, stops: Array, method: str | None) -> Array:
    """Solve period by period, until the solution is periodic: later periods equal the last."""
    period = w.period
    assert period is not None
    inner = stops[(stops > 0) & (stops < (1.0 - 1e-9) * period)]
    one = np.concatenate([[0.0], inner[np.diff(inner, prepend=0.0) > 1e-9 * period], [period]])
    shifted = w._replace(span=period)
    rows, x = [], np.asarray(w.x0, float)
    index, converged = 0, False
    done = np.floor(ts / period).astype(int)
    while len(rows) < len(ts):
        if converged:
            index = int(done[len(rows)])
        here = ts[len(rows) :][done[len(rows) :] == index] - index * period
        order = np.clip(here, 0.0, period)
        out = _pieces(shifted, 0.0, x, one, np.append(order, period), method)
        rows += list(out[:-1])
        converged = bool(
            np.max(np.abs(out[-1] - x)) <= 0.1 * w.accuracy * (1.0 + np.max(np.abs(x)))
        )
        x, index = out[-1], index + 1
    return np.array(rows)
