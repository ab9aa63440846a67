"""What P owes (paper, ass:operators (ii))."""

import abc
from typing import Any, NamedTuple

import equinox as eqx

from .._tree import Tree
from ..spaces import AbstractSpace


class Spectrum(NamedTuple):
    """min and max of the spectrum of P: m‖v‖² ≤ ⟨Pv, v⟩ ≤ norm ‖v‖²."""

    m: Any
    norm: Any

    @property
    def m_P(self) -> Any:
        """Coercivity modulus of P⁻¹: min σ(P⁻¹) = 1/‖P‖."""
        return 1.0 / self.norm

    @property
    def norm_P_inv(self) -> Any:
        """‖P⁻¹‖ = 1/min σ(P)."""
        return 1.0 / self.m


class AbstractOperator(eqx.Module):
    """P: linear, bounded, self-adjoint and coercive, with its inverse."""

    @abc.abstractmethod
    def apply(self, v: Tree) -> Tree:
        """P v."""

    @abc.abstractmethod
    def inverse(self, v: Tree) -> Tree:
        """P⁻¹ v."""

    @abc.abstractmethod
    def check(self, space: AbstractSpace) -> None:
        """Raise an `InputError` where P is not self-adjoint and coercive in `space`."""

    @abc.abstractmethod
    def spectrum(self, space: AbstractSpace) -> Spectrum:
        """The exact ends of the spectrum in the inner product of `space`."""
