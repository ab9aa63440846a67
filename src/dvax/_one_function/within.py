"""Operations carried out within a function."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr

from .._jaxpr import bound, values, variables, walked
from .joins import is_joined, part_by_part
from .kept import worth_keeping
from .small import inner_programs
from .sums import by_parts, is_sum

BRIEF = 64
"""Entries of an array that is handed on with others, as one, and never worth a loop of its own."""


def retraced(run: Any, avals: Any) -> ClosedJaxpr:
    return jax.make_jaxpr(run)(*(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals))


def summed_by_parts(program: ClosedJaxpr) -> ClosedJaxpr:
    """The program with its sums, and those of all that it calls, by parts."""
    if not _has_sums(program):
        return program

    return retraced(lambda *given: walked(program, given, _by_parts), program.in_avals)


def carried_out(
    eqns: list[Any], known: dict[Any, Any], results: list[Any], one: jax.Array
) -> list[Any]:
    """The results of the equations as one function has them fastest, from the values of what is known
    and a 1 that the compiler does not know."""
    for stage in worth_keeping(eqns, variables(results), BRIEF):
        compute = partial(_found, eqns, known, stage, one)
        blank = partial(_blank, stage)
        known = known | dict(zip(stage, lax.cond(one > 0.0, compute, blank), strict=True))
    return _found(eqns, known, results, one)


def _found(eqns: list[Any], known: dict[Any, Any], results: list[Any], one: Any) -> list[Any]:
    """The results, with no more computed than that takes."""
    needed = variables(results) - known.keys()
    own = []
    for eqn in reversed(eqns):
        if needed.intersection(eqn.outvars):
            own.append(eqn)
            needed |= variables(eqn.invars) - known.keys()
    known = dict(known)
    for eqn in reversed(own):
        given = values(known, eqn.invars)
        if is_joined(eqn) and eqn.outvars[0].aval.size > BRIEF:
            found = [part_by_part(eqn, given, one)]
        else:
            found = _by_parts(eqn, given)
        known = dict(zip(eqn.outvars, found, strict=True)) | known
    return values(known, results)


def _by_parts(eqn: Any, given: list[Any]) -> list[Any]:
    if is_sum(eqn):
        return [by_parts(eqn, given[0])]
    if any(map(_has_sums, inner_programs(eqn.params))):
        eqn = eqn.replace(params={key: _inside(value) for key, value in eqn.params.items()})
    return bound(eqn, given)


def _has_sums(program: ClosedJaxpr) -> bool:
    return any(
        is_sum(eqn) or any(map(_has_sums, inner_programs(eqn.params))) for eqn in program.jaxpr.eqns
    )


def _inside(value: Any) -> Any:
    if isinstance(value, tuple | list):
        return type(value)(map(_inside, value))
    return summed_by_parts(value) if isinstance(value, ClosedJaxpr) else value


def _blank(like: list[Any]) -> list[jax.Array]:
    return [jnp.zeros(v.aval.shape, v.aval.dtype) for v in like]
