"""What the loops of a function begin with, and what its branches return.

A number that a loop begins with is a constant to XLA, which gives it memory of its own, and takes and
returns that memory at every call of the program. So such numbers are handed to the function with its
arguments.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var

from .packed import is_number


def handed_over(program: ClosedJaxpr) -> tuple[ClosedJaxpr, list[np.ndarray]]:
    """The program with further arguments, its first ones, and what these are: the numbers that its
    loops begin with."""
    found: dict[Any, Any] = {}
    _look_through(program.jaxpr, found)
    values = list(map(_value, found.values()))
    return ClosedJaxpr(_with_arguments(program.jaxpr, found), program.consts), values


def _look_through(jaxpr: Jaxpr, found: dict[Any, Any]) -> None:
    for eqn in jaxpr.eqns:
        for inner in _opened(eqn):
            _look_through(inner.jaxpr, found)
        found |= {_key(atom): atom for atom in filter(_is_handed_over, _set(eqn))}


def _with_arguments(jaxpr: Jaxpr, numbers: dict[Any, Any]) -> Jaxpr:
    """The program with the numbers as its first arguments, and so all that is opened within it."""
    # Each program has variables of its own.
    own = {key: Var(atom.aval) for key, atom in numbers.items()}
    return jaxpr.replace(
        invars=[*own.values(), *jaxpr.invars],
        eqns=[_handed(eqn, own) for eqn in jaxpr.eqns],
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )


def _handed(eqn: Any, numbers: dict[Any, Var]) -> Any:
    """A loop or a branch with the numbers as arguments that it hands on."""
    if not _opened(eqn):
        return eqn
    given = list(eqn.invars)
    if eqn.primitive.name == "cond":
        branches = tuple(map(partial(_branch, numbers=numbers), eqn.params["branches"]))
        return eqn.replace(
            invars=[given[0], *numbers.values(), *given[1:]],
            params=eqn.params | {"branches": branches},
        )
    first, second = eqn.params["cond_nconsts"], _carried(eqn)
    body = eqn.params["body_jaxpr"]
    params = {
        "body_jaxpr": ClosedJaxpr(_with_arguments(body.jaxpr, numbers), body.consts),
        "body_nconsts": eqn.params["body_nconsts"] + len(numbers),
    }
    init = [_number(atom, numbers) for atom in given[second:]]
    return eqn.replace(
        invars=[*given[:first], *numbers.values(), *given[first:second], *init],
        params=eqn.params | params,
    )


def _branch(program: ClosedJaxpr, numbers: dict[Any, Var]) -> ClosedJaxpr:
    jaxpr = _with_arguments(program.jaxpr, numbers)
    own = dict(zip(numbers, jaxpr.invars[: len(numbers)], strict=True))
    outvars = [_number(atom, own) for atom in jaxpr.outvars]
    return ClosedJaxpr(jaxpr.replace(outvars=outvars), program.consts)


def _opened(eqn: Any) -> tuple[ClosedJaxpr, ...]:
    """The programs of a branch, or of a loop."""
    if eqn.primitive.name == "cond":
        return eqn.params["branches"]
    return (eqn.params["body_jaxpr"],) if eqn.primitive.name == "while" else ()


def _set(eqn: Any) -> list[Any]:
    """What begins a loop, or ends a branch."""
    if eqn.primitive.name == "while":
        return eqn.invars[_carried(eqn) :]
    return [atom for branch in _opened(eqn) for atom in branch.jaxpr.outvars]


def _carried(eqn: Any) -> int:
    """Where the arguments of a loop begin that it carries on."""
    return eqn.params["cond_nconsts"] + eqn.params["body_nconsts"]


def _number(atom: Any, numbers: dict[Any, Var]) -> Any:
    return numbers[_key(atom)] if _is_handed_over(atom) else atom


def _is_handed_over(atom: Any) -> bool:
    """Whether it is one number, which arrives as it left: a short one that is denormal does not."""
    if not (isinstance(atom, Literal) and is_number(atom.aval)) or np.shape(atom.val):
        return False
    value: Any = _value(atom)
    if not jnp.issubdtype(value.dtype, jnp.inexact) or jnp.finfo(value.dtype).bits >= 64:
        return True
    tiny = float(jnp.finfo(value.dtype).tiny)
    return not any(0.0 < abs(float(part)) < tiny for part in (value.real, value.imag))


def _value(atom: Any) -> np.ndarray:
    return np.asarray(atom.val, atom.aval.dtype)


def _key(atom: Any) -> Any:
    return atom.aval.weak_type, atom.aval.dtype.name, _value(atom).tobytes()
