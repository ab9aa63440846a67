"""Arithmetic on pytrees of arrays: a state or a control is one array, or a tuple of arrays."""

import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from equinox import is_array_like
from jax import lax

from .errors import InputError, input_error

Tree = Any
"""A pytree of arrays of one floating type."""


class Static:
    """A pytree node without leaves that contains an arbitrary static value."""

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


def dot(a: Tree, b: Tree) -> Any:
    """Return the sum of the products of all entries, in the type of the leaves."""
    return sum(map(jnp.vdot, jtu.tree_leaves(a), jtu.tree_leaves(b)))


def where(condition: Any, a: Tree, b: Tree) -> Tree:
    """Return a if the condition is true, else b, without an operation for identical leaves."""
    return jtu.tree_map(lambda p, q: p if p is q else jnp.where(condition, p, q), a, b)


def wide(condition: jax.Array, like: jax.Array) -> jax.Array:
    """Return a condition for each row with as many axes as `like`, a table of rows."""
    return condition.reshape(-1, *(1,) * (like.ndim - 1))


def put(table: Tree, index: Any, row: Tree) -> Tree:
    """Return the table with one row replaced, by a dynamic update, which is faster than a scatter."""
    return jtu.tree_map(
        lambda leaf, new: lax.dynamic_update_index_in_dim(leaf, new, index, 0), table, row
    )


def put_if(condition: Any, table: Tree, index: Any, row: Tree) -> Tree:
    """Return the table with one row replaced if the condition is true.

    Only the row is selected: a select between two tables would copy one."""
    old_row = jtu.tree_map(lambda leaf: lax.dynamic_index_in_dim(leaf, index, 0, False), table)
    return put(table, index, where(condition, row, old_row))


def zeros_like(a: Tree) -> Tree:
    return jtu.tree_map(_zeros, a)


def _zeros(leaf: Any) -> jax.Array:
    # JAX would compile a program for each shape. A large array is better made on its device.
    if is_concrete(leaf) and isinstance(leaf, jax.Array) and leaf.size <= _MOST_ON_HOST:
        return prepare(np.zeros_like, leaf)
    if isinstance(leaf, jax.ShapeDtypeStruct) and leaf.size <= _MOST_ON_HOST:
        return jnp.asarray(np.zeros(leaf.shape, leaf.dtype))
    return jnp.zeros_like(leaf)


_MOST_ON_HOST = 4096


def all_finite(a: Tree) -> jax.Array:
    """Return whether every entry is finite.

    0·v is NaN exactly if v is not finite. A sum of products is one pass over memory; a test of each
    entry followed by a reduction would be two."""
    total = sum(jnp.sum(0.0 * leaf) for leaf in jtu.tree_leaves(a))
    return jnp.isfinite(total)


def shapes(a: Tree) -> Tree:
    """Return the tree with every array replaced by its shape."""
    return jtu.tree_map(jnp.shape, a)


def same_shape(a: Tree, b: Tree) -> bool:
    if jtu.tree_structure(a) != jtu.tree_structure(b):
        return False
    pairs = zip(jtu.tree_leaves(a), jtu.tree_leaves(b), strict=True)
    return all(jnp.shape(p) == jnp.shape(q) for p, q in pairs)


def same_values(a: Tree, b: Tree) -> bool:
    """Return whether two trees have the same structure and equal leaves; False for traced leaves."""
    (leaves, structure), (others, other) = jtu.tree_flatten(a), jtu.tree_flatten(b)
    if structure != other or not is_concrete(leaves, others):
        return False
    return all(
        one is two or (is_array_like(one) and is_array_like(two) and np.array_equal(one, two))
        for one, two in zip(leaves, others, strict=True)
    )


def fits(name: str, given: Any, like: Tree, what: str) -> None:
    """Raise an `InputError` unless the array `given` has exactly the shape of `like`."""
    if isinstance(like, tuple) or jnp.shape(given) != jnp.shape(like):
        raise input_error(
            name,
            f"shape {jnp.shape(given)}",
            f"it acts entry by entry on the {what}, whose elements have shape {shapes(like)}",
            "Give it that shape, or pass state_space= or control_space= to dvax.Problem",
        )


