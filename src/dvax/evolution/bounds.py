"""Bounds on the values that the numerical trajectory has taken.

Constants that hold in a region only prove an error bound if the trajectory stays in that region.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..programs.enclosure import is_enclosure


class Bounds(NamedTuple):
    """Entrywise bounds (low, high) on x_h and on u_h, from one saved time to the next.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(                    # Lipschitz in a region only
    ...     A=dvax.generators.Scalar(-2.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
    ...     f=lambda t, x, u, args: u - 0.1 * x**3, h=lambda t, x, u, args: 1.0 - x - u,
    ... )
    >>> check = dvax.verify(problem, 0.0, 0.0, 2.0, x=(-1.0, 1.0))
    >>> sol = dvax.solve(problem, 0.0, 0.0, 2.0, constants=check.constants)
    >>> low, high = sol.bounds.x                   # boxes that x does not leave before each saved time
    >>> bool((-1.0 < low).all() and (high < 1.0).all())
    True

    ```
    """

    x: tuple[Tree, Tree]
    u: tuple[Tree, Tree]

    @classmethod
    def at_start(cls, x0: Tree, like: Tree) -> "Bounds":
        """Return the bounds before the first step: x₀ alone for x, the empty interval for u."""
        low, high = (
            jtu.tree_map(lambda v, end=end: jnp.full_like(v, end), like)
            for end in (jnp.inf, -jnp.inf)
        )
        return cls((x0, x0), (low, high))

    @classmethod
    def of_enclosures(cls, x: Tree, u: Tree) -> "Bounds":
        """Return the bounds of all values in two linear enclosures."""
        return cls(_ends(x), _ends(u))

    def hull_of_rows(self) -> "Bounds":
        """Return the tightest bounds on all rows, which are stacked along the first axis."""
        lows, highs = zip(*self, strict=True)
        low = jtu.tree_map(partial(jnp.min, axis=0), lows)
        high = jtu.tree_map(partial(jnp.max, axis=0), highs)
        return Bounds(*zip(low, high, strict=True))

    def hull(self, other: "Bounds") -> "Bounds":
        """Return the tightest bounds that contain both. NaN propagates, and lies in no region."""
        lows, highs = zip(*self, strict=True)
        other_lows, other_highs = zip(*other, strict=True)
        low = jtu.tree_map(jnp.minimum, lows, other_lows)
        high = jtu.tree_map(jnp.maximum, highs, other_highs)
        return Bounds(*zip(low, high, strict=True))


def _ends(enclosures: Tree) -> tuple[Tree, Tree]:
    """Return the lower and the upper bounds of the enclosures in a tree."""
    low, high = (
        jtu.tree_map(lambda q, name=name: getattr(q, name), enclosures, is_leaf=is_enclosure)
        for name in ("lowest", "highest")
    )
    return low, high
