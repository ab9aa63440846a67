"""NaN derivatives of a failed computation, in every mode and with respect to every input.

If an iteration or a time loop fails, the derivatives of its partial result (often 0) are not those of
the solution. NaN values do not ensure NaN derivatives: a loop without iterations, or a select that
masks an entry, replaces a NaN cotangent by 0.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax


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


def nan_derivatives_if_used(failed: Any, outputs: list[jax.Array], inputs: Any) -> list[jax.Array]:
    """Return `outputs` with NaN first derivatives if `failed` is true, and unchanged ones otherwise.

    In reverse mode, an output on which the result does not depend contributes 0, not 0 · NaN.
    """
    return _marked_if_used(outputs, [v for v in jtu.tree_leaves(inputs) if _is_real(v)], failed)


@jax.custom_jvp
def _marked(outputs: list[Any], inputs: list[Any], failed: Any) -> list[Any]:
    return outputs


@partial(_marked.defjvp, symbolic_zeros=True)
def _(primals: tuple, tangents: tuple) -> tuple[list[Any], list[Any]]:
    outputs, inputs, failed = primals

    def times_nan(total: jax.Array) -> jax.Array:
        # The factor depends on the inputs in the same way, so that higher derivatives are NaN as well.
        return total * _marked([jnp.full_like(total, jnp.nan)], inputs, failed)[0]

    return _marked(*primals), _with_nan(outputs, failed, tangents, times_nan)


@jax.custom_jvp
def _marked_if_used(outputs: list[Any], inputs: list[Any], failed: Any) -> list[Any]:
    return outputs


@partial(_marked_if_used.defjvp, symbolic_zeros=True)
def _(primals: tuple, tangents: tuple) -> tuple[list[Any], list[Any]]:
    return _marked_if_used(*primals), _with_nan(primals[0], primals[2], tangents, _nan_of)


def _with_nan(
    outputs: list[Any], failed: Any, tangents: tuple, nan_of: Callable[[jax.Array], jax.Array]
) -> list[Any]:
    """Return the tangents of the outputs; if `failed`, plus nan_of(the sum of those of the inputs)."""
    output_tangents, input_tangents, _ = tangents
    nonzero = [tangent for tangent in input_tangents if not _is_zero(tangent)]
    output_tangents = [
        jnp.zeros(leaf.shape, leaf.dtype) if _is_zero(leaf) else leaf for leaf in output_tangents
    ]
    if not outputs or not nonzero:
        return output_tangents
    dtype = jnp.finfo(jnp.result_type(*outputs)).dtype
    total = sum(jnp.sum(jnp.real(tangent)).astype(dtype) for tangent in nonzero)
    # Select on both sides, since 0 · NaN is NaN in forward and in reverse mode.
    nan_term = jnp.where(failed, nan_of(jnp.where(failed, total, 0.0)), 0.0)
    return [leaf + nan_term.astype(leaf.dtype) for leaf in output_tangents]


def _nan_of(tangent: jax.Array) -> jax.Array:
    """Return NaN, as a linear function whose transpose maps 0 to 0 and other numbers to NaN."""
    return lax.custom_linear_solve(
        lambda v: v,
        tangent,
        lambda _, v: v * jnp.nan,
        lambda _, cotangent: jnp.where(cotangent == 0, 0.0, cotangent * jnp.nan),
    )


def _is_zero(leaf: Any) -> bool:
    return isinstance(leaf, jax.custom_derivatives.SymbolicZero)


def _is_real(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.inexact)
