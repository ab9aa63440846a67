"""What a source of a netlist does in time, as a signal."""

import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...errors import InputError, InputProblem
from ...signals import AbstractSignal, Constant, Function, Table
from .values import read_value


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


def read_waveform(fields: list[str], quantity: str, place: str) -> AbstractSignal:
    """The signal that the end of a source's line describes: ``5``, ``DC 5``,
    ``SIN(offset amplitude frequency [delay damping phase])`` or ``PWL(t v t v ...)``.

    **Raises:** `dvax.InputError` at `place`, with everything that is wrong.
    """
    whole = " ".join(fields)
    call = re.fullmatch(r"(?P<name>[A-Za-z]+)\s*\((?P<inside>[^()]*)\)", whole)
    if call is None:
        numbers = fields[1:] if fields and fields[0].upper() == "DC" else fields
        if len(numbers) != 1 or "(" in whole:
            raise InputError(
                InputProblem(
                    place, repr(whole), "a source is a number, DC number, SIN(...) or PWL(...)",
                    "Write one of them after the two nodes",
                )
            )  # fmt: skip
        return Constant(read_value(numbers[0], quantity, place))
    shapes = {"SIN": _sine, "PWL": _lines}
    shape = shapes.get(call["name"].upper())
    if shape is None:
        raise InputError(
            InputProblem(
                place, call["name"], f"a waveform is one of {', '.join(shapes)}",
                "Write it as PWL(t v t v ...)",
            )
        )  # fmt: skip
    return shape(call["inside"].replace(",", " ").split(), quantity, place)


def _sine(fields: list[str], quantity: str, place: str) -> AbstractSignal:
    kinds = (quantity, quantity, "frequency", "time", "rate", "angle")
    if not 3 <= len(fields) <= len(kinds):
        raise InputError(
            InputProblem(
                place, f"SIN with {len(fields)} numbers",
                "it has an offset, an amplitude and a frequency, and may have a delay, a damping and "
                "a phase in degrees", "Write SIN(0 10 1k)",
            )
        )  # fmt: skip
    kinds = kinds[: len(fields)]
    values = _all(fields, kinds, place) + [0.0] * (6 - len(fields))
    wrong = [
        InputProblem(place, fields[k], f"the {what} is not negative", "Mend the sign")
        for k, what in ((2, "frequency"), (3, "delay"), (4, "damping"))
        if values[k] < 0
    ]
    if wrong:
        raise InputError(*wrong)
    values[5] = np.deg2rad(values[5])
    delay = values[3]
    return Function(Sine(*map(jnp.asarray, values)), knots=[delay] if delay > 0 else [])


def _lines(fields: list[str], quantity: str, place: str) -> AbstractSignal:
    if len(fields) < 4 or len(fields) % 2:
        raise InputError(
            InputProblem(
                place, f"PWL with {len(fields)} numbers", "it has pairs of a time and a value, two at "
                "least", "Write PWL(0 0 1m 5)",
            )
        )  # fmt: skip
    values = _all(fields, ("time", quantity) * (len(fields) // 2), place)
    times = np.array(values[::2])
    late = np.flatnonzero(np.diff(times) <= 0)
    if times[0] != 0.0 or late.size:
        given = f"PWL from {times[0]:g} s" if times[0] != 0.0 else fields[2 * int(late[0]) + 2]
        raise InputError(
            InputProblem(
                place, given, "the times begin at 0, where the run does, and increase",
                "Sort them, and say what the source does from 0 on",
            )
        )  # fmt: skip
    return Table(times, np.array(values[1::2]))


def _all(fields: list[str], kinds: tuple[str, ...], place: str) -> list[float]:
    values, wrong = [], []
    for field, kind in zip(fields, kinds, strict=True):
        try:
            values.append(read_value(field, kind, place))
        except InputError as error:
            wrong += error.problems
    if wrong:
        raise InputError(*wrong)
    return values
