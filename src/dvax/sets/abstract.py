"""What a closed convex set owes."""

import abc

import equinox as eqx
import jax

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace


class AbstractSet(eqx.Module):
    """A nonempty closed convex set K in a Hilbert space.

    **The convention at kinks.** The projection is differentiable except where its argument z meets
    the boundary of K from outside or from inside. There `jax.grad` and `jax.jvp` return the
    derivative of the *constrained* side: a point exactly on a bound counts as held by it. This one
    choice, made here for every set, is what every derivative in dvax inherits.

    **Derivatives** are with respect to the set's own data as well, since K may move. Where the
    projection needs an iteration, it only finds which face or multiplier holds the point, with
    derivatives cut; what is differentiated is the formula, or the equation, that holds there.

    **Data that are traced** cannot be looked at when the set is made. Where they turn out to describe
    no set, the projection is NaN or infinite: it never passes for a point.
    """

    @abc.abstractmethod
    def project(self, z: Tree, space: AbstractSpace) -> Tree:
        """proj_K(z), the nearest point of K in the norm of `space`."""

    @abc.abstractmethod
    def switches(self, z: Tree, space: AbstractSpace) -> list[jax.Array] | None:
        """Continuous functions of z, proj_K being smooth in z wherever none of them is zero: a
        trajectory's kinks are where one of them changes its sign. None where they are not known."""

    @abc.abstractmethod
    def intervals(self, like: Tree) -> tuple[Tree, Tree] | None:
        """(lower, upper) with K = {lower ≤ y ≤ upper} pointwise, shaped like `like`; else None."""

    @abc.abstractmethod
    def check(self, like: Tree) -> None:
        """Raise an `InputError` where K is empty or does not fit elements shaped like `like`."""

    def distance(self, z: Tree, space: AbstractSpace) -> jax.Array:
        """d_K(z) = ‖z − proj_K(z)‖."""
        return space.norm(_tree.sub(z, self.project(z, space)))

    def contains(self, y: Tree, space: AbstractSpace, tol: float = 0.0) -> jax.Array:
        """Whether d_K(y) ≤ tol."""
        return self.distance(y, space) <= tol

    def normal_cone_residual(self, y: Tree, xi: Tree, space: AbstractSpace) -> jax.Array:
        """‖y − proj_K(y + ξ)‖: zero exactly when ξ ∈ N_K(y) (paper, thm:equivalence_prelim)."""
        return space.norm(_tree.sub(y, self.project(_tree.add(y, xi), space)))
