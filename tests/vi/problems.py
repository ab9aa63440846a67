"""Published variational inequalities with their solutions and starting points.

Sources: Malitsky 2020, Khanh and Vuong 2014, Fukushima 1986, Mathiesen 1987, MCPLIB (Billups,
Munson), Murty 1988, Fathi 1979, Ahn 1983, Murphy, Sherali and Soyster 1982; solutions as published,
or a closed form beside the problem, which `test_conformance.py` checks by hand.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import dvax
from dvax.sets import Ball, Box, Ellipsoid, HalfSpace, Intersection, Polyhedron, Simplex

ORTHANT = Box(0.0, jnp.inf)
WEIGHT = np.array([[2.0, -1.0, 0.5], [1.0, 3.0, -0.5], [-0.5, 0.5, 1.5]])


class Problem(NamedTuple):
    """VI(K, F(·, args)). `starts` as published (or the corners and middle of K); `far(rng, count)`
    draws others. `tol` on ‖w‖ is larger where the projection itself is an iteration."""

    F: Callable[[Any, Any], Any]
    K: dvax.sets.AbstractSet
    solutions: list[np.ndarray]
    starts: list[np.ndarray]
    far: Callable[[np.random.Generator, int], np.ndarray]
    args: Any = None
    tol: float = 1e-11


def spread(size, length=10.0):
    """Starting points around the positive orthant, some outside it."""

    def draw(rng, count):
        return np.abs(rng.normal(size=(count, size))) * length * rng.choice([1, -0.1], (count, 1))

    return draw


def shares(size, total):
    return lambda rng, count: total * rng.dirichlet(np.ones(size), count)


def linear(y, args):
    matrix, q = args
    return matrix @ y + q


def unit(n, k):
    return np.eye(n)[k]


def expweight(y, _):
    return (jnp.exp(-jnp.sum(y * y)) + 0.2) * (WEIGHT @ y + jnp.array([-6.0, -1.0, 2.0]))


def murty(n):
    return np.eye(n) + 2 * np.triu(np.ones((n, n)), 1)


def fathi(n):
    i = np.arange(1, n + 1)
    matrix = 4 * np.minimum.outer(i, i) - 2.0
    np.fill_diagonal(matrix, 4 * i - 3.0)
    return matrix


def ahn(n):
    return 4 * np.eye(n) - 2 * np.eye(n, k=1) + np.eye(n, k=-1)


def kojima_shindo(x, args):
    """Kojima and Shindo's map (1986) with its published variants: not monotone."""
    a, b, c = args
    return jnp.stack([
        3 * x[0]**2 + 2 * x[0] * x[1] + 2 * x[1]**2 + x[2] + 3 * x[3] - 6,
        2 * x[0]**2 + x[0] + x[1]**2 + a * x[2] + 2 * x[3] - 2,
        3 * x[0]**2 + x[0] * x[1] + 2 * x[1]**2 + 2 * x[2] + b * x[3] - c,
        x[0]**2 + 3 * x[1]**2 + 2 * x[2] + 3 * x[3] - 3,
    ])  # fmt: skip


def cournot(q, _):
    """Five firms: marginal cost minus marginal revenue."""
    cost, slope = jnp.array([10.0, 8.0, 6.0, 4.0, 2.0]), jnp.array([1.2, 1.1, 1.0, 0.9, 0.8])
    total = jnp.sum(q)
    price = (5000.0 / total) ** (1 / 1.1)
    return cost + (q / 5.0) ** (1.0 / slope) - price + q * price / (1.1 * total)


def fukushima(x, _):
    return jnp.stack([
        2 * x[0] + 0.2 * x[0]**3 - 0.5 * x[1] + 0.1 * x[2] - 4,
        -0.5 * x[0] + x[1] + 0.1 * x[1]**3 + 0.5,
        0.5 * x[0] - 0.2 * x[1] + 2 * x[2] - 0.5,
    ])  # fmt: skip


