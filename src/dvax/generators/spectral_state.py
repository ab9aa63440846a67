"""States with their spectral coefficients, so that no transform is computed twice."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.tree_util as jtu

from .._tree import Tree
from .abstract import AbstractGenerator


class SpectralState(NamedTuple):
    """A state, or a part of one, with its coefficients in the eigenfunctions of a generator.

    A linear operation applied to both entries yields the spectral state of the result.
    """

    value: Tree
    coefficients: Tree


class AbstractModal(AbstractGenerator):
    """A generator that is diagonal, or block diagonal, in the eigenfunctions of a transform.

    This applies to at least some parts of a state that is a tuple.
    """

    @abc.abstractmethod
    def expand(self, v: Tree, coefficients: Tree = None) -> Tree:
        """Return v with its spectral coefficients: those given, or computed ones."""


def expand_state(A: AbstractGenerator, v: Tree, coefficients: Tree = None) -> Tree:
    """Return v in the form that the propagators of A process fastest."""
    return A.expand(v, coefficients) if isinstance(A, AbstractModal) else v


def is_spectral(v: Any) -> bool:
    """Return whether v is a spectral state."""
    return isinstance(v, SpectralState)


def values(tree: Tree) -> Tree:
    """Return the tree with every spectral state replaced by its value."""
    return jtu.tree_map(lambda v: v.value if is_spectral(v) else v, tree, is_leaf=is_spectral)


def coefficients(tree: Tree) -> Tree:
    """Return the tree with every spectral state replaced by its coefficients, other leaves by None."""
    return jtu.tree_map(
        lambda v: v.coefficients if is_spectral(v) else None, tree, is_leaf=is_spectral
    )


def with_coefficients(
    v: Tree, coefficients: Tree, forward: Callable[[Tree], Tree]
) -> SpectralState:
    """Return v with the given coefficients, or with `forward(v)` if these are None."""
    return SpectralState(v, forward(v) if coefficients is None else coefficients)


def coefficients_of(v: Tree, forward: Callable[[Tree], Tree]) -> Tree:
    """Return the coefficients of a spectral state, or `forward(v)` for a plain state."""
    return v.coefficients if is_spectral(v) else forward(v)


def in_form_of(v: Tree, coefficients: Tree, backward: Callable[[Tree], Tree]) -> Tree:
    """Return the state with these coefficients, as a spectral state if v is one."""
    value = backward(coefficients)
    return SpectralState(value, coefficients) if is_spectral(v) else value
