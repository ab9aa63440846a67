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


def known_name(eqn: Any) -> str | None:
    """Return the name in `VARIANTS` of the function that an operation calls, or None.

    The name of the call must match (functions with a derivative of their own have none in some versions
    of JAX), and its program must equal that of JAX for these shapes. `searchsorted` counts for a single
    number only.
    """
    name = eqn.params.get("name")
    inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    if eqn.primitive.name == "custom_jvp_call":
        name = "logaddexp"
    if name not in VARIANTS or inner is None:
        return None
    avals = tuple((v.aval.shape, str(v.aval.dtype), v.aval.weak_type) for v in eqn.invars)
    if name == "searchsorted" and (len(avals) != 2 or len(avals[0][0]) != 1 or avals[1][0] != ()):
        return None
    return name if _text(inner) in _programs(name, avals) else None


@functools.lru_cache(512)
def _text(inner: Any) -> str:
    return str(inner)


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
        if len(outer) == 1:
            params = outer[0].params
            found.add(str(params.get("jaxpr", params.get("call_jaxpr"))))
    return frozenset(found)
