"""Multiples A = a I of the identity."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace
from .abstract import AbstractGenerator, AbstractPropagator, FlowStep, Growth
from .phi import flow_factors, phi_scalar


class Scalar(AbstractGenerator):
    """A = a I on any space: e^{At} = e^{at} I, so M = 1 and ω = a.

    **Arguments:** `a`: a real number, in 1/time.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> print(f"{float(dvax.generators.Scalar(-1.0).semigroup(1.0, jnp.array(1.0))):.6f}")
    0.367879

    ```
    """

    a: jax.Array

    def __init__(self, a: Any):
        self.a = _tree.as_array(a, "dvax.generators.Scalar(a)")

    def apply(self, v: Tree) -> Tree:
        return _tree.scale(self.a, v)

    def propagator(self, h: Any, terms: int) -> "ElementwisePropagator":
        return ElementwisePropagator(flow_factors(h, phi_scalar(h * self.a, terms)))

    def check(self, space: AbstractSpace) -> None:
        if jnp.ndim(self.a) != 0:
            _tree.fits("dvax.generators.Scalar(a)", self.a, (), "state space")

    def adjoint(self, space: AbstractSpace) -> "Scalar":
        return self

    def growth(self, space: AbstractSpace) -> Growth:
        return Growth(jnp.ones(()), self.a)

    def chord_deviation(self, step: FlowStep, space: AbstractSpace, growth: Growth) -> Tree:
        h, *ends, c = step

        def bound(*leaves: Any) -> jax.Array:
            return elementwise_chord_deviation(self.a, h, *leaves)

        return jtu.tree_map(bound, *ends, *c)


def elementwise_chord_deviation(
    a: jax.Array, h: Any, x0: Any, x1: Any, c0: Any, c1: Any = None
) -> jax.Array:
    """Return a bound on the distance of x from its chord, for x' = ax + c₀ + c₁(t−t₀)/h with a real.

    x'' = x''(t₀)e^{a(t−t₀)} does not change its sign, so x' is monotone and x is convex or concave.
    The deviation is therefore at most h/4 |x'(t₁) − x'(t₀)|, and at most h²/8 max|x''|.
    """
    slope = jnp.zeros_like(c0) if c1 is None else c1
    v0, v1 = a * x0 + c0, a * x1 + c0 + slope
    w = jnp.maximum(jnp.abs(a * v0 + slope / h), jnp.abs(a * v1 + slope / h))
    return jnp.minimum(h / 4 * jnp.abs(v1 - v0), h**2 / 8 * w)


class ElementwisePropagator(AbstractPropagator):
    """A propagator with elementwise factors, for a scalar or diagonal A."""

    factors: tuple[jax.Array, ...]

    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        def one(*leaves: jax.Array) -> jax.Array:
            products = [f * leaf for f, leaf in zip(self.factors, leaves, strict=False)]
            return sum(products[1:], start=products[0])

        return jtu.tree_map(one, x0, *c)
