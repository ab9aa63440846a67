"""Compile small programs as one function of the processor, where JAX does not do so itself.

Up to 0.11, JAX compiles a program for a CPU to a list of kernels, and to call one takes longer than the
arithmetic on a handful of numbers. XLA can compile a program as one function instead, and does so of
its own accord for the tiniest loops. Two attributes ask for the same where a program is known to be
small (`marked`, `small`). Loops that are small but for calls of a library are divided into few
functions (`divided`).

From JAX 0.12 on, small programs run without this at the speed that it brings, and compile in half the
time; the attributes make them slower, and abort the compiler on some loops that call a library.
There, and wherever the interfaces that this package needs are absent, `in_one_function` calls the
program as it is. `OUTLINES` says which of the two this JAX gets.
"""

from collections.abc import Callable
from typing import Any

import jax

_FASTER_WITHOUT = (0, 12)
"""The first release of JAX that needs no help."""


def _plain(
    run: Callable[..., Any],
    *args: Any,
    computed: Any = (),
    otherwise: Callable[..., Any] | None = None,
) -> Any:
    """Return run(*args, *computed), or otherwise(*args, *computed), for XLA to compile as it likes."""
    return (otherwise or run)(*args, *computed)


def _chosen() -> Callable[..., Any]:
    """Return the outlined call where it is of use and can be built, and the plain one elsewhere."""
    if jax.__version_info__[:2] >= _FASTER_WITHOUT:
        return _plain
    try:
        from .call import in_one_function
    except (ImportError, AttributeError):
        # A JAX without the interfaces that it is built from: slower, with the same results.
        return _plain
    return in_one_function


in_one_function: Callable[..., Any] = _chosen()

OUTLINES = in_one_function is not _plain
"""Whether small programs are compiled as one function at dvax's request."""
