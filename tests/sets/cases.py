"""One example of every set in ℝ⁴, with properties that do not depend on dvax.

`make(data)` builds the set from a vector of its own data; `violation(y)` is how far y breaks the
set's definition; `members(rng)` draws points of it from that definition, corners included; `rows`
are (G, d, E, e) where the set is a polyhedron.
"""

from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dvax import sets

N = 4
RNG = np.random.default_rng(7)
NORMAL = np.array([1.0, -2.0, 0.5, 1.5])
E = RNG.normal(size=(2, N))
G = RNG.normal(size=(5, N))
D = np.array([0.4, 0.7, 0.1, 1.0, 0.6])  # all positive: 0 is a member
ROOT = RNG.normal(size=(N, N))
SHAPE = ROOT @ ROOT.T + 0.3 * np.eye(N)
NONE = (np.zeros((0, N)), np.zeros(0))


class Case(NamedTuple):
    make: Callable[[Any], sets.AbstractSet]
    data: np.ndarray
    violation: Callable[[np.ndarray], float]
    members: Callable[[np.random.Generator], np.ndarray]
    rows: tuple[np.ndarray, ...] | None = None


def _half(rng: np.random.Generator) -> np.ndarray:
    y = 3.0 * rng.normal(size=N)
    return y - NORMAL * (NORMAL @ y - 0.5 + abs(rng.normal())) / (NORMAL @ NORMAL)


def _plane(rng: np.random.Generator) -> np.ndarray:
    y = 3.0 * rng.normal(size=N)
    return y - NORMAL * (NORMAL @ y - 0.5) / (NORMAL @ NORMAL)


def _affine(rng: np.random.Generator) -> np.ndarray:
    base = np.linalg.lstsq(E, np.array([1.0, -0.5]), rcond=None)[0]
    return base + np.linalg.svd(E)[2][2:].T @ rng.normal(size=2) * 3.0


def _shares(rng: np.random.Generator) -> np.ndarray:
    return 2.0 * (np.eye(N)[rng.integers(N)] if rng.random() < 0.5 else rng.dirichlet(np.ones(N)))


