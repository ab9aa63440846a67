"""What an operator's own code proves about it: affine? pointwise?

A function traced to a jaxpr is a list of primitive operations, so its dependence on y can be read
off, operation by operation, and what is read is a proof: adding two affine things is affine,
multiplying two that both contain y is not. Sampling could never say as much. Whatever is not
understood is taken to be general.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from .._tree import Tree


class Structure(NamedTuple):
    """`affine`: F(y) = Jy + c with J independent of y. `pointwise`: Fᵢ depends on yᵢ alone."""

    affine: bool
    pointwise: bool


class _Mark(NamedTuple):
    """How one intermediate value depends on y: polynomial degree (2 means more than affine), and
    the leaf of y that it depends on entry by entry (None: several leaves, or mixed entries)."""

    degree: int
    leaf: int | None


_LINEAR = {
    "neg", "copy", "copy_p", "convert_element_type", "real", "imag", "reduce_precision",
    "stop_gradient", "optimization_barrier",
}  # fmt: skip
_SUM = {"add", "sub", "add_any"}
_PRODUCT = {"mul"}
_POINTWISE = {
    "max", "min", "exp", "exp2", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos",
    "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "logistic", "erf", "erfc",
    "erf_inv", "sqrt", "rsqrt", "cbrt", "abs", "sign", "floor", "ceil", "round", "pow",
    "integer_pow", "square", "clamp", "rem", "nextafter", "is_finite", "eq", "ne", "lt", "le",
    "gt", "ge", "and", "or", "xor", "not", "lgamma", "digamma",
}  # fmt: skip
_MIXING = {
    "reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose", "rev", "slice",
    "dynamic_slice", "concatenate", "pad", "reduce_sum", "cumsum", "gather", "split",
}  # fmt: skip
_CALLS = {"jit", "pjit", "closed_call", "core_call", "remat", "checkpoint", "custom_lin"}
_CUSTOM = {"custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"}


def analyse(F: Callable[[Tree], Tree], like: Tree) -> Structure:
    """The structure of F at arguments shaped like `like`, proved from its operations."""
    traced = jax.make_jaxpr(F)(like)
    leaves = jtu.tree_leaves(like)
    shapes = [jnp.shape(leaf) for leaf in leaves]
    inputs = [_Mark(1, i) for i in range(len(leaves))]
    outputs = _interpret(traced, inputs, shapes)
    affine = all(mark is None or mark.degree <= 1 for mark in outputs)
    pointwise = len(outputs) == len(leaves) and all(
        mark is None or mark.leaf == i for i, mark in enumerate(outputs)
    )
    return Structure(affine, pointwise)


def _interpret(
    traced: ClosedJaxpr, inputs: list[_Mark | None], shapes: list[tuple[int, ...]]
) -> list[_Mark | None]:
    """Marks of the outputs; None marks a value that does not depend on y."""
    jaxpr: Jaxpr = traced.jaxpr
    marks: dict[Any, _Mark | None] = dict(zip(jaxpr.invars, inputs, strict=True))

    def read(atom: Any) -> _Mark | None:
        return None if isinstance(atom, Literal) else marks.get(atom)

    for eqn in jaxpr.eqns:
        given = [read(atom) for atom in eqn.invars]
        name = eqn.primitive.name
        if all(mark is None for mark in given):
            continue
        if name in _CALLS or name in _CUSTOM:
            inner = _inner(eqn.params)
            if inner is not None and len(inner.jaxpr.invars) == len(given):
                results = _interpret(inner, given, shapes)
                marks.update(zip(eqn.outvars, results, strict=True))
                continue
        mark = _rule(name, eqn, given, shapes)
        marks.update((out, mark) for out in eqn.outvars)
    return [read(atom) for atom in jaxpr.outvars]


def _inner(params: dict[str, Any]) -> ClosedJaxpr | None:
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
        inner = params.get(key)
        if isinstance(inner, ClosedJaxpr):
            return inner
        if isinstance(inner, Jaxpr):
            return ClosedJaxpr(inner, ())
    return None


def _rule(
    name: str, eqn: Any, given: list[_Mark | None], shapes: list[tuple[int, ...]]
) -> _Mark:
    present = [mark for mark in given if mark is not None]
    degree = max(mark.degree for mark in present)
    leaves = {mark.leaf for mark in present}
    leaf = leaves.pop() if len(leaves) == 1 else None
    shape = eqn.outvars[0].aval.shape
    # Entry by entry only while shapes agree: anything else moves entries about.
    aligned = leaf is not None and all(
        mark is None or atom.aval.shape == shape
        for mark, atom in zip(given, eqn.invars, strict=True)
    )
    leaf = leaf if aligned and leaf is not None and shape == shapes[leaf] else None

    if name in _LINEAR or name in _SUM:
        return _Mark(degree, leaf)
    if name in _PRODUCT:
        return _Mark(min(2, sum(mark.degree for mark in present)), leaf)
    if name == "div":
        return _Mark(degree if given[1] is None else 2, leaf)
    if name == "select_n":
        return _Mark(degree if given[0] is None else 2, leaf)
    if name in _POINTWISE:
        return _Mark(2, leaf)
    if name in _MIXING:
        # Indices and start positions that depend on y would not be linear in it.
        indices_fixed = all(mark is None for mark in given[1:]) or name in ("concatenate", "pad")
        same = name in ("reshape", "squeeze", "broadcast_in_dim") and shape == eqn.invars[0].aval.shape
        return _Mark(degree if indices_fixed else 2, present[0].leaf if same else None)
    if name == "dot_general":
        return _Mark(min(2, sum(mark.degree for mark in present)), None)
    return _Mark(2, None)
