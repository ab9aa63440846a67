"""The abstract operator P (paper, ass:operators (ii))."""

import abc
from typing import Any, NamedTuple

import equinox as eqx

from .. import _tree
from .._tree import Tree
from ..spaces import AbstractSpace


class Spectrum(NamedTuple):
    """Bounds of the spectrum of P: m‖v‖² ≤ ⟨Pv, v⟩ ≤ norm ‖v‖².

    `exact`: m and norm are the smallest and largest values of the spectrum; else they enclose it.
    `declared`: the caller declared them, without proof.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> P = dvax.operators.Diagonal(jnp.array([1.0, 4.0]))
    >>> spectrum = P.spectrum(dvax.spaces.Euclidean(2))
    >>> float(spectrum.m), float(spectrum.norm), spectrum.exact
    (1.0, 4.0, True)
    >>> float(spectrum.norm_P_inv), float(spectrum.m_P)   # those of P⁻¹
    (1.0, 0.25)

    ```
    """

    m: Any
    norm: Any
    exact: bool = True
    declared: bool = False

    @property
    def m_P(self) -> Any:
        """The coercivity modulus of P⁻¹, min σ(P⁻¹) = 1/‖P‖."""
        return _tree.prepare(lambda norm: 1.0 / norm, self.norm)

    @property
    def norm_P_inv(self) -> Any:
        """‖P⁻¹‖ = 1/min σ(P)."""
        return _tree.prepare(lambda m: 1.0 / m, self.m)


class AbstractOperator(eqx.Module):
    """A linear, bounded, self-adjoint and coercive operator P with its inverse.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> P = dvax.operators.Diagonal(jnp.array([1.0, 4.0]))
    >>> isinstance(P, dvax.operators.AbstractOperator)
    True
    >>> P.inverse(P.apply(jnp.array([3.0, 3.0]))).tolist()
    [3.0, 3.0]
    >>> float(P.spectrum(dvax.spaces.Euclidean(2)).norm)
    4.0

    ```
    """

    @abc.abstractmethod
    def apply(self, v: Tree) -> Tree:
        """Return P v."""

    @abc.abstractmethod
    def inverse(self, v: Tree) -> Tree:
        """Return P⁻¹ v."""

    @abc.abstractmethod
    def check(self, space: AbstractSpace) -> None:
        """Raise an `InputError` if P is not self-adjoint and coercive in `space`."""

    @abc.abstractmethod
    def spectrum(self, space: AbstractSpace) -> Spectrum:
        """Return bounds of the spectrum in the inner product of `space`."""
