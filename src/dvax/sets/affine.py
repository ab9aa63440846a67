"""Several linear equations."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .. import _tree
from .._small_matrices import pseudoinverse, times
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from ._weights import has_uniform_weight, inverse_weights
from .abstract import AbstractSet

_ROUNDOFF_EXPONENT = 0.75
"""An equation is satisfied if its residual is at most eps^0.75 of its terms: 2e-12 in double
precision."""


class AffineSubspace(AbstractSet):
    """K = {y : E y = e}, with plain sums (E y)ₖ = Σᵢ Eₖᵢ yᵢ whatever the space's weights.

    proj_K(z) = z − R (E R)⁺ (E z − e) with R = diag(w)^{−1/2}. The pseudoinverse admits redundant
    equations. In a space with one weight for all entries it is computed once, with the set. It is
    differentiable in E as long as the rank of E is constant.

    **Arguments:** `E`: an array of shape (equations, *shape of y): a matrix where y is a vector;
    `e`: a vector, one value an equation.

    **Raises:** `dvax.InputError` if the equations are inconsistent or not finite. The projection is
    NaN if traced equations are inconsistent.

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
        self.E, self.e = checked_rows(name, E, e, "E", "e")
        rows, _ = normalised_conditions(self.E, self.e)
        self.pseudoinverse = jnp.linalg.pinv(rows)
        _tree.require(
            lambda: jax.jit(has_solution)(self.E, self.e),
            f"{name}(E, e)",
            (self.E, self.e),
            "E y = e must have a solution, or the set is empty and the law has no solution",
            "Remove or correct the equations that contradict the others",
        )

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        rows, values = normalised_conditions(self.E, self.e)
        if has_uniform_weight(space):
            back = self.pseudoinverse
        else:
            root = jnp.sqrt(inverse_weights(space, z)).reshape(-1)
            scaled, scale = normalise_rows(rows * root[None, :])
            back = root[:, None] * jnp.linalg.pinv(scaled) / scale[None, :]
        y = z.reshape(-1)
        # Iterative refinement: the second pass corrects the roundoff of a distant z.
        for _ in range(2):
            y = y - back @ (rows @ y - values)
        return jnp.where(_is_solution(rows, values, y), y, jnp.nan).reshape(jnp.shape(z))

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        return []

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        check_row_shapes("dvax.sets.AffineSubspace(E)", self.E, like)


def checked_rows(name: str, E: Any, e: Any, left: str, right: str) -> tuple[jax.Array, jax.Array]:
    """Return (E, e) as arrays; raise an `InputError` if their shapes or concrete values are wrong."""
    E = _tree.as_array(E, f"{name}({left})")
    e = _tree.as_array(e, f"{name}({right})")
    if jnp.ndim(E) < 1 or jnp.shape(e) != jnp.shape(E)[:1] or jnp.shape(E)[0] == 0:
        raise input_error(
            f"{name}({left}, {right})",
            f"shapes {jnp.shape(E)} and {jnp.shape(e)}",
            f"{left} must have one row, and {right} one number, for each condition",
            f"Give {left} the shape (conditions, *shape of y) and {right} (conditions,)",
        )
    _tree.require(
        lambda: _tree.has_only_finite(E) and not np.any(np.isnan(e)),
        f"{name}({left}, {right})",
        (E, e),
        f"{left} must be finite and {right} must not be NaN",
        "Correct the entries that are not",
    )
    return E, e


def check_row_shapes(name: str, E: jax.Array, like: Tree) -> None:
    """Raise an `InputError` unless the rows of E are shaped like the element `like`."""
    if isinstance(like, tuple) or jnp.shape(E)[1:] != jnp.shape(like):
        raise input_error(
            name,
            f"shape {jnp.shape(E)}",
            f"every row must have the shape {_tree.shapes(like)} of y = P u",
            "Give it the shape (conditions, *shape of y)",
        )


def normalised_conditions(E: Any, e: Any) -> tuple[jax.Array, jax.Array]:
    """Return the same conditions as a matrix with rows of length one; zero rows are unchanged."""
    rows, scale = normalise_rows(E.reshape(E.shape[0], -1))
    return rows, e / scale


def has_solution(E: jax.Array, e: jax.Array) -> jax.Array:
    """Return whether E y = e has a solution, up to roundoff."""
    rows, values = normalised_conditions(E, e)
    back = pseudoinverse(rows)
    y = times(back, values)
    # Iterative refinement as in `project`: nearly parallel rows amplify roundoff.
    for _ in range(2):
        y = y - times(back, times(rows, y) - values)
    return jnp.all(jnp.isfinite(e)) & _is_solution(rows, values, y)


def normalise_rows(rows: Any) -> tuple[jax.Array, jax.Array]:
    """Return (rows scaled to length one, the scale factors); zero rows are unchanged."""
    # Divide by the largest entry first: the squares of very small entries would underflow.
    # The scale does not depend on it. Where XLA computes the rows twice, with other roundoff, none may
    # equal the maximum, and its derivative would be NaN.
    largest = lax.stop_gradient(jnp.max(jnp.abs(rows), axis=1, initial=0.0))
    largest = jnp.where(largest == 0, 1.0, largest)
    square = jnp.sum((rows / largest[:, None]) ** 2, axis=1)
    scale = largest * jnp.sqrt(jnp.where(square == 0, 1.0, square))
    return rows / scale[:, None], scale


def _is_solution(rows: jax.Array, values: jax.Array, y: jax.Array) -> jax.Array:
    slack = jnp.finfo(jnp.result_type(y)).eps ** _ROUNDOFF_EXPONENT
    return jnp.all(
        jnp.abs(times(rows, y) - values) <= slack * (jnp.abs(values) + jnp.linalg.norm(y))
    )
