"""A family of problems: one structure, compiled once, with numbers drawn at random."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import dvax

from .reference import FINEST, Written

Array = np.ndarray[Any, Any]


class Sample(NamedTuple):
    """A problem of a family: what dvax is given, and the same written by hand on [0, t1 − t0]."""

    args: Any
    x0: Any
    t0: float
    t1: float
    ts: Array
    rtol: float
    atol: float
    written: Written
    law: Any = None
    """`vi_solver=` of `dvax.solve`."""


class Family(NamedTuple):
    """`samples` of it are in the long checks: fewer where one takes long."""

    name: str
    methods: tuple[str, ...]
    problem: dvax.Problem
    draw: Callable[[np.random.Generator], Sample]
    samples: int = 160


METHODS = {
    "default": None,
    "ETD1": dvax.ETD1(),
    "ETD4RK": dvax.ETD4RK(),
    "DormandPrince": dvax.DormandPrince(),
    "ExpRosenbrock": dvax.ExpRosenbrock(),
}
ALL = ("default", "ETD4RK", "DormandPrince", "ExpRosenbrock")
TOLERANCES = ((1e-6, 1e-9), (1e-6, 1e-9), (1e-4, 1e-7), (1e-3, 1e-6), (1e-8, 1e-11))
SAVED = 12
"""Times to save at, the end among them."""


def times_of(rng: Any, span: float, features: list[float], t0: float) -> Array:
    """Times to save at, half of them where something happens."""
    within = np.array([t for t in features if 0 < t < span])
    some = rng.choice(within, min(len(within), SAVED // 2), replace=False) if len(within) else []
    ts = np.concatenate([some, rng.uniform(0.0, span, SAVED - 1 - len(some))])
    return np.append(np.sort(t0 + ts), t0 + span)


def span_and_start(rng: Any) -> tuple[float, float]:
    """A span from 0.1 to 100, and a start up to 10⁶ from 0."""
    span = float(10.0 ** rng.uniform(-1.0, 2.0)) if rng.random() < 0.5 else 1.0
    t0 = 0.0 if rng.random() < 0.5 else float(rng.choice([-1, 1]) * 10.0 ** rng.uniform(0.0, 6.0))
    if rng.random() < 0.2:
        t0 = float(round(t0))
    return t0, (t0 + span) - t0


def tolerance(
    rng: Any, t0: float, t1: float, steep: float, tight: bool = True
) -> tuple[float, float]:
    """(rtol, atol), above what the rounding of t does to the data; 10⁻⁸ too where `tight`."""
    rtol, atol = TOLERANCES[rng.integers(len(TOLERANCES) - (not tight))]
    blurred = 1e2 * np.finfo(float).eps * max(abs(t0), abs(t1)) * steep
    return (rtol, atol) if atol > blurred else (1e-6, 1e-9) if 1e-6 > blurred else (1e-3, 1e-6)


def accuracy_for(rtol: float) -> float:
    """The accuracy of the reference for a run at this tolerance."""
    return max(1e-5 * rtol, FINEST)


def unit(rng: Any, n: int) -> Array:
    """A random direction."""
    v = rng.normal(size=n)
    return v / np.linalg.norm(v)


def traced(v: Any) -> Any:
    """A number or an array that may change without another compilation."""
    return jnp.asarray(v) if isinstance(v, np.ndarray) else v
