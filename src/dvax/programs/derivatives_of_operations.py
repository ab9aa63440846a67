"""Functions whose derivatives by JAX are those of their operations.

A function with a derivative rule of its own (`jax.custom_jvp`, `jax.custom_vjp`) or `stop_gradient` may
have any derivative. A proof needs that of the values which the function returns.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.tree_util as jtu

from .._jax.jaxprs import CUSTOM, bind, has_operation, inner_program, nested_programs, read
from .._jax.known_functions import operation

_RULED = CUSTOM | {"stop_gradient"}
"""Primitives whose derivative is not that of the values."""


def of_operations(fn: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Return fn for arguments of these types, without the derivative rules of its parts.

    Functions of JAX with rules of slope arithmetic (`known_functions`) keep theirs, which are true.

    **Raises:** `NotImplementedError` if a loop or a branch contains such rules.
    """
    program, shape = jax.make_jaxpr(fn, return_shape=True)(*arguments)
    if not has_operation(program, _RULED):
        return fn
    structure = jtu.tree_structure(shape)

    def plain(*given: Any) -> Any:
        return structure.unflatten(_evaluated(program, jtu.tree_leaves(given)))

    jax.eval_shape(plain, *arguments)
    return plain


def has_derivative(fn: Callable[..., Any], *arguments: Any) -> bool:
    """Return whether JAX has a derivative of fn. It has none of a callback, nor of `x.at[i].apply`."""
    try:
        jax.eval_shape(lambda *given: jax.jvp(fn, given, given)[1], *arguments)
    except (NotImplementedError, ValueError, TypeError):
        return False  # by the operation JAX raises the first, and of callbacks and own rules the others
    return True


def _evaluated(program: Any, inputs: list[Any]) -> list[Any]:
    """Return the outputs of a program."""
    jaxpr = program.jaxpr
    environment = dict(zip(jaxpr.constvars, program.consts, strict=True))
    environment |= dict(zip(jaxpr.invars, inputs, strict=True))
    for eqn in jaxpr.eqns:
        results = _results(eqn, read(environment, eqn.invars))
        environment.update(zip(eqn.outvars, results, strict=True))
    return read(environment, jaxpr.outvars)


def _results(eqn: Any, operands: list[Any]) -> list[Any]:
    name = eqn.primitive.name
    if name == "stop_gradient":
        return operands
    if operation(eqn) != name:
        return bind(eqn, operands)
    inner = inner_program(eqn)
    if inner is not None and (name in CUSTOM or has_operation(inner, _RULED)):
        return _evaluated(inner, operands)
    if name in CUSTOM or any(has_operation(p, _RULED) for p in nested_programs(eqn.params)):
        raise NotImplementedError(name)
    return bind(eqn, operands)
