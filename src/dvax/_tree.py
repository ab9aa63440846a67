"""Arithmetic on pytrees of arrays: a state or a control is one array, or a tuple of arrays."""

from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax

from .errors import InputError, InputProblem

Tree = Any
"""A pytree of arrays of one floating type."""


class Static:
    """Anything, as a part of a tree that has no leaves."""

    def __init__(self, value: Any):
        self.value = value


jtu.register_pytree_node(Static, lambda s: ((), s.value), lambda value, _: Static(value))


def add(a: Tree, b: Tree) -> Tree:
    return jtu.tree_map(jnp.add, a, b)


def sub(a: Tree, b: Tree) -> Tree:
    return jtu.tree_map(jnp.subtract, a, b)


def scale(c: Any, a: Tree) -> Tree:
    return jtu.tree_map(lambda leaf: c * leaf, a)


def where(condition: Any, a: Tree, b: Tree) -> Tree:
    one = lambda p, q: p if p is q else jnp.where(condition, p, q)  # noqa: E731
    return jtu.tree_map(one, a, b)


def put(table: Tree, index: Any, row: Tree) -> Tree:
    """The table of rows with one of them written over, as one move: a scatter is more than that."""
    return jtu.tree_map(
        lambda leaf, new: lax.dynamic_update_index_in_dim(leaf, new, index, 0), table, row
    )


def put_if(condition: Any, table: Tree, index: Any, row: Tree) -> Tree:
    """The same, where the condition holds. (To choose between two tables would be to copy one.)"""
    kept = jtu.tree_map(lambda leaf: lax.dynamic_index_in_dim(leaf, index, 0, False), table)
    return put(table, index, where(condition, row, kept))


def zeros_like(a: Tree) -> Tree:
    return jtu.tree_map(jnp.zeros_like, a)


def all_finite(a: Tree) -> jax.Array:
    """Whether every entry is finite. 0·v is NaN exactly where v is not, and a sum of products is one
    pass over memory, where a test of each entry and a reduction of the answers would be two."""
    total = sum(jnp.sum(0.0 * leaf) for leaf in jtu.tree_leaves(a))
    return jnp.isfinite(total)


def shapes(a: Tree) -> Tree:
    """The tree with every array replaced by its shape: what two compatible trees share."""
    return jtu.tree_map(jnp.shape, a)


def same_shape(a: Tree, b: Tree) -> bool:
    if jtu.tree_structure(a) != jtu.tree_structure(b):
        return False
    pairs = zip(jtu.tree_leaves(a), jtu.tree_leaves(b), strict=True)
    return all(jnp.shape(p) == jnp.shape(q) for p, q in pairs)


def fits(name: str, given: Any, like: Tree, what: str) -> None:
    """Raise an `InputError` unless the array `given` has the very shape of `like`."""
    if isinstance(like, tuple) or jnp.shape(given) != jnp.shape(like):
        raise InputError(
            InputProblem(
                name,
                f"shape {jnp.shape(given)}",
                f"it acts entry by entry on the {what}, whose elements have shape {shapes(like)}",
                "Give it that shape, or name the space that you mean (state_space= or "
                "control_space= of dvax.Problem)",
            )
        )


def fits_matrix(name: str, matrix: Any, like: Tree, what: str) -> None:
    """Raise an `InputError` unless `like` is a vector that the square `matrix` can act on."""
    if isinstance(like, tuple) or jnp.shape(like) != jnp.shape(matrix)[:1]:
        raise InputError(
            InputProblem(
                name,
                f"shape {jnp.shape(matrix)}",
                f"it acts on the {what}, whose elements have shape {shapes(like)}",
                "A matrix acts on vectors: give it as many rows, or state and control as vectors",
            )
        )


def fits_parts(name: str, count: int, like: Tree, what: str) -> None:
    """Raise an `InputError` unless `like` is a tuple of `count` parts."""
    if not isinstance(like, tuple) or len(like) != count:
        raise InputError(
            InputProblem(
                name,
                f"{count} parts",
                f"it acts on the {what}, whose elements have shape {shapes(like)}",
                "Give one part for each, and name the spaces with dvax.spaces.Product(...)",
            )
        )


def is_concrete(*trees: Tree) -> bool:
    """Whether every leaf has a value now, so that a check on values can be made at all."""
    for leaf in jtu.tree_leaves(trees):
        if isinstance(leaf, jax.core.Tracer):
            return False
    return True


def is_number(value: Any) -> bool:
    """Whether this is one real number, traced or not: no flag, text or array of several."""
    if isinstance(value, int | float):
        return not isinstance(value, bool)
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    return kind in ("f", "i", "u") and getattr(value, "shape", None) == ()


