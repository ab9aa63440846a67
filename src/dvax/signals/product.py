"""Products of signals, such as a spatial profile times a time series."""

from typing import Any

import jax
import numpy as np

from .. import _tree
from .abstract import AbstractSignal
from .constant import Constant


class Product(AbstractSignal):
    """s(t) = a(t) b(t), with broadcasting. A profile times a time series is a separable field.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> s = dvax.signals
    >>> field = s.Product(s.Constant(jnp.array([1.0, 2.0])), s.Table([0.0, 1.0], [0.0, 10.0]))
    >>> field(0.5).tolist()
    [5.0, 10.0]

    ```
    """

    a: AbstractSignal
    b: AbstractSignal

    def __init__(self, a: AbstractSignal, b: Any):
        _tree.check_kind(
            a, AbstractSignal, "dvax.signals.Product(a)", "it must be a signal of dvax.signals",
            "The signal comes first; write dvax.signals.Constant(a) for one value",
        )  # fmt: skip
        self.a = a
        self.b = b if isinstance(b, AbstractSignal) else Constant(b)

    def value(self, t: Any) -> jax.Array:
        return self.a(t) * self.b(t)

    def knots(self) -> Any:
        # The factors record their knots when they are evaluated.
        return np.zeros(0)

    def span(self) -> tuple[Any, Any]:
        return -np.inf, np.inf
