"""Translates K + a of a set."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from .abstract import AbstractSet


class Translated(AbstractSet):
    """K = {y + offset : y ∈ set}: proj_K(z) = offset + proj(z − offset).

    **Arguments:** `set`: any set; `offset`: an element, or a number for all entries.

    **Raises:** `dvax.InputError` if the offset is not finite.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.Translated(dvax.sets.Ball(0.0, 1.0), jnp.array([3.0, 0.0]))
    >>> K.project(jnp.zeros(2), dvax.spaces.Euclidean(2)).tolist()
    [2.0, 0.0]

    ```
    """

    set: AbstractSet
    offset: Tree

    def __init__(self, set: AbstractSet, offset: Any):
        _tree.check_kind(
            set, AbstractSet, "dvax.sets.Translated(set)", "it must be a set of dvax.sets",
            "The set comes first, then the offset",
        )  # fmt: skip
        self.set = set
        self.offset = _tree.as_float(offset, "dvax.sets.Translated(offset)")
        _tree.require(
            lambda: _tree.has_only_finite(self.offset),
            "dvax.sets.Translated(offset)",
            self.offset,
            "the entries of the offset must be finite",
            "Correct the entries that are not",
        )

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        offset = full_offset(self, z)
        return _tree.add(offset, self.set.project(_tree.sub(z, offset), space))

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array] | None:
        return self.set.switches(_tree.sub(z, full_offset(self, z)), space)

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        inner = self.set.intervals(like)
        if inner is None:
            return None
        offset = full_offset(self, like)
        return _tree.add(inner[0], offset), _tree.add(inner[1], offset)

    def check(self, like: Tree) -> None:
        if not (_is_number(self.offset) or _tree.same_shape(self.offset, like)):
            raise input_error(
                "dvax.sets.Translated(offset)",
                f"shape {_tree.shapes(self.offset)}",
                f"the offset must be an element of shape {_tree.shapes(like)}, or a number",
                "Give it that shape",
            )
        self.set.check(like)


def full_offset(K: Translated, like: Tree) -> Tree:
    """Return the offset, shaped like an element."""
    if _is_number(K.offset):
        return jtu.tree_map(lambda leaf: jnp.broadcast_to(K.offset, leaf.shape), like)
    return K.offset


def _is_number(offset: Tree) -> bool:
    return not isinstance(offset, tuple) and jnp.ndim(offset) == 0
