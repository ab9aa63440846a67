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

from .._jaxpr import bound, walked
from .._tree import Tree


class Structure(NamedTuple):
    """What is proved of F; False means "not shown", never "shown not to be".

    `affine`: F(y) = Jy + c with J independent of y. `pointwise`: Fᵢ depends on yᵢ alone.
    `isotropic`: affine and pointwise with one factor for all entries, F(y) = ay + c, so that
    y* = proj_K(−c/a) for every K (each part of a tuple may have its own a).
    """

    affine: bool
    pointwise: bool
    isotropic: bool


class _Mark(NamedTuple):
    """How one intermediate value depends on y: polynomial degree (2 means more than affine), and
    the leaf of y that it depends on entry by entry (None: several leaves, or mixed entries), and
    whether it is that leaf times one number (plus something independent of y)."""

    degree: int
    leaf: int | None
    even: bool


_LINEAR = {
    "neg", "copy", "copy_p", "real", "imag", "optimization_barrier",
}  # fmt: skip
_SUM = {"add", "sub", "add_any"}
_PRODUCT = {"mul"}
_POINTWISE = {
    "max", "min", "exp", "exp2", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos",
    "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "logistic", "erf", "erfc",
    "erf_inv", "sqrt", "rsqrt", "cbrt", "abs", "sign", "floor", "ceil", "round", "pow",
    "integer_pow", "square", "clamp", "rem", "nextafter", "is_finite", "eq", "ne", "lt", "le",
    "gt", "ge", "lt_to", "le_to", "eq_to", "and", "or", "xor", "not", "lgamma", "digamma",
    # Linear in value, but its derivative is 0, and the slope of a law is taken by differentiating.
    "stop_gradient", "reduce_precision",
}  # fmt: skip
_MIXING = {
    "reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose", "rev", "slice",
    "dynamic_slice", "concatenate", "stack", "pad", "reduce_sum", "cumsum", "gather", "split",
}  # fmt: skip
_ELEMENTWISE = {"div", "convert_element_type"}
_FLAT = _LINEAR | _SUM | _PRODUCT | _POINTWISE | _ELEMENTWISE | {"broadcast_in_dim"}
CALLS = {"jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint"}
CUSTOM = {"custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"}


def analyse(F: Callable[[Tree], Tree], like: Tree) -> Structure:
    """The structure of F at arguments shaped like `like`, proved from its operations."""
    traced = jax.make_jaxpr(F)(like)
    leaves = jtu.tree_leaves(like)
    shapes = [tuple(jnp.shape(leaf)) for leaf in leaves]
    inputs: list[_Mark | None] = [_Mark(1, i, True) for i in range(len(leaves))]
    outputs = _interpret(traced, inputs, shapes)
    affine = all(mark is None or mark.degree <= 1 for mark in outputs)
    pointwise = len(outputs) == len(leaves) and all(
        mark is None or mark.leaf == i for i, mark in enumerate(outputs)
    )
    isotropic = affine and pointwise and all(mark is not None and mark.even for mark in outputs)
    return Structure(affine, pointwise, isotropic)


def independent(fn: Callable[..., Tree], *args: Tree) -> bool:
    """Whether no output of fn(*args) depends on any of the args, as far as its code shows."""
    traced = jax.make_jaxpr(fn)(*args)
    count = len(traced.jaxpr.invars)
    marks = _interpret(traced, [_Mark(1, None, False)] * count, [])
    return all(mark is None for mark in marks)


def evaluate(
    traced: ClosedJaxpr,
    inputs: list[Any],
    special: Callable[[Any], bool],
    apply: Callable[[Any, list[Any]], list[Any]],
) -> list[Any]:
    """The outputs of a traced function, with values of another kind in the place of some arrays:
    operations on `special` values are done by `apply(eqn, given)`, the others as they are."""
    do = lambda eqn, given: (apply if any(map(special, given)) else bound)(eqn, given)  # noqa: E731
    return walked(traced, inputs, do)


