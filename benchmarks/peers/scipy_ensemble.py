"""C1 for one load after the other by SciPy, in the processes of a pool. Without JAX, so that they start
soon."""

import numpy as np
from scipy.integrate import solve_ivp

METHODS = ("RK45", "LSODA", "DOP853")


def ends(method: str, loads: list[float], tol: float) -> list[float]:
    """Return x(2) from x(0) = −1 for each load, the law solved by hand in plain Python."""
    found = []
    for load in loads:

        def field(t: float, x: np.ndarray, load: float = load) -> list[float]:
            value = float(x[0])
            return [load - 1.5 * value - min(max(0.5 - value, 0.0), 0.5)]

        run = solve_ivp(field, (0.0, 2.0), [-1.0], method=method, rtol=tol, atol=1e-3 * tol)
        found.append(float(run.y[0, -1]))
    return found
