"""The text of a result, for the terminal and for the page of the report."""

import math
from collections.abc import Mapping
from typing import Any

DIGITS = 10
"""Number of digits of a result with unknown error."""
NOT_FINITE = {"inf": "∞", "-inf": "−∞", "nan": "NaN"}
"""Non-finite numbers, as the JSON files of a run and as the terminal and the page write them."""
_MAX_ENTRIES = 4
"""Number of entries of a list that are shown; summary.json has all of them."""


def entry_text(entry: Mapping[str, Any]) -> str:
    """Return the text of an entry of summary.json; a `bound` has two digits, rounded up."""
    value, error = _decoded(entry.get("value")), _decoded(entry.get("error"))
    if entry.get("bound") is None or not isinstance(value, float) or not math.isfinite(value):
        return figure_text(value, error)
    if not value > 0:
        return figure_text(value)
    bound = _round_up(value)
    decimals = max(0, 1 - math.floor(math.log10(bound)))
    return f"≤ {bound:.{decimals}f}" if 1e-3 <= bound < 1e6 else f"≤ {_short(bound)}"


def figure_text(value: Any, error: Any = None) -> str:
    """Return the text of a number, a list or another value.

    A number has the digits that `error`, a bound on its error, certifies, followed by this bound;
    without a bound it has ten digits. A list is shown by its first entries.

    ```python
    >>> from dvax._figure_text import figure_text
    >>> figure_text(4231335.287107), figure_text(2.676123456, 3e-5), figure_text([1.0, 2.5, 3.0])
    ('4231335.287', '2.67612 ± 3e-05', '1, 2.5, 3')

    ```
    """
    if isinstance(value, list):
        errors = error if isinstance(error, list) else [error] * len(value)
        shown = ", ".join(map(figure_text, value[:_MAX_ENTRIES], errors[:_MAX_ENTRIES]))
        return shown + (f", … ({len(value)} in all)" if len(value) > _MAX_ENTRIES else "")
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "not known" if value is None else str(value)
    if isinstance(value, int):
        return str(value)
    if not math.isfinite(value):
        return NOT_FINITE[str(float(value))]
    value += 0.0  # no negative zero
    if error is None or not math.isfinite(error) or error < 0:
        return f"{value:.{DIGITS}g}"
    if error == 0:
        return f"{value:.17g}"
    error_exponent = math.floor(math.log10(error))
    exponent = math.floor(math.log10(abs(value))) if value else error_exponent
    digits = min(17, max(1, exponent - error_exponent + 1))
    return f"{value:.{digits}g} ± {_short(_round_up(error))}"


def _decoded(value: Any) -> Any:
    """Return a value of a JSON file with its strings for non-finite numbers replaced by numbers."""
    if isinstance(value, list):
        return [_decoded(entry) for entry in value]
    return float(value) if isinstance(value, str) and value in NOT_FINITE else value


def _short(error: float) -> str:
    return f"{error:.1e}".replace(".0e", "e")


def _round_up(error: float) -> float:
    """Return the error rounded up to two digits, which is still a bound."""
    unit = 10.0 ** (math.floor(math.log10(error)) - 1)
    return math.ceil(error / unit * (1 - 1e-12)) * unit
