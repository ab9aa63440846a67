"""Operations carried out within a function."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, Literal, Var

from .joins import is_joined, part_by_part
from .kept import worth_keeping
from .small import inner_programs
from .sums import by_parts, is_sum

BRIEF = 64
"""Entries of an array that is handed on with others, as one, and never worth a loop of its own."""


def bound(eqn: Any, given: list[Any]) -> list[Any]:
    """An operation on these arrays."""
    with eqn.ctx.manager:
        found = eqn.primitive.bind(*given, **eqn.primitive.get_bind_params(eqn.params))
    return list(found) if eqn.primitive.multiple_results else [found]


def retraced(run: Any, avals: Any) -> ClosedJaxpr:
    return jax.make_jaxpr(run)(*(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals))


def summed_by_parts(program: ClosedJaxpr) -> ClosedJaxpr:
    """The program with its sums, and those of all that it calls, by parts."""
    if not _has_sums(program):
        return program

    def run(*given: Any) -> list[Any]:
        known = dict(zip(program.jaxpr.constvars, program.consts, strict=True))
        known |= dict(zip(program.jaxpr.invars, given, strict=True))
        for eqn in program.jaxpr.eqns:
            known |= dict(zip(eqn.outvars, _by_parts(eqn, _all(known, eqn.invars)), strict=True))
        return _all(known, program.jaxpr.outvars)

    return retraced(run, program.in_avals)


def carried_out(
    eqns: list[Any], known: dict[Any, Any], results: list[Any], one: jax.Array
) -> list[Any]:
    """The results of the equations as one function has them fastest, from the values of what is known
    and a 1 that the compiler does not know."""
    for stage in worth_keeping(eqns, _variables(results), BRIEF):
        compute = partial(_found, eqns, known, stage, one)
        blank = partial(_blank, stage)
        known = known | dict(zip(stage, lax.cond(one > 0.0, compute, blank), strict=True))
    return _found(eqns, known, results, one)


def _found(eqns: list[Any], known: dict[Any, Any], results: list[Any], one: Any) -> list[Any]:
    """The results, with no more computed than that takes."""
    needed = _variables(results) - known.keys()
    own = []
    for eqn in reversed(eqns):
        if needed.intersection(eqn.outvars):
            own.append(eqn)
            needed |= _variables(eqn.invars) - known.keys()
    values = dict(known)
    for eqn in reversed(own):
        given = _all(values, eqn.invars)
        if is_joined(eqn) and eqn.outvars[0].aval.size > BRIEF:
            found = [part_by_part(eqn, given, one)]
        else:
            found = _by_parts(eqn, given)
        values = dict(zip(eqn.outvars, found, strict=True)) | values
    return _all(values, results)


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


def _all(known: dict[Any, Any], atoms: Any) -> list[Any]:
    return [atom.val if isinstance(atom, Literal) else known[atom] for atom in atoms]


def _variables(atoms: Any) -> set[Any]:
    return {atom for atom in atoms if isinstance(atom, Var)}


def _blank(like: list[Any]) -> list[jax.Array]:
    return [jnp.zeros(v.aval.shape, v.aval.dtype) for v in like]
