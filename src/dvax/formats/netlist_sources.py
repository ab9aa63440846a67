"""The sources of a netlist as signals."""

import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..errors import Problems, input_error
from ..signals import AbstractSignal, Constant, Function, Table
from .netlist_values import read_value


class Sine(eqx.Module):
    """offset + amplitude e^{−damping (t − delay)} sin(2π (frequency (t − delay)) + phase) from the
    delay on, and the value it has there before."""

    offset: jax.Array
    amplitude: jax.Array
    frequency: jax.Array
    delay: jax.Array
    damping: jax.Array
    phase: jax.Array

    def __call__(self, t: Any) -> jax.Array:
        s = jnp.maximum(t - self.delay, 0.0)
        angle = 2 * np.pi * self.frequency * s + self.phase
        return self.offset + self.amplitude * jnp.exp(-self.damping * s) * jnp.sin(angle)


class Pulse(AbstractSignal):
    """The PULSE of SPICE: `low` up to `delay`, then in every `period` a rise to `high`, which lasts for
    `width`, and a fall. Rise and fall take `edges` = (rise, fall), 0 for a jump. Without an end of the
    pulse `width` is infinite, and without repetition `period`.

    Its knots are those of the first 10⁵ periods, and there its span ends.
    """

    low: float
    high: float
    delay: float
    edges: tuple[float, float]
    width: float
    period: float

    def value(self, t: Any) -> jax.Array:
        s = jnp.asarray(t - self.delay, jnp.result_type(float))
        if np.isfinite(self.period):
            s = s - self.period * jnp.floor(s / self.period)
        rise, fall = self.edges
        end = rise + self.width
        up = s / rise if rise > 0 else jnp.ones_like(s)
        level = jnp.clip(up, 0.0, 1.0)
        if np.isfinite(end):
            down = (s - end) / fall if fall > 0 else jnp.where(s >= end, 1.0, 0.0)
            level = level * (1.0 - jnp.clip(down, 0.0, 1.0))
        level = jnp.where(t >= self.delay, level, 0.0)
        return jnp.where(t <= self.span()[1], self.low + (self.high - self.low) * level, jnp.nan)

    def knots(self) -> Any:
        rise, fall = self.edges
        end = rise + self.width
        one = np.array([0.0, rise, end, end + fall])
        one = self.delay + one[np.isfinite(one)]
        if np.isfinite(self.period):
            one = (one + self.period * np.arange(_PERIODS)[:, None]).ravel()
        return np.unique(one[one > 0.0])

    def span(self) -> tuple[Any, Any]:
        return -np.inf, self.delay + _PERIODS * self.period


_PERIODS = 100_000


def read_waveform(fields: list[str], quantity: str, place: str) -> AbstractSignal:
    """Return the signal that the end of a source's line describes: ``5``, ``DC 5``,
    ``SIN(offset amplitude frequency [delay damping phase])``, ``PWL(t v t v ...)`` or
    ``PULSE(low high [delay rise fall width period])``.

    **Raises:** `dvax.InputError` at `place`, with everything that is wrong.
    """
    whole = " ".join(fields)
    call = re.fullmatch(r"(?P<name>[A-Za-z]+)\s*\((?P<inside>[^()]*)\)", whole)
    if call is None:
        numbers = fields[1:] if fields and fields[0].upper() == "DC" else fields
        if len(numbers) != 1 or "(" in whole:
            raise input_error(
                place, repr(whole), "a source is a number, DC number, SIN(...), PWL(...) or "
                "PULSE(...)",
                "Write one of them after the two nodes",
            )  # fmt: skip
        return Constant(read_value(numbers[0], quantity, place))
    shapes = {"SIN": _sine, "PWL": _lines, "PULSE": _pulse}
    shape = shapes.get(call["name"].upper())
    if shape is None:
        raise input_error(
            place, call["name"], f"a waveform is one of {', '.join(shapes)}",
            "Write it as PWL(t v t v ...)",
        )  # fmt: skip
    return shape(call["inside"].replace(",", " ").split(), quantity, place)


