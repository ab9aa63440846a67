"""What a generator owes, and the propagator that a step of length h caches."""

import abc
from typing import Any, NamedTuple

import equinox as eqx

from .._tree import Tree
from ..spaces import AbstractSpace


class Growth(NamedTuple):
    """‖e^{At}‖ ≤ M e^{ωt} for all t ≥ 0 (paper, lem:semigroup_bound_prelim)."""

    M: Any
    omega: Any


class Arc(NamedTuple):
    """One step of x' = Ax + p: of length h, from x₀ to x₁, under a polynomial with the coefficients c
    (see `AbstractPropagator`)."""

    h: Any
    x0: Tree
    x1: Tree
    c: tuple[Tree, ...]


class AbstractPropagator(eqx.Module):
    """The exact flow of x' = Ax + p over one length h, with everything costly computed once.

    For the polynomial p(t₀ + θh) = c₀ + c₁θ + … + c_qθ^q,

        x(t₀ + h) = e^{hA}x₀ + h Σⱼ j! φ_{j+1}(hA) cⱼ,

    with φₖ(z) = ∫₀¹ e^{(1−s)z} s^{k−1}/(k−1)! ds, because
    ∫₀^h e^{(h−s)A} (s/h)^j ds = h j! φ_{j+1}(hA).
    """

    @abc.abstractmethod
    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        """x(t₀ + h), for at most as many coefficients as the propagator was made for; with its
        coefficients, where x₀ and all cⱼ have theirs (`dvax.generators.expanded`)."""


class AbstractGenerator(eqx.Module):
    """A linear operator A that generates a strongly continuous semigroup e^{At}."""

    @abc.abstractmethod
    def apply(self, v: Tree) -> Tree:
        """A v."""

    @abc.abstractmethod
    def propagator(self, h: Any, terms: int) -> AbstractPropagator:
        """The flow over h ≥ 0 for polynomials of up to `terms` coefficients."""

    @abc.abstractmethod
    def adjoint(self, space: AbstractSpace) -> "AbstractGenerator":
        """A* with ⟨Av, w⟩ = ⟨v, A*w⟩ in `space`."""

    @abc.abstractmethod
    def growth(self, space: AbstractSpace) -> Growth:
        """M and ω with ‖e^{At}‖ ≤ M e^{ωt} in the norm of `space`, proved from A's structure."""

    @abc.abstractmethod
    def bend(self, arc: Arc, space: AbstractSpace, growth: Growth) -> Tree:
        """A bound, entry by entry, on how far x(t₀ + θh) lies from its chord, the line between x₀ and
        x₁, where p has at most two coefficients, given the `growth` of this generator, or of a product
        that it is a part of, in the norm of `space`."""

    @abc.abstractmethod
    def check(self, space: AbstractSpace) -> None:
        """Raise an `InputError` where A does not act on the elements of `space`."""

    def semigroup(self, h: Any, v: Tree) -> Tree:
        """e^{hA} v."""
        return self.propagator(h, 0).step(v, ())
