"""Every set of dvax, with random data and a hand-written projection.

Each is moved by a number e, 0 where nothing happens: most shrink by the factor 1 − e, so e < 1.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import dvax

from . import projections as by_hand

Array = np.ndarray[Any, Any]
sets = dvax.sets


class Kind(NamedTuple):
    """`size` unknowns (0: one number); numbers `draw(rng)`; `make(p, e)` the set that dvax is given;
    `project(z, p, e)` onto it in NumPy, where z is a vector also if the size is 0."""

    size: int
    draw: Callable[[np.random.Generator], dict[str, Any]]
    make: Callable[[Any, Any], Any]
    project: Callable[[Array, dict[str, Any], float], Array]


def _radius(rng: Any) -> float:
    return float(rng.uniform(0.2, 1.5))


def _direction(rng: Any, n: int) -> Array:
    v = rng.normal(size=n)
    return v / np.linalg.norm(v)


_ANGLES = np.array([0.2, 1.7, 3.0, 4.1, 5.3])
_ROWS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
_FACES = by_hand.faces_of(_ROWS)
_SHARES = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 0.5]])
_BACK = np.linalg.pinv(_SHARES)

SETS: dict[str, Kind] = {
    "Box of one": Kind(
        0,
        lambda rng: {"low": -_radius(rng), "up": _radius(rng)},
        lambda p, e: sets.Box(p["low"], p["up"] * (1.0 - e)),
        lambda z, p, e: np.clip(z, p["low"], p["up"] * (1.0 - e)),
    ),
    "Box": Kind(
        3,
        lambda rng: {"low": -rng.uniform(0.2, 1.5, 3), "up": rng.uniform(0.2, 1.5, 3)},
        lambda p, e: sets.Box(p["low"] * (1.0 - e), p["up"] * (1.0 - e)),
        lambda z, p, e: np.clip(z, p["low"] * (1.0 - e), p["up"] * (1.0 - e)),
    ),
    "many boxes": Kind(
        40,
        lambda rng: {"low": 0.0, "up": rng.uniform(0.05, 0.3, 40)},
        lambda p, e: sets.Box(p["low"], p["up"] * (1.0 - e)),
        lambda z, p, e: np.clip(z, p["low"], p["up"] * (1.0 - e)),
    ),
    "Ball": Kind(
        3,
        lambda rng: {"c": 0.1 * rng.normal(size=3), "r": _radius(rng)},
        lambda p, e: sets.Ball(p["c"], p["r"] * (1.0 - e)),
        lambda z, p, e: by_hand.ball(z, p["c"], p["r"] * (1.0 - e)),
    ),
    "Ball that travels": Kind(
        2,
        lambda rng: {"c": _direction(rng, 2), "r": _radius(rng)},
        lambda p, e: sets.Ball(p["c"] * e, p["r"]),
        lambda z, p, e: by_hand.ball(z, p["c"] * e, p["r"]),
    ),
    "Ellipsoid": Kind(
        3,
        lambda rng: {"r": rng.uniform(0.3, 1.5, 3)},
        lambda p, e: sets.Ellipsoid(0.0, radii=p["r"] * (1.0 - e)),
        lambda z, p, e: by_hand.ellipsoid(z, p["r"] * (1.0 - e)),
    ),
    "Polyhedron": Kind(
        2,
        lambda rng: {"d": rng.uniform(0.2, 1.2, 5)},
        lambda p, e: sets.Polyhedron(jnp.asarray(_ROWS), p["d"] * (1.0 - e)),
        lambda z, p, e: by_hand.polyhedron(z, _FACES, _ROWS, p["d"] * (1.0 - e)),
    ),
    "Simplex": Kind(
        4,
        lambda rng: {"total": _radius(rng)},
        lambda p, e: sets.Simplex(p["total"] * (1.0 - e)),
        lambda z, p, e: by_hand.simplex(z, p["total"] * (1.0 - e)),
    ),
    "L1Ball": Kind(
        3,
        lambda rng: {"r": _radius(rng)},
        lambda p, e: sets.L1Ball(0.0, p["r"] * (1.0 - e)),
        lambda z, p, e: by_hand.l1_ball(z, p["r"] * (1.0 - e)),
    ),
    "SecondOrderCone": Kind(
        3,
        lambda rng: {"slope": _radius(rng)},
        lambda p, e: sets.SecondOrderCone(p["slope"] * (1.0 - e)),
        lambda z, p, e: by_hand.second_order_cone(z, p["slope"] * (1.0 - e)),
    ),
    "HalfSpace": Kind(
        3,
        lambda rng: {"a": _direction(rng, 3), "b": _radius(rng)},
        lambda p, e: sets.HalfSpace(p["a"], p["b"] * (1.0 - 2.0 * e)),
        lambda z, p, e: by_hand.half_space(z, p["a"], p["b"] * (1.0 - 2.0 * e)),
    ),
    "Hyperplane": Kind(
        2,
        lambda rng: {"a": _direction(rng, 2), "b": 0.3 * _radius(rng)},
        lambda p, e: sets.Hyperplane(p["a"], p["b"] * (1.0 - e)),
        lambda z, p, e: by_hand.hyperplane(z, p["a"], p["b"] * (1.0 - e)),
    ),
    "AffineSubspace": Kind(
        3,
        lambda rng: {"e": 0.3 * rng.normal(size=2)},
        lambda p, e: sets.AffineSubspace(jnp.asarray(_SHARES), p["e"] * (1.0 - e)),
        lambda z, p, e: z - _BACK @ (_SHARES @ z - p["e"] * (1.0 - e)),
    ),
    "Intersection": Kind(
        2,
        lambda rng: {"r": _radius(rng), "a": _direction(rng, 2), "b": 0.3 * _radius(rng)},
        lambda p, e: sets.Intersection(
            sets.Ball(0.0, p["r"] * (1.0 - 0.5 * e)),
            sets.HalfSpace(p["a"], p["r"] * p["b"] * (1.0 - 2.0 * e)),
        ),
        lambda z, p, e: by_hand.ball_and_half_space(
            z, p["r"] * (1.0 - 0.5 * e), p["a"], p["r"] * p["b"] * (1.0 - 2.0 * e)
        ),
    ),
    "Translated": Kind(
        2,
        lambda rng: {"c": _direction(rng, 2), "r": rng.uniform(0.3, 1.5, 2)},
        lambda p, e: sets.Translated(sets.Ellipsoid(0.0, radii=p["r"]), p["c"] * e),
        lambda z, p, e: p["c"] * e + by_hand.ellipsoid(z - p["c"] * e, p["r"]),
    ),
    "Scaled": Kind(
        4,
        lambda rng: {"total": _radius(rng)},
        lambda p, e: sets.Scaled(sets.Simplex(p["total"]), 1.0 - e),
        lambda z, p, e: (1.0 - e) * by_hand.simplex(z / (1.0 - e), p["total"]),
    ),
    "WholeSpace": Kind(
        3,
        lambda rng: {},
        lambda p, e: sets.WholeSpace(),
        lambda z, p, e: z,
    ),
}  # fmt: skip