def mathiesen(x, _):
    """A Walrasian economy: minus the excess demand for three goods at prices x."""
    income = 5 * x[1] + 3 * x[2]
    return -jnp.stack([0.9 * income / x[0], 0.1 * income / x[1] - 5, jnp.asarray(-3.0)])


def traffic(h, _):
    """Three routes 1–3–4, 1–2–3–4 and 1–2–4 of a net with five links of cost A + B v²: no toll on
    the route through the middle, whose flow is 0 at the solution."""
    uses = jnp.array([[1.0, 0, 0], [0, 1, 1], [0, 1, 0], [1, 1, 0], [0, 0, 1]])
    free, steep = jnp.array([25.0, 25, 75, 25, 25]), jnp.array([0.01, 0.01, 0.001, 0.01, 0.01])
    return uses.T @ (free + steep * (uses @ h) ** 2)


def disk2d():
    """y = −(M + μI)⁻¹q on the circle: μ is the root of a scalar equation, by bisection."""
    matrix, q = np.array([[3.0, 1.0], [2.0, 5.0]]), np.array([-5.0, -3.0])
    low, high = 0.0, 10.0
    for _ in range(200):
        mu = 0.5 * (low + high)
        y = np.linalg.solve(matrix + mu * np.eye(2), -q)
        low, high = (mu, high) if y @ y > 1 else (low, mu)
    return y


MCPLIB_STARTS = [
    np.zeros(4), np.ones(4), np.full(4, 100.0), np.array([1.0, 0, 1, 0]), unit(4, 0),
    np.array([0, 1.0, 1, 0]), np.array([0, 1.0, 0, 1]), np.array([1.25, 0, 0, 0.5]),
]  # fmt: skip
DEGENERATE = np.array([np.sqrt(6) / 2, 0, 0, 0.5])
# Malitsky's version on the simplex: three solutions are published; the other four, found by solving on
# every face (`test_conformance.py`), repel the methods that the three attract.
SHARES_OF_FOUR = [
    np.array([1.0, 0, 3, 0]), np.array([np.sqrt(6) / 2, 0, 0, 4 - np.sqrt(6) / 2]), 4 * unit(4, 1),
    np.array([0, 1.5 * np.sqrt(5) - 0.5, 4.5 - 1.5 * np.sqrt(5), 0]),
    np.array([1.144111508155, 1.363525113642, 0.878831099008, 0.613532279195]),
    np.array([1.620937271230, 0, 2.254875274524, 0.124187454246]),
    np.array([1.030211158951, 0.601253007053, 0, 2.368535833996]),
]  # fmt: skip
WIDE = Ellipsoid(0.0, radii=np.array([1.0, 0.4, 0.6]) ** -0.5)
HIGH = Ellipsoid(0.0, radii=np.array([0.6, 0.4, 1.0]) ** -0.5)
PRICES = [np.array([0.1, 0.8, 0.1]), np.array([0.4, 0.3, 0.3]), np.full(3, 1 / 3)]
# Good 1 costs no more than the other two together.
CHEAP = np.array([1.0, -1.0, -1.0])

