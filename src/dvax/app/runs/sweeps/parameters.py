"""The values of a swept key: what a member's configuration gets, and a coordinate for the results."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dvax.app.runs.units import converted, split_quantity
from dvax.errors import input_error


@dataclass(frozen=True)
class Parameter:
    """A dotted `key` of the configuration and its values, one a row; `numbers` are these values as
    numbers in `unit`, None where one of them is no number."""

    key: str
    values: tuple[Any, ...]
    numbers: tuple[float, ...] | None
    unit: str

    def __post_init__(self) -> None:
        assert self.numbers is None or len(self.numbers) == len(self.values)

    def take(self, rows: Sequence[int]) -> "Parameter":
        """Return the parameter with these rows."""
        numbers = None if self.numbers is None else tuple(self.numbers[k] for k in rows)
        return Parameter(self.key, tuple(self.values[k] for k in rows), numbers, self.unit)


def parameter(place: str, key: str, values: Sequence[Any]) -> Parameter:
    """Return the parameter of these values: numbers, and texts such as "5 mm", become numbers in the
    unit of the first one.

    **Raises:** `dvax.InputError` if units do not convert.
    """
    if all(_is_number(v) for v in values):
        return Parameter(key, tuple(values), tuple(map(float, values)), "")
    parts = [split_quantity(v) if isinstance(v, str) else None for v in values]
    if any(part is None for part in parts):
        return Parameter(key, tuple(values), None, "")
    unit = parts[0][1]  # pyright: ignore[reportOptionalSubscript]
    if converted(values[0], unit) is None:  # a text that begins with a number
        return Parameter(key, tuple(values), None, "")
    numbers = [_in_unit(place, str(v), unit) for v in values]
    return Parameter(key, tuple(values), tuple(numbers), unit)


def from_numbers(key: str, numbers: np.ndarray, unit: str) -> Parameter:
    """Return the parameter of computed numbers: with a unit its values are texts."""
    values = tuple(f"{n!r} {unit}" if unit else n for n in map(float, numbers))
    return Parameter(key, values, tuple(map(float, numbers)), unit)


def listed(place: str, key: str, given: Any) -> Parameter:
    """Return the parameter of a list of values, or of a range { from, to, count, spacing }.

    **Raises:** `dvax.InputError`.
    """
    if isinstance(given, list) and given and not any(isinstance(v, dict | list) for v in given):
        return parameter(place, key, given)
    if isinstance(given, Mapping):
        allowed = ("from", "to", "count", "spacing")
        first, last, unit = _ends(place, given, "from", "to", allowed)
        count = given.get("count")
        if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= 10**6:
            raise input_error(
                f"{place}.count", repr(count), "a range has a whole number of values, at least 1",
                "Write { from = 1.0, to = 2.0, count = 5 }",
            )  # fmt: skip
        numbers = (np.geomspace if _is_log(place, given, first, last) else np.linspace)(
            first, last, count
        )
        whole = all(isinstance(given[name], int) for name in ("from", "to"))
        if whole and all(n.is_integer() for n in numbers.tolist()):
            return parameter(place, key, [int(n) for n in numbers])
        return from_numbers(key, numbers, unit)
    raise input_error(
        place, repr(given)[:70], "a swept key has a list of values, or a range",
        "Write [1.0, 2.0], or { from = 1.0, to = 2.0, count = 5 }",
    )  # fmt: skip


def drawn(place: str, key: str, given: Any, points: np.ndarray) -> Parameter:
    """Return the parameter of `points` in (0, 1): uniform between { low, high }, in the logarithm with
    spacing = "log", or normal with { mean, deviation }; whole numbers with whole = true.

    **Raises:** `dvax.InputError`.
    """
    if isinstance(given, list) and len(given) == 2:
        given = {"low": given[0], "high": given[1]}
    if isinstance(given, Mapping) and "mean" in given:
        allowed = ("mean", "deviation", "whole")
        mean, deviation, unit = _ends(place, given, "mean", "deviation", allowed)
        if not deviation > 0:
            raise input_error(
                f"{place}.deviation", repr(given["deviation"]), "it must be positive",
                "Write { mean = 1.0, deviation = 0.1 }",
            )  # fmt: skip
        from scipy.special import ndtri

        numbers = mean + deviation * ndtri(points)
        if _is_whole(place, given, unit):
            return parameter(place, key, [int(n) for n in np.rint(numbers)])
        return from_numbers(key, numbers, unit)
    if isinstance(given, Mapping):
        low, high, unit = _ends(place, given, "low", "high", ("low", "high", "spacing", "whole"))
        if low > high:
            raise input_error(
                f"{place}.low", f"{given['low']!r}, and high = {given['high']!r}",
                "low is at most high", "Exchange them, if the range is meant",
            )  # fmt: skip
        if not _is_whole(place, given, unit):
            return from_numbers(key, _scaled(place, given, low, high, points), unit)
        # Both ends as likely as the numbers between them.
        numbers = np.floor(_scaled(place, given, low, high + 1, points))
        return parameter(place, key, [int(n) for n in numbers])
    raise input_error(
        place, repr(given)[:70], "a sampled key has { low, high }, or { mean, deviation }",
        "Write { low = 1.0, high = 2.0 }",
    )  # fmt: skip


def _ends(
    place: str, given: Mapping[str, Any], first: str, second: str, allowed: tuple[str, ...]
) -> tuple[float, float, str]:
    """Return two entries of a table as numbers in one unit, and that unit."""
    for name in given:
        if name not in allowed:
            raise input_error(
                f"{place}.{name}", repr(given[name])[:70], f"the keys here are {', '.join(allowed)}",
                "Remove or rename it",
            )  # fmt: skip
    found = []
    for name in (first, second):
        if name not in given:
            raise input_error(f"{place}.{name}", "nothing", "it is required", f"Add {name} = ...")
        found.append(parameter(f"{place}.{name}", name, [given[name]]))
        numbers = found[-1].numbers
        if numbers is None or not math.isfinite(numbers[0]):
            raise input_error(
                f"{place}.{name}", repr(given[name])[:70], "it is a finite number, or one with a unit",
                'Write 1.0 or "1 mm"',
            )  # fmt: skip
    one, two = found
    if bool(one.unit) != bool(two.unit):
        raise input_error(
            place, f"{given[first]!r} and {given[second]!r}", "both have a unit, or none",
            "Write the unit with both",
        )  # fmt: skip
    number = _in_unit(f"{place}.{second}", given[second], one.unit) if one.unit else given[second]
    assert one.numbers is not None
    return one.numbers[0], float(number), one.unit


def _is_whole(place: str, given: Mapping[str, Any], unit: str) -> bool:
    """Return whether whole numbers are asked for."""
    whole = given.get("whole", False)
    if not isinstance(whole, bool):
        raise input_error(f"{place}.whole", repr(whole)[:70], "it is true or false", "Write true")
    ends = [given[name] for name in ("low", "high") if name in given]
    if whole and (unit or not all(isinstance(end, int) for end in ends)):
        raise input_error(
            f"{place}.whole", "true", "whole numbers have whole ends and no unit",
            "Write { low = 10, high = 20, whole = true }",
        )  # fmt: skip
    return whole


def _scaled(place: str, given: Mapping[str, Any], low: float, high: float, points: Any) -> Any:
    """Map points in [0, 1] to [low, high], evenly or evenly in the logarithm."""
    if _is_log(place, given, low, high):
        return np.exp(np.log(low) * (1 - points) + np.log(high) * points)
    return low * (1 - points) + high * points


def _is_log(place: str, given: Mapping[str, Any], low: float, high: float) -> bool:
    """Return whether the spacing of a range is that of logarithms. **Raises:** `dvax.InputError`."""
    spacing = given.get("spacing", "linear")
    if spacing not in ("linear", "log"):
        raise input_error(
            f"{place}.spacing", repr(spacing), 'it is "linear" or "log"', 'Write spacing = "log"'
        )
    if spacing == "log" and not (low > 0 and high > 0):
        raise input_error(
            place, f"{low:g} to {high:g}", "logarithms need positive numbers", "Write positive ends"
        )
    return spacing == "log"


def _in_unit(place: str, text: str, unit: str) -> float:
    number = converted(text, unit)
    if number is None:
        raise input_error(
            place, repr(text), f"it must convert to the unit of the first value, {unit}",
            "Write all values of a key in units of one dimension",
        )  # fmt: skip
    return number


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_range(table: Mapping[str, Any]) -> bool:
    """Return whether a table is a range or a distribution, and not a table of keys."""
    return bool({"from", "to", "low", "high", "mean", "deviation"} & set(table))
