"""The first call of user-defined functions, with errors that name the file and line of the user's code.

The functions are f, h, A, P and K of a problem and F of `dvax.solve_vi`. JAX traces them, and many
first programs fail there: too few parameters, an `if` on a traced value, a NumPy function, wrong
shapes. The exceptions of Python and JAX point into the libraries. This module converts them to an
`InputError`."""

import dataclasses
import dis
import inspect
import os
import re
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from . import _tree
from .errors import DvaxError, InputError, InputProblem, input_error
from .programs.indices import IndexOutside

_LIBRARIES = {
    "dvax", "equinox", "jax", "jaxlib", "jaxtyping", "numpy", "scipy", "optimistix",
    "pandas", "polars", "pyarrow", "xarray",
}  # fmt: skip
"""Packages whose frames are not the user's code."""


def call(
    name: str,
    fn: Callable[..., Any],
    inputs: Mapping[str, Any],
    about: str = "",
    caller: str = "dvax.Problem",
) -> Any:
    """Return fn(*inputs.values()) for the argument `name` of `caller`.

    `about` describes the origin of the shape of u, for messages.

    **Raises:** `dvax.InputError` if fn has other parameters, or raises an exception that is typical
    of a common mistake; that of dvax gets the place in fn. Any other exception keeps its type and
    gets a note."""
    at = f"{caller}({name})"
    _check_parameters(at, name, fn, inputs)
    try:
        return fn(*inputs.values())
    except InputError as error:
        place = f"{at}, {_place(fn, error.__traceback__)}: "
        raise InputError(
            *(dataclasses.replace(p, place=place + p.place) for p in error.problems)
        ) from error
    except DvaxError:
        raise
    except (TypeError, ValueError, LookupError, AttributeError) as error:
        raise InputError(_explain(at, name, fn, inputs, about, error)) from error
    except Exception as error:
        error.add_note(f"Raised in {name} of {caller}, {_place(fn, error.__traceback__)}.")
        raise


def leaked_tracer_error(error: jax.errors.UnexpectedTracerError) -> InputError:
    """Return the `InputError` for a traced array that f, h or K stores beyond a call."""
    match = re.search(r"created on line (\S+?):(\d+)", str(error))
    place = f"{match[1]}, line {match[2]}" if match else "f, h, A, P or K of dvax.Problem"
    return input_error(
        place,
        "a traced array that is used after the call that created it",
        "a dvax.signals.Table, or an array stored in a global, must not be created inside of f, h "
        "or K, where it is traced and its times are unknown",
        "Create it once, outside of the function, or pass it in args",
    )


def check_values(
    name: str,
    fn: Callable[..., Any],
    out: Any,
    x: Any,
    inputs: str = "t, x, u, args",
    caller: str = "dvax.Problem",
    element: str = "the state x0",
) -> None:
    """Raise an `InputError` unless `out` = fn(`inputs`) consists of real numbers of the type of x.

    `element` is the name of x in messages."""
    expected = jnp.result_type(*jtu.tree_leaves(x))

    def fail(given: str, rule: str, fix: str) -> None:
        raise input_error(f"{caller}({name}), {_place(fn)}", given, rule, fix)

    for leaf in jtu.tree_leaves(out):
        if not _is_numeric(leaf):
            fail(
                f"{type(leaf).__name__} {_line(repr(leaf))}",
                f"{name}({inputs}) must be a function that returns an array, or a tuple of arrays",
                "Return numbers: jnp.stack([...]) joins several into one array",
            )
        dtype = _dtype(leaf, expected)
        common = jnp.promote_types(expected, dtype)
        if jnp.issubdtype(common, jnp.complexfloating):
            fail(
                f"a value of {common}", f"{name}({inputs}) is real, as {element} is",
                "Return its real part, or real and imaginary part as two components",
            )  # fmt: skip
        if _is_bool(leaf):
            fail(
                "a value of bool", f"{name}({inputs}) must return numbers",
                "Convert it: jnp.where(condition, 1.0, 0.0)",
            )  # fmt: skip
        if dtype != expected:
            fail(f"a value of {jnp.dtype(dtype)}", *_precision_rule(dtype, expected, element))


def check_precision(name: str, data: Any, x: Any) -> None:
    """Raise an `InputError` if an array in `data` has another floating type than the state.

    Arithmetic would then change the type of the state in the first step, or lose half of its digits."""
    expected = jnp.result_type(*jtu.tree_leaves(x))
    for leaf in jtu.tree_leaves(data):
        if isinstance(leaf, jax.Array) and leaf.dtype.kind == "f":
            dtype = _dtype(leaf, expected)
            if dtype != expected:
                given = f"data of {jnp.dtype(dtype)}"
                rule, fix = _precision_rule(dtype, expected, "the state x0")
                raise input_error(f"dvax.Problem({name})", given, rule, fix)


