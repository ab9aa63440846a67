"""All code that uses unstable interfaces of JAX, with fallbacks.

`outlined` compiles a small program as one CPU function on JAX before 0.12. From 0.12 on, JAX does this
itself, and `outlined` is a plain call; so it is if an interface is missing. `OUTLINES` says which.
`forward_only` improves an error message only.
"""

from collections.abc import Callable
from typing import Any

import jax

_FIRST_WITHOUT = (0, 12)
"""The first release of JAX on which outlining is not necessary."""


def _plain(run: Callable[..., Any], *args: Any, large: Any = ()) -> Any:
    """Return run(*args, *large)."""
    return run(*args, *large)


def _identity(tree: Any) -> Any:
    """Return the argument."""
    return tree


def _choose_forward_only() -> Callable[[Any], Any]:
    try:
        from .forward_only import forward_only
    except (ImportError, AttributeError):
        return _identity
    return forward_only


def _choose_outlined() -> Callable[..., Any]:
    """Return the outlined call if it is useful and available, else the plain one."""
    if jax.__version_info__[:2] >= _FIRST_WITHOUT:
        return _plain
    try:
        from .outlined import outlined
    except (ImportError, AttributeError):
        # This JAX lacks an interface: plain calls are slower, with the same results.
        return _plain
    return outlined


outlined: Callable[..., Any] = _choose_outlined()

forward_only: Callable[[Any], Any] = _choose_forward_only()

OUTLINES = outlined is not _plain
"""True if dvax compiles small programs as one function."""
