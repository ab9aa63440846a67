"""The user's own functions (f, h, A, P and K of a problem, F of `dvax.solve_vi`), called for the first
time.

JAX traces them, and that is where most first programs stop: too few parameters, an `if` on a traced
value, a NumPy function, shapes that do not fit. The exceptions of Python and JAX point into the
libraries; here they become an `InputError` with the file and the line of the user's code.
"""

import dis
import inspect
import re
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from . import _tree
from .errors import DvaxError, InputError, InputProblem

_LIBRARIES = {"dvax", "equinox", "jax", "jaxlib", "jaxtyping", "numpy", "scipy", "optimistix"}
"""Packages whose frames are no code of the user."""


def call(
    name: str,
    fn: Callable[..., Any],
    inputs: Mapping[str, Any],
    about: str = "",
    caller: str = "dvax.Problem",
) -> Any:
    """Return fn(*inputs.values()) for the argument `name` of `caller`.

    `about` says where the shape of u comes from, for messages.

    **Raises:** `dvax.InputError` where fn has other parameters, or raises an exception that a usual
    mistake leads to. Any other exception keeps its type and gets a note.
    """
    at = f"{caller}({name})"
    _check_parameters(at, name, fn, inputs)
    try:
        return fn(*inputs.values())
    except DvaxError:
        raise
    except (TypeError, ValueError, LookupError, AttributeError) as error:
        raise InputError(_explained(at, name, fn, inputs, about, error)) from error
    except Exception as error:
        error.add_note(f"Raised in {name} of {caller}, {_place(fn, error.__traceback__)}.")
        raise


