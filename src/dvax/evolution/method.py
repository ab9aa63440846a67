"""What an exponential integrator owes: the stage polynomial of a step."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx

from .. import _tree
from .._tree import Tree


class AbstractMethod(eqx.Module):
    """A method that replaces f̃(s, x(s)) on [t₀, t₀+h] by a polynomial p and solves the rest exactly.

    With p(t₀ + θh) = c₀ + c₁θ + … + c_qθ^q the step is

        x_h(t₀ + θh) = e^{θhA}x₀ + h Σⱼ j! θ^{j+1} φ_{j+1}(θhA) cⱼ,

    because ∫₀^{θh} e^{(θh−s)A} (s/h)^j ds = h θ^{j+1} j! φ_{j+1}(θhA). The formula is the dense
    output as well: x_h solves x' = Ax + p exactly, so ‖p − f̃(·, x_h)‖ is the whole defect.
    """

    order: eqx.AbstractClassVar[int]
    degree: eqx.AbstractClassVar[int]

    @abc.abstractmethod
    def coefficients(
        self,
        evaluate: Callable[[float, Tree], Tree],
        propagate: Callable[[tuple[Tree, ...]], Tree],
        first: Tree,
    ) -> tuple[Tree, ...]:
        """(c₀, …, c_q) from `first` = f̃(t₀, x₀), where `evaluate(θ, x)` = f̃(t₀ + θh, x) and
        `propagate(c)` = x_h(t₀ + h) for the polynomial c."""


def shortened(c: tuple[Tree, ...], theta: Any) -> tuple[Tree, ...]:
    """The same polynomial over a step of θ times the length: cⱼ becomes θ^j cⱼ."""
    return tuple(
        coefficient if j == 0 else _tree.scale(theta**j, coefficient)
        for j, coefficient in enumerate(c)
    )


def polynomial(c: tuple[Tree, ...], theta: Any) -> Tree:
    """p(t₀ + θh)."""
    value = c[-1]
    for coefficient in c[-2::-1]:
        value = _tree.add(coefficient, _tree.scale(theta, value))
    return value


class ETD1(AbstractMethod):
    """The exponential Euler method: x₁ = e^{hA}x₀ + hφ₁(hA) f̃(t₀, x₀).

    Order 1, with no restriction from a stiff A: the global error is at most C h Lip(f̃(·, x(·)))
    (Hochbruck and Ostermann 2010, Theorem 2.14). One evaluation of the law a step.

    ```python
    >>> import dvax
    >>> dvax.ETD1().order
    1

    ```
    """

    order: ClassVar[int] = 1
    degree: ClassVar[int] = 0

    def coefficients(self, evaluate, propagate, first):
        return (first,)


class ETD2RK(AbstractMethod):
    """Cox and Matthews' second order method (2002, eq. 22), the default.

        a  = e^{hA}x₀ + hφ₁(hA) f̃(t₀, x₀)
        x₁ = a + hφ₂(hA) (f̃(t₀+h, a) − f̃(t₀, x₀))

    Order 2 where f̃ is smooth along the solution, also for stiff A (stiff order 2: Hochbruck and
    Ostermann 2005, Section 5). A step over an isolated kink of f̃ has local error O(h²), so order 2
    survives kinks; moving free boundaries of a field leave it at 2 as observed. Two evaluations.

    ```python
    >>> import dvax
    >>> dvax.ETD2RK().order
    2

    ```
    """

    order: ClassVar[int] = 2
    degree: ClassVar[int] = 1

    def coefficients(self, evaluate, propagate, first):
        second = evaluate(1.0, propagate((first,)))
        return first, _tree.sub(second, first)
