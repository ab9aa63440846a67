"""The systems of the work–precision case, each written three times: as a problem of dvax, and with its
law solved by hand in JAX and in NumPy, for tools without laws."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import dvax

PLAIN = dvax.operators.Scaling(1.0)


class Race(NamedTuple):
    """x(0) = x0 up to `end`, where x is `exact`. `field(t, x, lib)` is the right-hand side with the law
    solved by hand; `banded` says that its Jacobian is tridiagonal; `key` is what peers that write
    the law themselves call it."""

    key: str
    name: str
    problem: dvax.Problem
    x0: np.ndarray
    end: float
    exact: np.ndarray
    field: Callable[[Any, Any, Any], Any]
    banded: bool = False

    def error(self, x: Any) -> float:
        """The largest entry of |x − x(end)|."""
        found = np.asarray(x)
        return float(np.max(np.abs(found - self.exact))) if np.isfinite(found).all() else np.inf


def contact() -> Race:
    """C1: one point, saturated, in contact, apart."""

    def field(t: Any, x: Any, lib: Any) -> Any:
        return 3.0 - 1.5 * x - lib.clip((1.0 - 2.0 * x) / 2.0, 0.0, 0.5)

    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=PLAIN, K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: 3.0 - 0.5 * x - u, h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )  # fmt: skip
    first = np.log(1.6) / 1.5
    second = first + 2 * np.log(10 / 9)
    exact = np.array([2.0 - 1.5 * np.exp(-1.5 * (2.0 - second))])
    return Race("contact", "C1, contact", problem, np.array([-1.0]), 2.0, exact, field)


_P = np.array([[2.0, 0.5], [0.5, 1.0]])
_INVERSE = np.linalg.inv(_P)
_TURN = np.array([[-1.0, 2.0], [-2.0, -1.0]])


def moving_box() -> Race:
    """C2: a full P and a box that moves; by hand, the nine faces are tried in turn."""

    def box(t: Any, lib: Any) -> tuple[Any, Any]:
        one = lib.ones_like(t)
        return (
            lib.stack([-5.0 * one, -1.0 + 0.25 * lib.cos(2.0 * t)]),
            lib.stack([1.0 + 0.5 * lib.sin(t), 5.0 * one]),
        )

    def field(t: Any, x: Any, lib: Any) -> Any:
        low, up = box(lib.asarray(t), lib)
        M, q = 1.5 * _INVERSE, -0.2 * x - np.array([4.0, -4.0])
        # With y₁ held or free in turn, y₂ is a clip, and so for the other; the face that satisfies
        # both conditions is the solution.
        best, off = low, np.inf
        for k in (0, 1):
            other = 1 - k
            free = lib.linalg.solve(M, -q)[k] if lib is np else _solved(M, -q, k)
            for value in (low[k], up[k], free):
                partner = lib.clip(-(q[other] + M[other, k] * value) / M[other, other],
                                   low[other], up[other])  # fmt: skip
                y = lib.stack([value, partner] if k == 0 else [partner, value])
                residual = lib.max(lib.abs(y - lib.clip(y - (M @ y + q), low, up)))
                better = residual < off
                best, off = lib.where(better, y, best), lib.where(better, residual, off)
        u = _INVERSE @ best
        return _TURN @ x + np.array([1.0, 0.0]) - np.array([1.0, 0.5]) * u

    problem = dvax.Problem(
        A=dvax.generators.Dense(_TURN), P=dvax.operators.Dense(_P),
        K=lambda t, args: dvax.sets.Box(*box(t, jnp)),
        f=lambda t, x, u, args: jnp.array([1.0, 0.0]) - jnp.array([1.0, 0.5]) * u,
        h=lambda t, x, u, args: 0.2 * x - 0.5 * u + jnp.array([4.0, -4.0]),
    )  # fmt: skip
    return Race(
        "moving_box", "C2, moving box", problem, np.array([0.3, -0.2]), 4.0, _corner(4.0), field
    )


def _solved(M: np.ndarray, right: Any, k: int) -> Any:
    """Entry k of M⁻¹ right, by Cramer's rule."""
    other = 1 - k
    return (M[other, other] * right[k] - M[k, other] * right[other]) / np.linalg.det(M)


