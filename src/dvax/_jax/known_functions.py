"""Calls of functions of JAX that have rules of their own, recognised by their programs.

The operations of such a function give loose bounds one by one, or none: the index in a table depends on
the argument. The function as a whole has sharp ones.
"""

import functools
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .jaxprs import Literal, inner_program, nested_programs, scan_counts

VARIANTS: dict[str, tuple[Callable[..., Any], ...]] = {
    "searchsorted": tuple(
        partial(jnp.searchsorted, side=side, method=method)
        for side in ("left", "right")
        for method in ("scan", "scan_unrolled", "compare_all")
    ),
    "_interp": (jnp.interp,),
    "logaddexp": (jnp.logaddexp,),
    "hypot": (jnp.hypot,),
    "norm": tuple(
        partial(jnp.linalg.norm, axis=axis, keepdims=keepdims)
        for axis in (None, -1, 0)
        for keepdims in (False, True)
    ),
}
"""The ways in which each function may be called, by the name of the call in a program."""


def operation(eqn: Any) -> str:
    """Return the name of an operation in tables of rules.

    It is the name of the primitive, or of a called function: one of `VARIANTS`, or "dvax_..." for
    functions of dvax that have a rule of their own.
    """
    name = eqn.params.get("name")
    if isinstance(name, str) and name.startswith("dvax_"):
        return name
    return _known_name(eqn) or eqn.primitive.name


def _known_name(eqn: Any) -> str | None:
    """Return the name in `VARIANTS` of the function that an operation calls, or None.

    The name of the call must match (functions with a derivative of their own have none in some versions
    of JAX), and its program must be that of JAX for these shapes. `searchsorted` counts for a single
    number only, and `interp` without values of its own outside of the table.
    """
    name = eqn.params.get("name")
    inner = inner_program(eqn)
    if eqn.primitive.name == "custom_jvp_call":
        name = "logaddexp"
    if name not in VARIANTS or inner is None:
        return None
    avals = tuple((v.aval.shape, str(v.aval.dtype), v.aval.weak_type) for v in eqn.invars)
    if name == "searchsorted" and (len(avals) != 2 or len(avals[0][0]) != 1 or avals[1][0] != ()):
        return None
    if name == "_interp" and len(avals) != 3:
        return None
    return name if _text(inner) in _programs(name, avals) else None


@functools.lru_cache(256)
def _programs(name: str, avals: tuple[Any, ...]) -> frozenset[str]:
    """Return the programs of the variants of a function for arguments of these types, as text."""
    arguments = [
        jax.ShapeDtypeStruct(shape, dtype, weak_type=weak_type) for shape, dtype, weak_type in avals
    ]
    found = set()
    for variant in VARIANTS[name]:
        try:
            outer = jax.make_jaxpr(variant)(*arguments).jaxpr.eqns
        except (TypeError, ValueError):
            continue  # these arguments do not fit
        inner = inner_program(outer[0]) if len(outer) == 1 else None
        if inner is not None:
            found.add(_text(inner))
    return frozenset(found)


@functools.lru_cache(512)
def _text(program: Any) -> str:
    """Return the operations of a program as text.

    The text of JAX depends on the context of the trace: numbers are literals or arrays that a program
    or a loop closes over, and programs that occur twice have names. Here numbers are values, calls are
    replaced by what they call, and variables are numbered.
    """
    lines: list[str] = []
    results = _write(program, [f"v{k}" for k in range(len(program.jaxpr.invars))], lines)
    return "\n".join([*lines, " ".join(results)])


def _write(program: Any, operands: list[str], lines: list[str]) -> list[str]:
    """Append the operations of a program to the lines, and return the names of its results."""
    jaxpr = program.jaxpr
    names = dict(zip(jaxpr.constvars, map(_value, program.consts), strict=True))
    names |= dict(zip(jaxpr.invars, operands, strict=True))
    for eqn in jaxpr.eqns:
        given = [_value(v.val) if isinstance(v, Literal) else names[v] for v in eqn.invars]
        called = inner_program(eqn)
        if called is not None:
            results = _write(called, given, lines)
        else:
            results = [f"r{len(lines)}.{k}" for k in range(len(eqn.outvars))]
            lines.append(f"{results} = {_operation(eqn, given)}")
        names |= dict(zip(eqn.outvars, results, strict=True))
    return [_value(v.val) if isinstance(v, Literal) else names[v] for v in jaxpr.outvars]


def _operation(eqn: Any, given: list[str]) -> str:
    """Return an operation as text. The numbers that the program of a `scan` closes over are written
    where they are used."""
    types = [str(v.aval) for v in eqn.outvars]
    counts = scan_counts(eqn.params) if eqn.primitive.name == "scan" else None
    if counts is None:
        return f"{eqn.primitive.name} {given} {sorted(map(str, eqn.params.items()))} {types}"
    (body,) = nested_programs(eqn.params)
    constants, others = given[: counts[0]], given[counts[0] :]
    lines: list[str] = []
    results = _write(body, [*constants, *(f"s{k}" for k in range(len(others)))], lines)
    settings = [eqn.params[name] for name in ("length", "reverse")]
    return f"scan {others} {settings} {lines} {results} {types}"


def _value(number: Any) -> str:
    array = np.asarray(number)
    return f"{array.dtype}{array.shape}{array.tolist()}"
