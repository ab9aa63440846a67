"""Implicit Runge–Kutta methods of Diffrax, applied to the whole right-hand side Ax + f̃(t, x).

Diffrax is slow to import, so it is imported where a method is constructed.
"""

from typing import TYPE_CHECKING

import equinox as eqx

from ..errors import input_error

if TYPE_CHECKING:
    from diffrax import AbstractSolver


def _kvaerno5() -> "AbstractSolver":
    import diffrax

    return diffrax.Kvaerno5()


class Implicit(eqx.Module):
    """An implicit Runge–Kutta method of Diffrax, by default Kværnø's method of order 5.

    Use it where exponential methods are expensive: f̃ is stiff and couples more unknowns than
    `ExpRosenbrock` accepts, or the exponential of A costs too much.

    The method only applies A. Each step solves equations of the size of the state by the chord
    iteration, by default with a dense matrix, which is feasible up to some thousand unknowns. `rtol`
    and `atol` refer to the error of one step, as in Diffrax. There are no certificates
    (`Solution.defect` is None). Events are not located, so derivatives of a run with events have errors
    of the order of the steps there. Steps are not recorded: list the times in `ts=`. Steps end at the
    knots of data.

    **Arguments:** `solver`: any implicit solver of Diffrax, with its root finder and linear solver. The
    KenCarp methods treat A implicitly and the law explicitly.

    **Raises:** `dvax.InputError` if the solver is not implicit, and if `dvax.solve` gets `dt`,
    `dense=True` or `measure=True` with this method.

    Source: Kværnø, BIT 44 (2004); Diffrax, https://docs.kidger.site/diffrax.

    ```python
    >>> import dvax
    >>> stiff = dvax.Problem(
    ...     A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 9.0),
    ...     f=lambda t, x, u, args: 1.0 - x + u, h=lambda t, x, u, args: -1e4 * (x - 2.0) - u,
    ... )                              # a spring of stiffness 5000 keeps x above 2, nearly
    >>> sol = dvax.solve(stiff, 4.0, 0.0, 4.0, method=dvax.Implicit())
    >>> print(f"{float(sol.xs[0]):.6f}")
    1.999800

    ```
    """

    solver: "AbstractSolver" = eqx.field(default_factory=_kvaerno5)

    def __check_init__(self) -> None:
        import diffrax

        if not isinstance(self.solver, diffrax.AbstractImplicitSolver):
            raise input_error(
                "dvax.Implicit(solver)",
                f"{type(self.solver).__name__}",
                "it must be an implicit solver of Diffrax",
                "Use diffrax.Kvaerno5() (the default), Kvaerno3() or KenCarp4(), for example",
            )
