"""Conversion of traced closure variables of f, h, K, A and P to arguments, for derivatives."""

from typing import Any

import equinox as eqx

from .. import _tree
from .._tree import Tree
from ..problem import Problem


def closure_convert(problem: Problem, t: Any, x: Tree, args: Any) -> Problem:
    """Return the problem with the traced closure variables of its callables as leaves of the pytree.

    (A callable defined inside a differentiated function may close over traced values.)
    """
    u = problem.zero_control(x)
    signatures = {
        "f": (t, x, u, args),
        "h": (t, x, u, args),
        "K": (t, args),
        "A": (args,),
        "P": (args,),
    }
    changed: dict[str, Any] = {}
    for name, inputs in signatures.items():
        fn = getattr(problem, name)
        converted = convert(fn, *inputs)
        if converted is not fn:
            changed[name] = converted
    if not changed:
        return problem
    return eqx.tree_at(
        lambda p: [getattr(p, name) for name in changed], problem, list(changed.values())
    )


def convert(fn: Any, *inputs: Any) -> Any:
    """Return a callable with its traced closure variables as leaves, or itself if there are none."""
    if isinstance(fn, eqx.Module):
        return fn
    converted: Any = eqx.filter_closure_convert(fn, *inputs)
    return fn if _tree.is_concrete(getattr(converted, "consts", ())) else converted
