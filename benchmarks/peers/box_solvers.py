"""Affine inequalities on boxes as a user would solve them with scipy, in JAX by hand, or with PATH."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .affine_boxes import Affine

Solve = Callable[[], np.ndarray]


def scipy_root(p: Affine, tol: float) -> Solve:
    """MINPACK's hybrid Powell method on y − clip(y − F(y)) with its exact Jacobian: what
    `scipy.optimize.root` takes by default. No solver of scipy's knows a bound on both F and y.

    **Raises:** `RuntimeError` where it ends above the tolerance.
    """
    from scipy.optimize import root

    M, q, lower, upper = p.M[0], p.q[0], p.lower[0], p.upper[0]
    one = np.eye(len(q))

    def map_and_slope(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        z = y - (M @ y + q)
        free = ((z > lower) & (z < upper))[:, None]
        return y - np.clip(z, lower, upper), np.where(free, M, one)

    def solve() -> np.ndarray:
        found = root(map_and_slope, np.zeros(len(q)), jac=True, tol=tol)
        # At an exact 0 it reports that it makes no progress: its residual decides.
        if np.linalg.norm(found.fun) > tol:
            raise RuntimeError(f"scipy.optimize.root failed: {found.message}")
        return found.x

    return solve


def extragradient(p: Affine, tol: float) -> Solve:
    """The method as its textbook has it in a jitted `lax.while_loop`, with the best fixed step of
    its proof, 1/(√2 L), L = ‖M‖ known beforehand; it stops at ‖y − clip(y − F(y))‖ ≤ tol."""
    step = float(1.0 / (np.sqrt(2.0) * np.linalg.norm(p.M[0], 2)))
    data = [jnp.asarray(part[0]) for part in p[:4]]

    @jax.jit
    def run(M: Any, q: Any, lower: Any, upper: Any) -> Any:
        F = lambda y: M @ y + q  # noqa: E731
        onto = lambda z: jnp.clip(z, lower, upper)  # noqa: E731

        def advance(state: Any) -> Any:
            y, Fy, _ = state
            new = onto(y - step * F(onto(y - step * Fy)))
            Fnew = F(new)
            return new, Fnew, jnp.linalg.norm(new - onto(new - Fnew))

        start = jnp.zeros_like(q)
        state = (start, F(start), jnp.asarray(jnp.inf))
        return lax.while_loop(lambda s: s[2] > tol, advance, state)[0]

    return lambda: np.asarray(run(*data))


def path(p: Affine) -> tuple[Callable[[], float], Callable[[], np.ndarray]] | str:
    """(seconds of one solve as PATH reports them, its answer) through GAMSPy, or why not."""
    try:
        import gamspy
    except ImportError:
        return "gamspy is not installed, through which PATH is called"
    n = len(p.q[0])
    names = [f"i{k}" for k in range(n)]
    box = gamspy.Container()
    i = gamspy.Set(box, "i", records=names)
    j = gamspy.Alias(box, "j", i)
    M = gamspy.Parameter(box, "M", domain=[i, i], records=p.M[0])
    q = gamspy.Parameter(box, "q", domain=[i], records=p.q[0])
    y = gamspy.Variable(box, "y", domain=[i])
    F = gamspy.Equation(box, "F", type="nonbinding", domain=[i])
    F[i] = gamspy.Sum(j, M[i, j] * y[j]) + q[i] == gamspy.Number(0)
    lower = gamspy.Parameter(box, "lo", domain=[i], records=p.lower[0])
    upper = gamspy.Parameter(box, "up", domain=[i], records=p.upper[0])
    y.lo[i], y.up[i] = lower[i], upper[i]
    model = gamspy.Model(box, "box", problem="MCP", matches={F: y})

    def seconds() -> float:
        # From the same start each time, or it would begin at its own answer.
        y.l[i] = 0.0
        model.solve(solver="path")
        time = model.total_solver_time
        if time is None:
            raise RuntimeError("PATH returned no time")
        return float(time)

    def answer() -> np.ndarray:
        seconds()
        return np.asarray(y.records["level"], float)

    try:
        answer()
    except gamspy.exceptions.GamspyException as reason:
        # The demonstration licence has a largest size.
        return f"PATH did not run: {str(reason).strip().splitlines()[-1]}"
    return seconds, answer
