"""Entries of nested tables by their dotted keys, such as "model.parameters.rate"."""

from collections.abc import Callable, Mapping
from typing import Any


def flat_keys(
    table: Mapping[str, Any],
    is_value: Callable[[Mapping[str, Any]], bool] = lambda table: False,
    prefix: str = "",
) -> dict[str, Any]:
    """Return the entries of nested tables by their dotted keys; `is_value` recognises a table that is
    a value."""
    entries: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, Mapping) and not is_value(value):
            entries |= flat_keys(value, is_value, f"{prefix}{key}.")
        else:
            entries[f"{prefix}{key}"] = value
    return entries


def set_key(table: dict[str, Any], dotted: str, value: Any) -> None:
    """Set an entry of nested tables, which are made where they are missing.

    **Raises:** `LookupError` with name and value of an entry on the way that is no table.
    """
    *tables, last = dotted.split(".")
    for name in tables:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise LookupError(name, table)
    table[last] = value
