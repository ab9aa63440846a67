"""The rules of slope arithmetic for operations that contain programs: loops and conditionals."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..interpreter import MAX_UNROLLED, Rule, unroll
from .values import is_slope

Run = Callable[[Any, list[Any]], list[Any]]
"""A function that interprets a program for these inputs."""


@functools.lru_cache(512)
def _row(shape: tuple[int, ...], dtype: str, k: int) -> Any:
    take = lambda v: lax.index_in_dim(v, k, keepdims=False)  # noqa: E731
    return jax.make_jaxpr(take)(jax.ShapeDtypeStruct(shape, dtype))


@functools.lru_cache(512)
def _stack(count: int, shape: tuple[int, ...], dtype: str) -> Any:
    one = jax.ShapeDtypeStruct(shape, dtype)
    return jax.make_jaxpr(lambda *rows: jnp.stack(rows))(*(one for _ in range(count)))


@functools.lru_cache(512)
def _choice(shape: tuple[int, ...], dtype: str) -> Any:
    one = jax.ShapeDtypeStruct(shape, dtype)
    choose = lambda which, no, yes: lax.select_n(which, no, yes)  # noqa: E731
    return jax.make_jaxpr(choose)(jax.ShapeDtypeStruct((), bool), one, one)


def program_rules(run: Run) -> dict[str, Rule]:
    """Return the rules, with the function that interprets an inner program."""

    def loop(eqn: Any, operands: list[Any]) -> list[Any] | None:
        """Return the slopes of an unrolled loop."""

        def row(value: Any, k: int) -> Any:
            if not is_slope(value):
                return np.asarray(value)[k]
            return run(_row(value.low.shape, str(value.low.dtype), k), [value])[0]

        def stack(rows: list[Any]) -> Any:
            first = rows[0].low if is_slope(rows[0]) else np.asarray(rows[0])
            return run(_stack(len(rows), first.shape, str(first.dtype)), rows)[0]

        return unroll(eqn, operands, run, row, stack)

    def repeat(eqn: Any, operands: list[Any]) -> list[Any] | None:
        """Return the slopes of a loop whose condition does not depend on the variables."""
        p = eqn.params
        first, second = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
        of_condition, of_body, carry = operands[:first], operands[first:second], operands[second:]
        for _ in range(MAX_UNROLLED + 1):
            (goes_on,) = run(p["cond_jaxpr"], [*of_condition, *carry])
            if is_slope(goes_on):
                return None
            if not bool(goes_on):
                return list(carry)
            carry = run(p["body_jaxpr"], [*of_body, *carry])
        return None

    def branch(eqn: Any, operands: list[Any]) -> list[Any] | None:
        """Return the slopes of the branch that is taken, or of a selection of two."""
        index, *arguments = operands
        branches = eqn.params["branches"]
        if not is_slope(index):
            return run(branches[int(np.clip(index, 0, len(branches) - 1))], arguments)
        if len(branches) != 2 or index.source is None:
            return None
        source = index.source
        which = source.operands[0] if source.eqn.primitive.name == "convert_element_type" else None
        if which is None or not is_slope(which) or which.low.dtype != bool:
            return None
        cases = [run(each, arguments) for each in branches]
        results = []
        for no, yes, out in zip(*cases, eqn.outvars, strict=True):
            program = _choice(out.aval.shape, str(out.aval.dtype))
            results += run(program, [which, no, yes])
        return results

    return {"scan": loop, "while": repeat, "cond": branch}


PROGRAMS = program_rules(lambda program, inputs: inputs)
"""The operations that have rules; an enclosure takes them with its own interpreter."""
