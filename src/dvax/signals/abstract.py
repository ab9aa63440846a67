"""The abstract signal, and the detection of the signals that a function evaluates.

Steps must end at the knots of measured data: between knots the data are smooth, at a knot they are not,
and a step over a knot can miss a whole pulse. f, h and K are ordinary functions that may evaluate
signals. While `listen()` is active, every signal records its knots when it is evaluated.
"""

import abc
import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.core
import numpy as np

_active = threading.local()


class SignalReports:
    """The records of evaluated signals.

    `knots` are their knots, and `spans` the intervals on which they are defined, with their types.
    `unresolved` names the signals whose knots in t are unknown, since they were evaluated at another
    time than t.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> load, t = dvax.signals.Table([0.0, 1.0, 2.0], [0.0, 4.0, 2.0]), jnp.array(0.5)
    >>> with dvax.signals.listen(t) as reports:
    ...     value = load(t)
    >>> len(reports.knots), reports.unresolved
    (1, [])

    ```
    """

    def __init__(self, time: Any):
        self.time = time
        self.knots: list[Any] = []
        self.spans: list[tuple[Any, Any, str]] = []
        self.unresolved: list[str] = []


@contextlib.contextmanager
def listen(time: Any) -> Iterator[SignalReports]:
    """Record every signal that is evaluated at `time` (the same tracer object) in the `with` block.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> load, t = dvax.signals.Table([0.0, 1.0, 2.0], [0.0, 4.0, 2.0]), jnp.array(0.5)
    >>> with dvax.signals.listen(t) as reports:
    ...     value = 2.0 * load(t)
    >>> [knots.tolist() for knots in reports.knots]
    [[0.0, 1.0, 2.0]]

    ```
    """
    reports = SignalReports(time)
    previous = getattr(_active, "reports", None)
    _active.reports = reports
    try:
        yield reports
    finally:
        _active.reports = previous


class AbstractSignal(eqx.Module):
    """A function of time whose values are arrays of one shape.

    ```python
    >>> import dvax
    >>> load = dvax.signals.Table([0.0, 1.0, 2.0], [0.0, 4.0, 2.0])
    >>> isinstance(load, dvax.signals.AbstractSignal)
    True
    >>> load.knots().tolist(), [float(t) for t in load.span()]
    ([0.0, 1.0, 2.0], [0.0, 2.0])

    ```
    """

    @abc.abstractmethod
    def value(self, t: Any) -> jax.Array:
        """Return the value at time t; at a jump, the limit from the right."""

    @abc.abstractmethod
    def knots(self) -> Any:
        """Return the sorted times where the signal or a derivative jumps, an array."""

    @abc.abstractmethod
    def span(self) -> tuple[Any, Any]:
        """Return the first and last time where the signal is defined; it is NaN outside."""

    def __call__(self, t: Any) -> jax.Array:
        self.report(t)
        return self.value(t)

    def report(self, t: Any) -> None:
        """Record the knots and the span if `listen` is active."""
        reports: SignalReports | None = getattr(_active, "reports", None)
        if reports is None:
            return
        knots, (first, last) = self.knots(), self.span()
        if np.shape(knots)[0] == 0 and not _is_bounded(first, last):
            return
        if t is not reports.time:
            # The knots in the integrator's time are unknown: t was shifted, scaled or recomputed.
            reports.unresolved.append(repr(self))
            return
        reports.knots.append(knots)
        reports.spans.append((first, last, type(self).__name__))


def _is_bounded(first: Any, last: Any) -> bool:
    traced = isinstance(first, jax.core.Tracer) or isinstance(last, jax.core.Tracer)
    return traced or bool(np.isfinite(first) or np.isfinite(last))
