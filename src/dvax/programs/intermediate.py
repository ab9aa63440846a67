"""Intermediate values of a traced program: the operations that make them, and functions of them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._jax.jaxprs import ClosedJaxpr, Literal, bind, read


def maker(traced: ClosedJaxpr, atom: Any) -> Any | None:
    """Return the operation that makes a value; None for an input or a constant."""
    if isinstance(atom, Literal):
        return None
    return next((eqn for eqn in traced.jaxpr.eqns if any(v is atom for v in eqn.outvars)), None)


def subtracted(traced: ClosedJaxpr) -> Any | None:
    """Return the value G of a program whose one output is u − G for its last input u, or None."""
    last = maker(traced, traced.jaxpr.outvars[0])
    if last is None or last.primitive.name != "sub":
        return None
    return last.invars[1] if last.invars[0] is traced.jaxpr.invars[-1] else None


def intermediate(traced: ClosedJaxpr, atom: Any) -> Callable[..., jax.Array]:
    """Return a function that computes a value of a program instead of its outputs."""
    if isinstance(atom, Literal):
        return lambda *inputs: jnp.asarray(atom.val)
    jaxpr = traced.jaxpr

    def fn(*inputs: Any) -> jax.Array:
        environment = dict(zip(jaxpr.constvars, traced.consts, strict=True))
        environment.update(zip(jaxpr.invars, jtu.tree_leaves(inputs), strict=True))
        for eqn in jaxpr.eqns:
            if atom in environment:
                break
            results = bind(eqn, read(environment, eqn.invars))
            environment.update(zip(eqn.outvars, results, strict=True))
        return jnp.asarray(environment[atom])

    return fn
