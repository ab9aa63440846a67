"""When JAX compiles, and how long it took: to tell it apart from solving, and to use the time."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dvax._jax.compile_clock import listen

# The time loop takes 0.2 s to write down for the compiler, a single operation 0.01 s.
_LARGE = 0.05
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


def compile_clock() -> Callable[[], float]:
    """What tells the seconds spent on compilation since now: those of one run, where a process has
    several one after the other."""
    before = compile_seconds()
    return lambda: compile_seconds() - before


@contextmanager
def announced(announce: Callable[[], None]) -> Iterator[None]:
    """Call `announce` once, when the first large program is traced and goes to the compiler.

    The compiler needs neither Python nor more than a core: from then on other work costs nothing.
    While JAX traces, which is Python, it would.
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
    if stage == "lower" and seconds > _LARGE and _announce is not None:
        call, _announce = _announce, None
        call()
