"""What the loops of a function begin with, and what its branches return.

A number that a loop begins with is a constant to XLA, which gives it memory of its own, and takes and
returns that memory at every call of the program: some 0.1 µs each, a third of what a step of a small
system costs. So such numbers are handed to the function with its arguments.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from .._jaxpr import bound, walked
from .packed import is_number, unpacked
from .small import CALLS, called, inner_programs
from .within import retraced

_Key = tuple[str, bytes]


def handed_over(program: ClosedJaxpr) -> tuple[ClosedJaxpr, np.ndarray]:
    """The program with one more argument, and what this is: the numbers that its loops begin with."""
    found: dict[_Key, np.ndarray] = {}
    _look_through(program, found)
    numbers = list(found.values())
    like = [jax.ShapeDtypeStruct((), number.dtype) for number in numbers]

    def run(*given: Any) -> list[Any]:
        known = dict(zip(found, unpacked(given[-1], like), strict=True))
        return walked(program, given[:-1], partial(_taken, known))

    vector = np.concatenate([np.zeros(0, jnp.result_type(float)), *map(_as_floating, numbers)])
    return retraced(run, [*program.in_avals, jax.typeof(vector)]), vector


def _look_through(program: ClosedJaxpr, found: dict[_Key, np.ndarray]) -> None:
    for eqn in program.jaxpr.eqns:
        if _is_opened(eqn):
            for inner in inner_programs(eqn.params):
                _look_through(inner, found)
            for atom in filter(_is_number, _set(eqn)):
                found[_key(atom)] = _value(atom)


def _taken(known: dict[_Key, jax.Array], eqn: Any, given: list[Any]) -> list[Any]:
    if not _is_opened(eqn):
        return bound(eqn, given)
    do = partial(_taken, known)

    def number(atom: Any, value: Any) -> Any:
        return known[_key(atom)] if _is_number(atom) else value

    if eqn.primitive.name == "cond":

        def branch(program: ClosedJaxpr) -> Any:
            ends = program.jaxpr.outvars
            return lambda *given: list(map(number, ends, walked(program, given, do)))

        return lax.switch(given[0], list(map(branch, eqn.params["branches"])), *given[1:])
    if eqn.primitive.name == "while":
        first = eqn.params["cond_nconsts"]
        second = first + eqn.params["body_nconsts"]
        goes_on, body = jaxpr_as_fun(eqn.params["cond_jaxpr"]), eqn.params["body_jaxpr"]
        return lax.while_loop(
            lambda carry: goes_on(*given[:first], *carry)[0],
            lambda carry: walked(body, (*given[first:second], *carry), do),
            list(map(number, eqn.invars[second:], given[second:])),
        )
    return walked(called(eqn), given, do)


def _is_opened(eqn: Any) -> bool:
    """Whether it is a branch, one loop (not one of a batch whose members have their own ends), or a
    call."""
    if eqn.primitive.name == "while":
        return not eqn.params["cond_jaxpr"].out_avals[0].shape
    return eqn.primitive.name == "cond" or eqn.primitive.name in CALLS


def _set(eqn: Any) -> list[Any]:
    """What begins a loop, or ends a branch."""
    if eqn.primitive.name == "while":
        return eqn.invars[eqn.params["cond_nconsts"] + eqn.params["body_nconsts"] :]
    if eqn.primitive.name == "cond":
        return [atom for branch in eqn.params["branches"] for atom in branch.jaxpr.outvars]
    return []


def _is_number(atom: Any) -> bool:
    return isinstance(atom, Literal) and is_number(atom.aval)


def _value(atom: Any) -> np.ndarray:
    return np.asarray(atom.val, atom.aval.dtype)


def _key(atom: Any) -> _Key:
    return atom.aval.dtype.name, _value(atom).tobytes()


def _as_floating(number: Any) -> np.ndarray:
    """As `packed` has it, bit by bit."""
    wide = jnp.result_type(float)
    if np.iscomplexobj(number):
        return np.array([number.real, number.imag], wide)
    if jnp.issubdtype(number.dtype, jnp.floating):
        return number.astype(wide).reshape(1)
    return number.astype(jnp.result_type(int)).reshape(1).view(wide)
