"""Where the code of a function of x and u branches: kinks and jumps that are not those of K."""

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
    """What changes its sign where fn(t, x, u) branches by x or u: the differences of what it compares,
    and the arguments of |·| and sign. Branches by t alone are knots. Loops and conditions are not
    entered."""
    found: list[jax.Array] = []

    def evaluate(eqn: Any, given: list[Any]) -> list[Any]:
        return list(map(_OfState, bind(eqn, [_value(v) for v in given])))

    def apply(rule: Rule, eqn: Any, given: list[Any]) -> list[Any]:
        if is_real(eqn.invars[0].aval):
            found.extend(rule(eqn, [_value(v) for v in given]))
        return evaluate(eqn, given)

    domain = Domain(RULES, lambda v: isinstance(v, _OfState), evaluate, apply)
    given = [t, *map(_OfState, jtu.tree_leaves((x, u)))]
    interpret(jax.make_jaxpr(fn)(t, x, u), given, domain)
    return found


def _value(v: Any) -> Any:
    return v.value if isinstance(v, _OfState) else v


RULES: dict[str, Rule] = {
    **same_for({"lt", "le", "gt", "ge", "max", "min"}, lambda eqn, v: [v[0] - v[1]]),
    **same_for({"abs", "sign"}, lambda eqn, v: [v[0]]),
    "clamp": lambda eqn, v: [v[1] - v[0], v[1] - v[2]],
}
"""What changes its sign where an operation branches."""
