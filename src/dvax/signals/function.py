"""A formula in time."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from .abstract import AbstractSignal


class Function(AbstractSignal):
    """s(t) = fn(t) for a smooth, traceable `fn`; name the times where it is not smooth in `knots`.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> ramp = dvax.signals.Function(lambda t: jnp.minimum(t, 1.0), knots=[1.0])
    >>> float(ramp(2.0))
    1.0

    ```
    """

    fn: Callable[[Any], Any]
    times: jax.Array | np.ndarray

    def __init__(self, fn: Callable[[Any], Any], knots: Any = ()):
        self.fn = fn
        if not _tree.is_concrete(knots):
            self.times = jnp.sort(jnp.asarray(knots).ravel())
        else:
            self.times = np.sort(np.asarray(knots, dtype=float))

    def value(self, t: Any) -> jax.Array:
        return jnp.asarray(self.fn(t))

    def knots(self) -> Any:
        return self.times

    def span(self) -> tuple[Any, Any]:
        return -np.inf, np.inf
