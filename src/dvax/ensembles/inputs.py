"""The inputs of the members of an ensemble."""

from typing import Any, NamedTuple

import jax
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..errors import Problems

_NAMES = ("x0s", "args", "t0", "t1", "ts")


class Inputs(NamedTuple):
    """(x0, args, t0, t1, ts) of all members, flattened: the leaves that are `own` have a leading axis
    of `count` members, and the others are the same for all."""

    leaves: list[Any]
    tree: Any
    own: tuple[bool, ...]
    count: int

    @staticmethod
    def of(
        x0s: Tree,
        args: Any,
        t0: Any,
        t1: Any,
        ts: Any,
        axes: tuple[Any, Any],
    ) -> "Inputs":
        """Return the inputs. `axes` are those of x0s and args, as the `in_axes` of `jax.vmap`; a single
        number has no axis.

        **Raises:** `dvax.InputError` if no leaf has a member axis, or if their lengths differ.
        """
        inputs = (x0s, args, t0, t1, ts)
        own = [
            *_own(axes[0], x0s, "x0s"),
            *_own(axes[1], args, "args"),
            *(np.ndim(t) > 0 for t in (t0, t1)),
            *([] if ts is None else [np.ndim(ts) > 1]),
        ]
        paths, tree = jtu.tree_flatten_with_path(inputs)
        # Copies: the ensemble solves single members later.
        leaves = [np.array(leaf) if _is_array(leaf) else leaf for _, leaf in paths]
        lengths = {
            _NAMES[path[0].idx] + jtu.keystr(path[1:]): np.shape(leaf)
            for (path, leaf), is_own in zip(paths, own, strict=True)
            if is_own
        }
        wrong = Problems()
        counts = {name: shape[0] for name, shape in lengths.items()}
        if not counts or len(set(counts.values())) > 1 or min(counts.values()) == 0:
            listed = ", ".join(f"{name} has {count}" for name, count in counts.items())
            wrong.add(
                "dvax.ensemble(x0s, args)", listed or "no array with a member axis",
                "axis 0 of each array counts the members, of which there is at least one; a list or a "
                "tuple is no array, but a tree of numbers",
                "Give all of them the same length, write jnp.array([...]) for a list, and say in axes= "
                "what the members share: axes=(None, 0) for one x0",
            )  # fmt: skip
        wrong.raise_any()
        return Inputs(leaves, tree, tuple(own), min(counts.values()))

    def member(self, k: int) -> tuple[Tree, Any, Any, Any, Any]:
        """Return (x0, args, t0, t1, ts) of member k."""
        return self.tree.unflatten(
            [leaf[k] if own else leaf for leaf, own in zip(self.leaves, self.own, strict=True)]
        )

    def examples(self) -> list[int]:
        """Return the numbers of the first members with finite values, [0] if there is none."""
        finite = np.ones(self.count, bool)
        for leaf, own in zip(self.leaves, self.own, strict=True):
            if own and _tree.is_concrete(leaf) and leaf.dtype.kind in "fc":
                finite &= np.isfinite(leaf).reshape(self.count, -1).all(axis=1)
        return np.flatnonzero(finite)[:_EXAMPLES].tolist() or [0]

    def rows(self, members: Any) -> list[Any]:
        """Return the leaves that differ, of these members."""
        return [leaf[members] for leaf, own in zip(self.leaves, self.own, strict=True) if own]


_EXAMPLES = 8


def _is_array(leaf: Any) -> bool:
    return _tree.is_concrete(leaf) and isinstance(leaf, jax.Array | np.ndarray)


def _own(axes: Any, of: Any, name: str) -> list[bool]:
    """Return for each leaf whether it has a member axis."""

    def spread(axis: Any, part: Any) -> Any:
        has_axis = lambda leaf: axis == 0 and np.ndim(leaf) > 0  # noqa: E731
        return jtu.tree_map(has_axis, part)

    wrong = Problems()
    try:
        flags = jtu.tree_map(spread, axes, of, is_leaf=lambda axis: axis is None)
        is_valid = all(axis in (0, None) for axis in jtu.tree_leaves(axes))
    except (TypeError, ValueError):
        flags, is_valid = None, False
    if not is_valid:
        wrong.add(
            "dvax.ensemble(axes)", _tree.line(axes),
            f"for {name} it must be 0, None, or a tree of these that is a prefix of {name}",
            "Write axes=(0, 0), the default, or axes=(0, None) if all members share args",
        )  # fmt: skip
    wrong.raise_any()
    return jax.tree_util.tree_leaves(flags)