def _corner(t: float) -> np.ndarray:
    """C2 in closed form: y rides the corner (upper, lower), so x solves a linear equation."""
    parts = _INVERSE @ np.array([[1.0, 0.5, 0.0], [-1.0, 0.0, 0.25]])
    drive = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) - np.diag([1.0, 0.5]) @ parts
    c0, c1, c2 = drive[0] + 1j * drive[1]
    rate = -1.0 - 2.0j

    def particular(s: float) -> complex:
        wave = lambda c, w: c * np.exp(1j * w * s) / (1j * w - rate)  # noqa: E731
        return (
            -c0 / rate + wave(c1 / 2j, 1) - wave(c1 / 2j, -1) + wave(c2 / 2, 2) + wave(c2 / 2, -2)
        )

    z = particular(t) + np.exp(rate * t) * (0.3 - 0.2j - particular(0.0))
    return np.array([z.real, z.imag])


def shrinking_ball() -> Race:
    """C3: a ball that shrinks onto the state, up to t = 4; one kink, at t = 3."""
    spiral = np.array([[-0.5, -3.0], [3.0, -0.5]])

    def field(t: Any, x: Any, lib: Any) -> Any:
        radius = 0.5 * lib.exp(-0.5 * t)
        norm = lib.sqrt(x @ x)
        return spiral @ x - x * lib.minimum(1.0, radius / norm)

    problem = dvax.Problem(
        A=dvax.generators.Dense(spiral), P=PLAIN,
        K=lambda t, args: dvax.sets.Ball(0.0, 0.5 * jnp.exp(-0.5 * t)),
        f=lambda t, x, u, args: -u, h=lambda t, x, u, args: 2.0 * x - u,
    )  # fmt: skip
    size = 0.5 * np.exp(-1.5) * np.exp(-1.5)
    exact = size * np.array([np.cos(12.0), np.sin(12.0)])
    return Race(
        "shrinking_ball", "C3, shrinking ball", problem, np.array([2.0, 0.0]), 4.0, exact, field
    )


def heat(n: int) -> Race:
    """Heat in a rod with fixed ends and a saturated law at every point, whose free boundaries move;
    second differences, so that all tools solve the same system. The reference is LSODA's at its
    tightest for n ≤ 512, and dvax's own with 16 384 fixed steps beyond."""
    length = np.pi
    width = length / n
    s = (np.arange(n) + 0.5) * width
    first = 1.0 / width**2

    def laplacian(x: Any, lib: Any) -> Any:
        inner = lib.concatenate([-x[:1], x, -x[-1:]])
        return first * (inner[:-2] - 2.0 * x + inner[2:])

    def load(t: Any, lib: Any) -> Any:
        wave = lib.exp(-t) * np.sin(s)
        return 0.2 * wave + lib.clip((1.0 - 1.5 * wave) / 1.5, 0.0, 0.4)

    def field(t: Any, x: Any, lib: Any) -> Any:
        u = lib.clip((1.0 - 1.5 * x) / 1.5, 0.0, 0.4)
        return laplacian(x, lib) + load(t, lib) - 0.2 * x - u

    problem = dvax.Problem(
        A=dvax.generators.Elliptic(n, length, scheme="differences"), P=PLAIN,
        K=dvax.sets.Box(0.0, 0.4), h=lambda t, x, u, args: 1.0 - 1.5 * x - 0.5 * u,
        f=lambda t, x, u, args: load(t, jnp) - 0.2 * x - u,
    )  # fmt: skip
    x0 = np.sin(s) + 0.3 * np.sin(2.0 * s)
    if n <= 512:
        exact = solve_ivp(
            lambda t, x: field(t, x, np), (0.0, 1.0), x0, method="LSODA", rtol=1e-13, atol=1e-13,
            lband=1, uband=1,
        ).y[:, -1]  # fmt: skip
    else:
        exact = np.asarray(
            dvax.solve(problem, x0, 0.0, 1.0, dt=1 / 16384, method=dvax.ETD4RK()).xs[-1]
        )
    return Race("heat", f"heat, n = {n}", problem, x0, 1.0, exact, field, banded=True)
