"""Matrix-free generators, defined by products Av and an enclosure of the numerical range."""

import abc
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..errors import InputError, input_error
from ..spaces import AbstractSpace
from .abstract import AbstractGenerator, FlowStep, Growth
from .chord_deviation import normwise_chord_deviation
from .faber import FaberPropagator, Range, faber_propagator


class AbstractMatrixFree(AbstractGenerator):
    """The base class of user-defined generators.

    A subclass defines two methods: `apply`, the product Av, and `numerical_range`, a rectangle that
    contains ⟨Av, v⟩/‖v‖² for all complex v. e^{hA} and the φ-functions are Faber series of products,
    summed to roundoff (`dvax.generators.faber`). The growth bound is M = 1, and ω is the right side of
    the rectangle, since d/dt ½‖e^{At}v‖² = Re⟨A e^{At}v, e^{At}v⟩ ≤ ω‖e^{At}v‖². Both depend on the
    rectangle: if it is too small the series diverges; if it is too large there are more products than
    necessary. For large h‖A‖ their number is about 6√(h‖A‖) if A is self-adjoint (height 0), and h‖A‖
    if it is skew-adjoint.

    `apply` must be linear and traceable by JAX. Fields of the class that it depends on can be
    differentiated in forward and reverse mode.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> class Chain(dvax.generators.AbstractMatrixFree):
    ...     "A v = v_{i−1} − 2vᵢ + v_{i+1}, fixed ends: self-adjoint, eigenvalues in [−4, 0]."
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
        """Return the rectangle, and the inner product to which it refers."""

    def propagator(self, h: Any, terms: int) -> FaberPropagator:
        h = jnp.asarray(h, float) if isinstance(h, int | float) else h
        return faber_propagator(self, self.numerical_range(), h, terms)

    def check(self, space: AbstractSpace) -> None:
        v = space.like()
        try:
            out = jax.eval_shape(self.apply, v)
        except (TypeError, ValueError) as error:
            raise self._shape_error(v, f"which raises {type(error).__name__}: {error}") from error
        if not _tree.same_shape(out, v):
            raise self._shape_error(v, f"which gives shape {_tree.shapes(out)}")

    def adjoint(self, space: AbstractSpace) -> "Adjoint":
        return Adjoint(self, space)

    def growth(self, space: AbstractSpace) -> Growth:
        # The norm of the space is equivalent to the norm of the enclosure, with this squared ratio.
        enclosure = self.numerical_range()
        ratios = jtu.tree_map(
            lambda w, w0: jnp.ravel(w / w0), *_same_structure(space.weights(), enclosure.weights)
        )
        ratio = jnp.concatenate(jtu.tree_leaves(ratios))
        squared_ratio = enclosure.spread * jnp.max(ratio) / jnp.min(ratio)
        return Growth(jnp.sqrt(squared_ratio), jnp.asarray(enclosure.high))

    def chord_deviation(self, step: FlowStep, space: AbstractSpace, growth: Growth) -> Tree:
        return normwise_chord_deviation(self, step, space, growth)

    def _shape_error(self, v: Tree, what: str) -> InputError:
        return input_error(
            f"{type(self).__name__}.apply",
            f"v of shape {_tree.shapes(v)}, {what}",
            "a generator must map the state space to itself",
            "Correct apply, or pass state_space= to dvax.Problem",
        )


class Adjoint(AbstractMatrixFree):
    """The adjoint A* = W⁻¹AᵀW of a matrix-free A in a space with weights W."""

    of: AbstractMatrixFree
    space: AbstractSpace

    def apply(self, v: Tree) -> Tree:
        w = self.space.weights()
        weighted = jtu.tree_map(jnp.multiply, v, w)
        (out,) = jax.linear_transpose(self.of.apply, v)(weighted)
        return jtu.tree_map(jnp.divide, out, w)

    def numerical_range(self) -> Range:
        """Return the enclosure of A, which is symmetric to the real axis, with other weights.

        For v = W⁻¹W₀r, ⟨A*v, v⟩ in the inner product of W²/W₀ equals the conjugate of ⟨Ar, r⟩ in that
        of W₀, and ‖v‖ = ‖r‖."""
        enclosure = self.of.numerical_range()
        w, w0 = _same_structure(self.space.weights(), enclosure.weights)
        return enclosure._replace(weights=jtu.tree_map(lambda w, w0: w * w / w0, w, w0))


def _same_structure(a: Tree, b: Tree) -> tuple[Tree, Tree]:
    """Return both trees of weights with the same structure: a single number is repeated."""
    if jtu.tree_structure(a) == jtu.tree_structure(b):
        return a, b
    if isinstance(b, tuple):
        return jtu.tree_map(lambda _: a, b), b
    return a, jtu.tree_map(lambda _: b, a)