def fits_matrix(name: str, matrix: Any, like: Tree, what: str) -> None:
    """Raise an `InputError` unless `like` is a vector that the square `matrix` can act on."""
    if isinstance(like, tuple) or jnp.shape(like) != jnp.shape(matrix)[:1]:
        raise input_error(
            name,
            f"shape {jnp.shape(matrix)}",
            f"it acts on the {what}, whose elements have shape {shapes(like)}",
            "Give it as many rows as the vector has entries; state and control must be vectors",
        )


def fits_parts(name: str, count: int, like: Tree, what: str) -> None:
    """Raise an `InputError` unless `like` is a tuple of `count` parts."""
    if not isinstance(like, tuple) or len(like) != count:
        raise input_error(
            name,
            f"{count} parts",
            f"it acts on the {what}, whose elements have shape {shapes(like)}",
            "Give one part for each, and pass the spaces as dvax.spaces.Product(...)",
        )


def is_concrete(*trees: Tree) -> bool:
    """Return whether no leaf is traced, so that values can be checked."""
    for leaf in jtu.tree_leaves(trees):
        if isinstance(leaf, jax.core.Tracer):
            return False
    return True


def is_sharded(leaf: Any) -> bool:
    """Return whether a concrete value is an array on several devices, which NumPy would gather."""
    return isinstance(leaf, jax.Array) and len(leaf.sharding.device_set) > 1


def is_on_host(leaf: Any) -> bool:
    """Return whether NumPy reads a concrete value without a copy."""
    if not isinstance(leaf, jax.Array):
        return True
    return not is_sharded(leaf) and next(iter(leaf.sharding.device_set)).platform == "cpu"


def has_only_finite(a: Tree) -> bool:
    """Return whether every entry of a concrete tree is finite, without a compiled program."""
    modules = ((jnp if is_sharded(leaf) else np, leaf) for leaf in jtu.tree_leaves(a))
    return all(bool(module.isfinite(leaf).all()) for module, leaf in modules)


def first_nonfinite(leaf: Any) -> tuple[int, ...] | None:
    """Return the index of the first entry of a concrete array that is not finite, None for none."""
    # NumPy compiles no program.
    module: Any = jnp if is_sharded(leaf) else np
    wrong = ~module.isfinite(leaf)
    if not wrong.any():
        return None
    return tuple(int(k) for k in np.unravel_index(int(module.argmax(wrong)), wrong.shape))


def primal(a: Tree) -> Tree:
    """Return the tree without its tangents, which is concrete where only derivatives are traced
    (`jax.grad` outside `jax.jit`)."""
    traced = lambda leaf: isinstance(leaf, jax.core.Tracer)  # noqa: E731
    return jtu.tree_map(lambda leaf: jax.lax.stop_gradient(leaf) if traced(leaf) else leaf, a)


def dtype(a: Tree) -> Any:
    """Return the floating-point type of a state."""
    # `jnp.result_type` takes ten microseconds.
    return a.dtype if isinstance(a, jax.Array) else jnp.result_type(*jtu.tree_leaves(a))


def is_number(value: Any) -> bool:
    """Return whether the value is one real number, traced or not, and no bool."""
    if isinstance(value, int | float):
        return not isinstance(value, bool)
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    return kind in ("f", "i", "u") and getattr(value, "shape", None) == ()


def prepare(fn: Callable[..., Any], *arrays: Any) -> jax.Array:
    """Return fn(*arrays), an array that is computed once from parameters.

    Concrete arrays are given to fn as NumPy arrays: outside of a trace JAX would compile a program for
    each operation, which takes as long as thousands of steps."""
    if not is_concrete(arrays) or any(map(is_sharded, arrays)):
        return fn(*arrays)
    # NumPy has no weak types: a number given as 1.0 would turn single precision into double.
    hosts = [np.asarray(a) for a in arrays]
    is_real = [host.dtype.kind == "f" for host in hosts]
    if any(is_real):
        real = jnp.result_type(*(a for a, of in zip(arrays, is_real, strict=True) if of))
        hosts = [host.astype(real) if of else host for host, of in zip(hosts, is_real, strict=True)]
    result = np.asarray(fn(*hosts))
    # A Python number takes the type of what it meets, and so does a result of Python numbers.
    are_weak = all(isinstance(a, int | float) or getattr(a, "weak_type", False) for a in arrays)
    if are_weak and result.ndim == 0:
        return jnp.asarray(float(result))
    return jnp.asarray(result, jax.dtypes.canonicalize_dtype(result.dtype))


