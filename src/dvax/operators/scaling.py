"""Multiples P = b I of the identity."""

from typing import Any

import jax
import numpy as np

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractOperator, Spectrum


class Scaling(AbstractOperator):
    """P v = b v with b > 0.

    **Raises:** `dvax.InputError` if b ≤ 0 (P would not be coercive) or b is not finite.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> float(dvax.operators.Scaling(4.0).inverse(jnp.array(2.0)))
    0.5

    ```
    """

    b: jax.Array
    inverse_b: jax.Array

    def __init__(self, b: Any):
        self.b = _tree.as_number(
            b, "dvax.operators.Scaling(b)", "Use dvax.operators.Diagonal for one factor an entry"
        )
        _tree.require(
            lambda: np.asarray(self.b) > 0 and np.isfinite(np.asarray(self.b)),
            "dvax.operators.Scaling(b)",
            self.b,
            "P must be coercive and bounded, so b must be positive and finite",
            "Give a positive number",
        )
        # Stored: a division for every entry, at every evaluation, would cost more than the law.
        self.inverse_b = _tree.prepare(lambda b: 1.0 / b, self.b)

    def apply(self, v: Tree) -> Tree:
        return _tree.scale(self.b, v)

    def inverse(self, v: Tree) -> Tree:
        return _tree.scale(self.inverse_b, v)

    def check(self, space: AbstractSpace) -> None:
        """Accept every space: a positive multiple of I is self-adjoint and coercive in all."""

    def spectrum(self, space: AbstractSpace) -> Spectrum:
        return Spectrum(self.b, self.b)
