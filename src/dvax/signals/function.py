"""Signals given by a function of time."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree
from ..errors import input_error
from .abstract import AbstractSignal


class Function(AbstractSignal):
    """s(t) = fn(t) for a traceable `fn` that is smooth except at the times `knots`.

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
        _tree.check_kind(
            fn, Callable, "dvax.signals.Function(fn)", "it must be a function of t",
            "Write lambda t: ..., or dvax.signals.Constant(...) for one value",
        )  # fmt: skip
        self.fn = fn
        if not _tree.is_concrete(knots):
            self.times = jnp.sort(jnp.asarray(knots).ravel())
        else:
            self.times = np.sort(_times(knots))

    def value(self, t: Any) -> jax.Array:
        return jnp.asarray(self.fn(t))

    def knots(self) -> Any:
        return self.times

    def span(self) -> tuple[Any, Any]:
        return -np.inf, np.inf


def _times(knots: Any) -> np.ndarray:
    """Return the knots, one time or several, as a vector."""
    try:
        times = np.atleast_1d(np.asarray(knots))
    except ValueError:  # rows of several lengths
        times = np.empty((0, 0))
    numbers = times.dtype.kind in "iuf" or times.size == 0
    if times.ndim != 1 or not numbers or np.any(np.isnan(times.astype(float))):
        raise input_error(
            "dvax.signals.Function(knots)", _tree.line(knots),
            "it must be a time, or a list of times, where fn is not smooth",
            "Write knots=[0.5, 1.0]",
        )  # fmt: skip
    return times.astype(float)
