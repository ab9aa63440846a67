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

from pydantic import BaseModel, ConfigDict

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
        target = self.of(kind)
        if unit.strip() == target:
            return 1.0
        registry = _registry()
        given, wanted = parse_unit(unit), parse_unit(target)
        if given.dimensionality != wanted.dimensionality:
            raise UnitError(
                f"{unit!r} does not measure this: the quantity is {_article(kind)}, in {target}",
                f"Give it in {target} or a unit that converts to {target}",
            )
        # parse_unit refuses units with an offset, so that one number is the ratio.
        return float(registry.Quantity(1.0, given).to(wanted).magnitude)

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


def converted(text: str, unit: str) -> float | None:
    """A text "number unit" in another unit; None where the text or the unit does not allow it."""
    match = _match(text)
    if match is None:
        return None
    if match["unit"].strip() == unit:
        return float(match["number"])
    try:
        given, wanted = parse_unit(match["unit"]), parse_unit(unit)
    except UnitError:
        return None
    if given.dimensionality != wanted.dimensionality:
        return None
    return float(match["number"]) * float(_registry().Quantity(1.0, given).to(wanted).magnitude)


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
        raise UnitError(f"{unit!r} has a zero point of its own", "Use a unit that starts at zero")
    return parsed


@lru_cache(maxsize=1)
def _registry() -> Any:
    import pint  # the import takes a second: only where a text with a unit occurs

    return pint.UnitRegistry(cache_folder=None)


def _article(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"
