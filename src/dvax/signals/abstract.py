"""What a signal owes, and how an integrator learns which signals it depends on.

An integrator must end its steps on the knots of measured data: between them the data is smooth,
across them it is not, and a knot stepped over can lose a whole pulse. The data hides inside f, h
and K, which are ordinary functions, so they are listened to: while `listen()` is active, every
signal that is evaluated reports itself.
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


class Heard:
    """What was reported while listening: the knots, the span where all data exists, warnings."""

    def __init__(self, time: Any):
        self.time = time
        self.knots: list[Any] = []
        self.spans: list[tuple[Any, Any, str]] = []
        self.elsewhere: list[str] = []


@contextlib.contextmanager
def listen(time: Any) -> Iterator[Heard]:
    """Collect every signal evaluated at `time` (this very tracer) inside the `with` block."""
    heard = Heard(time)
    previous = getattr(_active, "heard", None)
    _active.heard = heard
    try:
        yield heard
    finally:
        _active.heard = previous


class AbstractSignal(eqx.Module):
    """A function of time with values in arrays of one shape."""

    @abc.abstractmethod
    def value(self, t: Any) -> jax.Array:
        """The value at time t; at a jump, the limit from the right."""

    @abc.abstractmethod
    def knots(self) -> Any:
        """The sorted times where the signal or a derivative jumps; an array, maybe empty."""

    @abc.abstractmethod
    def span(self) -> tuple[Any, Any]:
        """First and last time where the signal is defined. Outside it, its value is NaN."""

    def __call__(self, t: Any) -> jax.Array:
        self.report(t)
        return self.value(t)

    def report(self, t: Any) -> None:
        """Tell a listener, if there is one, about the knots and the span."""
        heard: Heard | None = getattr(_active, "heard", None)
        if heard is None:
            return
        knots, (first, last) = self.knots(), self.span()
        if np.shape(knots)[0] == 0 and not _bounded(first, last):
            return
        if t is not heard.time:
            # The knots in the integrator's time are unknown: t was shifted, scaled or recomputed.
            heard.elsewhere.append(repr(self))
            return
        heard.knots.append(knots)
        heard.spans.append((first, last, type(self).__name__))


def _bounded(first: Any, last: Any) -> bool:
    traced = isinstance(first, jax.core.Tracer) or isinstance(last, jax.core.Tracer)
    return traced or bool(np.isfinite(first) or np.isfinite(last))
