"""Naming what went wrong: which function returned which bad value, when, and where."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._tree import Tree
from ..errors import InputError
from .flow import Flow


def diagnose(flow: Flow, t: Any, x: Tree) -> str:
    """A sentence naming the first of K, h, f that is not finite at (t, x) or shortly after.

    x is the last good state, so what broke may only show a little later: the state is carried on by
    the last good rate over growing fractions of a step, until something breaks.
    """
    problem, args = flow.problem, flow.args
    like = problem.zero_control(x)
    for ahead in (0.0, *np.geomspace(1e-12, 1.0, 25)):
        later = jnp.asarray(t + ahead * max(1.0, abs(float(t))))
        pieces = {
            "K": lambda s=later: problem.set_at(s, args),
            "h": lambda s=later: problem.h(s, x, like, args),
            "f": lambda s=later: problem.f(s, x, like, args),
            "the law (h at its solution)": lambda s=later: flow.rate(s, x, None).y,
            "f at the law's solution": lambda s=later: flow.rate(s, x, None).value,
        }
        for name, evaluate in pieces.items():
            try:
                found = _first_bad(evaluate(), allow_infinite=name == "K")
            except InputError as refused:
                return f"K is refused at t = {float(later):.9g}: {refused}"
            if found:
                return f"{name} is {found} at t = {float(later):.9g}."
    return ""


def _first_bad(tree: Tree, allow_infinite: bool) -> str:
    leaves = jax.tree_util.tree_leaves(tree)
    for k, leaf in enumerate(leaves):
        array = np.asarray(leaf)
        bad = np.isnan(array) if allow_infinite else ~np.isfinite(array)
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            value = array[index]
            part = f" of part {k}" if len(leaves) > 1 else ""
            place = f" in component {index}{part}" if index else part
            return f"{value}{place} ({int(bad.sum())} of {bad.size} entries)"
    return ""
