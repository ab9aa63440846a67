"""A self-test: solve a problem in closed form, C1, the paper's contact law at a point.

α = 1, d_x = ½, d_u = 1, b_x = 2, b_u = 1, β = 1, κ₀ = ½, g = 1, ℓ = 3, x₀ = −1: the point goes from
saturated through active to unloaded, and x(2) is a number in closed form.
"""

import math
from dataclasses import dataclass

END = 2.0
T_ACTIVE = math.log(1.6) / 1.5
T_UNLOADED = T_ACTIVE + 2 * math.log(10 / 9)
# On the last piece x = 2 − 3/2 e^{−3/2 (t − t₂)}.
EXACT = 2 - 1.5 * math.exp(-1.5 * (END - T_UNLOADED))
ALLOWED = 1e-9


@dataclass(frozen=True)
class SelfTest:
    """The computed x(2), its true error, and the time of the solve in seconds."""

    value: float
    error: float
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether the error is what rtol = 1e-10 promises here."""
        return self.error <= ALLOWED


def self_test() -> SelfTest:
    """Solve C1 with adaptive steps at rtol 1e-10. JAX must be in double precision."""
    import time

    import dvax

    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
        h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )
    began = time.perf_counter()
    solution = dvax.solve(problem, -1.0, 0.0, END, rtol=1e-10, atol=1e-12)
    value = float(solution.xs[-1])
    return SelfTest(value, abs(value - EXACT), time.perf_counter() - began)
