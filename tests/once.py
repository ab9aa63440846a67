"""Problems that are made once, so that tests share their compiled programs."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
T = TypeVar("T")


def once(make: Callable[P, T]) -> Callable[P, T]:
    """Return `make` with its results kept: dvax compiles one program for all calls with the same
    functions. Arrays are made outside of a trace that may be under way at the first call."""
    kept = functools.cache(make)

    @functools.wraps(make)
    def made(*given: P.args, **named: P.kwargs) -> T:
        with jax.ensure_compile_time_eval():
            return kept(*given, **named)

    return made