def host(a: Tree) -> Tree:
    """Return the tree with concrete leaves as NumPy arrays.

    NumPy is faster for few numbers: JAX compiles every operation on concrete values separately."""
    return jtu.tree_map(
        lambda leaf: np.asarray(leaf) if is_concrete(leaf) and not is_key(leaf) else leaf, a
    )


def is_key(leaf: Any) -> bool:
    """Return whether a leaf is a random key of JAX, which is no array of NumPy."""
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def array_module(*values: Tree) -> Any:
    """Return `numpy` if no value is traced, else `jax.numpy`."""
    return np if is_concrete(values) else jnp


_TREE = "it must be a real number, a floating-point array, or a tuple of these"


def as_float(a: Tree, name: str) -> Tree:
    """Return a state or control given by the user as floating-point arrays.

    It may be an array, or a tuple of these. Python numbers take JAX's default type. Raise an
    `InputError` for an integer or boolean *array*: a silent cast would hide unintended integer
    arithmetic.
    """
    if isinstance(a, tuple) and a:
        parts = [as_float(part, name) for part in a]
        return type(a)(*parts) if hasattr(a, "_fields") else tuple(parts)
    return _float_array(a, name)


def as_arrays(args: Any) -> Any:
    """Return args with floats converted to arrays; integers and flags remain static.

    `np.float64`, which is a float of Python too, has the same program as other floats.
    """
    return jtu.tree_map(lambda v: jnp.asarray(float(v)) if isinstance(v, float) else v, args)


def as_floats(a: Tree, name: str) -> Tree:
    """Return the parameters of a problem, an arbitrary tree, as floating-point arrays."""
    if not jtu.tree_leaves(a):
        raise _not_real(name, a)
    return jtu.tree_map(
        lambda leaf: _float_array(leaf, name), a, is_leaf=lambda leaf: isinstance(leaf, list)
    )


def as_array(a: Any, name: str, min_size: int = 1) -> jax.Array:
    """Return one floating-point array of at least `min_size` entries; a tuple is an error."""
    if isinstance(a, tuple):
        fix = f"Write jnp.array({[*a]!r})" if _are_numbers(a) else "Join them into one array"
        rule = "it must be one array: a tuple is an element of a direct sum, one array a part"
        raise input_error(name, line(a), rule, fix)
    array = _float_array(a, name, "it must be a real number or a floating-point array")
    if array.size < min_size:
        given, rule = f"an array of shape {array.shape}", "it must have at least one entry"
        raise input_error(name, given, rule, "Give a number or a vector with entries")
    return array


def as_number(a: Any, name: str, fix: str) -> jax.Array:
    """Return one floating-point number; `fix` is the advice for an array of several numbers."""
    if isinstance(a, tuple):
        raise input_error(name, line(a), "it must be one number", fix)
    number = _float_array(a, name, "it must be one real number")
    if number.shape != ():
        raise input_error(name, _short_array(number), "it must be one number", fix)
    return number


def as_shape(shape: Any, name: str, fix: str) -> tuple[int, ...]:
    """Return the shape of an array, (n,) for an integer n > 0, or a tuple of such integers."""
    try:
        sizes = tuple(shape) if np.ndim(shape) else (shape,)
        integers = tuple(operator.index(n) for n in sizes)
    except (TypeError, ValueError):
        sizes, integers = (), (0,)
    if any(isinstance(n, bool) for n in sizes) or min(integers, default=1) < 1:
        rule = "it must be a whole number > 0, or a tuple of these"
        raise input_error(name, line(shape), rule, fix)
    return integers


