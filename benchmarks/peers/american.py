"""An American put without dvax: a binomial tree, finite differences and integral equations.

Prices are multiples of the strike 1; rates are in 1/year, the volatility σ in 1/√year, times in years.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev, legendre
from scipy.linalg import solve_banded
from scipy.special import ndtr


def european(S: Any, r: float, d: float, sigma: float, T: Any) -> Any:
    """Return the Black–Scholes value of a European put."""
    up = (np.log(S) + (r - d + 0.5 * sigma**2) * T) / (sigma * np.sqrt(T))
    return np.exp(-r * T) * ndtr(sigma * np.sqrt(T) - up) - S * np.exp(-d * T) * ndtr(-up)


def tree(S: float, r: float, d: float, sigma: float, T: float, steps: int) -> float:
    """Return the value by a binomial tree with Black–Scholes values in its last step and Richardson
    extrapolation from half the steps (BBSR; Broadie and Detemple 1996)."""
    coarse, fine = (_one_tree(S, r, d, sigma, T, n) for n in (steps // 2, steps))
    return 2.0 * fine - coarse


def _one_tree(S: float, r: float, d: float, sigma: float, T: float, steps: int) -> float:
    dt = T / steps
    up = np.exp(sigma * np.sqrt(dt))
    p = (np.exp((r - d) * dt) - 1 / up) / (up - 1 / up)
    high, low = np.exp(-r * dt) * p, np.exp(-r * dt) * (1 - p)
    prices = S * up ** np.arange(-steps, steps + 1.0)  # node j of level k is entry steps − k + 2j
    pay = 1.0 - prices
    last = prices[1:-1:2]
    V = np.maximum(european(last, r, d, sigma, dt), 1.0 - last)
    for level in range(steps - 2, -1, -1):
        V = np.maximum(high * V[1:] + low * V[:-1], pay[steps - level : steps + level + 1 : 2])
    return float(V[0])


def finite_differences(
    r: float, d: float, sigma: float, T: float, cells: int, steps: int
) -> Callable[[Any], Any]:
    """Return the value as a function of S, by Crank–Nicolson steps in ln S, of which the first two are
    four implicit half steps (Rannacher 1984).

    Policy iteration solves the linear complementarity problem of each step (Forsyth and Vetzal 2002,
    with an infinite penalty): rows that hold V = ψ are exchanged until none changes. `cells` are those
    of one σ√T."""
    h = sigma * np.sqrt(T) / cells
    low = int(np.ceil(-np.log(0.35) / h))
    s = h * (np.arange(-low, 5 * cells) + 0.5)  # the strike is halfway between two nodes
    psi = np.maximum(1.0 - np.exp(s), 0.0)
    half, drift = 0.5 * sigma**2 / h**2, (r - d - 0.5 * sigma**2) / (2 * h)
    below, middle, above = half - drift, -2 * half - r, half + drift
    V, held = psi.copy(), psi > 0.0
    sizes = [0.5] * 4 + [1.0] * (steps - 2)
    for size in sizes:
        dt, theta = size * T / steps, 1.0 if size < 1.0 else 0.5
        right = V.copy()
        rate = below * V[:-2] + middle * V[1:-1] + above * V[2:]
        right[1:-1] += (1 - theta) * dt * rate
        for _ in range(50):
            matrix = np.zeros((3, len(s)))
            matrix[0, 2:], matrix[1], matrix[2, :-2] = (
                -theta * dt * above, 1 - theta * dt * middle, -theta * dt * below,
            )  # fmt: skip
            fixed = held.copy()
            fixed[[0, -1]] = True
            matrix[1, fixed] = 1.0
            matrix[0, 1:][fixed[:-1]] = 0.0
            matrix[2, :-1][fixed[1:]] = 0.0
            V = solve_banded((1, 1), matrix, np.where(fixed, psi, right), check_finite=False)
            residual = V - right
            residual[1:-1] -= theta * dt * (below * V[:-2] + middle * V[1:-1] + above * V[2:])
            changed = np.where(held, residual > 0.0, V < psi)
            if np.array_equal(changed, held):
                break
            held = changed

    def value(S: Any) -> Any:
        from scipy.interpolate import CubicSpline

        return CubicSpline(s, V)(np.log(S))

    return value


class IntegralEquation:
    """The exercise boundary B by fixed-point iteration of an integral equation, and values from it.

    Kim's (1990) representation of the premium, in form A of Andersen, Lake and Offengenden (2016):
    ln²(B/B(0+)) is a polynomial in the square root of the time to expiry. It shares no code, and no
    discretisation, with trees and finite differences. d ≤ r.
    """

    def __init__(
        self, r: float, d: float, sigma: float, T: float, nodes: int = 32, points: int = 256,
        sweeps: int = 60,
    ):  # fmt: skip
        self.data, self.nodes = (r, d, sigma, T), nodes
        z, w = legendre.leggauss(points)
        self.z, self.w = 0.5 * (1 + z), 0.5 * w
        x = 0.5 * np.sqrt(T) * (1 + np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes))
        self.coefficients = np.zeros(nodes)
        tau = x[:, None] ** 2
        y = np.sqrt(tau) * self.z  # √(τ − u), in which the integrands are smooth
        u = np.maximum(tau - y**2, 0.0)
        weight = 2 * y * np.sqrt(tau) * self.w
        for _ in range(sweeps):
            B = self.boundary(tau[:, 0])
            up, down = self._d(y, B[:, None] / self.boundary(u))
            up1, down1 = self._d(np.sqrt(tau), B[:, None])
            N = _density(down1) / (sigma * np.sqrt(tau))
            N = N[:, 0] + r * np.sum(weight * np.exp(r * u) * _density(down) / (sigma * y), 1)
            D = (_density(up1) / (sigma * np.sqrt(tau)) + ndtr(up1))[:, 0]
            D += d * np.sum(weight * np.exp(d * u) * (ndtr(up) + _density(up) / (sigma * y)), 1)
            B = np.exp(-(r - d) * tau[:, 0]) * N / D
            self.coefficients = self._fit(x, np.log(np.minimum(B, 1.0)) ** 2)

    def _fit(self, x: np.ndarray, H: np.ndarray) -> np.ndarray:
        ends = 2 * x / np.sqrt(self.data[3]) - 1
        return chebyshev.chebfit(ends, H, self.nodes - 1)

    def _d(self, root: Any, ratio: Any) -> tuple[Any, Any]:
        r, d, sigma, _ = self.data
        middle = (np.log(ratio) + (r - d) * root**2) / (sigma * root)
        return middle + 0.5 * sigma * root, middle - 0.5 * sigma * root

    def boundary(self, tau: Any) -> Any:
        """Return the exercise boundary at the times τ before expiry."""
        H = chebyshev.chebval(2 * np.sqrt(np.asarray(tau) / self.data[3]) - 1, self.coefficients)
        return np.exp(-np.sqrt(np.maximum(H, 0.0)))

    def value(self, S: float) -> float:
        """Return the value of the put at S above the boundary."""
        r, d, sigma, T = self.data
        y = np.sqrt(T) * self.z
        weight, u = 2 * y * np.sqrt(T) * self.w, T - y**2
        up, down = self._d(y, S / self.boundary(u))
        premium = r * np.exp(-r * y**2) * ndtr(-down) - d * S * np.exp(-d * y**2) * ndtr(-up)
        return float(european(S, r, d, sigma, T) + np.sum(weight * premium))


def _density(x: Any) -> Any:
    return np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