def _pairs(rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([[1.5], 0.8 * rng.dirichlet(np.full(3, 0.3))])


def _diamond(rng: np.random.Generator) -> np.ndarray:
    return 0.3 + 1.2 * rng.dirichlet(np.full(N, 0.3)) * rng.choice([-1.0, 1.0], N)


def _cone(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=N - 1)
    return rng.exponential() * np.concatenate([[1.0], 0.6 * v / np.linalg.norm(v)])


def _ball(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=N)
    return v / np.linalg.norm(v)


def _poly(rng: np.random.Generator) -> np.ndarray:
    """The farthest feasible point along a random direction: a point on the boundary."""
    v = 3.0 * rng.normal(size=N)
    return v * min(1.0, np.min(np.where(G @ v > 0, D / np.maximum(G @ v, 1e-300), np.inf)))


def _segment(rng: np.random.Generator) -> np.ndarray:
    """The same within Σ y = 0."""
    v = 3.0 * rng.normal(size=N)
    v -= v.mean()
    return v * min(1.0, np.min(np.where(G @ v > 0, D / np.maximum(G @ v, 1e-300), np.inf)))


def _lens(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=N) * [0.4, 1.0, 1.0, 1.0]
    v = v / max(np.linalg.norm(v), 1.0)
    return np.concatenate([[min(v[0], 0.3)], v[1:]])


def _above(*values: Any) -> float:
    return float(max(0.0, *(np.max(v) for v in values)))


LEFT, RIGHT = np.array([-1.0, -0.2, -0.5, -2.0]), np.array([0.3, 1.0, 0.5, 0.7])
SUMS = np.array([[1.0, 2.0, -1.0, 0.5], [1.0, 1.0, 1.0, -1.0]])


def _balanced(rng: np.random.Generator) -> np.ndarray:
    """The farthest member along a random direction in which the second sum is 0."""
    v = rng.normal(size=N)
    v -= SUMS[1] * (SUMS[1] @ v) / (SUMS[1] @ SUMS[1])
    limits = np.concatenate([RIGHT, -LEFT, [0.4, 0.6]])
    along = np.concatenate([v, -v, [SUMS[0] @ v, -SUMS[0] @ v]])
    return v * np.min(np.where(along > 0, limits / np.maximum(along, 1e-300), np.inf))


SIGNS = np.array(list(product((-1.0, 1.0), repeat=N)))
SIMPLEX_ROWS = (-np.eye(N), np.zeros(N), np.ones((1, N)), np.array([2.0]))
PAIR_ROWS = np.array([[1.0, 0, 0, 0], [0, 1.0, 1.0, 1.0]])
INVERSE = np.linalg.inv(SHAPE)
RADII = np.array([0.5, 2.0, 1.0, 1.5])

CASES: dict[str, Case] = {
    "box": Case(
        lambda v: sets.Box(v[:4], v[4:]),
        np.array([-1.0, 0.0, -0.5, 0.2, 1.0, 0.5, 2.0, 0.7]),
        lambda y: _above([-1.0, 0.0, -0.5, 0.2] - y, y - [1.0, 0.5, 2.0, 0.7]),
        lambda rng: np.array([-1.0, 0.0, -0.5, 0.2]) + rng.random(4) * [2.0, 0.5, 2.5, 0.5],
    ),
    "whole space": Case(
        lambda v: sets.WholeSpace(), np.zeros(0), lambda y: 0.0, lambda rng: rng.normal(size=N)
    ),
    "half-space": Case(
        lambda v: sets.HalfSpace(v[:4], v[4]),
        np.append(NORMAL, 0.5),
        lambda y: _above(NORMAL @ y - 0.5),
        _half,
        (NORMAL[None], np.array([0.5]), *NONE),
    ),
    "hyperplane": Case(
        lambda v: sets.Hyperplane(v[:4], v[4]),
        np.append(NORMAL, 0.5),
        lambda y: abs(NORMAL @ y - 0.5),
        _plane,
        (*NONE, NORMAL[None], np.array([0.5])),
    ),
    "affine subspace": Case(
        lambda v: sets.AffineSubspace(v[:8].reshape(2, 4), v[8:]),
        np.append(E.ravel(), [1.0, -0.5]),
        lambda y: np.max(np.abs(E @ y - [1.0, -0.5])),
        _affine,
        (*NONE, E, np.array([1.0, -0.5])),
    ),
    "simplex": Case(
        lambda v: sets.Simplex(v[0]),
        np.array([2.0]),
        lambda y: _above(-y, abs(y.sum() - 2.0)),
        _shares,
        SIMPLEX_ROWS,
    ),
    "unequal simplices": Case(
        lambda v: sets.Simplex(v, sizes=(1, 3)),
        np.array([1.5, 0.8]),
        lambda y: _above(-y, abs(y[0] - 1.5), abs(y[1:].sum() - 0.8)),
        _pairs,
        (-np.eye(N), np.zeros(N), PAIR_ROWS, np.array([1.5, 0.8])),
    ),
    "second-order cone": Case(
        lambda v: sets.SecondOrderCone(v[0]),
        np.array([0.6]),
        lambda y: _above(np.linalg.norm(y[1:]) - 0.6 * y[0]),
        _cone,
    ),
    "l1 ball": Case(
        lambda v: sets.L1Ball(v[:4], v[4]),
        np.append(np.full(N, 0.3), 1.2),
        lambda y: _above(np.abs(y - 0.3).sum() - 1.2),
        _diamond,
        (SIGNS, 1.2 + SIGNS @ np.full(N, 0.3), *NONE),
    ),
    "ellipsoid, radii": Case(
        lambda v: sets.Ellipsoid(v[:4], radii=v[4:]),
        np.append(np.full(N, 0.2), RADII),
        lambda y: _above(np.sum(((y - 0.2) / RADII) ** 2) - 1.0),
        lambda rng: 0.2 + RADII * _ball(rng),
    ),
    "ellipsoid, matrix": Case(
        lambda v: sets.Ellipsoid(v[:4], shape=(lambda S: 0.5 * (S + S.T))(v[4:].reshape(4, 4))),
        np.append(np.full(N, 0.2), SHAPE.ravel()),
        lambda y: _above((y - 0.2) @ INVERSE @ (y - 0.2) - 1.0),
        lambda rng: 0.2 + np.linalg.cholesky(SHAPE) @ _ball(rng),
    ),
    "polyhedron": Case(
        lambda v: sets.Polyhedron(v[:20].reshape(5, 4), v[20:]),
        np.append(G.ravel(), D),
        lambda y: _above(G @ y - D),
        _poly,
        (G, D, *NONE),
    ),
    "polyhedron with an equation": Case(
        lambda v: sets.Polyhedron(v[:20].reshape(5, 4), v[20:25], v[None, 25:29], v[29:]),
        np.concatenate([G.ravel(), D, np.ones(N), [0.0]]),
        lambda y: _above(G @ y - D, abs(y.sum())),
        _segment,
        (G, D, np.ones((1, N)), np.zeros(1)),
    ),
    "constrained box": Case(
        lambda v: sets.ConstrainedBox(
            v[:4], v[4:8], v[8:16].reshape(2, 4), jnp.stack([v[16], v[18]]), v[17:19]
        ),
        np.concatenate([LEFT, RIGHT, SUMS.ravel(), [-0.6, 0.4, 0.0]]),
        lambda y: _above(
            LEFT - y, y - RIGHT, SUMS[0] @ y - 0.4, -0.6 - SUMS[0] @ y, abs(SUMS[1] @ y)
        ),
        _balanced,
        (
            np.vstack([np.eye(N), -np.eye(N), SUMS[:1], -SUMS[:1]]),
            np.concatenate([RIGHT, -LEFT, [0.4, 0.6]]),
            SUMS[1:],
            np.zeros(1),
        ),
    ),
    "translated": Case(
        lambda v: sets.Translated(sets.Simplex(jnp.asarray(2.0, v.dtype)), v),
        np.array([0.5, -1.0, 0.0, 2.0]),
        lambda y: _above(
            -(y - [0.5, -1.0, 0.0, 2.0]), abs((y - [0.5, -1.0, 0.0, 2.0]).sum() - 2.0)
        ),
        lambda rng: _shares(rng) + [0.5, -1.0, 0.0, 2.0],
    ),
    "scaled": Case(
        lambda v: sets.Scaled(sets.L1Ball(*jnp.array([0.3, 1.2], v.dtype)), v[0]),
        np.array([-2.0]),
        lambda y: _above(np.abs(y / -2.0 - 0.3).sum() - 1.2),
        lambda rng: -2.0 * _diamond(rng),
    ),
    "intersection": Case(
        lambda v: sets.Intersection(
            sets.HalfSpace(jnp.array([1.0, 0, 0, 0], v.dtype), v[0]),
            sets.Ellipsoid(jnp.zeros((), v.dtype), radii=v[1]),
        ),
        np.array([0.3, 1.0]),
        lambda y: _above(y[0] - 0.3, np.linalg.norm(y) - 1.0),
        _lens,
    ),
}
