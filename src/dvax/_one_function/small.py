"""Which programs are small, and made of what one function of the processor can do (`_one_function`).

Not every operation can be compiled so (library calls cannot, nor what XLA hands to its own libraries
for matrices), and asking for one that cannot is an error that no program can catch once it is part of
a larger one. So programs are looked through, and only what is known to work is asked for.
"""

import math
from typing import Any

import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.lax import GatherScatterMode

from .sums import is_sum

LARGEST = 8192
"""Entries of an array that is computed: for a larger one, cores are worth more than few kernels."""
_COSTLY = 500
"""The same, of a function that costs many times as much as a product."""
_SUMMED = 2048
"""Entries of an array that is reduced: of larger ones XLA makes calls of a library."""
_SIDE = 5
"""Of a matrix that a matrix is multiplied by: larger ones are calls of a library as well."""

_ENTRYWISE = frozenset(
    "abs add add_any and ceil clamp complex conj convert_element_type copy div eq floor ge gt imag "
    "integer_pow is_finite le lt max min mul ne neg nextafter not or real rem round rsqrt select_n "
    "shift_left shift_right_arithmetic shift_right_logical sign sqrt square bitcast_convert_type sub "
    "xor any_of_batch largest_of_batch own_turn zeros_of_batch".split()
)
_FUNCTIONS = frozenset(
    "acos acosh asin asinh atan atan2 atanh cbrt cos cosh erf exp exp2 expm1 log log1p logistic pow "
    "sin sinh tan tanh".split()
)
_MOVES = frozenset(
    "concatenate expand_dims iota pad reshape rev slice split squeeze stack transpose".split()
)
_PLACES = {"dynamic_slice": None, "gather": None, "dynamic_update_slice": 1, "scatter": 2}
"""These touch a part of an array, which may be as large as it likes: the part is what comes out, or the
argument of this number."""
_MEMORY = frozenset("broadcast_in_dim stop_gradient".split())
"""How arrays begin that are then filled part by part, and what does nothing."""
_SUMS = frozenset(
    "argmax argmin reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum".split()
)
CALLS = frozenset("jit pjit closed_call custom_jvp_call custom_vjp_call remat2".split())
_CONTROL = CALLS | frozenset("cond while scan".split())


def are_few(arrays: list[Any], most: int = LARGEST) -> bool:
    return all(math.prod(jnp.shape(array)) <= most for array in arrays)


def is_small(program: ClosedJaxpr) -> bool:
    return are_few(program.consts) and all(map(is_known, program.jaxpr.eqns))


def is_brief(program: ClosedJaxpr) -> bool:
    """Whether all that a program computes at once is small, whatever computes it."""
    return all(map(_is_brief, program.jaxpr.eqns))


def _is_brief(eqn: Any) -> bool:
    name, inner = eqn.primitive.name, inner_programs(eqn.params)
    if inner or name in _MEMORY:
        return all(map(is_brief, inner))
    return are_few([_part(eqn)] if name in _PLACES else [v.aval for v in eqn.outvars])


def writes(eqn: Any, most: int) -> bool:
    """Whether it writes a part of an array of more entries than that."""
    if any(any(writes(e, most) for e in one.jaxpr.eqns) for one in inner_programs(eqn.params)):
        return True
    name = eqn.primitive.name
    return _PLACES.get(name) is not None and not are_few([eqn.outvars[0].aval], most)


def is_known(eqn: Any) -> bool:
    name = eqn.primitive.name
    if name in _CONTROL:
        return all(map(is_small, inner_programs(eqn.params)))
    if name in _MEMORY:
        return True
    if name in _PLACES:
        return are_few([_part(eqn)]) and (name != "scatter" or _is_one_place(eqn))
    if not are_few([v.aval for v in eqn.outvars]):
        return False
    if name == "dot_general":
        return _is_plain_product(eqn)
    if name in _SUMS and not is_sum(eqn):
        return math.prod(eqn.invars[0].aval.shape) <= _SUMMED
    if name in _FUNCTIONS:
        return are_few([v.aval for v in eqn.outvars], _COSTLY)
    return name in _ENTRYWISE or name in _MOVES or name in _SUMS


def _part(eqn: Any) -> Any:
    """The part of an array that is touched."""
    place = _PLACES[eqn.primitive.name]
    return (eqn.outvars[0] if place is None else eqn.invars[place]).aval


def _is_one_place(eqn: Any) -> bool:
    """A row that is written into the same place for all of a batch: of scatters only this can be
    compiled so, since XLA takes it for what it was."""
    indices = eqn.invars[1].aval.shape
    return math.prod(indices[:-1]) == 1 and eqn.params["mode"] == GatherScatterMode.CLIP


def _is_plain_product(eqn: Any) -> bool:
    """A matrix and a vector of real numbers, or two tiny matrices."""
    first, second = (v.aval for v in eqn.invars)
    if eqn.params["dimension_numbers"][1] != ((), ()) or first.dtype != second.dtype:
        return False
    if not jnp.issubdtype(first.dtype, jnp.floating) or max(first.ndim, second.ndim) > 2:
        return False
    if min(first.ndim, second.ndim) < 2:
        return are_few([first, second])
    return max(*first.shape, *second.shape) <= _SIDE


def called(eqn: Any) -> ClosedJaxpr:
    """The program that a call carries out."""
    return next(p for p in inner_programs(eqn.params) if len(p.jaxpr.invars) == len(eqn.invars))


def inner_programs(params: dict[str, Any]) -> list[ClosedJaxpr]:
    """The programs that an operation holds."""
    found = []
    for value in params.values():
        for one in value if isinstance(value, tuple | list) else (value,):
            if isinstance(one, ClosedJaxpr):
                found.append(one)
            elif isinstance(one, Jaxpr):
                found.append(ClosedJaxpr(one, ()))
    return found
