"""A loop whose number of turns is found while it runs, and through which derivatives go both ways."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def turns(
    count: Any, turn: Callable[[Any, Any], Any], carry: Any, run: int, branches: tuple[int, ...]
) -> Any:
    """`turn(j, carry)` for j from 0 to `count`, rounded up to a multiple of `run`.

    A tree of loops of fixed length whose idle branches are skipped, so that derivatives go backward
    through it; only what each run began with is kept for them.
    """

    def leaf(start: Any, carry: Any) -> Any:
        return lax.fori_loop(0, run, lambda j, carry: turn(start + j, carry), carry)

    def branch(inner: Callable, many: int, width: int) -> Callable:
        def several(start: Any, carry: Any) -> Any:
            def one(carry: Any, j: Any) -> tuple[Any, None]:
                begin = start + j * width
                return lax.cond(
                    begin < count, lambda carry: inner(begin, carry), lambda carry: carry, carry
                ), None

            return lax.scan(one, carry, jnp.arange(many))[0]

        return several

    whole, width = jax.checkpoint(leaf), run
    for many in branches:
        whole, width = branch(whole, many, width), width * many
    return whole(jnp.asarray(0), carry)
