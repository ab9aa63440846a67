"""NaN derivatives of a failed computation, in every mode and with respect to every input.

If an iteration or a time loop fails, the derivatives of its partial result (often 0) are not those of
the solution. NaN values do not ensure NaN derivatives: a loop without iterations, or a select that
masks an entry, replaces a NaN cotangent by 0.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu


def nan_derivatives_where(failed: Any, outputs: Any, inputs: Any) -> Any:
    """Return `outputs` with NaN derivatives if `failed` is true, and unchanged derivatives otherwise.

    This holds for derivatives of any order with respect to the real leaves of `inputs`. `outputs` is a
    tree of arrays, and `failed` a boolean of shape ().
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
    output_tangents, input_tangents, _ = tangents
    nonzero = [tangent for tangent in input_tangents if not _is_zero(tangent)]
    values = _marked(outputs, inputs, failed)
    output_tangents = [
        jnp.zeros(leaf.shape, leaf.dtype) if _is_zero(leaf) else leaf for leaf in output_tangents
    ]
    if not outputs or not nonzero:
        return values, output_tangents
    dtype = jnp.finfo(jnp.result_type(*outputs)).dtype
    total = sum(jnp.sum(jnp.real(tangent)).astype(dtype) for tangent in nonzero)
    # The factor depends on the inputs in the same way, so that higher derivatives are NaN as well.
    (nan,) = _marked([jnp.asarray(jnp.nan, dtype)], inputs, failed)
    # Select on both sides of the product, since 0 · NaN is NaN in forward and in reverse mode.
    nan_term = jnp.where(failed, jnp.where(failed, total, 0.0) * nan, 0.0)
    return values, [leaf + nan_term.astype(leaf.dtype) for leaf in output_tangents]


def _is_zero(leaf: Any) -> bool:
    return isinstance(leaf, jax.custom_derivatives.SymbolicZero)


def _is_real(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.inexact)
