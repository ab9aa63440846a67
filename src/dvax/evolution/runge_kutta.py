"""An explicit Runge–Kutta method for systems that are not stiff."""

from typing import ClassVar

from .method import TWO_SAMPLES, AbstractMethod, combined

_NODES = (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0)
_STAGES = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
)
_WEIGHTS = (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84)
_DENSE_WEIGHTS = (
    -12715105075 / 11282082432,
    0.0,
    87487479700 / 32700410799,
    -10690763975 / 1880347072,
    701980252875 / 199316789632,
    -1453857185 / 822651844,
    69997945 / 29380423,
)
"""The weights dᵢ of k₁, …, k₇ in the term r of the dense output."""
_SAMPLES = (TWO_SAMPLES[0], TWO_SAMPLES[0] ** 0.5, TWO_SAMPLES[1])
"""The defect is close to a multiple of θ(1−θ)(1 − 5(2θ−1)²), whose mean is zero. At its zeros, the
inner Lobatto points, the samples show the part that does not cancel; near the middle its size,
1.7 times the mean of its modulus."""


class DormandPrince(AbstractMethod):
    """The explicit Runge–Kutta method RK5(4)7M of order 5 of Dormand and Prince (1980).

    It treats the whole right-hand side g(t, x) = Ax + f̃(t, x) explicitly. Use it for few unknowns and
    an A that is not stiff.

        kᵢ = g(t₀ + cᵢh, x₀ + h Σⱼ aᵢⱼkⱼ),   x₁ = x₀ + hm,   m = Σ bᵢkᵢ,   k₇ = g(t₀ + h, x₁)
        x_h(t₀ + θh) = x₀ + h (θm + θ(1−θ)(k₁ − m) + θ²(1−θ)(2m − k₁ − k₇) + θ²(1−θ)²r),

    where r = Σ dᵢkᵢ is that of Shampine (Hairer, Nørsett and Wanner 1993, Section II.6). The error of
    the dense output is O(h⁵), and the defect x_h' − Ax_h − f̃ is of order 4. A step takes seven
    evaluations. The order is 5 if f̃ is smooth along the solution, and also if steps end at events.
    The method is stable for real hλ ≥ −3.3 only; the error control then limits the steps, so a stiff A
    costs steps and not accuracy. There are no exponentials, so a new step size has no extra cost.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> sol = dvax.solve(problem, -1.0, 0.0, 2.0, rtol=1e-6, method=dvax.DormandPrince())
    >>> print(f"{float(sol.xs[0]):.5f}", bool(sol.stats["steps"] < 50))
    1.83609 True

    ```
    """

    order: ClassVar[int] = 5
    degree: ClassVar[int] = 3
    samples: ClassVar[tuple[float, ...]] = _SAMPLES
    safety: ClassVar[float] = 1.85
    explicit_in_A: ClassVar[bool] = True
    pair: ClassVar[tuple[int, int] | None] = (5, 6)
    quadrature: ClassVar[tuple[float, ...] | None] = (1 / 12, 5 / 12, 0.0, 5 / 12, 1 / 12)
    stable: ClassVar[float] = 3.3

    def coefficients(self, evaluate, propagate, first, drift):
        sum_of = lambda weights, terms: combined(*zip(weights, terms, strict=False))  # noqa: E731
        k = [first]
        for node, weights in zip(_NODES, _STAGES, strict=True):
            k.append(evaluate(node, propagate(1.0, (sum_of(weights, k),))))
        mean = sum_of(_WEIGHTS, k)
        last = evaluate(1.0, propagate(1.0, (mean,)))
        dense_term = sum_of(_DENSE_WEIGHTS, [*k, last])
        # The coefficients of x_h' in powers of θ.
        back, gap = (1.0, first), combined((2.0, mean), (-1.0, first), (-1.0, last))
        slope = combined((-2.0, first), (2.0, mean), (2.0, gap), (2.0, dense_term))
        return (
            combined(back),
            slope,
            combined((-3.0, gap), (-6.0, dense_term)),
            combined((4.0, dense_term)),
        )
