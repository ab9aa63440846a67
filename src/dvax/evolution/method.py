"""What an exponential integrator owes: the stage polynomial of a step."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.tree_util as jtu

from .. import _tree
from .._tree import Tree

ONE_SAMPLE = (5**-0.5,)
TWO_SAMPLES = (0.5 - 0.5 * 5**-0.5, 0.5 + 0.5 * 5**-0.5)
"""Where a step is sampled: at irrational places near the middle and at the inner Lobatto points, so
that no step is a multiple of a period of the data at all of its samples and stages."""


class AbstractMethod(eqx.Module):
    """A method that replaces f̃(s, x(s)) on [t₀, t₀+h] by a polynomial p and solves the rest exactly.

    With p(t₀ + θh) = c₀ + c₁θ + … + c_qθ^q the step is

        x_h(t₀ + θh) = e^{θhA}x₀ + h Σⱼ j! θ^{j+1} φ_{j+1}(θhA) cⱼ,

    because ∫₀^{θh} e^{(θh−s)A} (s/h)^j ds = h θ^{j+1} j! φ_{j+1}(θhA). The formula is the dense
    output as well: x_h solves x' = Ax + p exactly, so ‖p − f̃(·, x_h)‖ is the whole defect, of order
    q + 1 where f̃ is smooth along the solution.

    `samples` are the points inside a step where the defect is looked at, apart from those where p was
    made to agree with f̃; the integral of the defect over a step with one kink or one jump of f̃ inside
    is at most `safety` times what they show. `has_half_stage` says that some stage lies half a step
    away. Where `is_rosenbrock`, the method has A + J in the place of A and f̃ − Jx in that of f̃, with
    J = Df̃(t₀, x₀); where `explicit_in_A`, it has 0 and f̃ + Ax there. `pair` numbers two evaluations of
    a measured step at one time, whose differences show the slope of f̃. `quadrature` has the weights
    of the integral of the defect, or None for those that interpolate. Without A, steps are `stable` for
    real hλ ≥ −stable. A method states the last six where they differ from the defaults.

    ```python
    >>> import dvax
    >>> method = dvax.ETD4RK()
    >>> isinstance(method, dvax.evolution.AbstractMethod), method.order, dvax.ETD2RK().order
    (True, 4, 2)

    ```
    """

    order: eqx.AbstractClassVar[int]
    degree: eqx.AbstractClassVar[int]
    samples: eqx.AbstractClassVar[tuple[float, ...]]
    safety: eqx.AbstractClassVar[float]
    has_half_stage: ClassVar[bool] = False
    is_rosenbrock: ClassVar[bool] = False
    explicit_in_A: ClassVar[bool] = False
    pair: ClassVar[tuple[int, int] | None] = None
    quadrature: ClassVar[tuple[float, ...] | None] = None
    stable: ClassVar[float] = 2.0

    @abc.abstractmethod
    def coefficients(
        self,
        evaluate: Callable[[float, Tree], Tree],
        propagate: Callable[[float, tuple[Tree, ...]], Tree],
        first: Tree,
        drift: Tree | None,
    ) -> tuple[Tree, ...]:
        """(c₀, …, c_q) from `first` = f̃(t₀, x₀), where `evaluate(θ, x)` = f̃(t₀ + θh, x) and
        `propagate(θ, c)` = x_h(t₀ + θh) for the polynomial c, written for the whole step; `drift` =
        h ∂ₜf̃(t₀, x₀) where the method linearises."""


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
    samples: ClassVar[tuple[float, ...]] = ONE_SAMPLE
    safety: ClassVar[float] = 1.0

    def coefficients(self, evaluate, propagate, first, drift):
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
    samples: ClassVar[tuple[float, ...]] = ONE_SAMPLE
    safety: ClassVar[float] = 1.12
    pair: ClassVar[tuple[int, int] | None] = (1, -1)

    def coefficients(self, evaluate, propagate, first, drift):
        second = evaluate(1.0, propagate(1.0, (first,)))
        return first, _tree.sub(second, first)


class ETD4RK(AbstractMethod):
    """Cox and Matthews' fourth order method with the stages of Krogstad (2005, ETD4RK-B).

        a  = x_h(½) for p = f₁,                      f₁ = f̃(t₀, x₀)
        b  = x_h(½) for p = f₁ + 4θ(fₐ − f₁),        fₐ = f̃(t₀ + h/2, a)
        d  = x_h(1) for p = f₁ + 2θ(f_b − f₁),       f_b = f̃(t₀ + h/2, b)
        x₁ = x_h(1) for p = f₁ + θ(−3f₁ + 2fₐ + 2f_b − f_d) + 2θ²(f₁ − fₐ − f_b + f_d),

    the parabola through f₁, ½(fₐ + f_b) and f_d = f̃(t₀ + h, d). Order 4 where f̃ is smooth along the
    solution; stiff order 3 (Hochbruck and Ostermann 2005, Section 6), so that for a stiff A whose
    boundary conditions f̃ does not satisfy it falls to between 3 and 4. Its defect is of order 3. A
    step over a kink has local error O(h²) as for any method: order 4 comes back where steps end at
    kinks. Four evaluations.

    ```python
    >>> import dvax
    >>> dvax.ETD4RK().order
    4

    ```
    """

    order: ClassVar[int] = 4
    degree: ClassVar[int] = 2
    samples: ClassVar[tuple[float, ...]] = TWO_SAMPLES
    safety: ClassVar[float] = 1.0
    has_half_stage: ClassVar[bool] = True
    pair: ClassVar[tuple[int, int] | None] = (1, 2)
    quadrature: ClassVar[tuple[float, ...] | None] = (1 / 12, 5 / 12, 5 / 12, 1 / 12)
    stable: ClassVar[float] = 2.7

    def coefficients(self, evaluate, propagate, first, drift):
        a = evaluate(0.5, propagate(0.5, (first,)))
        b = evaluate(0.5, propagate(0.5, (first, combined((-4.0, first), (4.0, a)))))
        d = evaluate(1.0, propagate(1.0, (first, combined((-2.0, first), (2.0, b)))))
        slope = combined((-3.0, first), (2.0, a), (2.0, b), (-1.0, d))
        bend = combined((2.0, first), (-2.0, a), (-2.0, b), (2.0, d))
        return first, slope, bend


class ExpRosenbrock(AbstractMethod):
    """The exponential Rosenbrock method exprb43 (Hochbruck, Ostermann and Schweitzer 2009, eq. 5.5),
    for an f̃ that is itself stiff: a feedback gain of 10⁴, a stiff contact, a fast reaction.

    With J = Df̃(t₀, x₀), v = ∂ₜf̃(t₀, x₀) and g(t, x) = f̃(t, x) − Jx, propagated by A + J,

        a  = x_h(½) for p = g₀ + θhv,                      g₀ = g(t₀, x₀)
        b  = x_h(1) for p = g₀ + θhv + Dₐ,                 Dₐ = g(t₀ + h/2, a) − g₀ − hv/2
        x₁ = x_h(1) for p = g₀ + θhv + θ²(8Dₐ − D_b) + θ³(2D_b − 8Dₐ),  D_b = g(t₀ + h, b) − g₀ − hv,

    the cubic that touches g at the start and meets it at both stages. Order 4 with no condition on
    h‖Df̃‖, where the other methods need it to be of the size of 1; and a system that is affine in
    pieces, in x and in t, is solved exactly from kink to kink. The defect is of order 4. Where h‖Df̃‖
    is large and f̃ depends on t, the order of the error falls, but it is divided by ‖Df̃‖. Three
    evaluations, and a derivative of the law through its implicit function. Where A is a
    number or diagonal and f and the law act point by point, J is
    diagonal; else the matrix of A + J is formed, up to 256 unknowns, and its exponential taken
    twice a step. Steps that end at kinks have their order, as with the other methods.

    ```python
    >>> import dvax
    >>> stiff = dvax.Problem(
    ...     A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 9.0),
    ...     f=lambda t, x, u, args: 1.0 - x + u, h=lambda t, x, u, args: -1e4 * (x - 2.0) - u,
    ... )                              # a spring of 5000 holds x above 2, nearly
    >>> sol = dvax.solve(stiff, 4.0, 0.0, 4.0, method=dvax.ExpRosenbrock())
    >>> print(f"{float(sol.xs[0]):.6f}", bool(sol.stats["steps"] < 100))
    1.999800 True

    ```
    """

    order: ClassVar[int] = 4
    degree: ClassVar[int] = 3
    samples: ClassVar[tuple[float, ...]] = TWO_SAMPLES
    safety: ClassVar[float] = 1.13
    has_half_stage: ClassVar[bool] = True
    is_rosenbrock: ClassVar[bool] = True

    def coefficients(self, evaluate, propagate, first, drift):
        a = evaluate(0.5, propagate(0.5, (first, drift)))
        bend_a = combined((1.0, a), (-1.0, first), (-0.5, drift))
        b = evaluate(1.0, propagate(1.0, (_tree.add(first, bend_a), drift)))
        bend_b = combined((1.0, b), (-1.0, first), (-1.0, drift))
        square = combined((8.0, bend_a), (-1.0, bend_b))
        return first, drift, square, combined((-8.0, bend_a), (2.0, bend_b))


def combined(*terms: tuple[float, Tree]) -> Tree:
    """Σ cᵢ vᵢ."""
    weights, trees = zip(*terms, strict=True)
    one = lambda *leaves: sum(w * v for w, v in zip(weights, leaves, strict=True) if w)  # noqa: E731
    return jtu.tree_map(one, *trees)


def extrapolation(nodes: tuple[float, ...]) -> list[float]:
    """Weights of values at the nodes that add up to how far the last inner one is from what the others
    predict: the parabola's (or the line's) for as many nodes as there are."""
    k = len(nodes) - 2
    others = [j for j in range(len(nodes)) if j != k]
    weights = [1.0] * len(nodes)
    for j in others:
        for i in others:
            if i != j:
                weights[j] *= (nodes[k] - nodes[i]) / (nodes[j] - nodes[i])
        weights[j] *= -1.0
    return weights
