"""Conversion of user input to signals."""

from collections.abc import Callable
from typing import Any

from .abstract import AbstractSignal
from .constant import Constant
from .function import Function


def as_signal(value: Any, constant: Callable[[Any], Any]) -> AbstractSignal:
    """Return a signal unchanged, a callable of t as a `Function`, and other values as a `Constant`.

    `constant` converts the value of a `Constant` to an array, or raises an error.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> float(dvax.signals.as_signal(2.0, jnp.asarray)(0.7))
    2.0

    ```
    """
    if isinstance(value, AbstractSignal):
        return value
    return Function(value) if callable(value) else Constant(constant(value))
