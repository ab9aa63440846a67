"""The bound on the error of a run, piece by piece."""

from typing import Any, NamedTuple

import numpy as np

from dvax.app.runs.applications.base import Figure, Variable
from dvax.evolution import Implicit, Solution
from dvax.problem import Problem
from dvax.theory import Bound, Constants, bound_error, weakest
from dvax.theory.along import BoundAlong
from dvax.theory.certificate import continue_bound


class Certificate(NamedTuple):
    """A bound on ‖x_h − x‖ at every saved time, and what it rests on.

    A piece of a run that goes on needs its `bound`. `size` is the largest norm of the computed state at
    the saved times so far, and `why` the reason for which the bound is infinite from some time on."""

    values: np.ndarray
    status: Any
    bound: Bound | None = None
    size: float = 0.0
    why: str = ""

    @property
    def largest(self) -> float | None:
        """Over all saved times; None where nothing is known, which infinity is not."""
        top = float(self.values.max())
        return None if np.isnan(top) else top

    def figure(self, unit: str, words: str) -> Figure:
        """The largest bound as a headline figure, with the word for how much is known of it."""
        top = self.largest
        relative = None if top is None or not 0 < self.size < np.inf else top / self.size
        said = f"{words} ({self.status})"
        return Figure(top, unit, said, bound=self.status, relative=relative, why=self.why)

    def variable(self, dimension: str, unit: str, words: str) -> Variable:
        """The bounds at the saved times."""
        return Variable((dimension,), self.values, unit, words, self.status)

    def proved(self, scale: float = 1.0) -> np.ndarray | None:
        """scale · bound at every saved time, where it is proved: what figures are certified to."""
        return scale * self.values if self.status == "proved" else None


def log_growth(constants: Constants, span: float) -> float:
    """Return the logarithm of the factor by which a bound grows over a time of this length: that of the
    smallest M e^{ct}, where c is a rate of the constants."""
    rates = [(float(constants.M), float(constants.growth_rate))]
    rates += [] if constants.one_sided is None else [(1.0, float(constants.one_sided))]
    rates += [] if constants.energy is None else [tuple(map(float, constants.energy))]
    return min(float(np.log(M)) + max(rate, 0.0) * span for M, rate in rates)


def certificate(
    problem: Problem, solution: Solution, constants: Constants, before: Certificate | None = None
) -> Certificate:
    """Return `dvax.bound_error`; `before`: of the piece whose last state the solution starts from."""
    if isinstance(solution.setup.method, Implicit):
        # Implicit methods keep no polynomials of their steps, of which a defect could be measured.
        return Certificate(np.full(len(solution.ts), np.nan), "not known")
    if before is None or before.bound is None:
        bound, status = bound_error(problem, solution, constants), "proved"
    else:
        bound = continue_bound(problem, solution, constants, before.bound)
        status = before.status
    return Certificate(np.asarray(bound.x), weakest(status, bound.status), bound, why=bound.why)


def along(follower: BoundAlong, solution: Solution, before: Certificate | None) -> Certificate:
    """Return the bound of the next piece, proved along the trajectory."""
    bound = follower.bound(solution)
    status = bound.status if before is None else weakest(before.status, bound.status)
    return Certificate(np.asarray(bound.x), status, None, why=bound.why)
