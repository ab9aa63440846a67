"""Ellipsoids, with axes along the coordinates or rotated."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..spaces import AbstractSpace
from ._root import differentiable_root
from ._weights import has_uniform_weight, inverse_weights
from .abstract import AbstractSet

_MAX_ITERATIONS = 100


class Ellipsoid(AbstractSet):
    """K = {y : (y − c)ᵀ S⁻¹ (y − c) ≤ 1}, with plain sums whatever the space's weights.

    With ζ = z − c outside, proj_K(z) = c + S (S + λW⁻¹)⁻¹ ζ, where λ > 0 is the root of the secular
    equation ‖S^{1/2}(S + λW⁻¹)⁻¹ζ‖ = 1. Newton's method is applied to the reciprocal of its left side,
    which is nearly linear, and increases monotonically to the root (Moré and Sorensen 1983). A point
    on the surface counts as active.

    **Arguments:** `center`: an array of the shape of y, or a number for all entries; and one of
    `radii` > 0: the half-axes along the coordinates, S = diag(radii²), a number or an array of the
    shape of y; `shape`: the symmetric positive definite matrix S, if y is a vector.

    **Raises:** `dvax.InputError` if a radius is not positive and finite, or S is not symmetric
    positive definite. The projection is NaN if traced data violate these conditions.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K = dvax.sets.Ellipsoid(0.0, radii=jnp.array([2.0, 1.0]))
    >>> K.project(jnp.array([5.0, 0.0]), dvax.spaces.Euclidean(2)).tolist()
    [2.0, 0.0]

    ```
    """

    center: jax.Array
    radii: jax.Array | None
    shape: jax.Array | None
    principal: tuple[jax.Array, jax.Array] | None

    def __init__(self, center: Any, radii: Any = None, *, shape: Any = None):
        name = "dvax.sets.Ellipsoid"
        self.center = _tree.as_array(center, f"{name}(center)")
        _tree.require(
            lambda: _tree.has_only_finite(self.center),
            f"{name}(center)",
            self.center,
            "the entries of the center must be finite",
            "Correct the entries that are not",
        )
        if (radii is None) == (shape is None):
            raise input_error(
                f"{name}(radii, shape)",
                "neither" if radii is None else "both",
                "an ellipsoid is defined by its half-axes along the coordinates or by its matrix S",
                "Give one of radii= and shape=",
            )
        self.radii = self.shape = self.principal = None
        if radii is not None:
            self.radii = _checked_radii(f"{name}(radii)", radii)
            return
        self.shape = _checked_matrix(f"{name}(shape)", shape)
        # Computed once for spaces with one weight for all entries: a solver's loop reuses the axes.
        self.principal = _principal_axes(self.shape)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        offset = z - jnp.broadcast_to(self.center, z.shape)
        inverse_w = inverse_weights(space, z)
        if self.radii is not None:
            radii = jnp.broadcast_to(self.radii, z.shape)
            inside, on_surface = _project_axis_aligned(radii, offset, inverse_w)
        else:
            principal = self.principal if has_uniform_weight(space) else None
            inside, on_surface = _project_rotated(self.shape, principal, offset, inverse_w)
        # Inside, return z itself: c + (z − c) has roundoff for a distant center.
        return jnp.where(inside, z, self.center + on_surface)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        offset = z - jnp.broadcast_to(self.center, z.shape)
        if self.radii is not None:
            return [1.0 - _norm(offset / self.radii)]
        return [1.0 - offset @ jnp.linalg.solve(self.shape, offset)]

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        data = self.shape if self.radii is None else self.radii
        shape, given = _tree.shapes(like), () if data is None else data.shape
        fits = not isinstance(like, tuple) and jnp.shape(self.center) in ((), shape)
        if self.shape is None:
            fits = fits and given in ((), shape)
        else:
            fits = fits and len(shape) == 1 and given == (shape[0], shape[0])
        if not fits:
            raise input_error(
                "dvax.sets.Ellipsoid(center, radii, shape)",
                f"shapes {jnp.shape(self.center)} and {given}",
                f"center and radii must have the shape {shape} of y = P u or be numbers; "
                "a matrix acts on vectors",
                "Use dvax.sets.Product for one ellipsoid a part",
            )


def _project_axis_aligned(
    radii: jax.Array, offset: jax.Array, inverse_w: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return (whether inside, projection − c) for the diagonal S = diag(radii²)."""
    inside = _norm(offset / radii) < 1.0
    offset = jnp.where(inside, radii, offset)  # inside, any point for which a root exists
    square = radii * radii / inverse_w

    def surface(lam: jax.Array) -> jax.Array:
        return _norm(offset / radii * (square / (square + lam))) - 1.0

    fixed = lax.stop_gradient((offset * jnp.sqrt(1.0 / inverse_w), jnp.sqrt(square)))
    lam = differentiable_root(surface, lambda: _multiplier(*fixed))
    return inside, offset * (square / (square + lam))


def _project_rotated(
    matrix: Any,
    principal: tuple[jax.Array, jax.Array] | None,
    offset: jax.Array,
    inverse_w: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Return (whether inside, projection − c) for a full matrix S.

    The multiplier is computed in the principal axes, whose derivatives need not exist. Everything
    that is differentiated is computed in the given coordinates.
    """
    inside = offset @ jnp.linalg.solve(matrix, offset) < 1.0
    # Inside, any point for which a root exists: this corner is on or outside the surface.
    corner = jnp.sqrt(jnp.sum(jnp.diagonal(matrix))) * jnp.ones_like(offset)
    offset = jnp.where(inside, lax.stop_gradient(corner), offset)

    def at(lam: jax.Array) -> jax.Array:
        return jnp.linalg.solve(matrix + lam * jnp.diag(inverse_w), offset)

    def surface(lam: jax.Array) -> jax.Array:
        dual = at(lam)
        return jnp.sqrt(dual @ (matrix @ dual)) - 1.0

    def find() -> jax.Array:
        root_w = 1.0 / jnp.sqrt(inverse_w)
        axes, lengths = principal or _principal_axes(root_w[:, None] * matrix * root_w[None, :])
        return _multiplier(axes.T @ (root_w * offset), lengths)

    return inside, matrix @ at(differentiable_root(surface, find))


def _multiplier(zeta: jax.Array, lengths: jax.Array) -> jax.Array:
    """Return λ ≥ 0 with ‖lengths ζ/(lengths² + λ)‖ = 1, for ζ outside the ellipsoid."""
    unit = jnp.max(lengths)
    zeta, lengths = zeta / unit, lengths / unit
    square = lengths * lengths

    def newton_step(state: tuple) -> tuple:
        _, lam, count = state
        y = lengths * zeta / (square + lam)
        norm = _norm(y)
        share = y / norm
        step = (norm - 1.0) / jnp.sum(share * share / (square + lam))
        return lam, lam + step, count + 1

    def is_increasing(state: tuple) -> jax.Array:
        before, lam, count = state
        return (lam > before) & (count < _MAX_ITERATIONS)

    # Replacing every half-axis by the longest one gives a lower bound of λ.
    start = jnp.maximum(_norm(lengths * zeta) - 1.0, 0.0)
    _, lam, _ = lax.while_loop(is_increasing, newton_step, newton_step((start, start, 0)))
    return jnp.maximum(lam, 0.0) * unit * unit


def _checked_radii(name: str, given: Any) -> jax.Array:
    radii = _tree.as_array(given, name)
    _tree.require(
        lambda: np.all((np.asarray(radii) > 0) & np.isfinite(radii)),
        name,
        radii,
        "half-axes must be positive and finite, or the set is flat, empty or unbounded",
        "Use dvax.sets.Product with a dvax.sets.Box for fixed or unbounded directions",
    )
    # A traced half-axis that is wrong becomes NaN, so that a solve stops.
    return radii if _tree.is_concrete(radii) else jnp.where(radii > 0, radii, jnp.nan)


def _checked_matrix(name: str, given: Any) -> jax.Array:
    matrix = _tree.as_array(given, name)
    if jnp.ndim(matrix) != 2 or matrix.shape[0] != matrix.shape[1]:
        raise input_error(
            name,
            f"shape {jnp.shape(matrix)}",
            "the matrix of an ellipsoid must be square",
            "Use radii= for half-axes along the coordinates",
        )
    _tree.require(
        lambda: (
            jnp.allclose(matrix, matrix.T, rtol=1e-6, atol=0.0)
            & (jnp.linalg.eigvalsh(matrix)[0] > 0)
            & jnp.all(jnp.isfinite(matrix))
        ),
        name,
        matrix,
        "the matrix of an ellipsoid must be symmetric and positive definite",
        "Symmetrise it, or add a multiple of the identity",
    )
    symmetric = 0.5 * (matrix + matrix.T)
    smallest = jnp.linalg.eigvalsh(lax.stop_gradient(symmetric))[0]
    return jnp.where(smallest > 0, symmetric, jnp.nan)


def _principal_axes(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return (axes, half-axes) of the ellipsoid with this matrix."""
    squares, axes = jnp.linalg.eigh(lax.stop_gradient(matrix))
    return axes, jnp.sqrt(squares)


def _norm(v: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(v * v))
