"""The contact law in scipy, the clip written into the right-hand side."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..contact_law import ContactLaw


def solver(law: ContactLaw, method: str, t1: float) -> Callable[[float], Any]:
    """rtol -> x(t1) by `scipy.integrate.solve_ivp`, with atol a thousandth of rtol.

    One point is plain Python arithmetic: on arrays of one entry, numpy's own calls would be most of
    the time.

    **Raises:** `RuntimeError` where scipy reports failure.
    """
    from scipy.integrate import solve_ivp

    a, d_u, b_x, capacity, ell = law.alpha + law.d_x, law.d_u, law.b_x, law.capacity, law.ell
    share, demand = 1.0 / (1.0 + law.b_u), float(law.g[0])

    def point(t: float, x: Any) -> tuple[float]:
        value = float(x[0])
        u = min(max((demand - b_x * value) * share, 0.0), capacity)
        return (ell - a * value - d_u * u,)

    def field(t: float, x: np.ndarray) -> np.ndarray:
        return law.slope(x)

    start = np.full(law.g.shape, law.x0)
    slope = point if law.g.size == 1 else field

    def solve(rtol: float) -> np.ndarray:
        answer = solve_ivp(slope, (0.0, t1), start, method=method, rtol=rtol, atol=1e-3 * rtol)
        if not answer.success:
            raise RuntimeError(f"scipy {method} at rtol {rtol:g} failed: {answer.message}")
        return answer.y[:, -1]

    return solve
