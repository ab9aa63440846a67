"""The matrix of a linear map, from the operations of its traced program.

The interpreter propagates the matrix of all intermediate values. As long as it is diagonal, it is
stored as a vector. The product of a constant matrix with such a value is that matrix with scaled
columns. Hence the matrix of d ↦ Md + φ′(y)d takes one pass over M, while applying the map to n unit
vectors would take n³ operations.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
from jax import lax

from .._jax.jaxprs import CUSTOM, bind
from .._tree import Tree
from .interpreter import Domain, Rule, interpret, same_for


class _Diagonal(NamedTuple):
    """A value whose k-th entry (in memory order) is the k-th entry of `factor` times the k-th
    unknown."""

    factor: jax.Array


class _Columns(NamedTuple):
    """A value with the matrix `columns`, whose last axis is that of the unknowns."""

    columns: jax.Array


def matrix_of(linear: Callable[[Tree], Tree], like: Tree) -> jax.Array:
    """Return the matrix of `linear` on flattened elements of the shape of `like`."""
    if isinstance(like, tuple):
        flat, unravel = jax.flatten_util.ravel_pytree(like)
        return matrix_of(lambda d: jax.flatten_util.ravel_pytree(linear(unravel(d)))[0], flat)
    out = _image(linear, like)
    if not _depends(out):
        return jnp.zeros((like.size, like.size), like.dtype)
    return _columns(out).reshape(like.size, like.size)


def diagonal_of(linear: Callable[[jax.Array], jax.Array], like: jax.Array) -> jax.Array | None:
    """Return the diagonal of `linear` if its operations prove that its matrix is diagonal, else
    None."""
    out = _image(linear, like)
    if not _depends(out):
        return jnp.zeros_like(like)
    return out.factor if isinstance(out, _Diagonal) and out.factor.shape == like.shape else None


def _image(linear: Callable[[Any], Any], like: jax.Array) -> Any:
    """Return the image of the identity, by interpretation."""
    (out,) = interpret(jax.make_jaxpr(linear)(like), [_Diagonal(jnp.ones_like(like))], _DOMAIN)
    return out


def _columns(value: _Diagonal | _Columns) -> jax.Array:
    if isinstance(value, _Columns):
        return value.columns
    factor = value.factor
    return jnp.diag(factor.ravel()).reshape(*factor.shape, factor.size)


def _depends(value: Any) -> bool:
    return isinstance(value, _Diagonal | _Columns)


def _factors(operands: list[Any]) -> list[Any]:
    return [value.factor if isinstance(value, _Diagonal) else value for value in operands]


def _entrywise(eqn: Any, operands: list[Any]) -> _Diagonal:
    return _Diagonal(bind(eqn, _factors(operands))[0])


def _reshape(eqn: Any, operands: list[Any]) -> _Diagonal | None:
    # A reshape may permute the axes first.
    return None if eqn.params.get("dimensions") is not None else _entrywise(eqn, operands)


def _broadcast_in_dim(eqn: Any, operands: list[Any]) -> _Diagonal | None:
    out, factor = eqn.outvars[0].aval, operands[0].factor
    return _Diagonal(factor.reshape(out.shape)) if out.size == factor.size else None


def _sum(eqn: Any, operands: list[Any]) -> _Diagonal | None:
    # A term that does not depend on the unknowns is zero, since the map is linear.
    shape = eqn.outvars[0].aval.shape
    if any(value.factor.shape != shape for value in operands if _depends(value)):
        return None
    return _Diagonal(jnp.broadcast_to(bind(eqn, _factors(operands))[0], shape))


def _multiple(eqn: Any, operands: list[Any]) -> _Diagonal | None:
    return _sum(eqn, operands) if sum(map(_depends, operands)) == 1 else None


def _choice(eqn: Any, operands: list[Any]) -> _Diagonal | None:
    return None if _depends(operands[0]) else _entrywise(eqn, operands)


def _product(eqn: Any, operands: list[Any]) -> _Columns | None:
    """Return the constant array, with its summed axis moved to the end and scaled by the diagonal."""
    (of_left, of_right), (batch, _) = eqn.params["dimension_numbers"]
    left, right = operands
    array, vector, axes = (right, left, of_right) if _depends(left) else (left, right, of_left)
    if _depends(array) or batch or len(axes) != 1 or vector.factor.ndim != 1:
        return None
    columns = jnp.moveaxis(array, axes[0], -1)
    columns = columns * jnp.broadcast_to(vector.factor, columns.shape)
    return _Columns(lax.convert_element_type(columns, eqn.outvars[0].aval.dtype))


def _column_by_column(eqn: Any, operands: list[Any]) -> list[_Columns]:
    axes = [-1 if _depends(value) else None for value in operands]
    full = [_columns(value) if _depends(value) else value for value in operands]
    results = jax.vmap(lambda *g: bind(eqn, list(g)), in_axes=axes, out_axes=-1)(*full)
    return [_Columns(result) for result in results]


RULES: dict[str, Rule] = {
    **same_for({"neg", "convert_element_type", "squeeze", "copy"}, _entrywise),
    **same_for({"add", "sub", "add_any"}, _sum),
    **same_for({"mul", "div"}, _multiple),
    "reshape": _reshape,
    "broadcast_in_dim": _broadcast_in_dim,
    "select_n": _choice,
    "dot_general": _product,
    # Do not enter these calls, so that their derivative rules apply to parameters of the map.
    **same_for(CUSTOM, _column_by_column),
}
"""The rules for diagonal values; a rule returns None if the result is a general matrix."""


def _apply(rule: Rule, eqn: Any, operands: list[Any]) -> list[Any] | None:
    if rule is _column_by_column:
        return _column_by_column(eqn, operands)
    if any(isinstance(value, _Columns) for value in operands):
        return None
    result = rule(eqn, operands)
    return None if result is None else [result]


_DOMAIN = Domain(RULES, _depends, _column_by_column, _apply)
