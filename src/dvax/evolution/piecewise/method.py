"""The method `PiecewiseLinear`: its documentation and its options. `propagate.py` runs it."""

from typing import ClassVar

import equinox as eqx


class PiecewiseLinear(eqx.Module):
    """An event-driven method for systems that are affine while no constraint changes.

    Let f and h be affine in (x, u) with constant coefficients, and K a box. As long as the same entries
    of y = P u are at their bounds, the system is linear, with inputs that depend on t:

        x' = Ax + By + g(t),    w = My + Cx + q(t),    0 = w on the free entries, y given on the others.

    Each step solves these equations by Radau collocation of order 39. The free y remain unknowns, so
    no step divides by a small M, and stiffness does no harm. The result is a polynomial of degree 20
    plus lightly damped oscillations in closed form. Bounds on both locate the change of a constraint,
    and the step ends there, up to roundoff. The cost therefore depends on the number of changes, of
    knots and of periods of the inputs, and not on stiffness: after a change, each excited time scale
    takes a few steps.

    The error of the polynomials is at most 10⁻⁴ of the tolerance that `rtol` and `atol` set, for rtol
    ≥ 10⁻⁸. Where roundoff is larger, it is at most a tenth of the tolerance. Shorter steps do not
    reduce the roundoff of a law. If y or w violates a bound by less than this roundoff, the constraint
    stays unchanged and the violation is added to the defect. The run ends with a `dvax.SolveError` if
    the violation could change the state by more than the tolerance. With `constants=` or `measure=True`
    the defect is enclosed, rounding errors included, so that bounds are proved. In `Solution.stats`,
    `switchings` counts the changes, and `evaluations` the linear solves. The method runs on the host in
    NumPy, outside of `jax.jit` and without derivatives; there, use `dvax.ExpRosenbrock` for the same
    systems.

    **Raises:** `dvax.InputError` if the structure cannot be proved from the code of f, h and K, for
    more than 64 states or responses, or with `dt`; `dvax.DifferentiationError` for traced values;
    `dvax.SolveError` if a run ends early.

    Source: Hairer and Wanner (1996), Sections IV.5 and VI.1 (Radau IIA; the direct approach); Murty,
    *Linear Complementarity* (1988), Section 4.1 (changes of the active set).

    ```python
    >>> import dvax
    >>> stiff = dvax.Problem(
    ...     A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1e12),
    ...     f=lambda t, x, u, args: 1.0 - x + u, h=lambda t, x, u, args: -1e12 * (x - 2.0) - u,
    ... )                              # a spring of stiffness 5·10¹¹ keeps x above 2, nearly
    >>> sol = dvax.solve(stiff, 4.0, 0.0, 4.0, method=dvax.PiecewiseLinear())
    >>> print(f"{float(sol.xs[0]):.12f}", int(sol.stats["switchings"]))
    1.999999999998 1

    ```
    """

    order: ClassVar[int] = 39
    degree: ClassVar[int] = 20
