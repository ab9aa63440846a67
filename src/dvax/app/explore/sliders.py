"""The numbers in the table `[model]` of a configuration as sliders.

A slider goes from a tenth of the value to ten times it, within the limits of the schema; around zero
and for negative numbers, by twice the size of the value to both sides.
"""

import re
from collections.abc import Iterator
from typing import Any

from pydantic.fields import FieldInfo

from dvax.app.explore.subject import Parameter
from dvax.app.runs.applications.config import OWN, ModelConfig
from dvax.app.runs.applications.from_model import FramesKeys

_NOT_MOVED = set(FramesKeys.model_fields) | {"seed", "bound_steps"}
"""Options of the solver do not change the exact solution."""


def sliders(config: ModelConfig) -> tuple[Parameter, ...]:
    """Return a slider for each number that the configuration has or takes by default."""
    table = config.table
    found = [
        _slider(f"model.{key}", getattr(table, key), *_words(key, field), *_limits(field))
        for key, field in type(table).model_fields.items()
        if key not in _NOT_MOVED and _is_number(getattr(table, key))
    ]
    if config.name == OWN:
        units = getattr(config.model, "units", {})
        found += [
            _slider(f"model.parameters.{key}", value, key, units.get(key, ""), -1e300, 1e300)
            for key, value in table.model_dump()["parameters"].items()
            if _is_number(value)
        ]
    return tuple(found)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _words(key: str, field: FieldInfo) -> tuple[str, str]:
    """Return the label of a key, and its unit, which ends the description in brackets."""
    text = field.description or ""
    unit = re.search(r"\[([^\]]+)\]$", text)
    return key.replace("_", " "), unit[1] if unit else ""


def _limits(field: FieldInfo) -> tuple[float, float]:
    low = [float(v) for m in field.metadata for v in _bounds(m, "gt", "ge")]
    high = [float(v) for m in field.metadata for v in _bounds(m, "lt", "le")]
    return max(low, default=-1e300), min(high, default=1e300)


def _bounds(metadata: Any, *names: str) -> Iterator[Any]:
    for name in names:
        bound = getattr(metadata, name, None)
        if bound is not None:
            yield bound


def _slider(
    key: str, value: float, label: str, unit: str, least: float, most: float
) -> Parameter:  # fmt: skip
    whole = isinstance(value, int)
    if value > 0:
        low, high = value / 10, 10 * value
    else:
        room = 2 * abs(value) or 1.0
        low, high = value - room, value + room
    low, high = max(low, least), min(high, most)
    if whole:
        low, high = max(1.0 if value > 0 else low, round(low)), round(high)
    return Parameter(
        key, label, unit, float(low), float(high), float(value), value > 0 and not whole, whole
    )
