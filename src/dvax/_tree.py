"""Arithmetic on pytrees of arrays: a state or a control is one array, or a tuple of arrays."""

import operator
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


class Label(str):
    """A text in a tree that JAX transforms: a node without leaves."""

    __slots__ = ()


jtu.register_pytree_node(Label, lambda text: ((), str(text)), lambda text, _: Label(text))


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


def array_module(*values: Tree) -> Any:
    """`numpy` where all of these have a value now, else `jax.numpy`."""
    return np if is_concrete(values) else jnp


_TREE = "it must be a real number, a floating-point array, or a tuple of these"


def as_float(a: Tree, name: str) -> Tree:
    """Arrays of a floating type from what the user gave; Python numbers take JAX's default type.

    States and controls are arrays and tuples of them. An integer or boolean *array* is refused rather
    than cast: its owner may have meant integer arithmetic, and a silent cast would hide that.
    """
    if isinstance(a, tuple) and a:
        parts = [as_float(part, name) for part in a]
        return type(a)(*parts) if hasattr(a, "_fields") else tuple(parts)
    return _float_array(a, name)


def as_floats(a: Tree, name: str) -> Tree:
    """The same for the parameters of a problem, which may be any tree."""
    if not jtu.tree_leaves(a):
        raise _not_real(name, a)
    return jtu.tree_map(
        lambda leaf: _float_array(leaf, name), a, is_leaf=lambda leaf: isinstance(leaf, list)
    )


def as_array(a: Any, name: str, least: int = 1) -> jax.Array:
    """One array of at least `least` entries, where no tuple of arrays will do."""
    if isinstance(a, tuple):
        fix = f"Write jnp.array({[*a]!r})" if _are_numbers(a) else "Join them into one array"
        rule = "it must be one array: a tuple is an element of a direct sum, one array a part"
        raise InputError(InputProblem(name, line(a), rule, fix))
    array = _float_array(a, name, "it must be a real number or a floating-point array")
    if array.size < least:
        given, rule = f"an array of shape {array.shape}", "it must have at least one entry"
        raise InputError(InputProblem(name, given, rule, "Give a number or a vector with entries"))
    return array


def as_number(a: Any, name: str, fix: str) -> jax.Array:
    """One number; `fix` says what to do about an array of several."""
    if isinstance(a, tuple):
        raise InputError(InputProblem(name, line(a), "it must be one number", fix))
    number = _float_array(a, name, "it must be one real number")
    if number.shape != ():
        raise InputError(InputProblem(name, _short_array(number), "it must be one number", fix))
    return number


def as_shape(shape: Any, name: str, fix: str) -> tuple[int, ...]:
    """The shape of an array: (n,) for a whole number n > 0, or a tuple of such numbers."""
    try:
        sizes = tuple(shape) if np.ndim(shape) else (shape,)
        whole = tuple(operator.index(n) for n in sizes)
    except (TypeError, ValueError):
        sizes, whole = (), (0,)
    if any(isinstance(n, bool) for n in sizes) or min(whole, default=1) < 1:
        rule = "it is a whole number > 0, or a tuple of these"
        raise InputError(InputProblem(name, line(shape), rule, fix))
    return whole


def check_kind(given: Any, kind: Any, name: str, rule: str, fix: str) -> None:
    """Raise an `InputError` unless `given` is an instance of `kind`."""
    if not isinstance(given, kind):
        raise InputError(InputProblem(name, _described(given), rule, fix))


def check_parts(parts: tuple[Any, ...], kind: type, name: str, example: str) -> None:
    """Raise an `InputError` unless there are parts and each is an instance of `kind`."""
    noun = kind.__name__.removeprefix("Abstract").lower()
    fix = f"Give one argument a part, such as dvax.{noun}s.{example}"
    rule = f"every part is one of dvax.{noun}s"
    for number, part in enumerate(parts, start=1):
        check_kind(part, kind, f"{name}, part {number}", rule, fix)
    if not parts:
        raise InputError(InputProblem(name, "no parts", f"it needs one {noun} or more", fix))


def check_tolerance(tol: Any, name: str) -> None:
    """Raise an `InputError` unless `tol` is a finite number ≥ 0 with a value."""
    number = isinstance(tol, int | float | np.floating) and not isinstance(tol, bool)
    if not (number and 0 <= tol < np.inf):
        rule = "it must be a finite number ≥ 0 that is not traced"
        raise InputError(InputProblem(name, _described(tol), rule, "Leave it out for the default"))


def _are_numbers(a: tuple[Any, ...]) -> bool:
    return all(isinstance(v, int | float) and not isinstance(v, bool) for v in a)


