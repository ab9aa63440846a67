"""Detection of NaN and infinity in trees and in the data of a problem."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import Problems
from ..problem import Problem
from .setup import Setup


def nonfinite_data(problem: Problem, args: Any, caller: str) -> Problems:
    """Return the problems of A, P, K and args that contain NaN, and of A and P that contain
    infinity."""
    wrong = Problems()
    for name, data in (("A", problem.A), ("P", problem.P), ("K", problem.K), ("args", args)):
        description = first_bad(data, allow_infinite=name in ("K", "args"))
        if description:
            place = f"{caller}(args)" if name == "args" else f"dvax.Problem({name})"
            wrong.add(place, description, "its numbers must be finite", "Correct the data there")
    return wrong


def first_bad(tree: Tree, allow_infinite: bool = False) -> str:
    """Describe the first NaN (or infinity) in a tree and its position; return "" if there is none."""
    # Skip setups: a solution among the args contains one, and its settings may be NaN.
    whole, _ = jtu.tree_flatten_with_path(tree, is_leaf=lambda v: isinstance(v, Setup))
    leaves = [v for v in whole if isinstance(v[1], float | np.ndarray | jax.Array)]
    for k, (path, leaf) in enumerate(leaves):
        # The type of a random key is no number.
        if not _tree.is_concrete(leaf) or not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            continue
        array = np.asarray(leaf)
        bad = np.isnan(array) if allow_infinite else ~np.isfinite(array)
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            is_named = bool(path) and all(
                isinstance(p, jtu.DictKey | jtu.SequenceKey) for p in path
            )
            part = jtu.keystr(path) if is_named else f"part {k}" if len(leaves) > 1 else ""
            places = (f"component {index}" if index else "", part)
            place = " of ".join(text for text in places if text)
            count = f" ({int(bad.sum())} of {bad.size} entries)" if bad.size > 1 else ""
            return f"{array[index]}" + (f" in {place}" if place else "") + count
    return ""
