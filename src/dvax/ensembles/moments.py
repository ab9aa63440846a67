"""Means and variances of rows that arrive in pieces."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._tree import Tree


class Moments(NamedTuple):
    """The number of rows, their mean, and the sum of the squares of their deviations from it, entry by
    entry.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, load: load - 0.5 * x - u,
    ...     h=lambda t, x, u, load: 1.0 - 2.0 * x - u,
    ... )
    >>> found = dvax.ensemble(problem, -1.0, 0.0, 2.0, jnp.linspace(2.0, 4.0, 11))
    >>> int(found.moments.count), bool(found.moments.mean == found.mean)
    (11, True)

    ```
    """

    count: Any
    mean: Tree
    squares: Tree

    @staticmethod
    def of(rows: Tree, valid: Any) -> "Moments":
        """Return the moments of the rows that are valid."""
        xp = _tree.array_module(rows, valid)
        count = xp.sum(valid)

        def mean(leaf: Any) -> Any:
            kept = xp.where(_wide(valid, leaf), leaf, 0.0)
            mean = xp.sum(kept, axis=0) / xp.maximum(count, 1).astype(kept.dtype)
            return xp.where(count > 0, mean, xp.nan)

        def squares(leaf: Any, mean: Any) -> Any:
            with np.errstate(invalid="ignore"):  # of infinities
                away = xp.where(_wide(valid, leaf), leaf, mean) - mean
            return xp.sum(xp.abs(away) ** 2, axis=0)

        means = jtu.tree_map(mean, rows)
        return Moments(count, means, jtu.tree_map(squares, rows, means))

    def merge(self, other: "Moments") -> "Moments":
        """Return the moments of both sets of rows (Chan, Golub and LeVeque 1983)."""
        count = self.count + other.count
        if not other.count:
            return self
        if not self.count:
            return other
        share = other.count / count

        def joined(a: Any, b: Any) -> Any:
            # ∞ − ∞ is not a number, and the mean of infinities is infinite, as the times of events that
            # did not happen.
            xp = _tree.array_module(a, b)
            return xp.where(a == b, a, a + share * (b - a))

        with np.errstate(invalid="ignore"):
            away = jtu.tree_map(lambda a, b: b - a, self.mean, other.mean)
            mean = jtu.tree_map(joined, self.mean, other.mean)
        squares = jtu.tree_map(
            lambda a, b, d: a + b + self.count * share * abs(d) ** 2,
            self.squares,
            other.squares,
            away,
        )
        return Moments(count, mean, squares)

    def standard_deviation(self) -> Tree:
        """Return √(squares/(count − 1)), NaN for fewer than two rows."""
        xp = _tree.array_module(self.squares, self.count)
        degrees = xp.asarray(self.count) - 1

        def root(squares: Any) -> Any:
            known = xp.where(degrees > 0, degrees, 1).astype(squares.dtype)
            return xp.where(degrees > 0, xp.sqrt(squares / known), xp.nan)

        return jtu.tree_map(root, self.squares)


def _wide(valid: Any, like: Any) -> Any:
    return valid.reshape(-1, *(1,) * (jnp.ndim(like) - 1))