def _float_array(leaf: Any, name: str, rule: str = _TREE) -> jax.Array:
    # `dtypes.issubdtype` and `asarray` cost as much as a hundred steps of a small system.
    if isinstance(leaf, jax.Array) and leaf.dtype in _FLOATS:
        return leaf
    if isinstance(leaf, int | float) and not isinstance(leaf, bool):
        try:
            return jnp.asarray(float(leaf))
        except OverflowError:
            raise _not_real(name, leaf, rule) from None
    if isinstance(leaf, list):
        leaf = _from_list(leaf, name)
    dtype = getattr(leaf, "dtype", None)
    if isinstance(leaf, np.ma.MaskedArray | type) or dtype not in _FLOATS:
        raise _not_real(name, leaf, rule)
    try:
        return jnp.asarray(leaf)
    except (TypeError, ValueError):  # pandas tables, ShapeDtypeStruct and others
        raise _not_real(name, leaf, rule) from None


_FLOATS = {np.dtype(np.float32), np.dtype(np.float64)}


def _from_list(numbers: list[Any], name: str) -> Any:
    try:
        array: Any = np.asarray(numbers) if is_concrete(numbers) else jnp.asarray(numbers)
        if array.dtype.kind == "O" and _are_numbers(tuple(array.flat)):
            array = array.astype(float)  # integers beyond 64 bits
    except (TypeError, ValueError, OverflowError):
        raise _not_real(name, numbers) from None
    if array.dtype.kind not in "iuf":
        raise _not_real(name, numbers)
    return (
        array.astype(float) if isinstance(array, np.ndarray) or array.dtype.kind != "f" else array
    )


def require(condition: Callable[[], Any], name: str, given: Any, rule: str, mend: str) -> None:
    """Raise an `InputError` unless `condition()` is true, in all entries, on concrete values.

    Values that are traced (inside `jax.jit`, `jax.grad`, ...) cannot be looked at, so they pass.
    """
    if not is_concrete(given):
        return
    # What has a value may be met while something else is traced.
    with jax.ensure_compile_time_eval():
        found = condition()
        holds = bool(np.all(found)) if np.ndim(found) else bool(found)
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
    if array.dtype.kind not in "iuf":
        return f"an array of {array.dtype} of shape {array.shape}"
    known = array[~np.isnan(array)] if array.dtype.kind == "f" else array
    unknown = array.size - known.size
    range_ = f" with range [{known.min():.6g}, {known.max():.6g}]" if known.size else ""
    return f"an array of shape {array.shape}{range_}" + (f" and {unknown} NaN" if unknown else "")


def line(value: Any, most: int = 120) -> str:
    """repr(value) on one line of at most `most` characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= most else text[: most - 3] + "..."


def _described(value: Any) -> str:
    """The type of a value, and the value where that says more."""
    kind = type(value).__name__
    if value is None:
        return "None"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    dtype = getattr(value, "dtype", None)
    if isinstance(value, np.generic):
        return f"{dtype} {value}"
    if dtype is not None and hasattr(value, "shape"):
        masked = "a masked array" if isinstance(value, np.ma.MaskedArray) else "an array"
        return f"{masked} of {dtype} of shape {value.shape}"
    return line(value) if isinstance(value, tuple | list) else f"{kind} {line(value)}"


def _not_real(name: str, given: Any, rule: str = _TREE) -> InputError:
    if isinstance(given, list):
        rule = "a list must have real numbers, and rows of one length"
    if getattr(getattr(given, "dtype", None), "kind", "") == "c":
        rule = "data and states are real"
    argument = name.rpartition("(")[2].rstrip(")")
    argument = argument if argument.isidentifier() else "value"
    return InputError(InputProblem(name, _described(given), rule, _conversion(given, argument)))


def _conversion(given: Any, argument: str) -> str:
    """How to make real numbers of `given`, the value of `argument`."""
    if isinstance(given, str):
        try:
            return f"Write {float(given)!r}, without quotation marks"
        except ValueError:
            return "Give a number or an array, not text"
    if isinstance(given, bool | np.bool_):
        return f"Write {float(given)!r} for {bool(given)}"
    if isinstance(given, dict):
        return "Give its values: a number, an array, or a tuple of arrays"
    if isinstance(given, set | frozenset):
        return "A set has no order: give a list"
    if isinstance(given, int):
        return "Give a number within the range of float64"
    if isinstance(given, list):
        return "Correct its entries, or join arrays of several shapes in a tuple"
    if isinstance(given, np.ma.MaskedArray):
        return f"Say what stands in for masked entries: {argument}.filled(0.0)"
    dtype = getattr(given, "dtype", None)
    kind = getattr(dtype, "kind", "")
    if isinstance(given, complex) or kind == "c":
        return f"Take its real part, jnp.real({argument}), or give both parts as two components"
    if kind in ("i", "u", "b"):
        return f"Convert it: jnp.asarray({argument}, float)"
    if kind == "f" or (dtype is not None and "float" in str(dtype).lower()):
        return f"Convert it to float32 or float64: np.asarray({argument}, np.float64)"
    if callable(given) and not isinstance(given, type):
        return "Give a number or an array, such as the value that it returns"
    if hasattr(given, "__array__") and not isinstance(given, type):
        return f"Convert it: np.asarray({argument}, float)"
    return "Give a number, such as 1.0, or an array, such as jnp.array([1.0, 2.0])"
