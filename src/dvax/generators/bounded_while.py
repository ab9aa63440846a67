"""A loop with a traced number of iterations that is differentiable in forward and reverse mode."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def bounded_while(
    count: Any,
    body: Callable[[Any, Any], Any],
    carry: Any,
    block: int,
    widths: tuple[int, ...],
) -> Any:
    """Apply carry ← body(j, carry) for j = 0, …, count − 1, rounded up to a multiple of `block`.

    The loop is a tree of loops of the fixed lengths `block` and `widths`, which bound the number of
    iterations. Subtrees that start beyond `count` are skipped. The reverse pass stores the carries of
    one subtree a level and recomputes the others.
    """

    def innermost(start: Any, carry: Any) -> Any:
        return lax.fori_loop(0, block, lambda j, carry: body(start + j, carry), carry)

    def enclose(inner: Callable, width: int, size: int) -> Callable:
        def outer(start: Any, carry: Any) -> Any:
            def subtree(carry: Any, j: Any) -> tuple[Any, None]:
                begin = start + j * size
                return lax.cond(
                    begin < count, lambda carry: inner(begin, carry), lambda carry: carry, carry
                ), None

            return lax.scan(subtree, carry, jnp.arange(width))[0]

        return outer

    loop, size = innermost, block
    for width in widths:
        # At every level: otherwise the values that a level stores are copied by the one around it,
        # those of skipped subtrees included.
        loop, size = enclose(jax.checkpoint(loop), width, size), size * width
    return loop(jnp.asarray(0), carry)
