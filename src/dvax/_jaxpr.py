"""Programs that JAX has traced, operation by operation."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
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


def scan_counts(params: dict[str, Any]) -> tuple[int, int] | None:
    """How many arguments of a `lax.scan` do not change, and how many it carries on; None where this JAX
    says it in another way."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    try:
        fixed, carried, *_ = params["ft_in"].elts  # from JAX 0.12 on
        counts = [len(list(part.vals)) for part in (fixed, carried)]
    except (AttributeError, KeyError, TypeError, ValueError):
        return None
    return counts[0], counts[1]


def variables(atoms: Any) -> set[Any]:
    """Those that are not literals."""
    return {atom for atom in atoms if isinstance(atom, Var)}


def is_search(eqn: Any) -> bool:
    """Whether a call is that of `jnp.searchsorted` for one number, as in `jnp.interp` and in a table
    with steps: by the name and by the program, which is that of JAX for these shapes."""
    inner = eqn.params.get("jaxpr")
    if eqn.params.get("name") != "searchsorted" or inner is None or len(eqn.invars) != 2:
        return False
    row, value = (
        jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype, weak_type=v.aval.weak_type)
        for v in eqn.invars
    )
    if len(row.shape) != 1:
        return False
    for side in ("left", "right"):
        for method in ("scan", "scan_unrolled", "compare_all"):
            search = partial(jnp.searchsorted, side=side, method=method)
            own = jax.make_jaxpr(search)(row, value).jaxpr.eqns
            if len(own) == 1 and str(own[0].params.get("jaxpr")) == str(inner):
                return True
    return False
