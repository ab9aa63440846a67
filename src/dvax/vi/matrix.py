"""The matrix of a linear map, read off the map's own operations.

A linear map traced to a jaxpr is a list of operations. Its matrix is carried through them, column
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
from jax.extend.core import ClosedJaxpr

from .._jaxpr import bound
from .._tree import Tree
from .structure import CALLS, evaluate, inner_jaxpr


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
    size = like.size
    (out,) = _carry(jax.make_jaxpr(linear)(like), [_Diagonal(jnp.ones_like(like))])
    if not _depends(out):
        return jnp.zeros((size, size), like.dtype)
    return _columns(out).reshape(size, size)


def diagonal_of(linear: Callable[[jax.Array], jax.Array], like: jax.Array) -> jax.Array | None:
    """The diagonal of `linear` on arrays shaped like `like`, where its operations show that the matrix
    has nothing else; None where they do not."""
    (out,) = _carry(jax.make_jaxpr(linear)(like), [_Diagonal(jnp.ones_like(like))])
    if not _depends(out):
        return jnp.zeros_like(like)
    return out.factor if isinstance(out, _Diagonal) and out.factor.shape == like.shape else None


def _columns(value: _Diagonal | _Columns) -> jax.Array:
    if isinstance(value, _Columns):
        return value.columns
    factor = value.factor
    return jnp.diag(factor.ravel()).reshape(*factor.shape, factor.size)


def _depends(value: Any) -> bool:
    return isinstance(value, _Diagonal | _Columns)


def _carry(traced: ClosedJaxpr, inputs: list[Any]) -> list[Any]:
    """The outputs for these inputs: what does not depend on the unknowns is computed as it is."""
    return evaluate(traced, inputs, _depends, _apply)


def _apply(eqn: Any, given: list[Any]) -> list[Any]:
    inner = inner_jaxpr(eqn.params) if eqn.primitive.name in CALLS else None
    if inner is not None:
        return _carry(inner, given)
    return _rule(eqn, given) or _column_by_column(eqn, given)


def _column_by_column(eqn: Any, given: list[Any]) -> list[Any]:
    axes = [-1 if _depends(value) else None for value in given]
    full = [_columns(value) if _depends(value) else value for value in given]
    results = jax.vmap(lambda *g: bound(eqn, list(g)), in_axes=axes, out_axes=-1)(*full)
    return [_Columns(result) for result in results]


def _rule(eqn: Any, given: list[Any]) -> list[Any] | None:
    """What becomes of a diagonal; None where it becomes a full matrix by no shorter way."""
    name, out = eqn.primitive.name, eqn.outvars[0].aval
    bent = [value for value in given if _depends(value)]
    if not all(isinstance(value, _Diagonal) for value in bent):
        return None
    if name == "reshape" and eqn.params.get("dimensions") is not None:
        return None  # it permutes the axes first
    if name in ("neg", "convert_element_type", "reshape", "squeeze", "copy"):
        return [_Diagonal(bound(eqn, [given[0].factor])[0])]
    if name == "broadcast_in_dim" and out.size == given[0].factor.size:
        return [_Diagonal(given[0].factor.reshape(out.shape))]
    factors = [value.factor if _depends(value) else value for value in given]
    if name in ("add", "sub", "add_any"):
        # What does not depend on the unknowns is zero here, or the map would not be linear.
        if all(value.factor.shape == out.shape for value in bent):
            return [_Diagonal(jnp.broadcast_to(bound(eqn, factors)[0], out.shape))]
    if name in ("mul", "div") and len(bent) == 1:
        if bent[0].factor.shape == out.shape:
            return [_Diagonal(jnp.broadcast_to(bound(eqn, factors)[0], out.shape))]
    if name == "select_n" and not _depends(given[0]):
        return [_Diagonal(bound(eqn, factors)[0])]
    if name == "dot_general":
        return _product(eqn, given)
    return None


def _product(eqn: Any, given: list[Any]) -> list[Any] | None:
    """A given array times a vector of unknowns: the array, its summed axis moved to the end."""
    (of_left, of_right), (batch, _) = eqn.params["dimension_numbers"]
    left, right = given
    array, vector, axes = (right, left, of_right) if _depends(left) else (left, right, of_left)
    if _depends(array) or batch or len(axes) != 1 or vector.factor.ndim != 1:
        return None
    columns = jnp.moveaxis(array, axes[0], -1)
    columns = columns * jnp.broadcast_to(vector.factor, columns.shape)
    return [_Columns(lax.convert_element_type(columns, eqn.outvars[0].aval.dtype))]
