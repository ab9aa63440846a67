"""f̃ taken apart at one point into what is linear in x, which joins A, and the rest."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.tree_util as jtu

from .._tree import Tree
from ..errors import InputError, InputProblem
from ..generators import AbstractGenerator, AbstractPropagator, Diagonal, Scalar, Zero
from ..generators.dense import MatrixPropagator
from ..generators.phi import flow_factors, phi_matrix, phi_scalar
from ..generators.scalar import ElementwisePropagator
from ..programs.matrix import diagonal_of, matrix_of

_DENSE = 256
"""Up to this many unknowns the matrix of A + J is formed."""


class AbstractLinear(eqx.Module):
    """A + J, where J = Df̃ at some point."""

    @abc.abstractmethod
    def propagator(self, h: Any, terms: int) -> AbstractPropagator:
        """The flow of x' = (A + J)x + p over h."""

    @abc.abstractmethod
    def apply(self, v: Tree) -> Tree:
        """J v."""


class ElementwiseLinear(AbstractLinear):
    """A and J both diagonal."""

    A: jax.Array
    J: jax.Array

    def propagator(self, h: Any, terms: int) -> ElementwisePropagator:
        return ElementwisePropagator(flow_factors(h, phi_scalar(h * (self.A + self.J), terms)))

    def apply(self, v: Tree) -> Tree:
        return self.J * v


class MatrixLinear(AbstractLinear):
    """A and J as matrices, on the entries of the state in a row."""

    A: jax.Array
    J: jax.Array

    def propagator(self, h: Any, terms: int) -> "FlatPropagator":
        factors = flow_factors(h, phi_matrix(h * (self.A + self.J), terms))
        return FlatPropagator(MatrixPropagator(factors))

    def apply(self, v: Tree) -> Tree:
        flat, back = jax.flatten_util.ravel_pytree(v)
        return back(self.J @ flat)


class NoJacobian(AbstractLinear):
    """J = −A: nothing is left to the propagator, and f̃ has Ax in it."""

    A: AbstractGenerator

    def propagator(self, h: Any, terms: int) -> AbstractPropagator:
        return Zero().propagator(h, terms)

    def apply(self, v: Tree) -> Tree:
        return jtu.tree_map(jnp.negative, self.A.apply(v))


class FlatPropagator(AbstractPropagator):
    """A propagator of vectors, for states of any shape."""

    of: AbstractPropagator

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        flat, back = jax.flatten_util.ravel_pytree(x0)
        return back(self.of.step(flat, tuple(jax.flatten_util.ravel_pytree(v)[0] for v in c)))


def split(generator: AbstractGenerator, change: Any, x: Tree) -> AbstractLinear:
    """A + J from the derivative v ↦ Jv at x.

    **Raises:** `dvax.InputError` where neither A and J are diagonal nor x is small enough for a matrix.
    """
    if isinstance(generator, Zero | Scalar | Diagonal) and isinstance(x, jax.Array):
        entries = diagonal_of(change, x)
        if entries is not None:
            A = jnp.broadcast_to(generator.apply(jnp.ones_like(x)), x.shape)
            return ElementwiseLinear(A, entries)
    size = sum(leaf.size for leaf in jtu.tree_leaves(x))
    if size > _DENSE:
        raise InputError(
            InputProblem(
                "dvax.solve(method=dvax.ExpRosenbrock())",
                f"{size} unknowns that A or f couples",
                f"its exponential is that of A + Df, which is formed as a matrix up to {_DENSE} "
                "unknowns, and beyond only where A is a number or diagonal and f acts point by point",
                "Use dvax.Implicit(), or the default method with more steps",
            )
        )
    return MatrixLinear(matrix_of(generator.apply, x), matrix_of(change, x))
