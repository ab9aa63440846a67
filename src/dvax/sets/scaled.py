"""Multiples s K of a set."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractSet


class Scaled(AbstractSet):
    """K = {factor · y : y ∈ set}: proj_K(z) = factor · proj(z/factor).

    **Arguments:** `set`: any set; `factor`: a number, not 0; a negative one reflects the set.

    **Raises:** `dvax.InputError` if the factor is 0 or not finite.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.Scaled(dvax.sets.Simplex(1.0), 2.0)
    >>> K.project(jnp.array([5.0, 0.0]), dvax.spaces.Euclidean(2)).tolist()
    [2.0, 0.0]

    ```
    """

    set: AbstractSet
    factor: jax.Array

    def __init__(self, set: AbstractSet, factor: Any):
        name = "dvax.sets.Scaled(factor)"
        _tree.check_kind(
            set, AbstractSet, "dvax.sets.Scaled(set)", "it must be a set of dvax.sets",
            "The set comes first, then the factor",
        )  # fmt: skip
        self.set = set
        self.factor = _tree.as_number(factor, name, "Scale the data of the set itself")
        _tree.require(
            lambda: np.isfinite(self.factor) & (np.asarray(self.factor) != 0),
            name,
            self.factor,
            "the factor must be finite and not 0",
            "Use dvax.sets.Ball(0.0, 0.0) for the set {0}",
        )
        if not _tree.is_concrete(self.factor):
            # A traced factor: replace 0 by NaN, so that it stops a solve.
            self.factor = jnp.where(self.factor == 0, jnp.nan, self.factor)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        return _tree.scale(self.factor, self.set.project(self._unscaled(z), space))

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array] | None:
        return self.set.switches(self._unscaled(z), space)

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        inner = self.set.intervals(like)
        if inner is None:
            return None
        ends = _tree.scale(self.factor, inner[0]), _tree.scale(self.factor, inner[1])
        return _tree.where(self.factor < 0, ends[1], ends[0]), _tree.where(
            self.factor < 0, ends[0], ends[1]
        )

    def check(self, like: Tree) -> None:
        self.set.check(like)

    def _unscaled(self, z: Tree) -> Tree:
        return jtu.tree_map(lambda leaf: leaf / self.factor, z)
