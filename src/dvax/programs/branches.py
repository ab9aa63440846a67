"""Branches in the code of f or h: kinks and jumps besides those of K."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._jax.jaxprs import bind
from .._tree import Tree
from .interpreter import Domain, Rule, interpret, is_real, same_for


class _Moving(NamedTuple):
    """A value that depends on t, x or u."""

    value: Any


def branches(fn: Callable[..., Tree], t: Any, x: Tree, u: Tree) -> list[jax.Array]:
    """Return quantities that change sign where fn(t, x, u) branches.

    They are differences of compared values, arguments of |·| and sign, and sin(πv) for steps such as
    floor(v). Knots are among them: they change no sign within a step. Bodies of loops and of
    conditionals are not examined.
    """
    switches: list[jax.Array] = []

    def evaluate(eqn: Any, operands: list[Any]) -> list[Any]:
        return list(map(_Moving, bind(eqn, [_value(v) for v in operands])))

    def apply(rule: Rule, eqn: Any, operands: list[Any]) -> list[Any]:
        if is_real(eqn.invars[0].aval):
            switches.extend(rule(eqn, [_value(v) for v in operands]))
        return evaluate(eqn, operands)

    domain = Domain(RULES, lambda v: isinstance(v, _Moving), evaluate, apply)
    operands = list(map(_Moving, jtu.tree_leaves((t, x, u))))
    interpret(jax.make_jaxpr(fn)(t, x, u), operands, domain)
    return switches


def _value(v: Any) -> Any:
    return v.value if isinstance(v, _Moving) else v


RULES: dict[str, Rule] = {
    **same_for({"lt", "le", "gt", "ge", "max", "min"}, lambda eqn, v: [v[0] - v[1]]),
    **same_for({"abs", "sign"}, lambda eqn, v: [v[0]]),
    **same_for({"floor", "ceil"}, lambda eqn, v: [jnp.sin(jnp.pi * v[0])]),
    "round": lambda eqn, v: [jnp.cos(jnp.pi * v[0])],
    "rem": lambda eqn, v: [jnp.sin(jnp.pi * (v[0] / v[1]))],
    "clamp": lambda eqn, v: [v[1] - v[0], v[1] - v[2]],
}
"""The quantities that change sign where an operation branches."""
