"""A known by its products and by where its numerical range lies."""

import abc
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..errors import InputError, InputProblem
from ..spaces import AbstractSpace
from .abstract import AbstractGenerator, Arc, Growth
from .bend import normwise_bend
from .faber import FaberPropagator, Range, propagator


class AbstractMatrixFree(AbstractGenerator):
    """A generator of your own, through two methods: `apply`, the product Av, and `numerical_range`, a
    rectangle that contains ⟨Av, v⟩/‖v‖² for all complex v.

    All else follows. e^{hA} and the φ-functions are Faber series of products, summed to rounding
    (`dvax.generators.faber`); the growth bound is M = 1 with ω the right side of the rectangle, since
    d/dt ½‖e^{At}v‖² = Re⟨A e^{At}v, e^{At}v⟩ ≤ ω‖e^{At}v‖². Both rest on the rectangle: one that is
    too small makes the series diverge, one that is too large costs products. The number of products
    for h‖A‖ large is about 6√(h‖A‖) where A is self-adjoint (height 0), and h‖A‖ where it is skew.

    `apply` must be linear and traceable by JAX; anything that it depends on and that is a field of the
    class can be differentiated, forward and backward.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> class Chain(dvax.generators.AbstractMatrixFree):
    ...     "A v = v_{i−1} − 2vᵢ + v_{i+1} between two walls: self-adjoint, eigenvalues in [−4, 0]."
    ...     def apply(self, v):
    ...         padded = jnp.pad(v, 1)
    ...         return padded[:-2] - 2.0 * v + padded[2:]
    ...     def numerical_range(self):
    ...         return dvax.generators.Range(-4.0, 0.0)
    >>> v = jnp.sin(jnp.pi * jnp.arange(1.0, 10.0) / 10)    # an eigenvector
    >>> rate = -4.0 * jnp.sin(jnp.pi / 20) ** 2
    >>> bool(jnp.allclose(Chain().semigroup(3.0, v), jnp.exp(3.0 * rate) * v, atol=1e-5))
    True

    ```
    """

    @abc.abstractmethod
    def numerical_range(self) -> Range:
        """The rectangle, and the inner product in which it is meant."""

    def propagator(self, h: Any, terms: int) -> FaberPropagator:
        h = jnp.asarray(h, float) if isinstance(h, int | float) else h
        return propagator(self, self.numerical_range(), h, terms)

    def check(self, space: AbstractSpace) -> None:
        v = space.zeros()
        try:
            out = jax.eval_shape(self.apply, v)
        except (TypeError, ValueError) as error:
            raise self._misfit(v, f"which raises {type(error).__name__}: {error}") from error
        if not _tree.same_shape(out, v):
            raise self._misfit(v, f"which gives shape {_tree.shapes(out)}")

    def adjoint(self, space: AbstractSpace) -> "Adjoint":
        return Adjoint(self, space)

    def growth(self, space: AbstractSpace) -> Growth:
        # The norm of the space lies between two multiples of the one in which the range is meant.
        found = self.numerical_range()
        ratios = jtu.tree_map(
            lambda w, own: jnp.ravel(w / own), *_alike(space.weights(), found.weights)
        )
        ratio = jnp.concatenate(jtu.tree_leaves(ratios))
        apart = found.spread * jnp.max(ratio) / jnp.min(ratio)
        return Growth(jnp.sqrt(apart), jnp.asarray(found.high))

    def bend(self, arc: Arc, space: AbstractSpace, growth: Growth) -> Tree:
        return normwise_bend(self, arc, space, growth)

    def _misfit(self, v: Tree, what: str) -> InputError:
        return InputError(
            InputProblem(
                f"{type(self).__name__}.apply",
                f"v of shape {_tree.shapes(v)}, {what}",
                "a generator maps the state space to itself",
                "Mend apply, or name the space that you mean: state_space= of dvax.Problem",
            )
        )


class Adjoint(AbstractMatrixFree):
    """A* of a matrix-free A in a space: W⁻¹AᵀW for its weights W."""

    of: AbstractMatrixFree
    space: AbstractSpace

    def apply(self, v: Tree) -> Tree:
        w = self.space.weights()
        weighted = jtu.tree_map(jnp.multiply, v, w)
        (out,) = jax.linear_transpose(self.of.apply, v)(weighted)
        return jtu.tree_map(jnp.divide, out, w)

    def numerical_range(self) -> Range:
        """That of A, which is its own mirror image. With v = W⁻¹W₀r it is ⟨A*v, v⟩ in the inner product
        of W²/W₀ that equals ⟨Ar, r⟩ in that of W₀, and ‖v‖ = ‖r‖."""
        found = self.of.numerical_range()
        w, own = _alike(self.space.weights(), found.weights)
        return found._replace(weights=jtu.tree_map(lambda w, own: w * w / own, w, own))


def _alike(a: Tree, b: Tree) -> tuple[Tree, Tree]:
    """Two trees of weights with one structure: one number stands for any."""
    if jtu.tree_structure(a) == jtu.tree_structure(b):
        return a, b
    if isinstance(b, tuple):
        return jtu.tree_map(lambda _: a, b), b
    return a, jtu.tree_map(lambda _: b, a)
