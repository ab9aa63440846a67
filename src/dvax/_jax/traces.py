"""The identity of the trace in which the current code runs."""

import threading
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import jax
from jax.extend.core import get_opaque_trace_state


def current_trace() -> Any:
    """Return an object that is equal to another one if both were made in the same trace: values that a
    function computed in one trace must not be used in another."""
    return get_opaque_trace_state()


def _outside() -> Any:
    """Return the trace outside of all transformations, in which each thread starts: this module may be
    imported inside of one."""
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(current_trace()))
    thread.start()
    thread.join()
    return found[0]


_OUTSIDE = _outside()


def evaluates() -> AbstractContextManager[None]:
    """Return a context in which a call with concrete arguments is evaluated, though a transformation of
    other values runs.

    Outside of transformations it is empty: `jax.ensure_compile_time_eval` would compile a program for
    each operation on constants of a function that is traced in it.
    """
    return nullcontext() if current_trace() == _OUTSIDE else jax.ensure_compile_time_eval()
