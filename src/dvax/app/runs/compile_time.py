"""The time that JAX compiles."""

from collections.abc import Callable

from dvax._jax.compile_clock import listen

_seconds = [0.0]


def compile_seconds() -> float:
    """Seconds spent on tracing, lowering and compilation since this module was imported."""
    return _seconds[0]


def compile_stopwatch() -> Callable[[], float]:
    """Return a function that returns the seconds spent on compilation since this call."""
    before = compile_seconds()
    return lambda: compile_seconds() - before


def _add(stage: str, seconds: float) -> None:
    _seconds[0] += seconds


listen(_add)