def _sine(fields: list[str], quantity: str, place: str) -> AbstractSignal:
    kinds = (quantity, quantity, "frequency", "time", "rate", "angle")
    if not 3 <= len(fields) <= len(kinds):
        raise input_error(
            place, f"SIN with {len(fields)} numbers",
            "it has an offset, an amplitude and a frequency, and may have a delay, a damping and "
            "a phase in degrees", "Write SIN(0 10 1k)",
        )  # fmt: skip
    kinds = kinds[: len(fields)]
    values = _all(fields, kinds, place) + [0.0] * (6 - len(fields))
    wrong = Problems()
    for k, what in ((2, "frequency"), (3, "delay"), (4, "damping")):
        if values[k] < 0:
            wrong.add(place, fields[k], f"the {what} is not negative", "Fix the sign")
    wrong.raise_any()
    values[5] = np.deg2rad(values[5])
    delay = values[3]
    return Function(Sine(*map(jnp.asarray, values)), knots=[delay] if delay > 0 else [])


def _pulse(fields: list[str], quantity: str, place: str) -> AbstractSignal:
    kinds = (quantity, quantity, "time", "time", "time", "time", "time")
    if not 2 <= len(fields) <= len(kinds):
        raise input_error(
            place, f"PULSE with {len(fields)} numbers",
            "it has a low and a high value, and may have a delay, a rise time, a fall time, a "
            "width and a period", "Write PULSE(0 5 0 1n 1n 5u 10u)",
        )  # fmt: skip
    values = _all(fields, kinds[: len(fields)], place)
    low, high, delay, rise, fall, width, period = values + _PULSE_DEFAULTS[len(values) :]
    names = ("the delay", "the rise time", "the fall time", "the width", "the period")
    wrong = Problems()
    for k, what in enumerate(names[: len(fields) - 2]):
        if values[2 + k] < 0:
            wrong.add(place, fields[2 + k], f"{what} is not negative", "Fix the sign")
    if not wrong and not period > 0:
        wrong.add(place, fields[6], "the period is positive", "Leave it out for one pulse")
    if not wrong and rise + width + fall > period:
        wrong.add(
            place, f"a period of {fields[6]}", "a pulse is over when the next one begins: rise, "
            f"width and fall are {rise + width + fall:.12g} s", "Lengthen the period, or leave it out",
        )  # fmt: skip
    wrong.raise_any()
    return Pulse(low, high, delay, (rise, fall), width, period)


_PULSE_DEFAULTS = [0.0, 0.0, 0.0, 0.0, 0.0, np.inf, np.inf]


def _lines(fields: list[str], quantity: str, place: str) -> AbstractSignal:
    if len(fields) < 4 or len(fields) % 2:
        raise input_error(
            place, f"PWL with {len(fields)} numbers", "it has pairs of a time and a value, two at "
            "least", "Write PWL(0 0 1m 5)",
        )  # fmt: skip
    values = _all(fields, ("time", quantity) * (len(fields) // 2), place)
    times = np.array(values[::2])
    late = np.flatnonzero(np.diff(times) <= 0)
    if times[0] != 0.0 or late.size:
        given = f"PWL from {times[0]:g} s" if times[0] != 0.0 else fields[2 * int(late[0]) + 2]
        raise input_error(
            place, given, "the times begin at 0, where the run does, and increase",
            "Sort them, and say what the source does from 0 on",
        )  # fmt: skip
    return Table(times, np.array(values[1::2]))


def _all(fields: list[str], kinds: tuple[str, ...], place: str) -> list[float]:
    values: list[float] = []
    wrong = Problems()
    for field, kind in zip(fields, kinds, strict=True):
        with wrong.collect():
            values.append(read_value(field, kind, place))
    wrong.raise_any()
    return values
