"""The method by its name."""

from typing import ClassVar

import equinox as eqx


class PiecewiseLinear(eqx.Module):
    """From one switching to the next, for systems that are affine while no constraint changes.

    Where f and h are affine in (x, u) with constant coefficients and K is a box, the system is linear,
    with inputs that depend on t, as long as the same entries of y = P u are at their bounds:

        x' = Ax + By + g(t),    w = My + Cx + q(t),    0 = w on the free entries, y given on the others.

    Each step solves these equations as they stand, by Radau collocation of order 39: no matter how
    stiff, since the free y stay unknowns and no small M is divided by. Polynomials of degree 20 are the
    result, and lightly damped oscillations in closed form beside them. Bounds on both decide where a
    constraint changes; the step ends there, within rounding. So the cost follows from the number of
    changes, of knots and of periods of the inputs, and not from stiffness: after a change each time
    scale that is excited takes a few steps.

    The polynomials may lack 10⁻⁴ of the tolerance that `rtol` and `atol` set, rtol no smaller than
    10⁻⁸; where rounding is larger, a tenth of it. What rounding leaves of a law is not known better by
    shorter steps. Where y or w passes a bound by less than that, the constraint is kept, the amount
    joins the defect, and the run ends with a `dvax.SolveError` where it could move the state by more
    than the tolerance. In `Solution.stats`, `switchings` counts the changes, and `evaluations` the
    solves. The method runs on the host in NumPy, outside of `jax.jit` and without derivatives:
    `dvax.ExpRosenbrock` solves the same systems there.

    **Raises:** `dvax.InputError` where the code of f, h or K does not show the structure, for more than
    64 states or responses, or where `dt` is given; `dvax.DifferentiationError` where values are traced;
    `dvax.SolveError` where a run ends early.

    Source: Hairer and Wanner (1996), Sections IV.5 and VI.1 (Radau IIA; the direct approach); Murty,
    *Linear Complementarity* (1988), Section 4.1 (changes of the active set).

    ```python
    >>> import dvax
    >>> stiff = dvax.Problem(
    ...     A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1e12),
    ...     f=lambda t, x, u, args: 1.0 - x + u, h=lambda t, x, u, args: -1e12 * (x - 2.0) - u,
    ... )                              # a spring of 5·10¹¹ holds x above 2, nearly
    >>> sol = dvax.solve(stiff, 4.0, 0.0, 4.0, method=dvax.PiecewiseLinear())
    >>> print(f"{float(sol.xs[0]):.12f}", int(sol.stats["switchings"]))
    1.999999999998 1

    ```
    """

    order: ClassVar[int] = 39
    degree: ClassVar[int] = 20
    is_rosenbrock: ClassVar[bool] = False
