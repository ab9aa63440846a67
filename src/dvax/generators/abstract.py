"""The abstract generator, and its propagator over a step of length h."""

import abc
from typing import Any, NamedTuple

import equinox as eqx

from .._tree import Tree
from ..spaces import AbstractSpace


class Growth(NamedTuple):
    """‖e^{At}‖ ≤ M e^{ωt} for all t ≥ 0 (paper, lem:semigroup_bound_prelim)."""

    M: Any
    omega: Any


class FlowStep(NamedTuple):
    """One step of x' = Ax + p, of length h, from x₀ to x₁.

    c holds the coefficients of the polynomial p (see `AbstractPropagator`).
    """

    h: Any
    x0: Tree
    x1: Tree
    c: tuple[Tree, ...]


class AbstractPropagator(eqx.Module):
    """The exact flow of x' = Ax + p over a step of length h, with precomputed φ-functions.

    For the polynomial p(t₀ + θh) = c₀ + c₁θ + … + c_qθ^q,

        x(t₀ + h) = e^{hA}x₀ + h Σⱼ j! φ_{j+1}(hA) cⱼ,

    with φₖ(z) = ∫₀¹ e^{(1−s)z} s^{k−1}/(k−1)! ds, because
    ∫₀^h e^{(h−s)A} (s/h)^j ds = h j! φ_{j+1}(hA).
    """

    @abc.abstractmethod
    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        """Return x(t₀ + h), for at most as many coefficients cⱼ as the propagator was built for.

        If x₀ and all cⱼ are spectral states (`dvax.generators.spectral_state`), so is the result."""


class AbstractGenerator(eqx.Module):
    """A linear operator A that generates a strongly continuous semigroup e^{At}."""

    @abc.abstractmethod
    def apply(self, v: Tree) -> Tree:
        """Return A v."""

    @abc.abstractmethod
    def propagator(self, h: Any, terms: int) -> AbstractPropagator:
        """Return the flow over h ≥ 0 for polynomials with up to `terms` coefficients."""

    @abc.abstractmethod
    def adjoint(self, space: AbstractSpace) -> "AbstractGenerator":
        """Return A* with ⟨Av, w⟩ = ⟨v, A*w⟩ in `space`."""

    @abc.abstractmethod
    def growth(self, space: AbstractSpace) -> Growth:
        """Return M and ω with ‖e^{At}‖ ≤ M e^{ωt} in the norm of `space`, proved from A's structure."""

    @abc.abstractmethod
    def chord_deviation(self, step: FlowStep, space: AbstractSpace, growth: Growth) -> Tree:
        """Return a bound, entry by entry, on |x(t₀ + θh) − (1 − θ)x₀ − θx₁| for 0 ≤ θ ≤ 1.

        The polynomial p has at most two coefficients. `growth` is the growth bound, in the norm of
        `space`, of this generator or of a product that it is a part of."""

    @abc.abstractmethod
    def check(self, space: AbstractSpace) -> None:
        """Raise an `InputError` if A does not act on the elements of `space`."""

    def semigroup(self, h: Any, v: Tree) -> Tree:
        """Return e^{hA} v."""
        return self.propagator(h, 0).step(v, ())
