"""Warnings after the first run of a problem, which no check before a run can give."""

import math
import warnings
from typing import Any

import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..problem import Problem
from .several_solutions import warn_of_several_solutions
from .signature import flat

_SEEN: set[Any] = set()
"""The problems that were examined, by their code and the shapes of their arrays."""

_MAX_SEEN = 256

_MAX_ROWS = 64
"""Most saved states that are looked at."""

_SHARE = 0.1
"""Largest share of the state that atol may be without a warning."""


def warn_after_first_run(
    problem: Problem,
    t0: Any,
    x0: Tree,
    args: Any,
    moduli: Any,
    states: Tree = None,
    atol: Any = None,
) -> None:
    """Warn, once for a problem, of a law with several solutions and of states that atol hides.

    `states`: the saved ones of a run with the tolerance `atol`; without them, of the law alone.
    """
    leaves, tree = jtu.tree_flatten((x0, args))
    numbers = [leaf if isinstance(leaf, float) else np.shape(leaf) for leaf in leaves]
    key = flat(problem).key, tree, tuple(type(n) if isinstance(n, float) else n for n in numbers)
    if key in _SEEN or not _tree.is_concrete(flat(problem).numbers, t0, leaves):
        return
    if len(_SEEN) >= _MAX_SEEN:
        _SEEN.clear()
    _SEEN.add(key)
    warn_of_several_solutions(problem, t0, x0, args, moduli)
    if states is not None and _tree.is_concrete(states, atol):
        _warn_of_small_states(problem, x0, states, float(atol))


def _warn_of_small_states(problem: Problem, x0: Tree, states: Tree, atol: float) -> None:
    """Warn if atol is more than a tenth of the largest state, unless all of them are 0."""
    weights = problem.spaces(x0)[0].weights()
    count = len(jtu.tree_leaves(states)[0])
    rows = np.unique(np.linspace(0, count - 1, _MAX_ROWS).astype(int)) if count else []
    saved = (jtu.tree_map(lambda leaf, k=k: leaf[k], states) for k in rows)
    largest = max(_norm(weights, x) for x in (x0, *saved))
    if 0.0 < largest and atol > _SHARE * largest:
        warnings.warn(
            f"atol = {atol:g} hides the solution: the norm of x is at most {largest:.3g} at t0 and at "
            "the saved times, so an error as large as x itself may pass. Pass "
            f"atol = {1e-3 * largest:.0e} or less, or choose units in which x is of size 1.",
            stacklevel=4,
        )


def _norm(weights: Tree, x: Tree) -> float:
    """Return ‖x‖, with NumPy: each operation of JAX would compile a program."""
    squares = jtu.tree_map(lambda w, leaf: np.sum(np.asarray(w) * np.square(leaf)), weights, x)
    return math.sqrt(sum(map(float, jtu.tree_leaves(squares))))
