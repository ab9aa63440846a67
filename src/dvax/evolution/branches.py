"""Where the code of a function of x and u branches: kinks and jumps that are not those of K."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend.core import ClosedJaxpr

from .._jaxpr import bound
from .._tree import Tree
from ..vi.structure import CALLS, CUSTOM, evaluate, inner_jaxpr

_COMPARE = {"lt", "le", "gt", "ge", "max", "min"}


class _OfState(NamedTuple):
    """A value that depends on x or u."""

    value: Any


def branches(fn: Callable[..., Tree], t: Any, x: Tree, u: Tree) -> list[jax.Array]:
    """What changes its sign where fn(t, x, u) branches by x or u: the differences of what it compares,
    and the arguments of |·| and sign. Branches by t alone are knots. Loops and conditions are not
    looked into."""
    found: list[jax.Array] = []

    def read(traced: ClosedJaxpr, given: list[Any]) -> list[Any]:
        return evaluate(traced, given, lambda v: isinstance(v, _OfState), apply)

    def apply(eqn: Any, given: list[Any]) -> list[Any]:
        name = eqn.primitive.name
        if name in CALLS or name in CUSTOM:
            inner = inner_jaxpr(eqn.params)
            if inner is not None and len(inner.jaxpr.invars) == len(given):
                return read(inner, given)
        plain = [v.value if isinstance(v, _OfState) else v for v in given]
        if jnp.issubdtype(jnp.result_type(plain[0]), jnp.floating):
            if name in _COMPARE:
                found.append(plain[0] - plain[1])
            elif name in ("abs", "sign"):
                found.append(plain[0])
            elif name == "clamp":
                found.extend([plain[1] - plain[0], plain[1] - plain[2]])
        return [_OfState(v) for v in bound(eqn, plain)]

    traced = jax.make_jaxpr(fn)(t, x, u)
    read(traced, [t, *map(_OfState, jtu.tree_leaves((x, u)))])
    return found
