"""How a headline figure reads: the same text on the terminal and on the page of the report."""

import math
from collections.abc import Mapping
from typing import Any

DIGITS = 10
"""Digits of a figure of which no error is known."""
NOT_FINITE = {"inf": "∞", "-inf": "−∞", "nan": "NaN"}
"""How the JSON files of a run spell numbers that are not finite, and how they are shown."""
_FEW = 4
"""So many entries of a list are shown; all of them are in summary.json."""


def entry_text(entry: Mapping[str, Any]) -> str:
    """The value of an entry of summary.json: with `bound`, two digits of it, rounded up."""
    value, error = _decoded(entry.get("value")), _decoded(entry.get("error"))
    if entry.get("bound") is None or not isinstance(value, float) or not math.isfinite(value):
        return figure_text(value, error)
    if not value > 0:
        return figure_text(value)
    above = _above(value)
    decimals = max(0, 1 - math.floor(math.log10(above)))
    return f"≤ {above:.{decimals}f}" if 1e-3 <= above < 1e6 else f"≤ {_short(above)}"


def figure_text(value: Any, error: Any = None) -> str:
    """A number with the digits that `error`, a bound on its error, certifies, and that bound; else with
    ten. A list by its first entries; anything else as it stands.

    ```python
    >>> from dvax._figure_text import figure_text
    >>> figure_text(4231335.287107), figure_text(2.676123456, 3e-5), figure_text([1.0, 2.5, 3.0])
    ('4231335.287', '2.67612 ± 3e-05', '1, 2.5, 3')

    ```
    """
    if isinstance(value, list):
        errors = error if isinstance(error, list) else [error] * len(value)
        shown = ", ".join(map(figure_text, value[:_FEW], errors[:_FEW]))
        return shown + (f", … ({len(value)} in all)" if len(value) > _FEW else "")
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
    place = math.floor(math.log10(error))  # of the first digit of the error
    leading = math.floor(math.log10(abs(value))) if value else place
    digits = min(17, max(1, leading - place + 1))
    return f"{value:.{digits}g} ± {_short(_above(error))}"


def _decoded(value: Any) -> Any:
    """A number, or a list of them, as it was before it was written to JSON."""
    if isinstance(value, list):
        return [_decoded(entry) for entry in value]
    return float(value) if isinstance(value, str) and value in NOT_FINITE else value


def _short(error: float) -> str:
    return f"{error:.1e}".replace(".0e", "e")


def _above(error: float) -> float:
    """The error rounded up to two digits, so that what is shown is still a bound."""
    unit = 10.0 ** (math.floor(math.log10(error)) - 1)
    return math.ceil(error / unit * (1 - 1e-12)) * unit