def check_kind(given: Any, kind: Any, name: str, rule: str, fix: str) -> None:
    """Raise an `InputError` unless `given` is an instance of `kind`."""
    if not isinstance(given, kind):
        raise input_error(name, _described(given), rule, fix)


def check_parts(parts: tuple[Any, ...], kind: type, name: str, example: str) -> None:
    """Raise an `InputError` unless there is at least one part and each is an instance of `kind`."""
    noun = kind.__name__.removeprefix("Abstract").lower()
    fix = f"Give one argument a part, such as dvax.{noun}s.{example}"
    rule = f"every part must be one of dvax.{noun}s"
    for number, part in enumerate(parts, start=1):
        check_kind(part, kind, f"{name}, part {number}", rule, fix)
    if not parts:
        raise input_error(name, "no parts", f"it needs one {noun} or more", fix)


def check_tolerance(tol: Any, name: str) -> None:
    """Raise an `InputError` unless `tol` is a finite number ≥ 0 that is not traced."""
    number = isinstance(tol, int | float | np.floating) and not isinstance(tol, bool)
    if not (number and 0 <= tol < np.inf):
        rule = "it must be a finite number ≥ 0 that is not traced"
        raise input_error(name, _described(tol), rule, "Leave it out for the default")


def _are_numbers(a: tuple[Any, ...]) -> bool:
    return all(isinstance(v, int | float) and not isinstance(v, bool) for v in a)


def _float_array(leaf: Any, name: str, rule: str = _TREE) -> jax.Array:
    # Avoid `dtypes.issubdtype` and `asarray`, which take as long as 100 steps of a small system.
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
        # With its type given, JAX compiles no program for a shape.
        return jnp.asarray(leaf, jax.dtypes.canonicalize_dtype(dtype))
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


def require(condition: Callable[[], Any], name: str, given: Any, rule: str, fix: str) -> None:
    """Raise an `InputError` unless `condition()` is true in all entries.

    Traced values (inside `jax.jit`, `jax.grad`, ...) cannot be checked, and are accepted.
    """
    if not is_concrete(given):
        return
    # Concrete values may occur inside the trace of another function.
    with jax.ensure_compile_time_eval():
        result = condition()
        module = jnp if is_sharded(result) else np
        holds = bool(module.all(result)) if np.ndim(result) else bool(result)
    if not holds:
        raise input_error(name, short(given), rule, fix)


def check_not_nan(name: str, a: Tree) -> None:
    """Raise an `InputError` if an entry of a concrete array is NaN."""
    for leaf in jtu.tree_leaves(a):
        if is_concrete(leaf) and (jnp if is_sharded(leaf) else np).isnan(leaf).any():
            raise input_error(name, short(leaf), "it must not be NaN", "Correct the NaN entries")


class Text(str):
    """A text that messages contain unchanged."""


def short(value: Any) -> str:
    """Return a value on one line for a message, and a summary of a large one."""
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
    numbers = array[~np.isnan(array)] if array.dtype.kind == "f" else array
    nan_count = array.size - numbers.size
    range_ = f" with range [{numbers.min():.6g}, {numbers.max():.6g}]" if numbers.size else ""
    nans = f" and {nan_count} NaN" if nan_count else ""
    return f"an array of shape {array.shape}{range_}{nans}"


def line(value: Any, max_length: int = 120) -> str:
    """Return repr(value) on one line of at most `max_length` characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= max_length else text[: max_length - 3] + "..."


def _described(value: Any) -> str:
    """Return the type of a value, and the value itself unless it is an array or a class."""
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
        rule = "a list must contain real numbers, in rows of one length"
    if getattr(getattr(given, "dtype", None), "kind", "") == "c":
        rule = "data and states are real, so the numbers must be real"
    argument = name.rpartition("(")[2].rstrip(")")
    argument = argument if argument.isidentifier() else "value"
    return input_error(name, _described(given), rule, _conversion(given, argument))


def _conversion(given: Any, argument: str) -> str:
    """Return advice on converting `given`, the value of `argument`, to real numbers."""
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
        return f"Replace the masked entries by numbers: {argument}.filled(0.0)"
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
