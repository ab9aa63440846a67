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


class AbstractPropagator(eqx.Module):
    """e^{hA} and φ₁(hA), …, φ_p(hA) for one h, with everything costly computed once.

    φₖ(z) = ∫₀¹ e^{(1−s)z} s^{k−1}/(k−1)! ds, so φ₀ = exp and z φ_{k+1}(z) = φₖ(z) − 1/k!.
    """

    @abc.abstractmethod
    def exp(self, v: Tree) -> Tree:
        """e^{hA} v."""

    @abc.abstractmethod
    def phi(self, k: int, v: Tree) -> Tree:
        """φₖ(hA) v, for 1 ≤ k ≤ p."""


class AbstractGenerator(eqx.Module):
    """A linear operator A that generates a strongly continuous semigroup e^{At}."""

    @abc.abstractmethod
    def apply(self, v: Tree) -> Tree:
        """A v."""

    @abc.abstractmethod
    def propagator(self, h: Any, order: int) -> AbstractPropagator:
        """e^{hA}, φ₁(hA), …, φ_order(hA) for the step h ≥ 0."""

    @abc.abstractmethod
    def growth(self, space: AbstractSpace) -> Growth:
        """M and ω with ‖e^{At}‖ ≤ M e^{ωt} in the norm of `space`, proved from A's structure."""

    def semigroup(self, h: Any, v: Tree) -> Tree:
        """e^{hA} v."""
        return self.propagator(h, 0).exp(v)
