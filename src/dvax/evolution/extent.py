"""Where a trajectory has been: constants of a region are good only while it stays there."""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..programs.enclosure import is_enclosure


class Extent(NamedTuple):
    """Between what x_h and u_h stay, entry by entry: (low, high) each."""

    x: tuple[Tree, Tree]
    u: tuple[Tree, Tree]

    @classmethod
    def at_start(cls, x0: Tree, like: Tree) -> "Extent":
        """x_h has been at x₀ alone, and u_h nowhere."""
        low, high = (
            jtu.tree_map(lambda v, end=end: jnp.full_like(v, end), like)
            for end in (jnp.inf, -jnp.inf)
        )
        return cls((x0, x0), (low, high))

    @classmethod
    def of_enclosures(cls, x: Tree, u: Tree) -> "Extent":
        """What linear enclosures hold."""
        return cls(_ends(x), _ends(u))

    def over_rows(self) -> "Extent":
        """The least that holds all of those stacked along the first axis."""
        least, most = partial(jnp.min, axis=0), partial(jnp.max, axis=0)
        rows = ((least, self.x[0]), (most, self.x[1]), (least, self.u[0]), (most, self.u[1]))
        a, b, c, d = (jtu.tree_map(over, tree) for over, tree in rows)
        return Extent((a, b), (c, d))

    def joined(self, other: "Extent") -> "Extent":
        """The least that holds both; what is not a number stays one, and is inside of nothing."""
        least = lambda a, b: jtu.tree_map(jnp.minimum, a, b)  # noqa: E731
        most = lambda a, b: jtu.tree_map(jnp.maximum, a, b)  # noqa: E731
        (x0, x1), (u0, u1) = other
        return Extent(
            (least(self.x[0], x0), most(self.x[1], x1)),
            (least(self.u[0], u0), most(self.u[1], u1)),
        )


def _ends(enclosures: Tree) -> tuple[Tree, Tree]:
    low, high = (
        jtu.tree_map(lambda q, name=name: getattr(q, name), enclosures, is_leaf=is_enclosure)
        for name in ("lowest", "highest")
    )
    return low, high
