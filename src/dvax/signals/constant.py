"""Constant signals."""

from typing import Any

import jax
import numpy as np

from .. import _tree
from .abstract import AbstractSignal


class Constant(AbstractSignal):
    """s(t) = value.

    ```python
    >>> import dvax
    >>> float(dvax.signals.Constant(3.0)(0.7))
    3.0

    ```

    **Raises:** `dvax.InputError` if the value is not finite.
    """

    constant: jax.Array

    def __init__(self, value: Any):
        self.constant = _tree.as_array(value, "dvax.signals.Constant(value)")
        _tree.require(
            lambda: np.all(np.isfinite(self.constant)),
            "dvax.signals.Constant(value)",
            self.constant,
            "data must be finite",
            "Replace the values that are not",
        )

    def value(self, t: Any) -> jax.Array:
        return self.constant

    def knots(self) -> Any:
        return np.zeros(0)

    def span(self) -> tuple[Any, Any]:
        return -np.inf, np.inf
