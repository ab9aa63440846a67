"""The `repr` of results: a title, and a line with numbers for each property."""

import math
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.tree_util as jtu
import numpy as np

from ._figure_text import NOT_FINITE

_MAX_SHOWN, _MAX_SEARCHED = 4, 10**6
"""Entries of an array that are shown; entries among which the smallest and the largest are found."""


def table(title: str, rows: Iterable[tuple[str, str]]) -> str:
    """Return a title and aligned lines of names and texts; empty texts are left out.

    ```python
    >>> from dvax._repr import table
    >>> print(table("Bound: proved", [("x", "1e-9"), ("status", ""), ("u", "2e-9")]))
    Bound: proved
      x  1e-9
      u  2e-9

    ```
    """
    kept = [row for row in rows if row[1]]
    width = max((len(name) for name, _ in kept), default=0)
    return "\n".join([title, *(f"  {name:<{width}}  {text}" for name, text in kept)])


def value_text(value: Any, digits: int = 7) -> str:
    """Return a number, the entries of a short array, or type, shape and range of a longer one; the
    parts of a tree in order. What has no values (a traced array, a shape) is shown by its type.

    ```python
    >>> import numpy as np
    >>> from dvax._repr import value_text
    >>> value_text(np.array([1.0, 2.5])), value_text(np.linspace(0.0, 1.0, 11))
    ('[1, 2.5]', 'float64 (11,), 0 to 1')

    ```
    """
    return "; ".join(_leaf(leaf, digits) for leaf in jtu.tree_leaves(value))


def last_text(values: Any) -> str:
    """Return the last entry of an array over the saved times, or its type where it has no values."""
    return _leaf(values[-1] if is_known(values) and values.ndim == 1 and values.size else values, 3)


def is_known(leaf: Any) -> bool:
    """Return whether the values of an array are here."""
    if isinstance(leaf, jax.Array) and not isinstance(leaf, jax.core.Tracer):
        return leaf.is_fully_addressable and not leaf.is_deleted()
    return isinstance(leaf, np.ndarray | np.generic | float | int)


def _leaf(leaf: Any, digits: int) -> str:
    if not is_known(leaf):
        return eqx.tree_pformat(leaf)
    array = np.asarray(leaf)
    if array.ndim == 0:
        return _number(array[()], digits)
    if array.ndim == 1 and array.size <= _MAX_SHOWN:
        return f"[{', '.join(_number(entry, digits) for entry in array)}]"
    text = f"{array.dtype} {array.shape}"
    if not 0 < array.size <= _MAX_SEARCHED:
        return text
    missing = int((~np.isfinite(array)).sum())
    if missing:
        return f"{text}, {missing} not finite"
    return f"{text}, {_number(array.min(), 4)} to {_number(array.max(), 4)}"


def _number(value: Any, digits: int) -> str:
    if not isinstance(value, float | np.floating):
        return str(value)
    return f"{value:.{digits}g}" if math.isfinite(value) else NOT_FINITE[str(float(value))]
