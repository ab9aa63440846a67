"""Ellipsoids, along the axes or turned."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from ._root import implicit
from ._weights import even, inverse_weights
from .abstract import AbstractSet

_MOST = 100


class Ellipsoid(AbstractSet):
    """K = {y : (y − c)ᵀ S⁻¹ (y − c) ≤ 1}, with plain sums whatever the space's weights.

    With ζ = z − c outside, proj_K(z) = c + S (S + λW⁻¹)⁻¹ ζ for the λ > 0 that puts it on the surface:
    the root of the secular equation ‖S^{1/2}(S + λW⁻¹)⁻¹ζ‖ = 1, by Newton's method on the reciprocal
    of its left side, which is nearly linear and climbs to the root from the left (Moré and Sorensen
    1983). A point on the surface is held by it.

    **Arguments:** `center`: an array of the shape of y, or a number that stands for a constant one;
    and one of `radii` > 0: the half-axes along the coordinates, S = diag(radii²), a number or an
    array of the shape of y; `shape`: the symmetric positive definite matrix S, where y is a vector.

    **Raises:** `dvax.InputError` where a radius is not positive and finite, or S is not symmetric
    positive definite. Traced ones that turn out so project to NaN.

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
            lambda: _tree.all_finite(self.center),
            f"{name}(center)",
            self.center,
            "a center is a point, with finite entries",
            "Mend the entries that are not",
        )
        if (radii is None) == (shape is None):
            raise InputError(
                InputProblem(
                    f"{name}(radii, shape)",
                    "neither" if radii is None else "both",
                    "the half-axes along the coordinates or the matrix S make the ellipsoid",
                    "Give one of radii= and shape=",
                )
            )
        self.radii = self.shape = self.principal = None
        if radii is not None:
            self.radii = _known_radii(f"{name}(radii)", radii)
            return
        self.shape = _known_matrix(f"{name}(shape)", shape)
        # Kept for spaces without weights, so that a solver's loop need not find them again.
        self.principal = _principal(self.shape)

    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        offset = z - jnp.broadcast_to(self.center, z.shape)
        inverse_w = inverse_weights(space, z)
        if self.radii is not None:
            inside, kept = _straight(jnp.broadcast_to(self.radii, z.shape), offset, inverse_w)
        else:
            known = self.principal if even(space) else None
            inside, kept = _turned(self.shape, known, offset, inverse_w)
        # Inside, z itself: c + (z − c) would lose digits for a far-away center.
        return jnp.where(inside, z, self.center + kept)

    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array]:
        offset = z - jnp.broadcast_to(self.center, z.shape)
        if self.radii is not None:
            return [1.0 - _norm(offset / self.radii)]
        return [1.0 - offset @ jnp.linalg.solve(self.shape, offset)]

    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        return None

    def check(self, like: Tree) -> None:
        own = self.shape if self.radii is None else self.radii
        shape, given = _tree.shapes(like), () if own is None else own.shape
        fits = not isinstance(like, tuple) and jnp.shape(self.center) in ((), shape)
        if self.shape is None:
            fits = fits and given in ((), shape)
        else:
            fits = fits and len(shape) == 1 and given == (shape[0], shape[0])
        if not fits:
            raise InputError(
                InputProblem(
                    "dvax.sets.Ellipsoid(center, radii, shape)",
                    f"shapes {jnp.shape(self.center)} and {given}",
                    f"center and radii have the shape {shape} of y = P u or are numbers; "
                    "a matrix acts on vectors",
                    "Use dvax.sets.Product for one ellipsoid a part",
                )
            )


