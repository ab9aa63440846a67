"""Physical quantities in the working units of a configuration.

A configuration declares one unit for each of time, length, indentation and pressure. From these
follow the units of every number in it, and so a number is enough; a text such as ``"2.5 MPa"`` is
converted, and refused when its dimension is wrong.
"""

import math
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from dvax.errors import input_error
from dvax.formats.csv_columns import Column
from dvax.formats.table import NUMBER

if TYPE_CHECKING:
    import pint

KINDS: Mapping[str, str] = {
    "time": "{time}",
    "rate": "1/({time})",
    "length": "{length}",
    "indentation": "{indentation}",
    "indentation rate": "({indentation})/({time})",
    "pressure": "{pressure}",
    "stiffness": "({pressure})/({indentation})",
    "number": "1",
}
"""What a quantity is -> its unit in working units. Stiffness is the unit of beta,
pressure/indentation."""

DEFAULTS: Mapping[str, str] = {"time": "s", "length": "m", "indentation": "m", "pressure": "Pa"}
_DIMENSIONS: Mapping[str, str] = {
    "time": "[time]",
    "length": "[length]",
    "indentation": "[length]",
    "pressure": "[mass] / [length] / [time] ** 2",
}

_QUANTITY = re.compile(
    rf"\s*(?P<number>{NUMBER.pattern})(?P<unit>\s*[A-Za-zµμ%°].*?|\s+(?:1\s*/|\().+?)\s*"
)
# A unit is names with single-digit exponents between * / · or blanks, one level of parentheses
# deep: no number in it can grow, and nothing else reaches pint's own parser.
_EXPONENT = r"(?:\s*(?:\*\*|\^)\s*-?\d)?"
_NAME = rf"[A-Za-zµμ%][A-Za-zµμ_]*{_EXPONENT}"
_BETWEEN = r"(?:\s*(?:\*(?!\*)|[/·])\s*|\s+)"
_GROUP = rf"\(\s*{_NAME}(?:{_BETWEEN}{_NAME})*\s*\){_EXPONENT}"
_FACTOR = rf"(?:{_NAME}|{_GROUP})"
_UNIT = re.compile(rf"(?:1\s*/\s*)?{_FACTOR}(?:{_BETWEEN}{_FACTOR})*")


_OFFSET = "has a zero point of its own"


class UnitError(ValueError):
    """A text that is no quantity or no unit; `fix` says what to write instead."""

    def __init__(self, rule: str, fix: str):
        self.rule, self.fix = rule, fix
        super().__init__(f"{rule}. {fix}")