def check_args(args: Any, caller: str) -> None:
    """Raise an `InputError` if `args` is no pytree of numbers.

    Dict keys may not be sortable, arrays may contain text or Python objects, and tables of other
    libraries are no arrays."""
    place = f"{caller}(args)"
    try:
        leaves = jtu.tree_leaves(args)
    except ValueError:
        rule = "JAX sorts the keys of a dict, and these have no order"
        raise input_error(place, "keys of several types", rule, "Use strings") from None
    for leaf in leaves:
        if _is_table(leaf):
            given, rule = _kind(leaf), "JAX computes with arrays, and with containers of arrays"
            fix = "Pass jnp.asarray(v.to_numpy()); for named numbers, dict(v)"
            raise input_error(place, given, rule, fix)
        if isinstance(leaf, np.ndarray) and leaf.dtype.kind not in "biufc":
            given = f"an array of {leaf.dtype}, {_tree.short(leaf)}"
            fix = "Convert it, np.asarray(..., float), and pass texts as str"
            rule = "the arrays in args must contain numbers"
            raise input_error(place, given, rule, fix)


def _precision_rule(dtype: Any, expected: Any, element: str) -> tuple[str, str]:
    """Return the rule and the fix for numbers of `dtype` with an `element` of the type `expected`."""
    x = element.split()[-1]
    fix = (
        f"Give {x} in that type, jnp.asarray({x}, float) in double precision, or the data in {x}'s"
    )
    if jnp.promote_types(dtype, expected) == expected:
        fix = f"Give the data in that type: jnp.asarray(..., jnp.{jnp.dtype(expected).name})"
    return f"{element} is of {jnp.dtype(expected).name}, and types are not converted silently", fix


def _is_numeric(leaf: Any) -> bool:
    """Return whether a leaf is a number or an array of numbers, including bool and complex."""
    if isinstance(leaf, np.ndarray | np.generic):
        return leaf.dtype.kind not in "OSUMm"
    number = isinstance(leaf, bool | int | float | complex)
    return number or (hasattr(leaf, "dtype") and hasattr(leaf, "shape"))


def _is_bool(leaf: Any) -> bool:
    return isinstance(leaf, bool) or getattr(leaf, "dtype", None) == np.dtype(bool)


def check_not_integer(name: str, fn: Callable[..., Any], out: Any) -> None:
    """Raise an `InputError` if `out` = fn(t, x, u, args) has integers, which have no derivative."""
    for leaf in jtu.tree_leaves(out):
        kind = getattr(getattr(leaf, "dtype", None), "kind", "")
        if isinstance(leaf, int) or kind in ("i", "u"):
            raise input_error(
                f"dvax.Problem({name}), {_place(fn)}",
                f"a value of {getattr(leaf, 'dtype', 'int')}",
                f"{name}(t, x, u, args) must return floating-point numbers",
                "Write 1.0 for 1, or convert an array: a.astype(float)",
            )


def _dtype(leaf: Any, expected: Any) -> Any:
    """Return the type of a leaf; Python numbers and weak types take the `expected` type."""
    if isinstance(leaf, bool | int | float):
        return expected
    dtype = jnp.result_type(leaf)
    if jnp.issubdtype(dtype, jnp.complexfloating):
        return dtype
    weak = getattr(leaf, "weak_type", False) or not jnp.issubdtype(dtype, jnp.floating)
    return expected if weak else dtype


def _check_parameters(
    at: str, name: str, fn: Callable[..., Any], inputs: Mapping[str, Any]
) -> None:
    try:
        signature = inspect.signature(fn)
    except (TypeError, ValueError):
        return  # some C functions have no signature
    try:
        signature.bind(*inputs.values())
    except TypeError:
        names = ", ".join(inputs)
        raise input_error(
            f"{at}, {_place(fn)}", f"a function of {signature}",
            f"it is called as {name}({names})",
            f"Write {name}=lambda {names}: ..., even if some parameters are unused",
        ) from None  # fmt: skip
    _check_order(at, name, fn, [*signature.parameters][: len(inputs)], [*inputs])


def _check_order(
    at: str, name: str, fn: Callable[..., Any], given: list[str], expected: list[str]
) -> None:
    """Raise an `InputError` if parameters have the names of others in another order: f(x, t, u, args)
    would compute with t as the state, without an error where shapes agree. A state that is named u is
    allowed, f(t, u, q, args)."""
    order = [expected.index(word) for word in given if word in expected]
    if order == sorted(order):
        return
    names = ", ".join(expected)
    raise input_error(
        f"{at}, {_place(fn)}", f"the parameters {', '.join(given)}",
        f"it is called as {name}({names}), by position",
        f"Write {name}=lambda {names}: ..., or give other names to the parameters",
    )  # fmt: skip


