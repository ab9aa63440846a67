"""Several linear equations."""

from typing import Any

import jax
import jax.numpy as jnp

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from ._weights import even, inverse_weights
from .abstract import AbstractSet

_ROUNDING = 0.75
"""Equations hold where they do to eps^0.75 of what enters them: 2e-12 in double precision."""


class AffineSubspace(AbstractSet):
    """K = {y : E y = e}, with plain sums (E y)ₖ = Σᵢ Eₖᵢ yᵢ whatever the space's weights.

    proj_K(z) = z − R (E R)⁺ (E z − e) with R = diag(w)^{−1/2}, through the pseudoinverse, so that
    equations may repeat each other. In a space without weights it is found once, with the set; it
    is differentiable in E while the rank of E stays what it is.

    **Arguments:** `E`: an array of shape (equations, *shape of y): a matrix where y is a vector;
    `e`: a vector, one value an equation.

    **Raises:** `dvax.InputError` where the equations contradict each other, or are not finite.
    Traced ones that turn out to do so project to NaN.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.AffineSubspace(jnp.array([[1.0, 1.0, 0.0]]), jnp.array([1.0]))
    >>> y = K.project(jnp.array([4.0, 3.0, 7.0]), dvax.spaces.Euclidean(3))
    >>> [round(float(v), 12) for v in y + 1.0]
    [2.0, 1.0, 8.0]

    ```
    """

    E: jax.Array
    e: jax.Array
    pseudoinverse: jax.Array

    def __init__(self, E: Any, e: Any):
        name = "dvax.sets.AffineSubspace"
        self.E, self.e = linear_rows(name, E, e, "E", "e")
        rows, _ = unit_rows(self.E, self.e)
        self.pseudoinverse = jnp.linalg.pinv(rows)
        _tree.require(
            lambda: consistent(self.E, self.e),
            f"{name}(E, e)",
            (self.E, self.e),
            "E y = e has a solution, or the set is empty and the law has none",
            "Drop or mend the equations that contradict the others",
        )

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        rows, values = unit_rows(self.E, self.e)
        if even(space):
            back = self.pseudoinverse
        else:
            root = jnp.sqrt(inverse_weights(space, z)).reshape(-1)
            scaled, scale = unit(rows * root[None, :])
            back = root[:, None] * jnp.linalg.pinv(scaled) / scale[None, :]
        y = z.reshape(-1)
        # Twice: what rounding leaves of a far-away z is seen from nearby.
        for _ in range(2):
            y = y - back @ (rows @ y - values)
        return jnp.where(_solved(rows, values, y), y, jnp.nan).reshape(jnp.shape(z))

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        return []

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        fits_rows("dvax.sets.AffineSubspace(E)", self.E, like)


def linear_rows(name: str, E: Any, e: Any, left: str, right: str) -> tuple[jax.Array, jax.Array]:
    """(E, e) of conditions on E y, looked at as far as their shapes and values are known."""
    E = _tree.as_array(E, f"{name}({left})")
    e = _tree.as_array(e, f"{name}({right})")
    if jnp.ndim(E) < 1 or jnp.shape(e) != jnp.shape(E)[:1] or jnp.shape(E)[0] == 0:
        raise InputError(
            InputProblem(
                f"{name}({left}, {right})",
                f"shapes {jnp.shape(E)} and {jnp.shape(e)}",
                f"{left} has a row a condition and {right} a number a condition",
                f"Give {left} the shape (conditions, *shape of y) and {right} (conditions,)",
            )
        )
    _tree.require(
        lambda: jnp.all(jnp.isfinite(E)) & ~jnp.any(jnp.isnan(e)),
        f"{name}({left}, {right})",
        (E, e),
        "conditions are made of numbers",
        "Mend the entries that are not",
    )
    return E, e


def fits_rows(name: str, E: jax.Array, like: Tree) -> None:
    """Raise an `InputError` unless the rows of E are shaped like the element `like`."""
    if isinstance(like, tuple) or jnp.shape(E)[1:] != jnp.shape(like):
        raise InputError(
            InputProblem(
                name,
                f"shape {jnp.shape(E)}",
                f"every row acts on y = P u, of shape {_tree.shapes(like)}",
                "Give it the shape (conditions, *shape of y)",
            )
        )


def unit_rows(E: jax.Array, e: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The same conditions with rows of length one, as a matrix; rows that are zero stay so."""
    rows, scale = unit(E.reshape(E.shape[0], -1))
    return rows, e / scale


def consistent(E: jax.Array, e: jax.Array) -> jax.Array:
    """Whether E y = e has a solution, up to rounding."""
    rows, values = unit_rows(E, e)
    back = jnp.linalg.pinv(rows)
    y = back @ values
    # Corrected as `project` does: rows that are nearly parallel leave much of the rounding.
    for _ in range(2):
        y = y - back @ (rows @ y - values)
    return jnp.all(jnp.isfinite(e)) & _solved(rows, values, y)


def unit(rows: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(rows scaled to length one, what they were divided by); rows that are zero stay so."""
    # The largest entry is taken out first: squares of very small ones would vanish.
    largest = jnp.max(jnp.abs(rows), axis=1, initial=0.0)
    largest = jnp.where(largest == 0, 1.0, largest)
    square = jnp.sum((rows / largest[:, None]) ** 2, axis=1)
    scale = largest * jnp.sqrt(jnp.where(square == 0, 1.0, square))
    return rows / scale[:, None], scale


def _solved(rows: jax.Array, values: jax.Array, y: jax.Array) -> jax.Array:
    slack = jnp.finfo(jnp.result_type(y)).eps ** _ROUNDING
    return jnp.all(jnp.abs(rows @ y - values) <= slack * (jnp.abs(values) + jnp.linalg.norm(y)))
