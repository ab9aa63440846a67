"""The matrix of a linear map, read off the map's own operations.

A linear map traced to a program is a list of operations. Its matrix is carried through them, column
after column, but as long as it is diagonal it stays a vector; and a product with a given matrix then
*is* that matrix, with its columns scaled. So the matrix of d ↦ Md + φ′(y)d costs a pass over M, where
applying the map to n unit vectors would cost the n³ operations of several factorisations.
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
    """A value whose k-th entry (in the order of memory) is `factor`'s k-th times the k-th unknown."""

    factor: jax.Array


class _Columns(NamedTuple):
    """A value that depends on the unknowns through `columns`: one more axis, the last."""

    columns: jax.Array


def matrix_of(linear: Callable[[Tree], Tree], like: Tree) -> jax.Array:
    """The matrix of `linear` between elements shaped like `like`, as flat vectors."""
    if isinstance(like, tuple):
        flat, unravel = jax.flatten_util.ravel_pytree(like)
        return matrix_of(lambda d: jax.flatten_util.ravel_pytree(linear(unravel(d)))[0], flat)
    out = _image(linear, like)
    if not _depends(out):
        return jnp.zeros((like.size, like.size), like.dtype)
    return _columns(out).reshape(like.size, like.size)


def diagonal_of(linear: Callable[[jax.Array], jax.Array], like: jax.Array) -> jax.Array | None:
    """The diagonal of `linear` on arrays shaped like `like`, where its operations show that the matrix
    has nothing else; None where they do not."""
    out = _image(linear, like)
    if not _depends(out):
        return jnp.zeros_like(like)
    return out.factor if isinstance(out, _Diagonal) and out.factor.shape == like.shape else None


def _image(linear: Callable[[Any], Any], like: jax.Array) -> Any:
    """The image of the identity; what does not depend on the unknowns is computed as it is."""
    (out,) = interpret(jax.make_jaxpr(linear)(like), [_Diagonal(jnp.ones_like(like))], _DOMAIN)
    return out


def _columns(value: _Diagonal | _Columns) -> jax.Array:
    if isinstance(value, _Columns):
        return value.columns
    factor = value.factor
    return jnp.diag(factor.ravel()).reshape(*factor.shape, factor.size)


def _depends(value: Any) -> bool:
    return isinstance(value, _Diagonal | _Columns)


def _factors(given: list[Any]) -> list[Any]:
    return [value.factor if isinstance(value, _Diagonal) else value for value in given]


def _entrywise(eqn: Any, given: list[Any]) -> _Diagonal:
    return _Diagonal(bind(eqn, _factors(given))[0])


def _reshape(eqn: Any, given: list[Any]) -> _Diagonal | None:
    # A reshape may permute the axes first.
    return None if eqn.params.get("dimensions") is not None else _entrywise(eqn, given)


def _broadcast_in_dim(eqn: Any, given: list[Any]) -> _Diagonal | None:
    out, factor = eqn.outvars[0].aval, given[0].factor
    return _Diagonal(factor.reshape(out.shape)) if out.size == factor.size else None


def _sum(eqn: Any, given: list[Any]) -> _Diagonal | None:
    # What does not depend on the unknowns is zero here, or the map would not be linear.
    shape = eqn.outvars[0].aval.shape
    if any(value.factor.shape != shape for value in given if _depends(value)):
        return None
    return _Diagonal(jnp.broadcast_to(bind(eqn, _factors(given))[0], shape))


def _multiple(eqn: Any, given: list[Any]) -> _Diagonal | None:
    return _sum(eqn, given) if sum(map(_depends, given)) == 1 else None


def _choice(eqn: Any, given: list[Any]) -> _Diagonal | None:
    return None if _depends(given[0]) else _entrywise(eqn, given)


def _product(eqn: Any, given: list[Any]) -> _Columns | None:
    """A given array times a vector of unknowns: the array, its summed axis moved to the end."""
    (of_left, of_right), (batch, _) = eqn.params["dimension_numbers"]
    left, right = given
    array, vector, axes = (right, left, of_right) if _depends(left) else (left, right, of_left)
    if _depends(array) or batch or len(axes) != 1 or vector.factor.ndim != 1:
        return None
    columns = jnp.moveaxis(array, axes[0], -1)
    columns = columns * jnp.broadcast_to(vector.factor, columns.shape)
    return _Columns(lax.convert_element_type(columns, eqn.outvars[0].aval.dtype))


def _column_by_column(eqn: Any, given: list[Any]) -> list[_Columns]:
    axes = [-1 if _depends(value) else None for value in given]
    full = [_columns(value) if _depends(value) else value for value in given]
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
    # As a whole: parameters of the map are differentiated by the rule of the function.
    **same_for(CUSTOM, _column_by_column),
}
"""What becomes of a diagonal; None where it becomes a full matrix by no shorter way."""


def _apply(rule: Rule, eqn: Any, given: list[Any]) -> list[Any] | None:
    if rule is _column_by_column:
        return _column_by_column(eqn, given)
    if any(isinstance(value, _Columns) for value in given):
        return None
    found = rule(eqn, given)
    return None if found is None else [found]


_DOMAIN = Domain(RULES, _depends, _column_by_column, _apply)