def _explain(
    at: str, name: str, fn: Callable[..., Any], inputs: Mapping[str, Any], about: str,
    error: Exception,
) -> InputProblem:  # fmt: skip
    shapes = ", ".join(
        f"{key} of shape {_tree.shapes(value)}" for key, value in inputs.items() if key in "xuy"
    )
    given = f"{type(error).__name__}: {_line(str(error))}"
    if isinstance(error, KeyError) and isinstance(inputs.get("args"), Mapping):
        known = ", ".join(map(repr, inputs["args"]))
        rule, fix = f"args has the keys {known}", "Correct the key, or add it to args"
        return InputProblem(f"{at}, {_place(fn, error.__traceback__)}", given, rule, fix)
    args = inputs.get("args")
    is_own = isinstance(args, list) or not any(isinstance(inputs.get(k), tuple) for k in "xu")
    if isinstance(args, list | tuple) and is_own and "index out of range" in str(error):
        rule, fix = f"args has {len(args)} entries", "Correct the index, or add the entry to args"
        return InputProblem(f"{at}, {_place(fn, error.__traceback__)}", given, rule, fix)
    rule, fix = _reason(name, fn, inputs, error)
    if shapes:
        rule += f". It was traced with {shapes}{about}"
    return InputProblem(f"{at}, {_place(fn, error.__traceback__)}", given, rule, fix)


def _is_table(value: Any) -> bool:
    """Return whether a value is data of pandas or a similar library, and no array."""
    has_method = callable(getattr(value, "to_numpy", None))
    return has_method and not isinstance(value, np.ndarray | jax.Array)


def _kind(value: Any) -> str:
    return f"a {type(value).__name__} of {type(value).__module__.split('.')[0]}"


def _table_read(fn: Callable[..., Any]) -> tuple[str, Any] | None:
    """Return name and value of the first table that fn reads from around it; None without one."""
    try:
        found = inspect.getclosurevars(inspect.unwrap(fn))
    except TypeError:
        return None
    return next(
        ((n, v) for n, v in {**found.globals, **found.nonlocals}.items() if _is_table(v)), None
    )


def _texts(args: Any) -> str:
    """Return the first texts in args with their places, "" if there are none."""
    leaves = jtu.tree_flatten_with_path(args)[0]
    texts = [f"args{jtu.keystr(path)} = {leaf!r}" for path, leaf in leaves if isinstance(leaf, str)]
    return _line(", ".join(texts[:2]))


def _reason(
    name: str, fn: Callable[..., Any], inputs: Mapping[str, Any], error: Exception
) -> tuple[str, str]:
    """Return the rule that was violated, and the fix."""
    traced = f"JAX traces {name}, so that its arguments have no values, which"
    if isinstance(error, TypeError) and (table := _table_read(fn)) is not None:
        return (
            f"{name} reads `{table[0]}`, {_kind(table[1])}, and JAX computes with arrays",
            "Convert what it reads once, outside of the function: jnp.asarray(v.to_numpy())",
        )
    if isinstance(error, jax.errors.TracerBoolConversionError):
        return (
            f"{traced} `if`, `while`, `and`, `or`, `not`, `min` and `max` require",
            "Write jnp.where(condition, a, b) for `if`, jnp.logical_and(a, b) for `and`, "
            "jnp.maximum(a, b) for `max`",
        )
    if isinstance(error, jax.errors.NonConcreteBooleanIndexError):
        return f"{traced} indexing by a mask requires", "Write jnp.where(mask, a, b) for a[mask]"
    if isinstance(error, jax.errors.TracerArrayConversionError):
        return (
            f"{traced} a NumPy function requires",
            "Use jax.numpy: `import jax.numpy as jnp`, and jnp.sin(x) for np.sin(x). For values at "
            "given times, use dvax.signals.Table",
        )
    if isinstance(error, jax.errors.TracerIntegerConversionError):
        return (
            f"{traced} a list index or a loop bound requires",
            "Write jnp.take(a, i) for a list at i, jax.lax.fori_loop for a loop",
        )
    if isinstance(error, jax.errors.ConcretizationTypeError):
        return (
            f"{traced} float(), int() or a function of `math` requires",
            "Remove float() or int(); write jnp.sin(x) for math.sin(x), and dvax.signals.Table for "
            "values at given times",
        )
    if isinstance(error, jax.errors.UnexpectedTracerError):
        return (
            f"{name} stores an array for another call, but traced arrays are valid only in one call",
            "Return all results, and create data outside of the function",
        )
    if "immutable" in str(error) or "item assignment" in str(error):
        return "JAX arrays are immutable", "Write x = x.at[i].set(v) for x[i] = v"
    if inputs.get("args", 0) is None and _reads_args(fn, error):
        return f"{name} reads args, and no args were given", "Pass args=... to the call"
    if isinstance(error, TypeError) and (texts := _texts(inputs.get("args"))):
        return (
            f"args holds text, {texts}, and arithmetic needs numbers",
            "Convert numbers that were read as text: float(...)",
        )
    if isinstance(error, TypeError) and "'list'" in str(error):
        return (
            f"{name} computes with a list, as args may hold one, and arithmetic needs an array",
            "Pass jnp.asarray(...) in place of the list",
        )
    fix = "Fix that line"
    if "u" in inputs:
        fix += (
            ", or x0, from which x has its shape; if u has another shape, pass it to dvax.Problem: "
            "control_space=dvax.spaces.Euclidean(()) for a single number, Euclidean(3) for a vector "
            "of 3"
        )
    return f"JAX must be able to trace {name}({', '.join(inputs)})", fix


