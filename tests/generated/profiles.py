"""Functions of time that are difficult for step-size control, with one formula each for JAX and NumPy.

A profile is drawn on [0, span]; `shifted` moves its times by t0, for a run that begins there. Its
`breaks` are the times where its formula is not smooth, with more around narrow features, so that a
reference that ends its steps there cannot miss them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import dvax

Array = np.ndarray[Any, Any]
Numbers = dict[str, Any]


class Profile(NamedTuple):
    """`value(lib, t, p)` with numbers p from `draw(rng, span)`; `times` names those that are times.

    `knots(p)`, where it is given, is what a problem announces to dvax (`dvax.signals`).
    """

    draw: Callable[[np.random.Generator, float], Numbers]
    value: Callable[[Any, Any, Numbers], Any]
    breaks: Callable[[Numbers, float], list[float]]
    times: tuple[str, ...] = ("a",)
    knots: Callable[[Numbers], Array] | None = None
    table: str | None = None

    def of(self, p: Numbers) -> Callable[[Any], Any]:
        """The profile inside a problem: a function of a traced t."""
        if self.table is not None:
            return dvax.signals.Table(p["a"], p["d"], kind=self.table)
        formula = lambda t: self.value(jnp, t, p)  # noqa: E731
        if self.knots is None:
            return formula
        return dvax.signals.Function(formula, knots=p["knots"])

    def shifted(self, p: Numbers, by: float) -> Numbers:
        moved = {name: v + by if name in self.times else v for name, v in p.items()}
        return moved if self.knots is None else {**moved, "knots": self.knots(moved)}


WIDTHS = 1e-4, 0.2
"""Of the span."""


def _one(rng: np.random.Generator, span: float, low: float = 0.3, high: float = 0.9) -> Numbers:
    """A feature at a random place, of a width between 1e-4 and 1/5 of the span."""
    w = span * float(np.exp(rng.uniform(*np.log(WIDTHS))))
    # At the very start or end now and then.
    a = float(rng.choice([rng.uniform(0.0, span), 0.3 * w, span - 0.3 * w], p=[0.9, 0.05, 0.05]))
    return {"a": a, "w": w, "d": float(rng.uniform(low, high))}


def _three(rng: np.random.Generator, span: float) -> Numbers:
    each = [_one(rng, span, 0.1, 0.3) for _ in range(3)]
    return {name: np.array([p[name] for p in each]) for name in ("a", "w", "d")}


def _around(p: Numbers, span: float) -> list[float]:
    a, w = np.atleast_1d(p["a"]), np.atleast_1d(p["w"])
    ladder = np.array([-4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0])
    return [float(v) for v in (a[:, None] + w[:, None] * ladder).ravel()]


def _tent(lib: Any, t: Any, p: Numbers) -> Any:
    return lib.sum(p["d"] * lib.maximum(0.0, 1.0 - lib.abs(t - p["a"]) / p["w"]))


def _vee(lib: Any, t: Any, p: Numbers) -> Any:
    return p["d"] * (1.0 - lib.abs(t - p["a"]) / p["w"])


def _bump(lib: Any, t: Any, p: Numbers) -> Any:
    s = (t - p["a"]) / p["w"]
    return lib.sum(p["d"] * lib.where(lib.abs(s) < 1.0, (1.0 - s * s) ** 3, 0.0))


def _gauss(lib: Any, t: Any, p: Numbers) -> Any:
    s = (t - p["a"]) / p["w"]
    return lib.sum(p["d"] * lib.exp(-lib.minimum(s * s, 300.0)))


def _pulse(lib: Any, t: Any, p: Numbers) -> Any:
    inside = (t >= p["a"]) & (t < p["a"] + p["w"])
    return lib.sum(lib.where(inside, p["d"], 0.0 * p["d"]))


def _trapezoid(lib: Any, t: Any, p: Numbers) -> Any:
    """A trapezoid that rises and falls within a tenth of its width, by clip."""
    s = (t - p["a"]) / p["w"]
    return lib.sum(p["d"] * lib.clip(lib.minimum(10.0 * s, 10.0 - 10.0 * s), 0.0, 1.0))


def _jump(lib: Any, t: Any, p: Numbers) -> Any:
    return lib.sum(lib.where(t < p["a"], 0.0 * p["d"], p["d"]))


def _jump_knots(p: Numbers) -> Array:
    return np.atleast_1d(p["a"])


def _pulse_knots(p: Numbers) -> Array:
    return np.concatenate([np.atleast_1d(p["a"]), np.atleast_1d(p["a"] + p["w"])])


def _tent_knots(p: Numbers) -> Array:
    a, w = np.atleast_1d(p["a"]), np.atleast_1d(p["w"])
    return np.concatenate([a - w, a, a + w])


def _in_pulse(p: Numbers, span: float) -> list[float]:
    a, w = np.atleast_1d(p["a"]), np.atleast_1d(p["w"])
    ladder = np.array([0.0, 0.1, 0.5, 0.9, 1.0])
    return [float(v) for v in (a[:, None] + w[:, None] * ladder).ravel()]


def _at(p: Numbers, span: float) -> list[float]:
    return [float(v) for v in np.atleast_1d(p["a"])]


def _waves(least: float, most: float, low: float = 0.3, high: float = 0.9) -> Callable:
    """The number of periods in the span, integer or not, log-uniform between these."""

    def draw(rng: np.random.Generator, span: float) -> Numbers:
        count = float(np.exp(rng.uniform(np.log(least), np.log(most))))
        if rng.random() < 0.7:
            count = float(round(count)) or 1.0
        if rng.random() < 0.4 and most >= 1000:
            count = float(rng.choice([500, 1000, 2000], p=[0.4, 0.4, 0.2]))
        a = 0.0 if rng.random() < 0.5 else float(rng.uniform(0.0, span / count))
        return {"a": a, "w": span / count, "d": float(rng.uniform(low, high))}

    return draw


def _sine_squared(lib: Any, t: Any, p: Numbers) -> Any:
    return p["d"] * lib.sin(np.pi * (t - p["a"]) / p["w"]) ** 2


def _abs_sine(lib: Any, t: Any, p: Numbers) -> Any:
    return p["d"] * (1.0 - lib.abs(lib.sin(np.pi * (t - p["a"]) / p["w"])))


def _square(lib: Any, t: Any, p: Numbers) -> Any:
    s = (t - p["a"]) / p["w"]
    return lib.where(s - lib.floor(s) < 0.5, p["d"], 0.0 * p["d"])


def _saw(lib: Any, t: Any, p: Numbers) -> Any:
    s = (t - p["a"]) / p["w"]
    return p["d"] * (s - lib.floor(s))


def _of_period(*fractions: float) -> Callable[[Numbers, float], list[float]]:
    def breaks(p: Numbers, span: float) -> list[float]:
        first = np.floor(-p["a"] / p["w"]) - 1
        k = np.arange(first, first + round(span / p["w"]) + 4)
        ends = p["a"] + p["w"] * (k[:, None] + np.asarray(fractions))
        return [float(v) for v in ends.ravel() if 0 < v < span]

    return breaks


NODES = 48


def _table(rng: np.random.Generator, span: float) -> Numbers:
    inner = np.sort(rng.uniform(0.0, span, NODES - 2))
    a = np.concatenate([[-0.01 * span], inner, [1.01 * span]])
    walk = np.abs(np.cumsum(rng.normal(size=NODES)))
    return {"a": a, "d": 0.9 * walk / np.max(walk)}


def _linear(lib: Any, t: Any, p: Numbers) -> Any:
    return np.interp(t, p["a"], p["d"])


def _constant(lib: Any, t: Any, p: Numbers) -> Any:
    return p["d"][np.clip(np.searchsorted(p["a"], t, side="right") - 1, 0, len(p["a"]) - 1)]


PROFILES: dict[str, Profile] = {
    "nothing": Profile(lambda rng, span: {}, lambda lib, t, p: 0.0, lambda p, span: []),
    "tent": Profile(_one, _tent, _around),
    "three tents": Profile(_three, _tent, _around),
    "vee": Profile(_one, _vee, _around),
    "bump": Profile(_one, _bump, _around),
    "three bumps": Profile(_three, _bump, _around),
    "gauss": Profile(_one, _gauss, _around),
    "pulse": Profile(_one, _pulse, _in_pulse),
    "three pulses": Profile(_three, _pulse, _in_pulse),
    "trapezoid": Profile(_one, _trapezoid, _in_pulse),
    "jump": Profile(_one, _jump, _at),
    "three jumps": Profile(_three, _jump, _at),
    "announced jump": Profile(_one, _jump, _at, knots=_jump_knots),
    "announced pulse": Profile(_one, _pulse, _in_pulse, knots=_pulse_knots),
    "announced tents": Profile(_three, _tent, _around, knots=_tent_knots),
    "few waves": Profile(_waves(1, 40), _sine_squared, _of_period(0.0, 0.5)),
    "a hundred waves": Profile(_waves(20, 100), _sine_squared, _of_period(0.0, 0.5)),
    "waves": Profile(_waves(100, 2000), _sine_squared, _of_period(0.0, 0.5)),
    "few touches": Profile(_waves(1, 20), _abs_sine, _of_period(0.0, 0.02, 0.1, 0.5, 0.9, 0.98)),
    "few squares": Profile(_waves(1, 20), _square, _of_period(0.0, 0.5)),
    "squares": Profile(_waves(10, 500), _square, _of_period(0.0, 0.5)),
    "saw": Profile(_waves(1, 40), _saw, _of_period(0.0)),
    "linear table": Profile(_table, _linear, _at, table="linear"),
    "constant table": Profile(_table, _constant, _at, table="constant"),
}  # fmt: skip
