"""Branches in the code of f or h that depend on x or u: kinks and jumps besides those of K."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.tree_util as jtu

from .._jax.jaxprs import bind
from .._tree import Tree
from .interpreter import Domain, Rule, interpret, is_real, same_for


class _OfState(NamedTuple):
    """A value that depends on x or u."""

    value: Any


def branches(fn: Callable[..., Tree], t: Any, x: Tree, u: Tree) -> list[jax.Array]:
    """Return quantities that change sign where fn(t, x, u) branches on x or u.

    They are differences of compared values, and arguments of |·| and sign. Branches on t alone are
    knots, and not included. Bodies of loops and of conditionals are not examined.
    """
    switches: list[jax.Array] = []

    def evaluate(eqn: Any, operands: list[Any]) -> list[Any]:
        return list(map(_OfState, bind(eqn, [_value(v) for v in operands])))

    def apply(rule: Rule, eqn: Any, operands: list[Any]) -> list[Any]:
        if is_real(eqn.invars[0].aval):
            switches.extend(rule(eqn, [_value(v) for v in operands]))
        return evaluate(eqn, operands)

    domain = Domain(RULES, lambda v: isinstance(v, _OfState), evaluate, apply)
    operands = [t, *map(_OfState, jtu.tree_leaves((x, u)))]
    interpret(jax.make_jaxpr(fn)(t, x, u), operands, domain)
    return switches


def _value(v: Any) -> Any:
    return v.value if isinstance(v, _OfState) else v


RULES: dict[str, Rule] = {
    **same_for({"lt", "le", "gt", "ge", "max", "min"}, lambda eqn, v: [v[0] - v[1]]),
    **same_for({"abs", "sign"}, lambda eqn, v: [v[0]]),
    "clamp": lambda eqn, v: [v[1] - v[0], v[1] - v[2]],
}
"""The quantities that change sign where an operation branches."""
