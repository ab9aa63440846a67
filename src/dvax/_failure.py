"""Derivatives of a computation that failed: NaN, in every mode and with respect to every input.

What an iteration or a time loop returns when it fails has derivatives of its own (of the partial
result, often 0), and they are not those of the solution. NaN values alone do not show this: a loop
that never ran, or a select that masks an entry, turns a NaN cotangent into 0.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu


def nan_derivatives_where(failed: Any, outputs: Any, inputs: Any) -> Any:
    """Return `outputs`, whose derivatives of any order with respect to the real leaves of `inputs`
    are NaN where `failed` holds, and unchanged where it does not.

    `outputs` is a tree of arrays; `failed`, a boolean of shape ().
    """
    leaves, tree = jtu.tree_flatten(outputs)
    is_real = [_is_real(leaf) for leaf in leaves]
    real = [leaf for leaf, r in zip(leaves, is_real, strict=True) if r]
    given = [leaf for leaf in jtu.tree_leaves(inputs) if _is_real(leaf)]
    marked = iter(_marked(real, given, failed))
    return tree.unflatten(
        [next(marked) if r else leaf for leaf, r in zip(leaves, is_real, strict=True)]
    )


@jax.custom_jvp
def _marked(outputs: list[Any], inputs: list[Any], failed: Any) -> list[Any]:
    return outputs


@partial(_marked.defjvp, symbolic_zeros=True)
def _(primals: tuple, tangents: tuple) -> tuple[list[Any], list[Any]]:
    outputs, inputs, failed = primals
    along, turns, _ = tangents
    moving = [turn for turn in turns if not _is_zero(turn)]
    values = _marked(outputs, inputs, failed)
    along = [jnp.zeros(leaf.shape, leaf.dtype) if _is_zero(leaf) else leaf for leaf in along]
    if not outputs or not moving:
        return values, along
    dtype = jnp.finfo(jnp.result_type(*outputs)).dtype
    total = sum(jnp.sum(jnp.real(turn)).astype(dtype) for turn in moving)
    # A factor that depends on the inputs in the same way gives the higher derivatives.
    (nan,) = _marked([jnp.asarray(jnp.nan, dtype)], inputs, failed)
    # A select on either side of the product, because 0 · NaN is NaN in either direction.
    lost = jnp.where(failed, jnp.where(failed, total, 0.0) * nan, 0.0)
    return values, [leaf + lost.astype(leaf.dtype) for leaf in along]


def _is_zero(leaf: Any) -> bool:
    return isinstance(leaf, jax.custom_derivatives.SymbolicZero)


def _is_real(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.inexact)