def _reads_args(fn: Callable[..., Any], error: Exception) -> bool:
    """Return whether the error is due to args=None.

    The error must refer to None, and the statement of the user's code that raised it must read a
    parameter that is None: args, or a parameter to which args was passed."""
    if "NoneType" not in str(error):
        return False
    frame, instruction, trace = None, 0, error.__traceback__
    while trace is not None:
        if not _in_library(trace):
            frame, instruction = trace.tb_frame, trace.tb_lasti
        trace = trace.tb_next
    if frame is None:
        return False
    code, names = frame.f_code, frame.f_locals
    parameter_count = code.co_argcount + code.co_kwonlyargcount
    parameters = {*code.co_varnames[:parameter_count], *_last_parameter(fn)}
    first, last = [*code.co_positions()][instruction // 2][:2]
    for step in dis.get_instructions(code):
        at = step.positions.lineno if step.positions else None
        if first is None or last is None or at is None or not first <= at <= last:
            continue
        read = step.argval if isinstance(step.argval, tuple) else (step.argval,)
        if any(isinstance(n, str) and n in parameters and names.get(n, 0) is None for n in read):
            return True
    return False


def _last_parameter(fn: Callable[..., Any]) -> list[str]:
    """Return the name of fn's last parameter, which is args."""
    try:
        return [*inspect.signature(fn).parameters][-1:]
    except (TypeError, ValueError):
        return []


def _in_library(trace: TracebackType) -> bool:
    module = str(trace.tb_frame.f_globals.get("__name__", ""))
    return module.split(".")[0] in _LIBRARIES


def place(at: str, fn: Callable[..., Any]) -> str:
    """Return the name `at` of an argument with the file and line of the function's definition."""
    return f"{at}, {_place(fn)}"


def index_error(at: str, fn: Callable[..., Any], wrong: IndexOutside) -> InputError:
    """Return the `InputError` for a constant index outside of an array, in the function fn."""
    folders = [f"{os.sep}{name}{os.sep}" for name in _LIBRARIES]
    own = (line for line in wrong.lines if not any(folder in line[0] for folder in folders))
    file, line = next(own, ("", 0))
    added = " (after JAX added the number of entries)" if wrong.index < 0 else ""
    return input_error(
        f"{at}, {file}, line {line}" if file else place(at, fn),
        f"the index {wrong.index}{added} into an axis of {wrong.entries} entries",
        f"it must be from 0 to {wrong.entries - 1}: JAX raises no error, and reads the nearest entry",
        "Correct the index; for the nearest entry on purpose, write x.at[i].get(mode='clip')",
    )


def _place(fn: Callable[..., Any], trace: TracebackType | None = None) -> str:
    """Return file and line of the innermost frame of `trace` in the user's code.

    Without such a frame, return those of the definition of fn."""
    place = None
    while trace is not None:
        if not _in_library(trace):
            place = f"{trace.tb_frame.f_code.co_filename}, line {trace.tb_lineno}"
        trace = trace.tb_next
    if place is None:
        inner = inspect.unwrap(getattr(fn, "func", fn))
        # The code of a callable object, such as an equinox.Module, is in its class.
        code = getattr(inner, "__code__", None) or getattr(type(inner).__call__, "__code__", None)
        has_code = code is not None
        place = f"{code.co_filename}, line {code.co_firstlineno}" if has_code else f"{fn!r}"
    return place


def _line(text: str) -> str:
    """Return the first line of a text, at most 160 characters of it."""
    first = text.strip().split("\n", 1)[0]
    return first if len(first) <= 160 else first[:157] + "..."
