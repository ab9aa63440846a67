"""Bounds on the speed of the projection onto K(t): ‖proj_{K(s)}z − proj_{K(t)}z‖ ≤ speed |s − t| for
every z."""

from typing import Any

import jax.tree_util as jtu
import numpy as np

from .._tree import Tree
from ..programs.slope import Slope, Values, is_slope
from ..sets._motion import Entries, Fixed, Independent, Sum, Unbounded


def speed_of(motion: Any) -> float:
    """Return the speed of a motion whose arrays are slopes in t; ∞ if it is unknown."""
    if isinstance(motion, Entries):
        fastest = np.maximum.reduce([_entry_speeds(v) for v in motion.arrays])
        # Roundoff of the gain is far below the margins of the slopes.
        gain = motion.gain.high
        moved_by = gain * fastest if gain.ndim == 1 else gain @ fastest
        found = float(np.linalg.norm(moved_by))
    elif isinstance(motion, Sum):
        found = float(sum(map(speed_of, motion.parts)))
    elif isinstance(motion, Independent):
        found = float(np.linalg.norm([speed_of(part) for part in motion.parts]))
    else:
        found = 0.0 if is_fixed(motion) else np.inf
    return np.inf if np.isnan(found) else found


def is_fixed(motion: Any) -> bool:
    """Return whether all data do not move that must not."""
    if isinstance(motion, Fixed | Unbounded):
        return not any(_entry_speeds(v).any() for v in motion.arrays)
    return isinstance(motion, Entries) or all(map(is_fixed, motion.parts))


def slopes(tree: Tree) -> list[Slope]:
    """Return the leaves of a tree of slopes."""
    return jtu.tree_leaves(tree, is_leaf=is_slope)


def _entry_speeds(x: Slope) -> Values:
    """Return a bound on the speed of each entry; a bound at infinity has speed 0."""
    part = x.parts.get(0)
    if part is None:
        return np.zeros(x.low.size)
    found = (np.abs(part.center) + part.radius).reshape(-1)
    low, high = x.low.reshape(-1), x.high.reshape(-1)
    return np.where((low == high) & np.isinf(low), 0.0, found)
