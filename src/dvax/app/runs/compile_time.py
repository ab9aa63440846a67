"""The time that JAX compiles, measured by its monitoring events."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dvax._jax.compile_clock import listen

# Lowering the time loop takes 0.2 s, a single operation 0.01 s.
_LONG_LOWERING = 0.05
_spent = 0.0
_listening = False
_announce: Callable[[], None] | None = None


def compile_seconds() -> float:
    """Seconds spent on compilation since the first call of this function."""
    global _listening
    if not _listening:
        listen(_add)
        _listening = True
    return _spent


def compile_stopwatch() -> Callable[[], float]:
    """Return a function that returns the seconds spent on compilation since this call."""
    before = compile_seconds()
    return lambda: compile_seconds() - before


@contextmanager
def call_when_compiling(announce: Callable[[], None]) -> Iterator[None]:
    """Call `announce` once, when the first large program has been lowered and goes to the compiler.

    The compiler releases the interpreter lock and uses one core, so other work is free from then on;
    while JAX traces, in Python, it is not.
    """
    global _announce
    compile_seconds()
    _announce = announce
    try:
        yield
    finally:
        _announce = None


def _add(stage: str, seconds: float) -> None:
    global _spent, _announce
    _spent += seconds
    if stage == "lower" and seconds > _LONG_LOWERING and _announce is not None:
        call, _announce = _announce, None
        call()
