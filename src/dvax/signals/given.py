"""What a user may give where a function of time is wanted."""

from collections.abc import Callable
from typing import Any

from .abstract import AbstractSignal
from .constant import Constant
from .function import Function


def as_signal(value: Any, constant: Callable[[Any], Any]) -> AbstractSignal:
    """A signal as it is, a callable of t as a `Function`; of anything else `constant` makes the array
    of a `Constant`, or raises.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> float(dvax.signals.as_signal(2.0, jnp.asarray)(0.7))
    2.0

    ```
    """
    if isinstance(value, AbstractSignal):
        return value
    return Function(value) if callable(value) else Constant(constant(value))
