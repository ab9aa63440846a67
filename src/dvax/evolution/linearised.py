"""The linearisation A + J of the right-hand side at one point, J = Df̃, and its propagators."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..errors import input_error
from ..generators import AbstractGenerator, AbstractPropagator, Diagonal, Scalar, Zero
from ..generators.dense import MatrixPropagator
from ..generators.phi import flow_factors, phi_matrix, phi_scalar
from ..generators.scalar import ElementwisePropagator
from ..programs.matrix import diagonal_of, matrix_of

_MAX_DENSE = 256
"""Largest number of unknowns for which the matrix A + J is formed."""


class AbstractLinear(eqx.Module):
    """The linear operator A + J, where J = Df̃ at some point."""

    @abc.abstractmethod
    def propagator(self, h: Any, terms: int) -> AbstractPropagator:
        """Return the flow of x' = (A + J)x + p over h, for polynomials p with `terms` coefficients."""

    @abc.abstractmethod
    def apply(self, v: Tree) -> Tree:
        """Return J v."""


class ElementwiseLinear(AbstractLinear):
    """A + J with A and J diagonal."""

    A: jax.Array
    J: jax.Array

    def propagator(self, h: Any, terms: int) -> ElementwisePropagator:
        return ElementwisePropagator(flow_factors(h, phi_scalar(h * (self.A + self.J), terms)))

    def apply(self, v: Tree) -> Tree:
        return self.J * v


class MatrixLinear(AbstractLinear):
    """A + J as dense matrices that act on the flattened state."""

    A: jax.Array
    J: jax.Array

    def propagator(self, h: Any, terms: int) -> "FlatPropagator":
        factors = flow_factors(h, phi_matrix(h * (self.A + self.J), terms))
        return FlatPropagator(MatrixPropagator(factors))

    def apply(self, v: Tree) -> Tree:
        flat, back = jax.flatten_util.ravel_pytree(v)
        return back(self.J @ flat)


class NoJacobian(AbstractLinear):
    """The choice J = −A, for explicit methods: A + J = 0, and f̃ includes Ax."""

    A: AbstractGenerator

    def propagator(self, h: Any, terms: int) -> AbstractPropagator:
        return Zero().propagator(h, terms)

    def apply(self, v: Tree) -> Tree:
        return jtu.tree_map(jnp.negative, self.A.apply(v))


class FlatPropagator(AbstractPropagator):
    """A propagator of flat vectors, applied to states of any shape."""

    of: AbstractPropagator

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        flat, back = jax.flatten_util.ravel_pytree(x0)
        return back(self.of.step(flat, tuple(jax.flatten_util.ravel_pytree(v)[0] for v in c)))


def linearise(generator: AbstractGenerator, jvp: Any, x: Tree) -> AbstractLinear:
    """Return A + J from the derivative `jvp`: v ↦ Jv at x.

    **Raises:** `dvax.InputError` if A and J are not both diagonal and x is too large for a matrix.
    """
    if isinstance(generator, Zero | Scalar | Diagonal) and isinstance(x, jax.Array):
        entries = diagonal_of(jvp, x)
        if entries is not None:
            A = jnp.broadcast_to(generator.apply(jnp.ones_like(x)), x.shape)
            return ElementwiseLinear(A, finite(entries))
    size = sum(leaf.size for leaf in jtu.tree_leaves(x))
    if size > _MAX_DENSE:
        raise input_error(
            "dvax.solve(method=dvax.ExpRosenbrock())",
            f"{size} unknowns that A or f couples",
            f"it forms the matrix A + Df, which may have at most {_MAX_DENSE} unknowns unless A is "
            "a number or diagonal and f acts point by point",
            "Use dvax.Implicit(), or the default method with more steps",
        )
    return MatrixLinear(matrix_of(generator.apply, x), finite(matrix_of(jvp, x)))


def finite(tree: Tree) -> Tree:
    """Return 0 in the place of entries that are not finite, as those of the derivative of √max(x, 0) at
    0: f̃ − Jx is exact for any J, and the defect says how long steps may be."""
    return jtu.tree_map(lambda leaf: jnp.where(jnp.isfinite(leaf), leaf, 0.0), tree)
