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

    @functools.cache
    def made(*given, **named):
        with jax.ensure_compile_time_eval():
            return make(*given, **named)

    return functools.wraps(make)(made)