def leaked(error: jax.errors.UnexpectedTracerError) -> InputError:
    """The `InputError` for a traced array that f, h or K keeps, or hands on, beyond a call."""
    found = re.search(r"created on line (\S+?):(\d+)", str(error))
    place = f"{found[1]}, line {found[2]}" if found else "f, h, A, P or K of dvax.Problem"
    return InputError(
        InputProblem(
            place,
            "a traced array that is used after the call that made it",
            "a dvax.signals.Table (or an array that is kept in a global) is made inside of f, h or K, "
            "where it has no values yet, and steps must end at the times of tables",
            "Make it once, outside of the function, or hand it over in args",
        )
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
    """Raise an `InputError` unless `out` = fn(`inputs`) consists of real numbers of the type of x, an
    `element` of which messages speak."""
    wide = jnp.result_type(*jtu.tree_leaves(x))

    def refuse(given: str, rule: str, fix: str) -> None:
        raise InputError(InputProblem(f"{caller}({name}), {_place(fn)}", given, rule, fix))

    for leaf in jtu.tree_leaves(out):
        if not _is_numeric(leaf):
            refuse(
                f"{type(leaf).__name__} {_line(repr(leaf))}",
                f"{name}({inputs}) returns an array, or a tuple of arrays",
                "Return numbers: jnp.stack([...]) joins several into one array",
            )
        own = _dtype(leaf, wide)
        common = jnp.promote_types(wide, own)
        if jnp.issubdtype(common, jnp.complexfloating):
            refuse(
                f"a value of {common}", f"{name}({inputs}) is real, as {element} is",
                "Return its real part, or take real and imaginary part as two components",
            )  # fmt: skip
        if _is_flag(leaf):
            refuse(
                "a value of bool", f"{name}({inputs}) is a number",
                "Say which: jnp.where(condition, 1.0, 0.0)",
            )  # fmt: skip
        if own != wide:
            refuse(f"a value of {jnp.dtype(own)}", *_other_precision(own, wide, element))


def check_precision(name: str, data: Any, x: Any) -> None:
    """Raise an `InputError` where an array in `data` is of another type than the state: arithmetic
    would change the type of the state at the first step, or lose half of its digits."""
    wide = jnp.result_type(*jtu.tree_leaves(x))
    for leaf in jtu.tree_leaves(data):
        if isinstance(leaf, jax.Array) and leaf.dtype.kind == "f":
            own = _dtype(leaf, wide)
            if own != wide:
                given = f"data of {jnp.dtype(own)}"
                words = _other_precision(own, wide, "the state x0")
                raise InputError(InputProblem(f"dvax.Problem({name})", given, *words))


def check_args(args: Any, caller: str) -> None:
    """Raise an `InputError` where JAX cannot take `args`: keys that have no order, arrays of text or of
    Python objects."""
    place = f"{caller}(args)"
    try:
        leaves = jtu.tree_leaves(args)
    except ValueError:
        rule = "JAX sorts the keys of a dict, and these have no order"
        raise InputError(
            InputProblem(place, "keys of several types", rule, "Use strings")
        ) from None
    for leaf in leaves:
        if isinstance(leaf, np.ndarray) and leaf.dtype.kind not in "biufc":
            given = f"an array of {leaf.dtype}, {_tree.short(leaf)}"
            fix = "Convert it, np.asarray(..., float), and keep texts beside it, as str"
            raise InputError(InputProblem(place, given, "the arrays in args hold numbers", fix))


def _other_precision(own: Any, wide: Any, element: str) -> tuple[str, str]:
    """The rule that numbers of the type `own` break beside an `element` of the type `wide`, and the
    fix."""
    x = element.split()[-1]
    fix = (
        f"Give {x} in that type, jnp.asarray({x}, float) in double precision, or the data in {x}'s"
    )
    if jnp.promote_types(own, wide) == wide:
        fix = f"Give the data in that type: jnp.asarray(..., jnp.{jnp.dtype(wide).name})"
    return f"{element} is of {jnp.dtype(wide).name}, and nothing is converted unasked", fix


def _is_numeric(leaf: Any) -> bool:
    """Whether a leaf is a number or an array of them (flags and complex numbers included)."""
    if isinstance(leaf, np.ndarray | np.generic):
        return leaf.dtype.kind not in "OSUMm"
    number = isinstance(leaf, bool | int | float | complex)
    return number or (hasattr(leaf, "dtype") and hasattr(leaf, "shape"))


def _is_flag(leaf: Any) -> bool:
    return isinstance(leaf, bool) or getattr(leaf, "dtype", None) == np.dtype(bool)


def _dtype(leaf: Any, wide: Any) -> Any:
    """The type that a leaf has beside the state: Python's numbers and weak types take the state's."""
    if isinstance(leaf, bool | int | float):
        return wide
    dtype = jnp.result_type(leaf)
    if jnp.issubdtype(dtype, jnp.complexfloating):
        return dtype
    weak = getattr(leaf, "weak_type", False) or not jnp.issubdtype(dtype, jnp.floating)
    return wide if weak else dtype


def _check_parameters(
    at: str, name: str, fn: Callable[..., Any], inputs: Mapping[str, Any]
) -> None:
    try:
        signature = inspect.signature(fn)
    except (TypeError, ValueError):
        return  # some functions written in C have none
    try:
        signature.bind(*inputs.values())
    except TypeError:
        names = ", ".join(inputs)
        raise InputError(
            InputProblem(
                f"{at}, {_place(fn)}", f"a function of {signature}",
                f"it is called as {name}({names})",
                f"Write {name}=lambda {names}: ..., also where not all of them are used",
            )
        ) from None  # fmt: skip


def _explained(
    at: str, name: str, fn: Callable[..., Any], inputs: Mapping[str, Any], about: str,
    error: Exception,
) -> InputProblem:  # fmt: skip
    shapes = ", ".join(
        f"{key} of shape {_tree.shapes(value)}" for key, value in inputs.items() if key in "xuy"
    )
    given = f"{type(error).__name__}: {_line(str(error))}"
    rule, fix = _reason(name, fn, inputs, error)
    if shapes:
        rule += f". It was traced with {shapes}{about}"
    return InputProblem(f"{at}, {_place(fn, error.__traceback__)}", given, rule, fix)


def _reason(
    name: str, fn: Callable[..., Any], inputs: Mapping[str, Any], error: Exception
) -> tuple[str, str]:
    """The rule that was broken, and the fix."""
    traced = f"JAX traces {name}, so that its arguments have no values yet where"
    if isinstance(error, jax.errors.TracerBoolConversionError):
        return (
            f"{traced} `if`, `while`, `and`, `or`, `not`, `min` and `max` need one",
            "Write jnp.where(condition, a, b) for `if`, jnp.logical_and(a, b) for `and`, "
            "jnp.maximum(a, b) for `max`",
        )
    if isinstance(error, jax.errors.NonConcreteBooleanIndexError):
        return f"{traced} a mask selects entries", "Write jnp.where(mask, a, b) for a[mask]"
    if isinstance(error, jax.errors.TracerArrayConversionError):
        return (
            f"{traced} a function of NumPy needs one",
            "Use jax.numpy: `import jax.numpy as jnp`, and jnp.sin(x) for np.sin(x)",
        )
    if isinstance(error, jax.errors.TracerIntegerConversionError):
        return (
            f"{traced} an index or the bound of a loop needs one",
            "Write jnp.take(a, i) for a list at i, jax.lax.fori_loop for a loop",
        )
    if isinstance(error, jax.errors.ConcretizationTypeError):
        return (
            f"{traced} float(), int() or a function of `math` needs one",
            "Leave out float(); write jnp.sin(x) for math.sin(x)",
        )
    if isinstance(error, jax.errors.UnexpectedTracerError):
        return (
            f"{name} keeps an array of its own for another call, and traced arrays end with the call",
            "Return all that is needed, and make data outside of the function",
        )
    if "immutable" in str(error) or "item assignment" in str(error):
        return "arrays of JAX cannot be written into", "Write x = x.at[i].set(v) for x[i] = v"
    if inputs.get("args", 0) is None and _reads_args(fn, error):
        return f"{name} reads args, and no args were given", "Pass args=... to the call"
    fix = "Fix that line"
    if "u" in inputs:
        fix += (
            "; where u has another shape, name it: control_space=dvax.spaces.Euclidean(()) of "
            "dvax.Problem for a single number, Euclidean(3) for a vector of 3"
        )
    return f"{name}({', '.join(inputs)}) must be evaluable by JAX", fix


def _reads_args(fn: Callable[..., Any], error: Exception) -> bool:
    """Whether the error is about None, and the statement of the user's code that raised it reads a
    parameter that is None: args, or what args was handed on to."""
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
    own = {*code.co_varnames[: code.co_argcount + code.co_kwonlyargcount], *_last_parameter(fn)}
    first, last = [*code.co_positions()][instruction // 2][:2]
    for step in dis.get_instructions(code):
        at = step.positions.lineno if step.positions else None
        if first is None or last is None or at is None or not first <= at <= last:
            continue
        read = step.argval if isinstance(step.argval, tuple) else (step.argval,)
        if any(isinstance(n, str) and n in own and names.get(n, 0) is None for n in read):
            return True
    return False


def _last_parameter(fn: Callable[..., Any]) -> list[str]:
    """The name that fn gives to args."""
    try:
        return [*inspect.signature(fn).parameters][-1:]
    except (TypeError, ValueError):
        return []


def _in_library(trace: TracebackType) -> bool:
    module = str(trace.tb_frame.f_globals.get("__name__", ""))
    return module.split(".")[0] in _LIBRARIES


def place(at: str, fn: Callable[..., Any]) -> str:
    """The place of an argument `at`, with the file and the line where the function begins."""
    return f"{at}, {_place(fn)}"


def _place(fn: Callable[..., Any], trace: TracebackType | None = None) -> str:
    """File and line of the user's code: the innermost frame of `trace` in it, else where fn begins."""
    place = None
    while trace is not None:
        if not _in_library(trace):
            place = f"{trace.tb_frame.f_code.co_filename}, line {trace.tb_lineno}"
        trace = trace.tb_next
    if place is None:
        inner = inspect.unwrap(getattr(fn, "func", fn))
        # A callable object, such as an equinox.Module, has its code in its class.
        code = getattr(inner, "__code__", None) or getattr(type(inner).__call__, "__code__", None)
        known = code is not None
        place = f"{code.co_filename}, line {code.co_firstlineno}" if known else f"{fn!r}"
    return place


def _line(text: str) -> str:
    """The first line of a text, at most 160 characters of it."""
    first = text.strip().split("\n", 1)[0]
    return first if len(first) <= 160 else first[:157] + "..."
