"""Access to traced programs (jaxprs): operations, inner programs and loops.

A traced program is a `ClosedJaxpr`: a list of equations, each of which applies a primitive to variables
and literals, and the arrays that the traced function closes over.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp


def _types() -> tuple[Any, ...]:
    """Return the types `ClosedJaxpr`, `Jaxpr` and `Literal`, from a program that is traced here."""
    program = jax.make_jaxpr(lambda v: v + 1.0)(1.0)
    return type(program), type(program.jaxpr), type(program.jaxpr.eqns[0].invars[1])


try:
    from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
except ImportError:
    ClosedJaxpr, Jaxpr, Literal = _types()

__all__ = ["ClosedJaxpr", "Jaxpr", "Literal"]

CUSTOM = frozenset({"custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"})
"""Calls of a function with a custom derivative rule."""

CALLS = CUSTOM | {
    "jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint",
}  # fmt: skip
"""Primitives that apply one inner program to their arguments."""

LOOPS = frozenset({"while", "scan"})
"""Primitives that repeat an inner program."""


def bind(eqn: Any, operands: list[Any], **others: Any) -> list[Any]:
    """Return the results of one operation on these arrays, with some `others` of its parameters."""
    with eqn.ctx.manager:
        params = eqn.primitive.get_bind_params(eqn.params) | others
        results = eqn.primitive.bind(*operands, **params)
    return list(results) if eqn.primitive.multiple_results else [results]


def read(environment: dict[Any, Any], atoms: Any) -> list[Any]:
    """Return the values of variables and literals in an environment of variables."""
    return [atom.val if isinstance(atom, Literal) else environment[atom] for atom in atoms]


def source_lines(eqn: Any) -> list[tuple[str, int]]:
    """Return (file, line) of the calls that created an equation, innermost first."""
    traceback = eqn.source_info.traceback
    return [] if traceback is None else [(f.file_name, f.line_num) for f in traceback.frames]


def count_operations(program: Any) -> int:
    """Return the number of operations of a program, with those of its inner programs."""
    return sum(
        1 + sum(map(count_operations, nested_programs(e.params))) for e in program.jaxpr.eqns
    )


def has_loop(program: Any) -> bool:
    """Return whether a program contains a loop."""
    return has_operation(program, LOOPS)


def has_operation(program: Any, names: Any) -> bool:
    """Return whether a program contains one of these primitives."""
    return any(
        e.primitive.name in names
        or any(has_operation(inner, names) for inner in nested_programs(e.params))
        for e in program.jaxpr.eqns
    )


def nested_programs(params: dict[str, Any]) -> list[Any]:
    """Return the programs among the parameters of an operation, such as the branches of a `cond`."""
    programs = []
    for value in params.values():
        for one in value if isinstance(value, tuple | list) else (value,):
            if isinstance(one, ClosedJaxpr | Jaxpr):
                programs.append(one if isinstance(one, ClosedJaxpr) else ClosedJaxpr(one, ()))
    return programs


def inner_program(eqn: Any) -> Any:
    """Return the program that a call applies to its arguments, or None for another operation.

    A polynomial, which is one operation from JAX 0.12 on, counts as a call of Horner's scheme, and so
    does 1 − x², of the derivative of tanh.
    """
    if eqn.primitive.name == "one_minus_square":
        x = eqn.invars[0].aval
        return _one_minus_square(x.shape, str(x.dtype))
    if eqn.primitive.name == "polynomial":
        return _horner(*((v.aval.shape, str(v.aval.dtype)) for v in eqn.invars))
    if eqn.primitive.name not in CALLS:
        return None
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
        inner = eqn.params.get(key)
        # From JAX 0.12 on the two types are the same, and a program contains its constants.
        if isinstance(inner, Jaxpr) and not isinstance(inner, ClosedJaxpr):
            inner = ClosedJaxpr(inner, ())
        if isinstance(inner, ClosedJaxpr) and len(inner.jaxpr.invars) == len(eqn.invars):
            return inner
    return None


def applies_function(eqn: Any) -> bool:
    """Return whether an operation replaces entries by a function of them, `x.at[i].apply(fn)`: a
    scatter, as that which writes given values, but with a program."""
    return eqn.primitive.name == "scatter" and eqn.params.get("update_jaxpr") is not None


@functools.lru_cache(64)
def _one_minus_square(shape: tuple[int, ...], dtype: str) -> Any:
    return jax.make_jaxpr(lambda x: 1.0 - x * x)(jax.ShapeDtypeStruct(shape, dtype))


@functools.lru_cache(64)
def _horner(*types: tuple[tuple[int, ...], str]) -> Any:
    """Return the program of c₀ + x (c₁ + x (c₂ + …)) for x and coefficients of these types."""

    def value(x: Any, *coefficients: Any) -> Any:
        *others, total = coefficients
        total = jnp.broadcast_to(total, x.shape)
        for c in reversed(others):
            total = total * x + c
        return total

    return jax.make_jaxpr(value)(*(jax.ShapeDtypeStruct(*each) for each in types))


def scan_counts(params: dict[str, Any]) -> tuple[int, int] | None:
    """Return the numbers of constant and of carried arguments of a `lax.scan`, or None if this JAX
    represents it in another way."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    try:
        constants, carry, *_ = params["ft_in"].elts  # from JAX 0.12 on
        counts = [len(list(part.vals)) for part in (constants, carry)]
    except (AttributeError, KeyError, TypeError, ValueError):
        return None
    return counts[0], counts[1]