def host(a: Tree) -> Tree:
    """What has a value now as NumPy arrays, the rest as it is. On a few numbers JAX would compile
    every operation as a program of its own."""
    return jtu.tree_map(lambda leaf: np.asarray(leaf) if is_concrete(leaf) else leaf, a)


def library(*values: Tree) -> Any:
    """`numpy` where all of these have a value now, else `jax.numpy`."""
    return np if is_concrete(values) else jnp


def as_float(a: Tree, name: str) -> Tree:
    """Arrays of a floating type from what the user gave; Python numbers take JAX's default type.

    An integer or boolean *array* is refused rather than cast: its owner may have meant integer
    arithmetic, and a silent cast would hide that.
    """
    if not jtu.tree_leaves(a):
        raise _not_real(name, repr(a))
    # States are arrays and tuples of them; parameters may be any tree.
    if isinstance(a, str | set) or (isinstance(a, dict) and name in ("x0", "x", "y0")):
        raise _not_real(name, f"{type(a).__name__} {a!r}"[:120])
    return jtu.tree_map(
        lambda leaf: _float_array(leaf, name), a, is_leaf=lambda leaf: isinstance(leaf, list)
    )


def _float_array(leaf: Any, name: str) -> jax.Array:
    # `dtypes.issubdtype` and `asarray` cost as much as a hundred steps of a small system.
    if isinstance(leaf, jax.Array) and leaf.dtype.kind == "f":
        return leaf
    if isinstance(leaf, bool | complex):
        raise _not_real(name, repr(leaf))
    if isinstance(leaf, int | float):
        return jnp.asarray(float(leaf))
    if isinstance(leaf, list):
        try:
            leaf = np.asarray(leaf, dtype=float)
        except (TypeError, ValueError):
            raise _not_real(name, " ".join(repr(leaf).split())[:120]) from None
    if not hasattr(leaf, "dtype"):
        raise _not_real(name, f"{type(leaf).__name__} {leaf!r}")
    if not jnp.issubdtype(leaf.dtype, jnp.floating):
        if jnp.issubdtype(leaf.dtype, jnp.complexfloating):
            return jnp.asarray(leaf)
        raise _not_real(name, f"an array of {leaf.dtype}")
    return jnp.asarray(leaf)


def require(condition: Callable[[], Any], name: str, given: Any, rule: str, mend: str) -> None:
    """Raise an `InputError` unless `condition()` is true on concrete values.

    Values that are traced (inside `jax.jit`, `jax.grad`, ...) cannot be looked at, so they pass.
    """
    if not is_concrete(given):
        return
    # What has a value may be met while something else is traced.
    with jax.ensure_compile_time_eval():
        holds = bool(condition())
    if not holds:
        raise InputError(InputProblem(name, short(given), rule, mend))


def refuse_nan(name: str, a: Tree) -> None:
    """Raise an `InputError` where an entry of a concrete array is NaN."""
    for leaf in jtu.tree_leaves(a):
        if is_concrete(leaf) and np.isnan(np.asarray(leaf)).any():
            raise InputError(
                InputProblem(name, short(leaf), "it must be a number", "Correct the NaN entries")
            )


class Text(str):
    """A value that a message shows as it stands."""


def short(value: Any) -> str:
    """A value as a message shows it, on one line: whole when small, summarised when large."""
    if isinstance(value, Text):
        return str(value)
    leaves = jtu.tree_leaves(value)
    if not leaves or not all(hasattr(leaf, "shape") for leaf in leaves) or len(leaves) > 4:
        text = " ".join(str(value).split())
        return text if len(text) <= 120 else text[:117] + "..."
    return ", ".join(map(_short_array, leaves))


def _short_array(leaf: Any) -> str:
    if not is_concrete(leaf):
        return f"a traced array of shape {jnp.shape(leaf)}"
    array = np.asarray(leaf)
    if array.size <= 6:
        return " ".join(str(array).split())
    known = array[~np.isnan(array)] if array.dtype.kind == "f" else array
    unknown = array.size - known.size
    range_ = f" with range [{known.min():.6g}, {known.max():.6g}]" if known.size else ""
    return f"an array of shape {array.shape}{range_}" + (f" and {unknown} NaN" if unknown else "")


def _not_real(name: str, given: str) -> InputError:
    return InputError(
        InputProblem(
            name,
            given,
            "it must be a real number, a floating-point array, or a tuple of these",
            f"Write {name} with a decimal point or convert it: jnp.asarray({name}, float)",
        )
    )
