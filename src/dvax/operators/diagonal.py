"""Diagonal operators P = diag(p₁, …, pₙ)."""

from typing import Any

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractOperator, Spectrum


class Diagonal(AbstractOperator):
    """P v = p ⊙ v, elementwise, with every pᵢ > 0.

    **Raises:** `dvax.InputError` if an entry is not positive and finite.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> P = dvax.operators.Diagonal(jnp.array([1.0, 2.0]))
    >>> float(P.spectrum(dvax.spaces.Euclidean(2)).norm_P_inv)
    1.0

    ```
    """

    entries: jax.Array
    inverse_entries: jax.Array

    def __init__(self, entries: Any):
        self.entries = _tree.as_array(entries, "dvax.operators.Diagonal(entries)")
        _tree.require(
            lambda: jnp.all((self.entries > 0) & jnp.isfinite(self.entries)),
            "dvax.operators.Diagonal(entries)",
            self.entries,
            "P must be coercive and bounded, so every entry must be positive and finite",
            "Remove or regularise the entries that are not",
        )
        self.inverse_entries = _tree.prepare(lambda entries: 1.0 / entries, self.entries)

    def apply(self, v: Tree) -> Tree:
        return self.entries * v

    def inverse(self, v: Tree) -> Tree:
        return self.inverse_entries * v

    def check(self, space: AbstractSpace) -> None:
        # A positive diagonal is self-adjoint and coercive for all diagonal weights.
        name = "dvax.operators.Diagonal(entries)"
        _tree.fits(name, self.entries, space.like(), "control space")

    def spectrum(self, space: AbstractSpace) -> Spectrum:
        return Spectrum(jnp.min(self.entries), jnp.max(self.entries))
