"""The abstract generator, and its propagator over a step of length h."""

import abc
from typing import Any, NamedTuple

import equinox as eqx

from .._tree import Tree
from ..spaces import AbstractSpace


class Growth(NamedTuple):
    """‖e^{At}‖ ≤ M e^{ωt} for all t ≥ 0 (paper, lem:semigroup_bound_prelim).

    ```python
    >>> import dvax
    >>> growth = dvax.generators.Scalar(-2.0).growth(dvax.spaces.Euclidean(()))
    >>> float(growth.M), float(growth.omega)
    (1.0, -2.0)

    ```
    """

    M: Any
    omega: Any


class FlowStep(NamedTuple):
    """One step of x' = Ax + p, of length h, from x₀ to x₁.

    c holds the coefficients of the polynomial p (see `AbstractPropagator`).

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> A, space = dvax.generators.Scalar(-2.0), dvax.spaces.Euclidean(())
    >>> p = (jnp.array(4.0),)
    >>> x0, x1 = jnp.array(1.0), A.propagator(0.1, terms=1).step(jnp.array(1.0), p)
    >>> step = dvax.generators.FlowStep(0.1, x0, x1, p)
    >>> far = A.chord_deviation(step, space, A.growth(space))     # from the chord between x0 and x1
    >>> middle = A.propagator(0.05, terms=1).step(x0, p)
    >>> bool(abs(middle - (x0 + x1) / 2) <= far)
    True

    ```
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

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> step = dvax.generators.Scalar(-2.0).propagator(0.5, terms=1)
    >>> isinstance(step, dvax.generators.AbstractPropagator)
    True
    >>> x = step.step(jnp.array(1.0), (jnp.array(4.0),))     # x' = −2x + 4 from 1: 2 − e^{−2t}
    >>> print(f"{float(x):.9f} {float(2 - jnp.exp(-1.0)):.9f}")
    1.632120559 1.632120559

    ```
    """

    @abc.abstractmethod
    def step(self, x0: Tree, c: tuple[Tree, ...]) -> Tree:
        """Return x(t₀ + h), for at most as many coefficients cⱼ as the propagator was built for.

        If x₀ and all cⱼ are spectral states (`dvax.generators.spectral_state`), so is the result."""


class AbstractGenerator(eqx.Module):
    """A linear operator A that generates a strongly continuous semigroup e^{At}.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> A = dvax.generators.Dense(jnp.array([[-1.0, 1.0], [0.0, -2.0]]))
    >>> isinstance(A, dvax.generators.AbstractGenerator)
    True
    >>> A.apply(jnp.array([1.0, 1.0])).tolist()
    [0.0, -2.0]
    >>> growth = A.growth(dvax.spaces.Euclidean(2))
    >>> bool(jnp.linalg.norm(A.semigroup(1.0, jnp.eye(2)[0])) <= growth.M * jnp.exp(growth.omega))
    True

    ```
    """

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