def _straight(
    radii: jax.Array, offset: jax.Array, inverse_w: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(inside, the projection minus c), S diagonal: in the coordinates as they are."""
    inside = _norm(offset / radii) < 1.0
    offset = jnp.where(inside, radii, offset)  # where no root is asked for, one that exists
    square = radii * radii / inverse_w

    def surface(lam: jax.Array) -> jax.Array:
        return _norm(offset / radii * (square / (square + lam))) - 1.0

    fixed = lax.stop_gradient((offset * jnp.sqrt(1.0 / inverse_w), jnp.sqrt(square)))
    lam = implicit(surface, lambda: _multiplier(*fixed))
    return inside, offset * (square / (square + lam))


def _turned(
    matrix: Any,
    known: tuple[jax.Array, jax.Array] | None,
    offset: jax.Array,
    inverse_w: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """(inside, the projection minus c): the multiplier in the principal axes, whose derivatives
    need not exist, and all that is differentiated in the coordinates as they are."""
    inside = offset @ jnp.linalg.solve(matrix, offset) < 1.0
    # Where no root is asked for, one that exists: an axis' end is on or outside the surface.
    corner = jnp.sqrt(jnp.sum(jnp.diagonal(matrix))) * jnp.ones_like(offset)
    offset = jnp.where(inside, lax.stop_gradient(corner), offset)

    def at(lam: jax.Array) -> jax.Array:
        return jnp.linalg.solve(matrix + lam * jnp.diag(inverse_w), offset)

    def surface(lam: jax.Array) -> jax.Array:
        dual = at(lam)
        return jnp.sqrt(dual @ (matrix @ dual)) - 1.0

    def find() -> jax.Array:
        root_w = 1.0 / jnp.sqrt(inverse_w)
        axes, lengths = known or _principal(root_w[:, None] * matrix * root_w[None, :])
        return _multiplier(axes.T @ (root_w * offset), lengths)

    return inside, matrix @ at(implicit(surface, find))


def _multiplier(zeta: jax.Array, lengths: jax.Array) -> jax.Array:
    """The λ ≥ 0 with ‖lengths ζ/(lengths² + λ)‖ = 1, for a ζ outside."""
    unit = jnp.max(lengths)
    zeta, lengths = zeta / unit, lengths / unit
    square = lengths * lengths

    def climb(state: tuple) -> tuple:
        _, lam, count = state
        y = lengths * zeta / (square + lam)
        norm = _norm(y)
        share = y / norm
        step = (norm - 1.0) / jnp.sum(share * share / (square + lam))
        return lam, lam + step, count + 1

    def climbing(state: tuple) -> jax.Array:
        before, lam, count = state
        return (lam > before) & (count < _MOST)

    # The longest axis alone gives a bound from the left.
    start = jnp.maximum(_norm(lengths * zeta) - 1.0, 0.0)
    _, lam, _ = lax.while_loop(climbing, climb, climb((start, start, 0)))
    return jnp.maximum(lam, 0.0) * unit * unit


def _known_radii(name: str, given: Any) -> jax.Array:
    radii = _tree.as_array(given, name)
    _tree.require(
        lambda: jnp.all((radii > 0) & jnp.isfinite(radii)),
        name,
        radii,
        "half-axes are positive and finite, or the set is flat, empty or unbounded",
        "Use dvax.sets.Product with a dvax.sets.Box for the directions that are flat or free",
    )
    return jnp.where(radii > 0, radii, jnp.nan)


def _known_matrix(name: str, given: Any) -> jax.Array:
    matrix = _tree.as_array(given, name)
    if jnp.ndim(matrix) != 2 or matrix.shape[0] != matrix.shape[1]:
        raise InputError(
            InputProblem(
                name,
                f"shape {jnp.shape(matrix)}",
                "the matrix of an ellipsoid is square",
                "Use radii= for half-axes along the coordinates",
            )
        )
    _tree.require(
        lambda: (
            jnp.allclose(matrix, matrix.T, rtol=1e-6, atol=0.0)
            & (jnp.linalg.eigvalsh(matrix)[0] > 0)
            & jnp.all(jnp.isfinite(matrix))
        ),
        name,
        matrix,
        "the matrix of an ellipsoid is symmetric and positive definite",
        "Symmetrise it, or add a multiple of the identity",
    )
    symmetric = 0.5 * (matrix + matrix.T)
    smallest = jnp.linalg.eigvalsh(lax.stop_gradient(symmetric))[0]
    return jnp.where(smallest > 0, symmetric, jnp.nan)


def _principal(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(axes, half-axes) of the ellipsoid with this matrix."""
    squares, axes = jnp.linalg.eigh(lax.stop_gradient(matrix))
    return axes, jnp.sqrt(squares)


def _norm(v: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(v * v))