class Units(BaseModel):
    """The working units: the section ``[units]`` of a configuration.

    The state x and the demand g are indentations, the load ell an indentation per time, the
    normalised reaction u an indentation, the pressure y = beta u a pressure.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    time: str = DEFAULTS["time"]
    length: str = DEFAULTS["length"]
    indentation: str = DEFAULTS["indentation"]
    pressure: str = DEFAULTS["pressure"]

    def of(self, kind: str) -> str:
        """The working unit of a kind of quantity, as a person writes it: ``um/s``, ``MPa/um``."""
        text = KINDS[kind].format(**self.model_dump())
        # Parentheses matter only around a compound unit.
        return re.sub(r"\(([^()*/ ·]+)\)", r"\1", text)

    def factor(self, unit: str, kind: str) -> float:
        """How many working units of `kind` one `unit` is. Raises `UnitError`."""
        return ratio(unit, self.of(kind), f"the quantity is {_article(kind)}, in")

    def values(self, file: str, column: Column, kind: str) -> np.ndarray:
        """Return the values of a column of a file in working units. Raises `InputError`."""
        return in_unit(file, column, self.of(kind), f"the quantity is {_article(kind)}, in")

    def convert(self, text: str, kind: str) -> float:
        """A text "number unit" in working units. Raises `UnitError`."""
        match = _match(text)
        if match is None:
            number = text.strip() if NUMBER.fullmatch(text.strip()) else "2.5"
            example = self.of(kind) if kind != "number" else ""
            raise UnitError(
                "a quantity in quotes is a number and a unit",
                f'Write "{number} {example}"' if example else "Write the number without quotes",
            )
        return float(match["number"]) * self.factor(match["unit"].strip(), kind)


def ratio(unit: str, wanted: str, what: str = "it is in") -> float:
    """Return how many `wanted` one `unit` is. Raises `UnitError`, with `what` before `wanted`."""
    if unit.strip() == wanted:
        return 1.0
    try:
        given, target = parse_unit(unit), parse_unit(wanted)
    except UnitError as error:
        rule = error.rule
        if rule.endswith(_OFFSET):
            rule = f"nothing is converted to or from a unit that {_OFFSET}, such as degC"
        raise UnitError(f"{what} {wanted}, and {rule}", f"Give it in {wanted}") from None
    if given.dimensionality != target.dimensionality:
        raise UnitError(
            f"{unit!r} does not measure this: {what} {wanted}",
            f"Give it in {wanted} or a unit that converts to {wanted}",
        )
    # parse_unit refuses units with an offset, so that one number is the ratio.
    return float(_registry().Quantity(1.0, given).to(target).magnitude)


def converted(text: str, unit: str) -> float | None:
    """A text "number unit" in another unit; None where the text or the unit does not allow it."""
    match = _match(text)
    if match is None:
        return None
    try:
        # Rounded to the digits that a decimal number keeps: 12 L/s is 0.012 m3/s, and no more.
        return float(f"{float(match['number']) * ratio(match['unit'], unit):.15g}")
    except UnitError:
        return None


def is_linear(unit: str) -> bool:
    """Return whether quantities can be converted to a unit: it is known, and starts at zero."""
    try:
        parse_unit(unit)
    except UnitError:
        return False
    return True


def in_unit(file: str, column: Column, unit: str, what: str = "it is in") -> np.ndarray:
    """Return the values of a column of a file in this unit. Raises `InputError`."""
    try:
        return column.values * ratio(column.unit, unit, what)
    except UnitError as error:
        place = f"{file}, column {column.name!r}"
        raise input_error(place, f"[{column.unit}]", error.rule, f"{error.fix}.") from None


def split_quantity(text: str) -> tuple[float, str] | None:
    """Return number and unit of a text "number unit"; None where it is none."""
    match = _match(text)
    return None if match is None else (float(match["number"]), match["unit"].strip())


def is_quantity(text: str) -> bool:
    """Whether a text has the form "number unit". No formula has it."""
    return _match(text) is not None


def _match(text: str) -> re.Match[str] | None:
    # The pattern takes quadratic time, which is minutes for a long text.
    return _QUANTITY.fullmatch(text) if len(text) <= 100 else None


def check_working_unit(name: str, unit: str) -> None:
    """Raise `UnitError` unless `unit` can be the working unit of `name` (time, length, ...)."""
    parsed = parse_unit(unit)
    registry = _registry()
    if parsed.dimensionality != registry.get_dimensionality(_DIMENSIONS[name]):
        raise UnitError(
            f"{unit!r} is no unit of {name if name != 'indentation' else 'length'}",
            f"Write one such as {DEFAULTS[name]!r}",
        )


def parse_unit(unit: str) -> "pint.Unit":
    """The unit that a text names. Raises `UnitError`; the text is checked before it is parsed."""
    import pint

    text = unit.strip()
    if text == "1":
        return _registry().Unit("dimensionless")
    if len(text) > 40 or not _UNIT.fullmatch(text):
        raise UnitError(f"{unit[:60]!r} is not a unit", "Write one such as s, mm, um/s or MPa/mm")
    registry = _registry()
    try:
        parsed = registry.Unit(text.replace("·", "*"))
        one, two = (registry.Quantity(n, parsed).to_base_units().magnitude for n in (1.0, 2.0))
    except (pint.PintError, ValueError, ArithmeticError, AttributeError):
        # pint raises the last for a unit that is neither linear nor known.
        raise UnitError(
            f"{unit!r} is not a known unit", "Write one such as s, mm, um/s or MPa/mm (1 for none)"
        ) from None
    if not math.isclose(two, 2 * one, rel_tol=1e-9):
        raise UnitError(f"{unit!r} {_OFFSET}", "Use a unit that starts at zero")
    return parsed


@lru_cache(maxsize=1)
def _registry() -> Any:
    import pint  # the import takes a second: only where a text with a unit occurs

    return pint.UnitRegistry(cache_folder=None)


def _article(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"
