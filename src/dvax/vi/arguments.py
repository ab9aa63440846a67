"""Validation of the arguments of `dvax.solve_vi`."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree, _user_code
from .._tree import Tree
from ..errors import InputProblem, Problems, input_error
from ..sets import AbstractSet
from ..spaces import AbstractSpace
from .abstract import AbstractSolver
from .parameters import MODULUS, Rule, describe, obeys
from .weighted import Weighted

_CALLER = "dvax.solve_vi"


def as_guess(y0: Any) -> Tree:
    """Return y0 as an array of a real floating type, or as plain tuples of such arrays.

    **Raises:** `dvax.InputError` for anything else.
    """
    return _as_plain_tuples(_tree.as_float(y0, "y0"))


def _as_plain_tuples(y: Tree) -> Tree:
    return tuple(map(_as_plain_tuples, y)) if isinstance(y, tuple) else y


def check(F: Any, K: Any, args: Any, solver: Any, space: Any) -> None:
    """Raise one `InputError` that lists every argument of a wrong type."""
    problems = Problems()
    if not callable(F):
        problems.add(
            f"{_CALLER}(F)", describe(F), "it must be callable as (y, args)",
            "Write F=lambda y, args: ...",
        )  # fmt: skip
    if not isinstance(K, AbstractSet):
        is_time_dependent = callable(K) and not isinstance(K, type)
        fix = (
            "Call it: K=K(t, args), the set at one time"
            if is_time_dependent
            else "Write dvax.sets.Box(0.0, 1.0)"
        )
        problems.add(f"{_CALLER}(K)", describe(K), "it must be a set of dvax.sets", fix)
    problems += solver_problems(f"{_CALLER}(solver)", solver)
    if not isinstance(space, AbstractSpace | None):
        problems.add(
            f"{_CALLER}(space)", describe(space), "it must be a space of dvax.spaces, or None",
            "Omit it for the Euclidean inner product",
        )  # fmt: skip
    problems.raise_any()
    _user_code.check_args(args, _CALLER)
    for name, value in (("F", F), ("args", args)):
        for leaf in jtu.tree_leaves(value):
            _check_hashable(name, leaf)


def solver_problems(place: str, solver: Any) -> list[InputProblem]:
    """Return the problems of an argument `solver`; None stands for the default."""
    if isinstance(solver, AbstractSolver | None):
        return []
    rule = "it must be an instance of a solver, such as dvax.vi.Auto()"
    return [InputProblem(place, describe(solver), rule, "Omit it for the default")]


def _check_hashable(name: str, leaf: Any) -> None:
    if isinstance(leaf, jax.Array | np.ndarray | float | int):
        return
    try:
        hash(leaf)
    except TypeError:
        raise input_error(
            f"{_CALLER}({name})", describe(leaf),
            "a leaf that is not an array becomes a static argument, which must be hashable",
            "Register its class as a pytree (an equinox.Module is one), or make it hashable",
        ) from None  # fmt: skip


def as_number(name: str, value: Any, rule: Rule, dtype: Any) -> Any:
    """Return a numeric argument of `solve_vi` after checking it.

    Python numbers become arrays of the dtype of y, since a Python number would be a static argument:
    every new value would compile the program again.
    """
    number = value
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            with np.errstate(over="ignore"):
                number = np.asarray(float(value), dtype)
        except OverflowError:
            number = np.asarray(math.inf, dtype)
    if obeys(rule, number):
        return number
    value_text = describe(value)
    if number is not value and obeys(rule, float(min(value, 1e308))):
        value_text += f", which is {number} in {jnp.dtype(dtype).name}"
    fix = "Omit it if it is unknown" if rule is MODULUS else "Omit it for 1e-10"
    raise input_error(f"{_CALLER}({name})", value_text, rule.words, fix)


def check_functions(F: Any, y0: Tree, args: Any, space: AbstractSpace) -> None:
    """Trace F and raise an `InputError` unless its value has the structure and shapes of y0.

    Call it inside the compiled function, so that F is traced only on compilation.
    """
    zero = jax.eval_shape(space.zeros)  # abstract, so that its dtype does not enter the program
    if not _tree.same_shape(y0, zero):
        raise input_error(
            f"{_CALLER}(y0)", f"shape {_tree.shapes(y0)}",
            f"it must be an element of space={space!r}, of shape {_tree.shapes(zero)}",
            "Give y0 that shape, or name the space of y in space=",
        )  # fmt: skip
    if not isinstance(F, Weighted):
        _check_function("F", F, y0, args, _CALLER)
        return
    _check_function("G", F.G, y0, args, "dvax.vi.Weighted")

    def weight(y: Tree) -> None:
        out = _user_code.call("a", F.a, {"y": y, "args": args}, caller="dvax.vi.Weighted")
        if not _tree.is_number(out) and jnp.shape(out) == ():
            raise input_error(
                "dvax.vi.Weighted(a)", describe(out), "a(y, args) must be one real number",
                "Return a scalar",
            )  # fmt: skip

    jax.eval_shape(weight, y0)


def _check_function(name: str, fn: Callable[..., Any], y0: Tree, args: Any, caller: str) -> None:
    def traced(y: Tree) -> None:
        out = _user_code.call(name, fn, {"y": y, "args": args}, caller=caller)
        same_structure = jtu.tree_structure(out) == jtu.tree_structure(y)
        # The parts of a tuple may have different dtypes.
        pairs = zip(jtu.tree_leaves(out), jtu.tree_leaves(y), strict=True)
        parts = pairs if same_structure else [(out, y)]
        for value, like in parts:
            _user_code.check_values(
                name, fn, value, like, inputs="y, args", caller=caller, element="the guess y0"
            )
        problem = _shape_problem(name, out, y) or _dtype_problem(name, out, y)
        if problem is not None:
            place = _user_code.place(f"{caller}({name})", fn)
            raise input_error(place, *problem)

    jax.eval_shape(traced, y0)


def _shape_problem(name: str, out: Any, y: Tree) -> tuple[str, str, str] | None:
    if _tree.same_shape(out, y):
        return None
    fix = f"Return that shape from {name}, or give y0 the shape that y has"
    if isinstance(out, list | tuple) and not isinstance(y, tuple):
        fix = f"Join the components: return jnp.stack([...]) from {name}"
    if out is None:
        fix = f"End {name} with `return`"
    value_text = "None" if out is None else f"a value of shape {_tree.shapes(out)}"
    rule = f"{name}(y, args) must have the shape of y, which is {_tree.shapes(y)} as y0 is"
    return value_text, rule, fix


def _dtype_problem(name: str, out: Any, y: Tree) -> tuple[str, str, str] | None:
    for leaf, like in zip(jtu.tree_leaves(out), jtu.tree_leaves(y), strict=True):
        if isinstance(leaf, int) or getattr(leaf, "dtype", like.dtype).kind in "iu":
            value_text = f"a value of {jnp.result_type(leaf)}"
            fix = f"Write numbers with a decimal point, or jnp.asarray(..., {like.dtype})"
            return (
                value_text,
                f"{name}(y, args) must have the floating type of y, {like.dtype}",
                fix,
            )
    return None