def _interpret(
    traced: ClosedJaxpr, inputs: list[_Mark | None], shapes: list[tuple[int, ...]]
) -> list[_Mark | None]:
    """Marks of the outputs; None marks a value that does not depend on y."""
    jaxpr: Jaxpr = traced.jaxpr
    marks: dict[Any, _Mark | None] = dict(zip(jaxpr.invars, inputs, strict=True))
    flat: set[Any] = set()  # values independent of y that are the same in every entry

    def is_flat(atom: Any) -> bool:
        return atom.aval.shape == () or (not isinstance(atom, Literal) and atom in flat)

    def read(atom: Any) -> _Mark | None:
        return None if isinstance(atom, Literal) else marks.get(atom)

    for eqn in jaxpr.eqns:
        given = [read(atom) for atom in eqn.invars]
        name = eqn.primitive.name
        if not eqn.outvars or all(mark is None for mark in given):
            if name in _FLAT and all(map(is_flat, eqn.invars)):
                flat.update(eqn.outvars)
            continue
        if name in CALLS or name in CUSTOM:
            inner = inner_jaxpr(eqn.params)
            if inner is not None and len(inner.jaxpr.invars) == len(given):
                results = _interpret(inner, given, shapes)
                if name in CUSTOM:
                    # A derivative rule of its own need not be the slope of the values.
                    results = [r and r._replace(degree=2) for r in results]
                marks.update(zip(eqn.outvars, results, strict=True))
                continue
        mark = _rule(name, eqn, given, shapes, is_flat)
        marks.update((out, mark) for out in eqn.outvars)
    return [read(atom) for atom in jaxpr.outvars]


def inner_jaxpr(params: dict[str, Any]) -> ClosedJaxpr | None:
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
        inner = params.get(key)
        if isinstance(inner, ClosedJaxpr):
            return inner
        if isinstance(inner, Jaxpr):
            return ClosedJaxpr(inner, ())
    return None


def _rule(
    name: str,
    eqn: Any,
    given: list[_Mark | None],
    shapes: list[tuple[int, ...]],
    is_flat: Callable[[Any], bool],
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
    even = leaf is not None and all(mark.even for mark in present)
    others_flat = all(
        mark is not None or is_flat(atom) for mark, atom in zip(given, eqn.invars, strict=True)
    )

    if name in _LINEAR or name in _SUM:
        return _Mark(degree, leaf, even)
    if name in _PRODUCT:
        return _Mark(min(2, sum(mark.degree for mark in present)), leaf, even and others_flat)
    if name == "convert_element_type":
        # To integers, booleans and shorter floating types it makes steps.
        before, after = eqn.invars[0].aval.dtype, eqn.outvars[0].aval.dtype
        kept = jnp.issubdtype(after, jnp.inexact) and (
            not jnp.issubdtype(before, jnp.inexact) or jnp.finfo(after).eps <= jnp.finfo(before).eps
        )
        return _Mark(degree if kept else 2, leaf, even)
    if name == "div":
        return _Mark(degree if given[1] is None else 2, leaf, even and others_flat)
    if name == "select_n":
        return _Mark(degree if given[0] is None else 2, leaf, False)
    if name in _POINTWISE:
        return _Mark(2, leaf, False)
    if name in _MIXING:
        # Indices and start positions that depend on y would not be linear in it.
        indices_fixed = all(mark is None for mark in given[1:]) or name in (
            "concatenate",
            "stack",
            "pad",
        )
        keeps = name in ("reshape", "squeeze", "broadcast_in_dim")
        # A reshape may permute the axes first.
        keeps = keeps and eqn.params.get("dimensions") in (None, ())
        same = keeps and shape == eqn.invars[0].aval.shape
        kept = present[0] if same else _Mark(degree, None, False)
        return kept._replace(degree=degree if indices_fixed else 2)
    if name in ("dot_general", "conv_general_dilated", "bcoo_dot_general"):
        # Of a sparse product the second argument holds the places of the first.
        product = sum(mark.degree for mark in present)
        places_move = name == "bcoo_dot_general" and given[1] is not None
        return _Mark(2 if places_move else min(2, product), None, False)
    if name in ("scatter-add", "scatter_add"):
        return _Mark(degree if given[1] is None else 2, None, False)
    if name == "triangular_solve":
        return _Mark(degree if given[0] is None else 2, None, False)
    if name == "fft":
        return _Mark(degree, None, False)
    return _Mark(2, None, False)
