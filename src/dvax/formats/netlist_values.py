"""Numbers of a netlist: decimal, with an engineering suffix and a unit, or without."""

import math
import re

from ..errors import input_error
from .table import NUMBER

_VALUE = re.compile(rf"({NUMBER.pattern})([A-Za-zµμΩΩ°]*)")

_SUFFIXES = {
    "": 1.0, "f": 1e-15, "p": 1e-12, "n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3,
    "k": 1e3, "meg": 1e6, "g": 1e9, "t": 1e12,
}  # fmt: skip

UNITS = {
    "resistance": ("ohm", "ohms", "Ω", "Ω"),
    "inductance": ("H",),
    "capacitance": ("F",),
    "conductance": ("S",),
    "voltage": ("V",),
    "current": ("A",),
    "frequency": ("Hz",),
    "rate": ("Hz",),
    "time": ("s",),
    "angle": ("deg", "°"),
}
"""The units of each quantity; rates are 1/s."""


def read_value(text: str, quantity: str, place: str) -> float:
    """Return `text` as a number in the SI unit of `quantity`: 4.7k, 10mH, 1e-6, 2.2uF.

    **Raises:** `dvax.InputError` at `place` for what is no finite number, a unit of another quantity,
    and the two traps of SPICE: a large M (milli there, mega elsewhere) and F alone (femto there).
    """
    found = _VALUE.fullmatch(text)
    if found is None:
        raise input_error(
            place, repr(text), f"the {quantity} is a decimal number", "Write 4.7k, 10m or 1e-6"
        )
    digits, tail = found.groups()
    if tail.startswith("M") and not tail.lower().startswith("meg"):
        raise input_error(
            place, repr(text), "M is milli in SPICE and mega everywhere else", "Write m or Meg"
        )
    if tail.lower() == "f":
        raise input_error(
            place, repr(text), "F alone is femto in SPICE and farad everywhere else",
            "Leave the unit out for farad, or write fF",
        )  # fmt: skip
    factor = _factor(tail, UNITS[quantity])
    if factor is None:
        other = next((q for q, units in UNITS.items() if _factor(tail, units) is not None), None)
        rule = f"the {quantity} is in {UNITS[quantity][0]}, and this is in no unit that is known"
        if other is not None:
            rule = f"the {quantity} is in {UNITS[quantity][0]}, and this has a unit of {other}"
        raise input_error(place, repr(text), rule, "Fix the unit, or leave it out")
    value = float(digits) * factor
    if not math.isfinite(value):
        raise input_error(place, repr(text), "values are finite", "Fix the exponent")
    return value


def _factor(tail: str, units: tuple[str, ...]) -> float | None:
    """Return the factor of a suffix with one of these units, None where it has another."""
    for unit in ("", *units):
        head = tail.removesuffix(unit)
        if tail.endswith(unit) and head.lower() in _SUFFIXES:
            return _SUFFIXES[head.lower()]
    return None
