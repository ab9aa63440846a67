"""The bound on the error of a run, roundoff included."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np

from dvax.app.runs.applications.base import Figure, Variable
from dvax.evolution import Implicit, Solution
from dvax.problem import Problem
from dvax.spaces import AbstractSpace
from dvax.theory import Bound, Constants, bound_error, weakest
from dvax.theory.certificate import continue_bound

_ROUNDOFF_PER_STEP = 16.0
"""Unit roundoffs of the state that a step may add."""


class Certificate(NamedTuple):
    """A bound on ‖x_h − x‖ at every saved time, and what it rests on.

    A piece of a run that goes on needs `bound`, the numbers of `steps` and the largest `size` of a
    state so far."""

    values: np.ndarray
    status: Any
    bound: Bound | None = None
    steps: int = 0
    size: float = 0.0

    @property
    def largest(self) -> float | None:
        """Over all saved times; None where nothing is known."""
        top = float(self.values.max())
        return top if np.isfinite(top) else None

    def figure(self, unit: str, words: str) -> Figure:
        """The largest bound as a headline figure, with the word for how much is known of it."""
        return Figure(self.largest, unit, f"{words} ({self.status})", bound=self.status)

    def variable(self, dimension: str, unit: str, words: str) -> Variable:
        """The bounds at the saved times."""
        return Variable((dimension,), self.values, unit, words, self.status)

    def proved(self, scale: float = 1.0) -> np.ndarray | None:
        """scale · bound at every saved time, where it is proved: what figures are certified to."""
        return scale * self.values if self.status == "proved" else None


def certificate(
    problem: Problem, solution: Solution, constants: Constants, before: Certificate | None = None
) -> Certificate:
    """Return `dvax.bound_error`, plus the roundoff of all steps, which `PiecewiseLinear` does not count
    in its defect and which dominates where a solve is exact; `before`: of the piece whose last state
    the solution starts from.
    """
    if isinstance(solution.setup.method, Implicit):
        # Implicit methods keep no polynomials of their steps, of which a defect could be measured.
        return Certificate(np.full(len(solution.ts), np.nan), "not known")
    steps, largest, status = int(solution.stats["steps"]), 0.0, "proved"
    if before is None or before.bound is None:
        bound = bound_error(problem, solution, constants)
    else:
        bound = continue_bound(problem, solution, constants, before.bound)
        steps, largest, status = steps + before.steps, before.size, before.status
    space = problem.spaces(solution.setup.x0)[0]
    size: Any = _sizes(space, solution.xs)
    eps = np.finfo(jtu.tree_leaves(solution.xs)[0].dtype).eps
    largest = max(largest, float(size.max()))
    lost = _ROUNDOFF_PER_STEP * eps * (1.0 + steps) * largest
    status = weakest(status, bound.status)
    return Certificate(np.asarray(bound.x) + lost, status, bound, steps, largest)


@eqx.filter_jit
def _sizes(space: AbstractSpace, states: Any) -> jax.Array:
    return jax.vmap(space.norm)(states)
