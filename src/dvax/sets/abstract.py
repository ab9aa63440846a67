"""The abstract closed convex set."""

import abc

import equinox as eqx
import jax

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace


class AbstractSet(eqx.Module):
    """A nonempty closed convex set K in a Hilbert space.

    **The convention at kinks.** The projection of z is differentiable unless z lies on the boundary
    of K (or of a face). There `jax.grad` and `jax.jvp` return the derivative of the *constrained*
    side: a point exactly on a bound counts as active. Every set follows this convention, and every
    derivative in dvax inherits it.

    **Derivatives** exist with respect to the data of the set as well, since K may depend on time and
    parameters. Where a projection iterates, the iteration only determines the active face or the
    multiplier and is not differentiated; the derivative is that of the formula, or of the equation,
    that is valid on that face.

    **Traced data** cannot be checked when the set is constructed. If they describe an empty set, the
    projection is NaN or infinite, and so is never mistaken for a point of K.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> K, space = dvax.sets.Ball(jnp.zeros(2), 1.0), dvax.spaces.Euclidean(2)
    >>> isinstance(K, dvax.sets.AbstractSet)
    True
    >>> y = K.project(jnp.array([3.0, 4.0]), space)
    >>> print(y.round(6), float(K.distance(jnp.array([3.0, 4.0]), space)))
    [0.6 0.8] 4.0
    >>> bool(K.normal_cone_residual(y, 3.0 * y, space) < 1e-12)      # 3y is normal to the ball at y
    True

    ```
    """

    @abc.abstractmethod
    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        """Return proj_K(z), the nearest point of K in the norm of `space`."""

    @abc.abstractmethod
    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array] | None:
        """Return continuous functions of z such that proj_K is smooth in z where none of them is zero.

        The kinks of a trajectory are the sign changes of these functions. Return None if no such
        functions are available."""

    @abc.abstractmethod
    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        """Return (lower, upper) with K = {lower ≤ y ≤ upper} pointwise, or None if K is not a box.

        The bounds have the shape of `like`."""

    @abc.abstractmethod
    def check(self, like: Tree) -> None:
        """Raise an `InputError` if K is empty or does not fit elements shaped like `like`."""

    def distance(self, z: Tree, space: AbstractSpace) -> jax.Array:
        """Return d_K(z) = ‖z − proj_K(z)‖."""
        return space.norm(_tree.sub(z, self.project(z, space)))

    def contains(self, y: Tree, space: AbstractSpace, tol: float = 0.0) -> jax.Array:
        """Return whether d_K(y) ≤ tol."""
        return self.distance(y, space) <= tol

    def normal_cone_residual(self, y: Tree, xi: Tree, space: AbstractSpace) -> jax.Array:
        """Return ‖y − proj_K(y + ξ)‖, zero exactly when ξ ∈ N_K(y) (paper, thm:equivalence_prelim)."""
        return space.norm(_tree.sub(y, self.project(_tree.add(y, xi), space)))