PROBLEMS = {
    "kojshin": Problem(
        kojima_shindo, ORTHANT, [DEGENERATE, np.array([1.0, 0, 3, 0])], MCPLIB_STARTS, spread(4),
        args=(10.0, 9.0, 9.0),
    ),
    "josephy": Problem(
        kojima_shindo, ORTHANT, [DEGENERATE], MCPLIB_STARTS, spread(4), args=(3.0, 3.0, 1.0)
    ),
    "kojshin_simplex": Problem(
        kojima_shindo, Simplex(4.0), SHARES_OF_FOUR,
        [4 * unit(4, k) for k in range(4)] + [np.ones(4)], shares(4, 4.0), args=(3.0, 9.0, 9.0),
    ),
    "mathiesen": Problem(
        mathiesen, Polyhedron(np.vstack([CHEAP, -np.eye(3)]), np.zeros(4), np.ones((1, 3)), [1.0]),
        [np.array([1 / 2, 1 / 12, 5 / 12])], PRICES, shares(3, 1.0),
    ),
    "mathiesen as an intersection": Problem(
        mathiesen, Intersection(Simplex(1.0), HalfSpace(CHEAP, 0.0)),
        [np.array([1 / 2, 1 / 12, 5 / 12])], PRICES, shares(3, 1.0), tol=1e-10,
    ),
    "cournot5": Problem(
        cournot, Box(1e-6, jnp.inf),
        [np.array([36.932510815736, 41.818141660438, 43.706578522274, 42.659239743305,
                   39.178952516625])],
        [np.full(5, 10.0), np.ones(5), np.array([1.0, 50, 3, 80, 20])],
        lambda rng, count: rng.uniform(0.1, 100.0, (count, 5)),
    ),
    "billups": Problem(
        lambda y, _: (y - 1.0) ** 2 - 1.01, ORTHANT, [np.array([2.004987562112089])],
        [np.zeros(1), np.full(1, 0.5), np.full(1, 3.0)], spread(1),
    ),
    "expweight_box3": Problem(
        expweight, Box(-1.0, 1.0), [np.array([1.0, -3 / 19, -18 / 19])],
        [np.zeros(3), np.ones(3), np.array([-1.0, 1.0, 1.0])], spread(3),
    ),
    "kv_ball": Problem(
        lambda y, _: (1.5 - jnp.linalg.norm(y)) * y, Ball(0.0, 1.0), [np.zeros(5)],
        [0.4 * np.ones(5), unit(5, 0), np.array([5.0, -3.0, 1.0, 0.0, 2.0])], spread(5),
    ),
    "fukushima1": Problem(
        fukushima, WIDE, [unit(3, 0)], [np.zeros(3), np.ones(3), -5 * np.ones(3)], spread(3)
    ),
    "fukushima2": Problem(
        fukushima, Intersection(WIDE, HIGH, HalfSpace(-np.ones(3), -np.sqrt(3.0))),
        [np.array([0.916763984646, 0.484980246407, 0.330306576516])],
        [np.zeros(3), np.ones(3), -5 * np.ones(3)], spread(3), tol=1e-10,
    ),
    "disk2d": Problem(
        linear, Ball(0.0, 1.0), [disk2d()],
        [np.zeros(2), np.array([-1.0, 0.0]), np.array([9.0, -7.0])], spread(2),
        args=(np.array([[3.0, 1.0], [2.0, 5.0]]), np.array([-5.0, -3.0])),
    ),
    "traffic3": Problem(
        traffic, Simplex(100.0), [np.array([50.0, 0, 50])],
        [100 * unit(3, k) for k in range(3)] + [np.full(3, 100 / 3)], shares(3, 100.0), tol=1e-10,
    ),
    "murty10": Problem(
        linear, ORTHANT, [unit(10, 9)], [np.zeros(10), np.ones(10)], spread(10),
        args=(murty(10), -np.ones(10)),
    ),
    "fathi10": Problem(
        linear, ORTHANT, [unit(10, 0)], [np.zeros(10), np.ones(10)], spread(10),
        args=(fathi(10), -np.ones(10)),
    ),
    "ahn10": Problem(
        linear, ORTHANT, [np.linalg.solve(ahn(10), np.ones(10))],
        [np.zeros(10), np.full(10, 7.0)], spread(10), args=(ahn(10), -np.ones(10)),
    ),
    "munson1": Problem(
        linear, ORTHANT, [np.array([1.0, 0.0, 0.0])], [np.zeros(3), np.ones(3)], spread(3),
        args=(
            np.array([[1.0, 2.0, 3.0], [0.0, 1.0, -1.0], [1.0, 1.0, 0.0]]),
            np.array([-1.0, 1.0, 1.0]),
        ),
    ),
}  # fmt: skip
