"""The bound on the error of the state in summary.json: which figure it is, and whether it is of use."""

import math
from collections.abc import Mapping
from typing import Any

from dvax._figure_text import entry_text
from dvax.theory.status import ORDER

REMEDY = (
    "A shorter run or a smaller tolerance makes it smaller; the page Troubleshooting by message of the "
    "documentation (docs/howto/troubleshooting.md) lists the reasons."
)
"""What to try if a bound certifies no digit."""
_STATE_BOUNDS = ("error_bound", "error_bound_sharp_x", "error_bound_x")
"""The figures that bound the error of the state."""


def best_bound(summary: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """Return the bound on the error of the state, the smallest where there are several; None without
    one."""
    entries = [summary[name] for name in _STATE_BOUNDS if "bound" in summary.get(name, {})]
    return min(entries, key=_size_of, default=None)


def is_finite(entry: Mapping[str, Any]) -> bool:
    """Whether a bound is a finite number."""
    return math.isfinite(_size_of(entry))


def certifies_no_digit(entry: Mapping[str, Any]) -> bool:
    """Whether a bound is as large as the norm of the solution, or larger."""
    relative = entry.get("relative")
    return isinstance(relative, int | float) and relative >= 1


def useless_bound(summary: Mapping[str, Mapping[str, Any]], remedy: str) -> str | None:
    """Return a sentence on a bound that certifies no digit, with the remedy; None for a useful bound,
    and without one."""
    entry = best_bound(summary)
    if entry is None or entry["bound"] not in ORDER:
        return None
    if not is_finite(entry):
        why = f": {entry['why']}" if "why" in entry else ""
        said = f"The error bound is not finite, so that it states nothing about the error{why}."
        return f"{said} {remedy}"
    if not certifies_no_digit(entry):
        return None
    amount = entry_text(entry).removeprefix("≤ ")
    return (
        f"The error bound {amount} exceeds the norm of the solution, so that it certifies no digit. "
        f"{remedy}"
    )


def _size_of(entry: Mapping[str, Any]) -> float:
    value = entry.get("value")
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else math.inf
