"""What f, h, K, A and P close over, brought out where a derivative can reach it."""

from typing import Any

import equinox as eqx

from .. import _tree
from .._tree import Tree
from ..problem import Problem


def closure_convert(problem: Problem, t: Any, x: Tree, args: Any) -> Problem:
    """The same problem; a callable that closes over traced values, as one written inside a function
    that is being differentiated does, carries them as parts of its own."""
    u = problem.zero_control(x)
    given = {"f": (t, x, u, args), "h": (t, x, u, args), "K": (t, args), "A": (args,), "P": (args,)}
    changed: dict[str, Any] = {}
    for name, inputs in given.items():
        fn = getattr(problem, name)
        if isinstance(fn, eqx.Module):
            continue
        converted: Any = eqx.filter_closure_convert(fn, *inputs)
        if not _tree.is_concrete(getattr(converted, "consts", ())):
            changed[name] = converted
    if not changed:
        return problem
    return eqx.tree_at(
        lambda p: [getattr(p, name) for name in changed], problem, list(changed.values())
    )
