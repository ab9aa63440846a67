"""Programs that JAX has traced, operation by operation."""

from collections.abc import Callable
from typing import Any

from jax.extend.core import ClosedJaxpr, Literal, Var


def bound(eqn: Any, given: list[Any]) -> list[Any]:
    """One operation, on these arrays."""
    with eqn.ctx.manager:
        found = eqn.primitive.bind(*given, **eqn.primitive.get_bind_params(eqn.params))
    return list(found) if eqn.primitive.multiple_results else [found]


def walked(
    program: ClosedJaxpr, given: Any, do: Callable[[Any, list[Any]], list[Any]]
) -> list[Any]:
    """The outputs of a program whose operations are done by `do(eqn, given)`."""
    known = dict(zip(program.jaxpr.constvars, program.consts, strict=True))
    known |= dict(zip(program.jaxpr.invars, given, strict=True))
    for eqn in program.jaxpr.eqns:
        known.update(zip(eqn.outvars, do(eqn, values(known, eqn.invars)), strict=True))
    return values(known, program.jaxpr.outvars)


def values(known: dict[Any, Any], atoms: Any) -> list[Any]:
    """What is known of each, or written in its place."""
    return [atom.val if isinstance(atom, Literal) else known[atom] for atom in atoms]


def variables(atoms: Any) -> set[Any]:
    """Those that are not literals."""
    return {atom for atom in atoms if isinstance(atom, Var)}
