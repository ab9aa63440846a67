"""States along with their coefficients, so that no transform is made twice."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.tree_util as jtu

from .._tree import Tree
from .abstract import AbstractGenerator


class Expanded(NamedTuple):
    """A state, or a part of one, and its coefficients in the eigenfunctions of a generator: what is
    linear in one is so in the other, entry by entry."""

    value: Tree
    coefficients: Tree


class AbstractModal(AbstractGenerator):
    """A generator whose propagators and bends are made of coefficients in eigenfunctions, of some parts
    of a state at least."""

    @abc.abstractmethod
    def expand(self, v: Tree, known: Tree = None) -> Tree:
        """v with those coefficients: the ones that are `known`, or computed."""


def expanded(A: AbstractGenerator, v: Tree, known: Tree = None) -> Tree:
    """v as the propagators of A take it with the least work."""
    return A.expand(v, known) if isinstance(A, AbstractModal) else v


def is_expanded(v: Any) -> bool:
    return isinstance(v, Expanded)


def values(tree: Tree) -> Tree:
    """The states alone."""
    return jtu.tree_map(lambda v: v.value if is_expanded(v) else v, tree, is_leaf=is_expanded)


def coefficients(tree: Tree) -> Tree:
    """The coefficients alone, None where there are none."""
    one = lambda v: v.coefficients if is_expanded(v) else None  # noqa: E731
    return jtu.tree_map(one, tree, is_leaf=is_expanded)


def with_coefficients(v: Tree, known: Tree, forward: Callable[[Tree], Tree]) -> Expanded:
    """v with its coefficients, those `known` where there are such."""
    return Expanded(v, forward(v) if known is None else known)


def coefficients_of(v: Tree, forward: Callable[[Tree], Tree]) -> Tree:
    return v.coefficients if is_expanded(v) else forward(v)


def as_given(v: Tree, total: Tree, backward: Callable[[Tree], Tree]) -> Tree:
    """The state with the coefficients `total`; with them, where v came so."""
    value = backward(total)
    return Expanded(value, total) if is_expanded(v) else value
