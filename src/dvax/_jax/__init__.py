"""Everything that rests on interfaces which JAX does not promise to keep, each with a plain fallback.

`outlined` compiles small programs as one function of the processor where JAX does not do so itself
(before 0.12); elsewhere, and where an interface that it needs is absent, it is a plain call.
`OUTLINES` says which. `forward_only` only improves an error; without it, values are the same.
"""

from collections.abc import Callable
from typing import Any

import jax

_FASTER_WITHOUT = (0, 12)
"""The first release of JAX that compiles small programs well by itself."""


def _plain(run: Callable[..., Any], *args: Any, large: Any = (), transposable: bool = False) -> Any:
    """Return run(*args, *large)."""
    del transposable
    return run(*args, *large)


def _identity(tree: Any) -> Any:
    """Return the same values."""
    return tree


def _choose_forward_only() -> Callable[[Any], Any]:
    try:
        from .forward_only import forward_only
    except (ImportError, AttributeError):
        return _identity
    return forward_only


def _choose_outlined() -> Callable[..., Any]:
    """Return the outlined call where it is of use and can be built, and the plain one elsewhere."""
    if jax.__version_info__[:2] >= _FASTER_WITHOUT:
        return _plain
    try:
        from .outlined import outlined
    except (ImportError, AttributeError):
        # A JAX without the interfaces that it is built from: slower, with the same results.
        return _plain
    return outlined


outlined: Callable[..., Any] = _choose_outlined()

forward_only: Callable[[Any], Any] = _choose_forward_only()

OUTLINES = outlined is not _plain
"""Whether small programs are compiled as one function at the request of dvax."""
